"""Check that no acknowledged data is lost: kill commands at random moments, and put load on a service.

    python benchmarks/durability.py [--only runs load] [--kills 200] [--views 1000] [--clients 50]

`session add`, `session take` and `serve` are killed; after each kill, the session is opened and its graph is
compared with that of the same events without a kill. `explore`, `extract` and `benchmark` are killed
too: their output stays whole, and the next run continues or replaces it and cleans up.
Then clients, some of them hostile, put load on a service. An `AssertionError` says what was lost.
"""

from __future__ import annotations

import http.client
import json
import multiprocessing
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Lock
from typing import Annotated, Any
from urllib.parse import urlsplit

import numpy as np
import psutil
import tyro

from caryatid import cli
from caryatid.benchmark.store import RESULTS, ResultStore
from caryatid.config import SensorConfig
from caryatid.geometry import transforms
from caryatid.io import write_recording
from caryatid.io.graph_json import graph_text, graph_to_json
from caryatid.io.images import png
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.sessions import Session
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.scenes import load_scene
from caryatid.steps import read_run

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

from robot_client import RobotClient

SENSOR = SensorConfig(width=160, height=120, focal=131.25)
"""Small images: a view takes a tenth of a second, so many views fit into a short time."""
SMALL = [f"--set=sensor.{name}={getattr(SENSOR, name)}" for name in ("width", "height", "focal")]

FORKS = multiprocessing.get_context("forkserver")  # its processes have imported everything and run nothing
FORKS.set_forkserver_preload(["caryatid.sessions.session", "caryatid.cli.sessions", "caryatid.service"])


def start(arguments: Sequence[object], said: Path) -> BaseProcess:
    """Start a caryatid command in its own process; its output goes to a file."""
    process = FORKS.Process(target=_run, args=([str(a) for a in arguments], said), daemon=True)
    process.start()
    return process


def _run(arguments: list[str], said: Path) -> None:
    os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
    os.dup2(1, 2)
    status = cli.main(arguments)
    sys.stdout.flush()
    os._exit(status)


def stop(process: BaseProcess, said: Path, seconds: float | None = 0.0) -> bool:
    """Kill a command after this long [s]; None lets it end. Return whether it had ended."""
    process.join(seconds)
    process.kill()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL), said.read_text()
    return process.exitcode == 0


def wait_for_change(look: Callable[[Path], object], place: Path, process: BaseProcess) -> None:
    """Wait until a place looks different, or a command has ended."""
    before = look(place)
    while process.is_alive() and look(place) == before:
        time.sleep(0.0005)


