"""The service: the same sessions over HTTP, within bounds."""

from __future__ import annotations

import asyncio
import base64
import json
import sys
import threading
from contextlib import asynccontextmanager

import httpx
import numpy as np
import pytest
from conftest import npy, run_command

from caryatid.config import Config
from caryatid.io.graph_json import graph_to_json
from caryatid.io.images import png
from caryatid.scene import Scene
from caryatid.service.app import make_app
from caryatid.service.pool import SessionPool
from caryatid.service.serving import check_token
from caryatid.sessions import Session

TOKEN = "a-token-nobody-guesses"


def text(content):
    return base64.b64encode(content).decode()


def body(view, **changes):
    """A view as a client sends it."""
    camera = {"K": view.K.tolist(), "T_world_camera": view.pose.tolist()}
    images = {"depth": text(npy(view.depth)), "labels": text(png(view.labels.astype(np.uint16)))}
    return {"camera": camera, **images} | changes


@asynccontextmanager
async def serving(
    folder, *, token=None, max_request=1_000_000, open_sessions=2, waiting=8, base=None, **more
):
    """A client of the application in this process."""
    pool = SessionPool(folder, Config(), open_sessions, waiting)
    app = make_app(pool, token=token, max_request=max_request, **more)
    transport = httpx.ASGITransport(app=app)
    client = httpx.AsyncClient(transport=transport, base_url=base or "http://127.0.0.1")
    client.pool = pool
    async with app.router.lifespan_context(app), client:
        yield client


def served(talk, folder, **options):
    """Have a conversation with a service."""

    async def run():
        async with serving(folder, **options) as client:
            return await talk(client)

    return asyncio.run(run())


def graph_of(views, **options):
    scene = Scene(**({"segmentation": "labels"} | options))
    for view in views:
        scene.update(view)
    return graph_to_json(scene.graph)


@pytest.fixture(scope="module")
def asked(tmp_path_factory, views):
    """What a service answers to a whole session: begun, two views, next, one taken back."""

    async def talk(client):
        answers = {}
        answers["begin"] = await client.post("/sessions", json={"name": "table", "segmentation": "labels"})
        answers["early"] = await client.get("/sessions/table/next")
        for number in (0, 1):
            answers[number] = await client.post("/sessions/table/views", json=body(views[number]))
        answers["again"] = await client.post("/sessions/table/views", json=body(views[1], number=1))
        answers["wrong"] = await client.post("/sessions/table/views", json=body(views[2], number=1))
        answers["graph"] = await client.get("/sessions/table/graph")
        answers["next"] = await client.get("/sessions/table/next")
        reach = {"T_world_camera": [v.pose.tolist() for v in views], "path_length": [0.0, 9.0, 9.0]}
        answers["reach"] = await client.post("/sessions/table/next", json=reach)
        answers["told"] = await client.get("/sessions/table")
        answers["list"] = await client.get("/sessions")
        answers["undo"] = await client.delete("/sessions/table/views/last")
        answers["undo more"] = await client.delete("/sessions/table/views/last")
        answers["undo all"] = await client.delete("/sessions/table/views/last")
        answers["page"] = await client.get("/docs")
        answers["schema"] = await client.get("/openapi.json")
        return answers

    return served(talk, tmp_path_factory.mktemp("service"))


def test_a_session_over_http_is_the_session(asked, views):
    assert asked["begin"].status_code == 201
    assert asked["begin"].json()["views"] == 0
    for number in (0, 1):
        assert asked[number].status_code == 201
        assert asked[number].json()["view"] == number
        assert asked[number].json()["graph"] == graph_of(views[: number + 1])
    assert asked["graph"].json() == graph_of(views[:2])
    assert asked["told"].json()["views"] == 2
    assert asked["list"].json() == {"sessions": ["table"]}


def test_the_next_view_says_where_and_why(asked):
    told = asked["next"].json()
    assert told["view"] == 2
    assert np.array(told["T_world_camera"]).shape == (4, 4)
    assert len(told["platform"]) == 3
    assert told["why"]
    assert asked["reach"].json()["candidate"] in (0, 1, 2)
    assert asked["reach"].json()["platform"] is None


def test_a_view_is_not_added_twice(asked):
    assert asked["again"].status_code == 201
    assert asked["again"].json() == asked[1].json()
    assert asked["wrong"].status_code == 409
    assert "the next one is view 2" in asked["wrong"].json()["detail"]


def test_views_are_taken_back(asked, views):
    assert asked["undo"].json() == {"views": 1, "graph": graph_of(views[:1])}
    assert asked["undo more"].json()["views"] == 0
    assert asked["undo all"].status_code == 409


