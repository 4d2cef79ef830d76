"""The service: the same sessions over HTTP, within bounds."""

from __future__ import annotations

import asyncio
import base64
import json
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from anyio.from_thread import start_blocking_portal
from conftest import npy, run_command

from caryatid import service
from caryatid.config import Config
from caryatid.config.settings import changed_settings
from caryatid.exports import planning_scene
from caryatid.io.graph_json import graph_to_json
from caryatid.io.images import png
from caryatid.manipulation.order import plan_order
from caryatid.scene import Scene
from caryatid.service import SessionPool, check_token, make_app
from caryatid.sessions import Session

TOKEN = "a-token-nobody-guesses"


def text(content):
    return base64.b64encode(content).decode()


def body(view, **changes):
    """A view as a client sends it."""
    camera = {"K": view.K.tolist(), "T_world_camera": view.pose.tolist()}
    images = {"depth": text(npy(view.depth)), "labels": text(png(view.labels.astype(np.uint16)))}
    return {"camera": camera, **images} | changes


@contextmanager
def serving(folder, *, token=None, open_sessions=2, waiting=8, base="http://127.0.0.1", **more):
    """A client of the application in this process."""
    pool = SessionPool(folder, Config(), open_sessions)
    app = make_app(pool, token=token, max_request=1_000_000, waiting=waiting, **more)
    client = httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=base)

    def ask(method, page, **given):
        return portal.call(partial(client.request, method, page, **given))

    methods = {method: partial(ask, method.upper()) for method in ("get", "post", "delete")}
    with closing(pool), start_blocking_portal() as portal:
        yield SimpleNamespace(request=ask, pool=pool, **methods)


@pytest.fixture
def client(tmp_path):
    """A service with one session `a` that demands labels."""
    with serving(tmp_path) as client:
        client.post("/sessions", json={"name": "a", "segmentation": "labels"})
        yield client


def graph_of(views):
    scene = Scene(segmentation="labels")
    for view in views:
        scene.update(view)
    return graph_to_json(scene.graph)


def test_a_session_over_http_is_the_session(client, views):
    assert client.get("/sessions/a/next").status_code == 409
    answers = [client.post("/sessions/a/views", json=body(view)) for view in views[:2]]
    again = client.post("/sessions/a/views", json=body(views[1], number=1))
    assert (again.status_code, again.json()) == (201, answers[1].json())
    wrong = client.post("/sessions/a/views", json=body(views[2], number=1))
    assert wrong.status_code == 409
    assert "the next view is 2" in wrong.json()["detail"]

    assert client.get("/sessions").json() == {"sessions": ["a"]}
    options = {"segmentation": "labels", "seed": 0, "planner": "support"}
    assert client.get("/sessions/a").json() == {"name": "a", "views": 2, "reports": 0, **options}

    with Session.open(client.pool.folder / "a", read_only=True) as session:
        assert client.get("/sessions/a/next").json() == session.next().to_json()
        scene = session.scene
        rehearsed = {"gripper": {"kind": "parallel", "seen": 0.1}, "rehearsal": {"draws": 20}}
        config = changed_settings(Config(), rehearsed, "")
        page = "/sessions/a/planning_scene?frame=base_link"
        assert client.get(page).json() == planning_scene(scene.graph, "base_link")
        order = plan_order(scene.graph, config, goal="o2", hands=1, voxels=scene.voxels).to_json()
        assert order["steps"][0]["grasp"]["seen_free"] < 1.0
        asked = {"goal": "o2", "settings": rehearsed}
        assert client.post("/sessions/a/order", json=asked).json() == order
        falls = client.get("/sessions/a/effects/o1").json()
        assert falls == [asdict(effect) for effect in scene.predict_removal("o1")]
        why = client.get("/sessions/a/supports/o1/o2").json()
        assert why == {"why": scene.explain("o1", "o2")}
    for page in ("effects/o9", "supports/o1/o9"):
        assert client.get(f"/sessions/a/{page}").status_code == 422
    assert client.post("/sessions/a/order", json={"goal": "o9"}).status_code == 422
    over = {"settings": {"rehearsal": {"draws": 10_000_000}}}
    assert client.post("/sessions/a/order", json=over).status_code == 422

    stretched = {"object": "o1", "T": np.ones((4, 4)).tolist()}
    assert client.post("/sessions/a/reports", json=stretched).status_code == 422
    taken = client.post("/sessions/a/reports", json={"object": "o2"})
    assert (taken.json()["views"], taken.json()["reports"]) == (2, 1)
    left = client.delete("/sessions/a/views/last").json()
    assert left == {"views": 2, "reports": 0, "graph": graph_of(views[:2])}