def address_of(said: Path) -> str:
    """Wait for a service that was just started, and return its address."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        try:
            return str(json.loads(said.read_text())["address"])
        except (OSError, ValueError):
            time.sleep(0.005)
    raise RuntimeError(f"the service did not start: {said.read_text()}")


def views_around(scene: str, count: int) -> list[View]:
    """Return views from all around a scene, with the noise of a Carmine and depth rounded to millimetres."""
    rng = np.random.default_rng(0)
    camera = SimulatedCamera(load_scene(scene), "carmine", rng=rng, sensor=SENSOR)
    centre_world = np.array([0.0, 0.0, 0.75])
    found = []
    for azimuth in 2.0 * np.pi * rng.random(count):
        elevation = np.radians(rng.uniform(25.0, 60.0))
        out = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
        view = camera.capture(transforms.look_at(centre_world + 1.2 * out, centre_world))
        depth = np.round(1e3 * view.depth).astype(np.uint16)
        depth_m = (depth.astype(np.float64) * (1.0 / 1000.0)).astype(np.float32)
        found.append(replace(view, depth=depth_m, rgb=None, normals_camera=None))
    return found


def sent(view: View) -> dict[str, Any]:
    """Return a view as a robot sends it."""
    assert view.labels is not None
    depth, labels = png(np.round(1e3 * view.depth).astype(np.uint16)), png(view.labels.astype(np.uint16))
    return {"depth": depth, "K": view.K.tolist(), "T_world_camera": view.pose.tolist(), "labels": labels}


def events_in(session: Path, acknowledged: int, graphs: Sequence[str]) -> int:
    """Check and return how many events a session has after a kill: those acknowledged, at most one more."""
    with Session.open(session) as opened:
        found = opened.views + opened.reports
        assert 0 <= found - acknowledged <= 1, f"{found} events, but {acknowledged} were acknowledged"
        assert graph_text(opened.graph) == graphs[found], "the session differs from one of the same events"
    return found


def kill_session(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `session add` of all views and `session take` of all objects.

    Of three commands, one ends, one is killed at a random moment, and one as soon as it writes.

    Returns the counts of events: killed before or after they were stored, or acknowledged before the kill.
    """
    chance, tally, usual = random.Random(seed), Counter[str](), 1.0
    scene = Scene(segmentation="labels")
    graphs, steps = [graph_text(scene.graph)], list[list[object]]()
    for number, view in enumerate(views):
        files = sent(view)
        files["camera"] = json.dumps({name: files.pop(name) for name in ("K", "T_world_camera")}).encode()
        paths = {name: folder / f"{name}-{number}" for name in files}
        for name, content in files.items():
            paths[name].write_bytes(content)
        steps.append(["add", *(f"--{name}={path}" for name, path in paths.items()), "--number", number])
        graphs.append(graph_text(scene.update(view)))
    for number, o in enumerate(scene.graph.movable):
        steps.append(["take", o.id, "--number", number])
        graphs.append(graph_text(scene.removed(o.id)))
    known, session = len(steps), folder / "session"
    while tally["kept"] + tally["not kept"] < kills:
        if known == len(steps):
            session, known = folder / f"session-{tally.total()}", 0
            Session.begin(session, segmentation="labels").close()
        words = ["session", steps[known][0], session, *steps[known][1:], "--json"]
        begun, process, moment = time.monotonic(), start(words, folder / "said"), None
        if tally.total() % 3 == 1:
            moment = chance.uniform(0.0, 1.1) * usual
        elif tally.total() % 3 == 2:
            wait_for_change(written, session, process)
            moment = chance.uniform(0.0, 0.04)
        ended = stop(process, folder / "said", moment)
        found = events_in(session, known, graphs)
        assert not ended or found == known + 1, "an acknowledged event is lost"
        tally["acknowledged" if ended else "kept" if found > known else "not kept"] += 1
        usual = time.monotonic() - begun if moment is None else usual
        known = found
    return tally


def written(session: Path) -> tuple[set[str], int]:
    """Names of the files of a session, and the size of its log."""
    return {path.name for path in session.rglob("*")}, (session / "session.jsonl").stat().st_size