def test_there_is_an_openapi_page(asked):
    assert asked["page"].status_code == 200
    assert set(asked["schema"].json()["paths"]) == {
        "/sessions",
        "/sessions/{name}",
        "/sessions/{name}/views",
        "/sessions/{name}/views/last",
        "/sessions/{name}/graph",
        "/sessions/{name}/next",
    }


def without(document, key):
    return {k: v for k, v in document.items() if k != key}


REFUSED = {
    "no camera": (lambda v: without(body(v), "camera"), 422, "camera: Field required"),
    "no pose": (lambda v: body(v, camera={"K": v.K.tolist()}), 422, "T_world_camera: Field required"),
    "no matrix": (lambda v: body(v, camera={"K": [[1]], "T_world_camera": v.pose.tolist()}), 422, "camera.K"),
    "mirrored": (
        lambda v: body(v, camera={"K": v.K.tolist(), "T_world_camera": np.diag((1, 1, -1, 1)).tolist()}),
        422,
        "no rotation",
    ),
    "no base64": (lambda v: body(v, depth="£"), 422, "depth: is no base64"),
    "no image": (lambda v: body(v, depth=text(b"hello")), 422, "is no image"),
    "no labels": (lambda v: without(body(v), "labels"), 422, "has no labels"),
    "another size": (lambda v: body(v, labels=text(png(np.ones((9, 9), np.uint16)))), 422, "labels is 9×9"),
    "a key too many": (lambda v: body(v, labls="x"), 422, "labls"),
    "half a character": (lambda v: body(v, **{"\ud800": 1}), 422, "body"),
    "too large": (lambda v: body(v, rgb="A" * 2_000_000), 413, "Too Large"),
}


NO_JSON = (
    b"", b"{", b"[" * 100_000, b"\xff\xfe", b"null", b"3", b'{"seed": 1' + b"0" * 5000 + b"}",
    b'{"name": NaN}',
)  # fmt: skip


def test_what_cannot_be_used_changes_nothing(tmp_path, views):
    async def talk(client):
        await client.post("/sessions", json={"name": "a", "segmentation": "labels"})
        headers = {"Content-Type": "application/json"}
        for make, status, said in REFUSED.values():
            content = json.dumps(make(views[0])).encode()
            refused = await client.post("/sessions/a/views", content=content, headers=headers)
            reason = refused.text if status == 413 else refused.json()["detail"]
            assert (refused.status_code, "\n" in reason) == (status, False)
            assert said in reason
        for content in NO_JSON:
            for page in ("/sessions", "/sessions/a/views", "/sessions/a/next"):
                refused = await client.post(page, content=content, headers=headers)
                assert refused.status_code in (400, 422)
                assert refused.json()["detail"]
        return (await client.get("/sessions/a")).json()

    assert served(talk, tmp_path)["views"] == 0


NOT_BEGUN = (
    ({"name": "../a"}, 422, "name"),
    ({"name": "a" * 65}, 422, "name"),
    ({"name": "a", "planner": "juggler"}, 422, "no planner 'juggler'"),
    ({"name": "a", "settings": {"fit": {"hypotheses": 0}}}, 422, "fit.hypotheses"),
    ({"name": "a", "settings": {"voxels": {"size": 1e-6}}}, 422, "voxels"),
    ({"name": "a", "settings": {"active": {"sphere_points": 10**9}}}, 422, "sphere_points"),
    ({"name": "a", "seed": -1}, 422, "seed"),
    ({"name": "there"}, 409, "holds a session already"),
)


def test_a_session_that_cannot_be_begun_is_not(tmp_path):
    async def talk(client):
        await client.post("/sessions", json={"name": "there"})
        for given, status, said in NOT_BEGUN:
            refused = await client.post("/sessions", json=given)
            assert refused.status_code == status
            assert said in refused.json()["detail"]
        return await client.get("/sessions")

    assert served(talk, tmp_path).json() == {"sessions": ["there"]}


def test_what_is_not_there_is_said(tmp_path):
    async def talk(client):
        asked = [
            client.get("/sessions/no"),
            client.get("/sessions/no/graph"),
            client.get("/sessions/no/next"),
        ]
        return [await one for one in [*asked, client.delete("/sessions/no/views/last")]]

    for answer in served(talk, tmp_path):
        assert answer.status_code == 404
        assert "no session 'no'" in answer.json()["detail"]


def test_a_session_that_another_process_writes_is_busy(tmp_path, views):
    async def talk(client):
        return await client.post("/sessions/a/views", json=body(views[0]))

    with Session.begin(tmp_path / "a") as session:
        answer = served(talk, tmp_path)
        assert answer.status_code == 409
        assert "another writer" in answer.json()["detail"]
        assert session.views == 0
    assert served(talk, tmp_path).status_code == 201