def test_a_view_with_a_budget_is_open_until_it_is_sent_again(client, views, monkeypatch):
    update, gate = Scene.update, Event()
    monkeypatch.setattr(Scene, "update", lambda scene, view: gate.wait(30.0) and update(scene, view))
    first = client.post("/sessions/a/views", json=body(views[0], budget=0.0))
    assert (first.status_code, first.json()["open"], first.json()["graph"]["objects"]) == (202, True, [])
    for answer in (
        client.post("/sessions/a/views", json=body(views[1])),
        client.post("/sessions/a/reports", json={"object": "o1"}),
        client.delete("/sessions/a/views/last"),
    ):
        assert answer.status_code == 409
        assert "view 0 is still being added; send that view again until it is" in answer.json()["detail"]
    assert client.get("/sessions/a").json()["views"] == 0
    gate.set()
    done = client.post("/sessions/a/views", json=body(views[0]))
    assert (done.status_code, done.json()["open"]) == (201, False)
    assert done.json()["graph"] == graph_of(views[:1])
    assert client.post("/sessions/a/views", json=body(views[1], budget=-1.0)).status_code == 422


def camera_of(view, **changes):
    return {"K": view.K.tolist(), "T_world_camera": view.pose.tolist()} | changes


MIRRORED = np.diag((1, 1, -1, 1)).tolist()
REFUSED = {
    "no camera": (lambda v: body(v, camera=None), 422, "body.camera"),
    "no K": (lambda v: body(v, camera={"T_world_camera": v.pose.tolist()}), 422, "K: Field required"),
    "mirrored": (lambda v: body(v, camera=camera_of(v, T_world_camera=MIRRORED)), 422, "not a rotation"),
    "endless units": (lambda v: body(v, camera=camera_of(v, depth_scale=np.inf)), 422, "depth_scale"),
    "no base64": (lambda v: body(v, depth="£"), 422, "depth: not an image"),
    "half of base64": (lambda v: body(v, depth="abc"), 422, "body.depth"),
    "no labels": (lambda v: body(v, labels=None), 422, "has no labels"),
    "a key too many": (lambda v: body(v, labls="x"), 422, "labls"),
    "half a character": (lambda v: body(v, **{"\ud800": 1}), 422, "body"),
    "too large": (lambda v: body(v, rgb="A" * 2_000_000), 413, "Too Large"),
}
NO_JSON = (
    *(b"", b"{", b"[" * 100_000, b"\xff\xfe", b"null", b"3"),
    *(b'{"seed": 1' + b"0" * 5000 + b"}", b'{"name": NaN}'),
)


def test_what_cannot_be_used_changes_nothing(client, views):
    headers = {"Content-Type": "application/json"}
    for make, status, said in REFUSED.values():
        content = json.dumps(make(views[0])).encode()
        refused = client.post("/sessions/a/views", content=content, headers=headers)
        reason = refused.text if status == 413 else refused.json()["detail"]
        assert (refused.status_code, "\n" in reason) == (status, False)
        assert said in reason
    for content in NO_JSON:
        for page in ("/sessions", "/sessions/a/views", "/sessions/a/next"):
            refused = client.post(page, content=content, headers=headers)
            # An empty object asks for the next view: of a session that has none yet.
            assert refused.status_code in (400, 409, 422)
            assert refused.json()["detail"]
    assert client.get("/sessions/a").json()["views"] == 0
    for method, page in (("GET", ""), ("GET", "/graph"), ("GET", "/next"), ("DELETE", "/views/last")):
        answer = client.request(method, f"/sessions/no{page}")
        assert (answer.status_code, answer.json()["detail"][:20]) == (404, "unknown session 'no'")