def kill_serving(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `serve` while two clients each add views to a session; return the counts of the views."""
    chance, tally, scene = random.Random(seed), Counter[str](), Scene(segmentation="labels")
    graphs = [graph_text(scene.graph), *(graph_text(scene.update(view)) for view in views)]
    payloads, kept = [sent(view) for view in views], {"table-0": 0, "table-1": 0}
    for name in kept:
        Session.begin(folder / name, segmentation="labels").close()
    for _ in range(kills):
        (folder / "said").unlink(missing_ok=True)
        process = start(["serve", folder, "--port", 0, "--json"], folder / "said")
        robot, acknowledged = RobotClient(address_of(folder / "said")), dict(kept)

        def add(name: str, robot: RobotClient = robot, acknowledged: dict[str, int] = acknowledged) -> None:
            with suppress(OSError, http.client.HTTPException):  # the service is gone
                while (number := acknowledged[name]) < len(payloads):
                    assert robot.add(name, **payloads[number], number=number)["view"] == number
                    acknowledged[name] = number + 1

        with ThreadPoolExecutor(len(kept)) as threads:
            clients = [threads.submit(add, name) for name in kept]
            wanted = sum(kept.values()) + chance.choice((0, 1, 1, 2, 3))
            while sum(acknowledged.values()) < wanted and not all(client.done() for client in clients):
                time.sleep(0.002)
            time.sleep(chance.uniform(0.0, 0.4))
            process.kill()
            process.join()
            robot.patience = 0.0
        for client in clients:
            client.result()
        tally["kills"] += 1
        for name, sure in acknowledged.items():
            found = events_in(folder / name, sure, graphs)
            tally["acknowledged"] += sure - kept[name]
            tally["kept unsaid"] += found - sure
            kept[name] = found
            if found == len(views):
                del kept[name]
                kept[f"{name}-"] = 0
                Session.begin(folder / f"{name}-", segmentation="labels").close()
    return tally


def kill_runs(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `explore` and `extract` while they replace an older run; every other time as they publish.

    After each kill, a whole run exists or the next command recovers it; no other files remain at the end.
    """
    chance, tally, said = random.Random(seed), Counter[str](), folder / "said"
    write_recording(folder / "recording", views[:2])
    for name, command in (
        ("explore", ["explore", "tower", "--views", 2, *SMALL]),
        ("extract", ["extract", folder / "recording"]),
    ):
        out = folder / name / "run"
        command += ["--out", out, "--quiet", "--seed"]
        for _ in range(2):
            begun = time.monotonic()
            stop(start([*command, 0], said), said, None)
        took = time.monotonic() - begun
        for number in range(1, kills // 2 + 1):
            process, moment = start([*command, number], said), chance.uniform(0.0, 1.1) * took
            if number % 2:
                wait_for_change(staged, out.parent, process)
                moment = chance.uniform(0.0, 0.01)
            ended = stop(process, said, moment)
            tally["ended before" if ended else "killed"] += 1
            tally["recovered"] += not out.exists()
            assert seed_of(out) in range(number + 1)
        stop(start([*command, kills], said), said, None)
        assert os.listdir(out.parent) == ["run"], "other files remain after the next run"
        assert seed_of(out) == kills
    return tally


def staged(place: Path) -> list[Path]:
    """Runs that are whole and about to be published."""
    return list(place.glob(".partial-run-*/run.json"))


def seed_of(folder: Path) -> int:
    """Read a whole run and return its seed."""
    found = read_run(folder)
    assert len(found.views) == len(found.record["steps"])
    assert all(view.load_labels().any() for view in found.views)
    return int(found.record["seed"])


def kill_benchmark(folder: Path, _: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill a benchmark and its workers at random moments; finished episodes are kept, and none runs twice."""
    chance, tally, out, known = random.Random(seed), Counter[str](), folder / "out", 0
    words = ["benchmark", "--suite=smoke", "--scenes=tower", "--planner=random", "--views=2", "--jobs=2"]
    command = [sys.executable, "-m", "caryatid", *words, f"--out={out}", *SMALL, "--quiet"]
    for number in range(1, kills + 1):
        process = subprocess.Popen([*command, f"--seeds={4 * number}"], start_new_session=True)
        time.sleep(chance.uniform(0.5, 6.0))
        tally["killed" if process.poll() is None else "ended before"] += 1
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if (out / RESULTS).exists():
            found = len(ResultStore(out / RESULTS).outcomes)
            assert found >= known, "a finished episode is lost"
            known = found
    subprocess.run([*command, f"--seeds={4 * kills}"], check=True)
    keys = [line["key"] for line in map(json.loads, (out / RESULTS).open()) if "key" in line]
    assert len(keys) == len(set(keys)) == 4 * kills, "an episode is missing or ran twice"
    return tally


@contextmanager
def hostile_clients(address: str, count: int) -> Iterator[Counter[str]]:
    """Have clients send incomplete, invalid and oversized requests, each as soon as the last is answered.

    Yields the counts of the answers: statuses, or `closed`.
    """
    where, stop, tally = urlsplit(address), Event(), Counter[str]()
    head = b"POST /sessions/table-0/views HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
    kinds = (
        b"GET / HT",
        head + b"Content-Length: 100000000000\r\n\r\n{",
        head + b"Content-Length: 50\r\n\r\n{",
        head + b"Content-Length: 7\r\n\r\n[[[[[[[",
        head + b'Content-Length: 14\r\n\r\n{"depth": null}',
        head + b"Transfer-Encoding: chunked\r\n\r\nffffffff\r\n",
        b"GET /sessions/..%2f..%2fetc/graph HTTP/1.1\r\nHost: x\r\n\r\n",
        bytes(range(256)) * 20,
    )

    def send(number: int) -> None:
        chance = random.Random(number)
        while not stop.wait(0.05):
            answer = b""
            with suppress(OSError), socket.create_connection((where.hostname, where.port), 10.0) as client:
                client.sendall(chance.choice(kinds))
                answer = client.recv(64)
            tally[answer[9:12].decode("latin-1") or "closed"] += 1

    with ThreadPoolExecutor(max(1, count)) as threads:
        for number in range(count):
            threads.submit(send, number)
        try:
            yield tally
        finally:
            stop.set()


def put_load(
    folder: Path,
    views: Sequence[View],
    *,
    clients: int,
    sessions: int,
    hostile: int = 0,
    options: Sequence[object] = (),
) -> tuple[dict[str, list[int]], list[float], list[float], Counter[str]]:
    """Have clients add views to sessions of a service, each view once, as fast as they can.

    View n goes to session n modulo the number of sessions; client n modulo the number of clients sends it.

    Returns:
        The indices of each session's views, in its order; the duration of each answer [s]; the memory of the
        service after each answer [MB]; the counts of the answers to hostile clients.
    """
    names = [f"table-{n}" for n in range(sessions)]
    orders: dict[str, list[int]] = {name: [] for name in names}
    seconds: list[float] = []
    memory: list[float] = []
    turns = {name: Lock() for name in names}
    service = start(["serve", folder / "sessions", "--port", 0, "--json", *options], folder / "said")
    robot, watched = RobotClient(address_of(folder / "said"), patience=120.0), psutil.Process(service.pid)
    for name in names:
        robot.begin(name, segmentation="labels")

    def work(client: int) -> None:
        for number in range(client, len(views), clients):
            name, begun = names[number % sessions], time.monotonic()
            # Otherwise two clients would compete for one view number, and one would have to retry.
            with turns[name]:
                robot.add(name, **sent(views[number]))
                orders[name].append(number)
            robot.next(name)
            seconds.append(time.monotonic() - begun)
            memory.append(watched.memory_info().rss / 1e6)

    with hostile_clients(robot.address, hostile) as answers, ThreadPoolExecutor(clients) as threads:
        list(threads.map(work, range(clients)))
    found = {name: (robot.session(name)["views"], robot.graph(name)) for name in names}
    service.terminate()
    service.join()
    assert service.exitcode == 0, "the service did not stop cleanly"
    for name, order in orders.items():
        scene = Scene(segmentation="labels")
        for number in order:
            scene.update(views[number])
        assert found[name] == (len(order), graph_to_json(scene.graph)), "a view is lost, or the graph differs"
    assert not [status for status in answers if status.startswith("5") and status != "503"], answers
    return orders, seconds, memory, answers


KILLS: dict[str, Callable[[Path, Sequence[View], int, int], Counter[str]]] = {
    "session": kill_session,
    "serve": kill_serving,
    "runs": kill_runs,
    "benchmark": kill_benchmark,
}


def main(
    *,
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME…")] = (),
    kills: int = 200,
    seed: int = 0,
    views: int = 1000,
    clients: int = 50,
    hostile: int = 10,
) -> None:
    """Kill commands and put load on a service; check that no acknowledged data is lost.

    Args:
        only: Checks to run: any of session, serve, runs, clear, benchmark, load.
        kills: Number of kills of each kind.
        seed: Seed of the random moments.
        views: Number of views in the load test, which go to eight sessions; four of them are in memory.
        clients: Number of clients that send these views.
        hostile: Number of clients that send invalid requests meanwhile.
    """
    around = views_around("clutter", max(12, views))
    for what, kill_some in KILLS.items():
        if what in (only or KILLS):
            begun = time.monotonic()
            with TemporaryDirectory() as folder:
                tally = kill_some(Path(folder), around[:12], kills, seed)
            figures = ", ".join(f"{count} {name}" for name, count in sorted(tally.items()))
            print(f"{what}: {figures}; nothing lost ({time.monotonic() - begun:.0f} s)", flush=True)
    if only and "load" not in only:
        return
    begun, options = time.monotonic(), ("--open-sessions", 4)
    load: dict[str, Any] = {"clients": clients, "sessions": 8, "hostile": hostile, "options": options}
    with TemporaryDirectory() as folder:
        _, seconds, memory, answers = put_load(Path(folder), around[:views], **load)
    seconds.sort()
    level = [max(memory[k * views // 5 : (k + 1) * views // 5]) for k in range(5)]
    print(
        f"{views} views, {clients} clients, 8 sessions: none lost, graphs equal, "
        f"{views / (time.monotonic() - begun):.1f} views/s; a view and its next view take "
        f"{seconds[len(seconds) // 2]:.2f} s in the median, {seconds[-1]:.2f} s at most; "
        f"peak memory in each fifth of the answers: {', '.join(f'{m:.0f}' for m in level)} MB; "
        f"{hostile} hostile clients got {dict(sorted(answers.items()))}"
    )


if __name__ == "__main__":
    tyro.cli(main)