@pytest.mark.slow
def test_sessions_that_are_closed_for_want_of_room_are_the_same_afterwards(tmp_path, views):
    names = ["a", "b", "c"]

    async def talk(client):
        for name in names:
            await client.post("/sessions", json={"name": name, "segmentation": "labels"})
        graphs = []
        for view in views:
            for name in names:
                answer = await client.post(f"/sessions/{name}/views", json=body(view))
                graphs.append(answer.json()["graph"])
                assert len(client.pool._open) <= 1
        return graphs

    graphs = served(talk, tmp_path, open_sessions=1)
    assert graphs == [graph_of(views[: n + 1]) for n in range(len(views)) for _ in names]


def test_when_too_much_waits_more_is_refused_and_nothing_is_lost(tmp_path, views):
    async def talk(client):
        await client.post("/sessions", json={"name": "a", "segmentation": "labels"})
        gate = threading.Event()
        blocked = asyncio.ensure_future(client.pool.do(gate.wait))
        await asyncio.sleep(0)
        sent = [client.post("/sessions/a/views", json=body(views[0])) for _ in range(6)]
        tasks = [asyncio.ensure_future(one) for one in sent]
        while sum(task.done() for task in tasks) < 4:
            await asyncio.sleep(0.01)
        gate.set()
        answers = [await task for task in tasks]
        await blocked
        return answers, (await client.get("/sessions/a")).json()

    answers, told = served(talk, tmp_path, waiting=3)
    codes = [answer.status_code for answer in answers]
    assert sorted(codes) == [201] * 2 + [503] * 4
    assert all(a.headers["Retry-After"] for a in answers if a.status_code == 503)
    assert told["views"] == 2


def test_stopping_finishes_what_was_asked(tmp_path, views):
    """A request that waits when the service stops is answered."""

    async def run():
        async with serving(tmp_path) as client:
            await client.post("/sessions", json={"name": "a", "segmentation": "labels"})
            task = asyncio.ensure_future(client.post("/sessions/a/views", json=body(views[0])))
            await asyncio.sleep(0.05)
        return await task

    assert asyncio.run(run()).status_code == 201
    with Session.open(tmp_path / "a") as session:
        assert session.views == 1


# Who may come


def test_where_there_is_a_token_it_is_demanded(tmp_path):
    others = ("Bearer wrong", f"Basic {TOKEN}", "Bearer é".encode())
    wrong = [{}, *({"Authorization": sent} for sent in others)]

    async def talk(client):
        for headers in wrong:
            assert (await client.post("/sessions", json={"name": "a"}, headers=headers)).status_code == 401
            assert (await client.get("/sessions", headers=headers)).status_code == 401
        assert not (tmp_path / "a").exists()
        right = {"Authorization": f"Bearer {TOKEN}"}
        assert (await client.post("/sessions", json={"name": "a"}, headers=right)).status_code == 201
        assert (await client.get("/sessions", headers=right)).status_code == 200

    served(talk, tmp_path, token=TOKEN, base="http://robot.example")


def test_without_a_token_pages_of_others_have_no_business_here(tmp_path):
    """A name that somebody else's page has made point here is no name of this machine."""

    async def talk(client):
        return await client.get("/sessions")

    assert served(talk, tmp_path, base="http://evil.example").status_code == 400
    for base in ("http://localhost:8765", "http://[::1]:8765"):
        assert served(talk, tmp_path, base=base).status_code == 200
    assert served(talk, tmp_path, base="http://127.3.2.1:80").status_code == 400
    assert served(talk, tmp_path, base="http://127.3.2.1:80", host="127.3.2.1").status_code == 200


def test_this_machine_needs_no_token_and_every_other_address_demands_one(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("CARYATID_TOKEN", raising=False)
    for host in ("127.0.0.1", "127.3.2.1", "localhost", "::1"):
        check_token(host, None)
    for host in ("0.0.0.0", "::", "192.168.0.7", "robot", "", "localhost.example"):
        check_token(host, TOKEN)
        assert run_command("serve", tmp_path / "s", "--host", host, "--port", 0) == 1
        said = capsys.readouterr().err
        assert "there is no token; set CARYATID_TOKEN" in said
    assert run_command("serve", tmp_path / "s", "--token", "short") == 1
    assert "has fewer than 16 characters" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_without_the_extra_one_sentence_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.delitem(sys.modules, "caryatid.service.serving")
    assert run_command("serve", tmp_path / "s") == 1
    said = capsys.readouterr().err
    assert said == 'error: serve: needs uvicorn; pip install "caryatid[serve]"\n'