LARGE = png(np.zeros((5000, 5000), np.uint8))
NOT_BEGUN = (
    ({"name": "../b"}, 422, "name"),
    ({"name": "b" * 65}, 422, "name"),
    ({"name": "b", "planner": "juggler"}, 422, "unknown planner 'juggler'"),
    ({"name": "b", "settings": {"fit": {"hypotheses": 0}}}, 422, "fit.hypotheses"),
    ({"name": "b", "settings": {"voxels": {"size": 1e-6}}}, 422, "voxels"),
    ({"name": "b", "settings": {"active": {"sphere_points": 10**6}}}, 422, "sphere_points"),
    ({"name": "b", "settings": {"fit": {"hypotheses": 10**20}}}, 422, "fit.hypotheses"),
    ({"name": "b", "settings": {"robot": {"cell": 1e-5}}}, 422, "by more than a factor of ten"),
    ({"name": "b", "settings": {"recording": {"max_pixels": 10**9}}}, 422, "a limit of the service"),
    ({"name": "b", "settings": {"voxels": {"max_voxels": 10**9}}}, 422, "a limit of the service"),
    (
        {"name": "b", "ignore": text(LARGE), "settings": {"recording": {"max_pixels": 10**9}}},
        422,
        "ignore: 5000×5000 pixels exceed the limit of 16000000",
    ),
    ({"name": "b", "seed": -1}, 422, "seed"),
    ({"name": "a"}, 409, "contains a session or other files"),
)


def test_a_session_over_http_ignores_what_its_mask_says(client, views):
    mask = np.zeros(views[0].depth.shape, dtype=np.uint8)
    mask[60:] = 255
    options = {"name": "b", "segmentation": "labels", "ignore": text(png(mask))}
    assert client.post("/sessions", json=options).status_code == 201
    answer = client.post("/sessions/b/views", json=body(views[0]))
    assert answer.json()["graph"] == graph_of([replace(views[0], ignored=mask > 0)]) != graph_of(views[:1])
    broken = client.post("/sessions", json=options | {"name": "c", "ignore": text(b"no image")})
    assert (broken.status_code, broken.json()["detail"].split(":")[0]) == (422, "ignore")


def test_a_session_that_cannot_be_begun_is_not(client, tmp_path, monkeypatch):
    for given, status, said in NOT_BEGUN:
        refused = client.post("/sessions", json=given)
        assert refused.status_code == status
        assert said in refused.json()["detail"]
        assert str(client.pool.folder) not in refused.text
    assert client.get("/sessions").json() == {"sessions": ["a"]}
    monkeypatch.chdir(tmp_path)
    Path("sess").mkdir()
    with serving(Path("sess")) as other:  # its name changes no sentence
        refused = other.post("/sessions", json={"name": "a", "planner": "sessile"})
    assert "unknown planner 'sessile'" in refused.json()["detail"]


@pytest.mark.parametrize("limit", [{"max_sessions": 1}, {"min_free": 1e18}])
def test_a_service_that_is_full_takes_nothing_new(client, limit, views):
    client.post("/sessions/a/views", json=body(views[0]))
    config = client.pool.config
    client.pool.config = replace(config, session=replace(config.session, **limit))
    refused = client.post("/sessions", json={"name": "b"})
    assert refused.status_code == 503
    assert f"session.{next(iter(limit))}" in refused.json()["detail"]
    for page, given in (("views", body(views[1])), ("reports", {"object": "o1"})):
        added = client.post(f"/sessions/a/{page}", json=given)
        assert added.status_code == (503 if "min_free" in limit else 201)


def test_a_session_is_free_for_others_unless_it_is_open(tmp_path, views):
    with serving(tmp_path, open_sessions=1) as client:
        with Session.begin(tmp_path / "b", segmentation="labels") as session:
            answer = client.post("/sessions/b/views", json=body(views[0]))
            assert (answer.status_code, session.views) == (409, 0)
            assert "in use by another process" in answer.json()["detail"]
        client.post("/sessions", json={"name": "c", "segmentation": "labels"})
        for number, view in enumerate(views[:2]):
            for name, other in (("b", "c"), ("c", "b")):
                added = client.post(f"/sessions/{name}/views", json=body(view)).json()
                assert added["graph"] == graph_of(views[: number + 1])
                with Session.open(tmp_path / other):
                    pass  # it was closed to make room


def test_when_too_much_waits_more_is_refused_and_nothing_is_lost(tmp_path, views, monkeypatch):
    gate = threading.Event()
    with serving(tmp_path, waiting=3) as client, ThreadPoolExecutor() as threads:
        client.post("/sessions", json={"name": "a", "segmentation": "labels"})
        monkeypatch.setattr(client.pool, "names", lambda: gate.wait() and [])
        slow = threads.submit(client.get, "/sessions")
        sent = [threads.submit(client.post, "/sessions/a/views", json=body(views[0])) for _ in range(6)]
        while sum(answer.done() for answer in sent) < 4:
            time.sleep(0.01)
        gate.set()
        answers = [answer.result() for answer in sent]
        assert slow.result().status_code == 200
        assert client.get("/sessions/a").json()["views"] == 2
    assert sorted(answer.status_code for answer in answers) == [201] * 2 + [503] * 4
    assert all(a.headers["Retry-After"] for a in answers if a.status_code == 503)


# Who may come


def test_where_there_is_a_token_it_is_demanded(tmp_path):
    others = ("Bearer wrong", f"Basic {TOKEN}", "Bearer é".encode())
    with serving(tmp_path, token=TOKEN, base="http://robot.example") as client:
        for headers in [{}, *({"Authorization": sent} for sent in others)]:
            assert client.post("/sessions", json={"name": "a"}, headers=headers).status_code == 401
            for page in ("/sessions", "/openapi.json", "/docs"):
                assert client.get(page, headers=headers).status_code == 401
            unread = {"Content-Type": "application/json"} | headers
            assert client.post("/sessions", content=b"{", headers=unread).status_code == 401
        assert not (tmp_path / "a").exists()
        right = {"Authorization": f"Bearer {TOKEN}"}
        assert client.post("/sessions", json={"name": "a"}, headers=right).status_code == 201
        page = client.get("/openapi.json", headers=right)
        assert "https://" not in page.text


@pytest.mark.parametrize(
    ("base", "host", "status"),
    [
        ("http://evil.example", "127.0.0.1", 400),
        ("http://localhost:8765", "127.0.0.1", 200),
        ("http://[::1]:8765", "127.0.0.1", 200),
        ("http://127.3.2.1:80", "127.0.0.1", 400),
        ("http://127.3.2.1:80", "127.3.2.1", 200),
    ],
)
def test_without_a_token_pages_of_others_have_no_business_here(tmp_path, base, host, status):
    """A name that somebody else's page has made point here is no name of this machine."""
    with serving(tmp_path, base=base, host=host) as client:
        assert client.get("/sessions").status_code == status


def test_this_machine_needs_no_token_and_every_other_address_demands_one(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("CARYATID_TOKEN", raising=False)
    for host in ("127.0.0.1", "127.3.2.1", "localhost", "::1"):
        check_token(host, None)
    for host in ("0.0.0.0", "::", "192.168.0.7", "robot", "", "localhost.example"):
        check_token(host, TOKEN)
        assert run_command("serve", tmp_path / "s", "--host", host, "--port", 0) == 1
        assert "no token is set; set CARYATID_TOKEN" in capsys.readouterr().err
    assert run_command("serve", tmp_path / "s", "--token", "short") == 1
    assert "has fewer than 16 characters" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_a_port_in_use_ends_in_one_line(tmp_path, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert run_command("serve", tmp_path / "s", "--port", port) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"error: 127.0.0.1:{port}: cannot listen on it (address already in use")
    assert said.count("\n") == 1


def test_a_body_that_does_not_arrive_in_time_is_refused(client, monkeypatch):
    """Each byte comes soon after the one before, the whole does not."""
    monkeypatch.setattr(service, "PATIENCE", 0.5)
    sent = []

    async def trickle():
        for _ in range(100):
            sent.append(b" ")
            yield b" "
            await asyncio.sleep(0.05)

    began = time.monotonic()
    answer = client.post("/sessions", content=trickle(), headers={"content-type": "application/json"})
    assert (answer.status_code, answer.json()["detail"]) == (408, "the request body took longer than 0.5 s")
    assert time.monotonic() - began < 3.0
    assert len(sent) < 50
    assert client.post("/sessions", json={"name": "b"}).status_code == 201


@pytest.mark.slow
def test_half_requests_do_not_keep_others_out(tmp_path):
    command = [sys.executable, "-m", "caryatid", "serve", tmp_path / "s", "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service, ExitStack() as held:
        held.callback(service.kill)
        address = json.loads("".join(iter(service.stdout.readline, "}\n")) + "}")["address"]
        there = urlsplit(address)
        for _ in range(200):
            half = held.enter_context(socket.create_connection((there.hostname, there.port)))
            half.sendall(b"GET /sessions HTTP/1.1\r\nHost:")
        assert httpx.get(f"{address}/sessions").status_code == 200
        service.terminate()
        assert service.wait(30) == 0
