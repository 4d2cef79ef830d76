"""Check that no acknowledged data is lost: kill commands at random moments, and put load on a service.

    python benchmarks/durability.py [--only runs load] [--kills 200] [--views 1000] [--clients 50]

`session add`, `session take` and `serve` are killed; after each kill, the session is opened and its graph is
compared with that of the same views without a kill. `explore`, `extract`, `clear`, `benchmark` and the first
compilation are killed too: their output stays whole, and the next run continues or replaces it and cleans up.
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
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Lock, Thread
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


def kill(process: BaseProcess) -> int:
    """Kill a command and return its exit status, -9 unless it ended before."""
    process.kill()
    process.join()
    assert process.exitcode is not None
    return process.exitcode


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


def graphs_of(views: Sequence[View]) -> list[str]:
    """Return graph.json after zero, one, two … of the views."""
    scene = Scene(segmentation="labels")
    return [graph_text(scene.graph), *(graph_text(scene.update(view)) for view in views)]


def views_in(session: Path, acknowledged: int, graphs: Sequence[str]) -> int:
    """Check and return how many views a session has after a kill: those acknowledged, at most one more."""
    with Session.open(session) as opened:
        found = opened.views
        assert 0 <= found - acknowledged <= 1, f"{found} views, but {acknowledged} were acknowledged"
        assert graph_text(opened.graph) == graphs[found], "the session differs from one of the same views"
    return found


def judge(tally: Counter[str], status: int, new: int, said: Path) -> None:
    """Count the outcome of one view or report: acknowledged, or killed before or after it was stored."""
    if status == 0:
        assert new == 1, "an acknowledged view or report is lost"
        tally["acknowledged"] += 1
    else:
        assert status == -9, said.read_text()
        assert new in (0, 1)
        tally["kept" if new else "not kept"] += 1


def kill_adding(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `session add` at random moments; every other time after it has begun to write.

    Returns the counts of views: killed before or after they were stored, or acknowledged before the kill.
    """
    chance, tally, graphs = random.Random(seed), Counter[str](), graphs_of(views)
    words: list[list[str]] = []
    for number, view in enumerate(views):
        files = sent(view)
        files["camera"] = json.dumps({name: files.pop(name) for name in ("K", "T_world_camera")}).encode()
        words.append([])
        for name, content in files.items():
            (folder / f"{name}-{number}").write_bytes(content)
            words[-1].append(f"--{name}={folder / f'{name}-{number}'}")
    session, usual, known = folder / "session-0", 1.0, 0
    Session.begin(session, segmentation="labels").close()
    while tally["kept"] + tally["not kept"] < kills:
        begun = time.monotonic()
        options = [*words[known], "--json", "--number", known]
        process = start(["session", "add", session, *options], folder / "said")
        if tally["acknowledged"] == 0:
            process.join()
        elif sum(tally.values()) % 2 == 1:
            _wait_for(partial(_any, session / "views", ".partial-*"), 1.1 * usual)
            time.sleep(chance.uniform(0.0, 0.04))
        else:
            process.join(1.1 * usual * chance.random())
        status = kill(process)
        found = views_in(session, known, graphs)
        judge(tally, status, found - known, folder / "said")
        if status == 0:
            usual = 0.7 * usual + 0.3 * (time.monotonic() - begun)
            assert json.loads((folder / "said").read_text())["view"] == known
        known = found
        if known == len(views):
            session, known = folder / f"session-{sum(tally.values())}", 0
            Session.begin(session, segmentation="labels").close()
    return tally


def kill_taking(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `session take` at random moments, while it takes one object after another.

    Returns the counts of reports, as `kill_adding` does for views.
    """
    chance, tally, usual = random.Random(seed), Counter[str](), 1.0
    scene = Scene(segmentation="labels")
    for view in views:
        scene.update(view)
    ids = [o.id for o in scene.graph.objects if o.role == "object"]
    graphs = [graph_text(scene.graph), *(graph_text(scene.removed(i)) for i in ids)]
    session, known = folder / "taking", len(ids)
    while tally["kept"] + tally["not kept"] < kills:
        if known == len(ids):
            session, known = folder / f"taking-{sum(tally.values())}", 0
            with Session.begin(session, segmentation="labels") as begun:
                for view in views:
                    begun.add(view)
        at = time.monotonic()
        process = start(["session", "take", session, ids[known], "--json"], folder / "said")
        process.join(None if tally["acknowledged"] == 0 else 1.2 * usual * chance.random())
        status = kill(process)
        with Session.open(session) as opened:
            found = graphs.index(graph_text(opened.graph))
            assert opened.views == len(views)
            assert len(opened.scene.changes) == found
        judge(tally, status, found - known, folder / "said")
        if status == 0:
            usual = 0.7 * usual + 0.3 * (time.monotonic() - at)
        known = found
    return tally


def kill_serving(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `serve` while two clients each add views to a session; return the counts of the views."""
    chance, tally, graphs = random.Random(seed), Counter[str](), graphs_of(views)
    payloads, kept = [sent(view) for view in views], {"table-0": 0, "table-1": 0}
    for name in kept:
        Session.begin(folder / name, segmentation="labels").close()
    for _ in range(kills):
        (folder / "said").unlink(missing_ok=True)
        process = start(["serve", folder, "--port", 0, "--json"], folder / "said")
        robot, acknowledged = RobotClient(address_of(folder / "said")), dict(kept)

        def add(name: str, robot: RobotClient = robot, acknowledged: dict[str, int] = acknowledged) -> None:
            try:
                while (number := acknowledged[name]) < len(payloads):
                    assert robot.add(name, **payloads[number], number=number)["view"] == number
                    acknowledged[name] = number + 1
            except (OSError, http.client.HTTPException):
                return  # the service is gone

        with ThreadPoolExecutor(len(kept)) as threads:
            clients = [threads.submit(add, name) for name in kept]
            wanted = sum(kept.values()) + chance.choice((0, 1, 1, 2, 3))
            while sum(acknowledged.values()) < wanted and not all(client.done() for client in clients):
                time.sleep(0.002)
            time.sleep(chance.uniform(0.0, 0.4))
            kill(process)
            robot.patience = 0.0
        for client in clients:
            client.result()
        tally["kills"] += 1
        for name, sure in acknowledged.items():
            found = views_in(folder / name, sure, graphs)
            tally["acknowledged"] += sure - kept[name]
            tally["kept unsaid"] += found - sure
            kept[name] = found
            if found == len(views):
                del kept[name]
                kept[f"{name}-"] = 0
                Session.begin(folder / f"{name}-", segmentation="labels").close()
    return tally


def kill_runs(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `explore` and `extract` while they replace an older run, half of the time while they publish.

    After each kill, a whole run exists or the next command recovers it; no other files remain at the end.
    """
    chance, tally = random.Random(seed), Counter[str]()
    write_recording(folder / "recording", views[:2])
    took: dict[int, float] = {}
    commands: tuple[list[object], ...] = (
        ["explore", "tower", "--views", 2, *SMALL],
        ["extract", folder / "recording"],
    )
    for number in range(kills):
        run, words = folder / f"runs-{number % 2}" / "run", commands[number % 2]
        words = [*words, "--out", run, "--quiet"]
        if not run.parent.exists():
            _finish([*words, "--seed", 0], folder / "said")
            begun = time.monotonic()
            _finish([*words, "--seed", 0], folder / "said")
            took[number % 2] = time.monotonic() - begun
        process = start([*words, "--seed", number + 1], folder / "said")
        if number % 4 < 2:
            process.join(chance.uniform(0.0, 1.1) * took[number % 2])
        else:
            pattern = f".partial-{run.name}-*/run.json"
            _wait_for(partial(_any, run.parent, pattern), 2.0 * took[number % 2])
            time.sleep(chance.uniform(0.0, 0.01))
        status = kill(process)
        assert status in (0, -9), (folder / "said").read_text()
        tally["ended before" if status == 0 else "killed"] += 1
        if not run.exists():
            tally["recovered"] += 1
            assert cli.main([*map(str, words), "--set=sensor.width=0"]) != 0  # an invalid command
        _check_run(run)
    for number, words in enumerate(commands):
        run = folder / f"runs-{number}" / "run"
        _finish([*words, "--out", run, "--quiet", "--seed", kills + 1], folder / "said")
        assert os.listdir(run.parent) == ["run"], "other files remain after the next run"
        assert _check_run(run) == kills + 1
    return tally


def _any(folder: Path, pattern: str) -> bool:
    return any(folder.glob(pattern))


def _check_run(folder: Path) -> int:
    """Read a whole run and return its seed."""
    run = read_run(folder)
    assert len(run.views) == len(run.record["steps"])
    assert all(view.load_labels().any() for view in run.views)
    return int(run.record["seed"])


def kill_clearing(folder: Path, _: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `clear` at random moments; the same command continues, and ends as it does without a kill."""
    chance, tally = random.Random(seed), Counter[str]()
    words = ["clear", "tower", "--no-report", "--hands", 1, "--quiet", *SMALL, "--out"]
    begun = time.monotonic()
    _finish([*words, folder / "whole"], folder / "said")
    took, whole = time.monotonic() - begun, read_run(folder / "whole")
    run, known = folder / "runs" / "run", 0
    while tally["killed"] < kills:
        process = start([*words, run], folder / "said")
        process.join(chance.uniform(0.0, 0.6) * took)
        status = kill(process)
        assert status in (0, -9), (folder / "said").read_text()
        tally["killed" if status else "ended"] += 1
        found = len(read_run(run).views) if run.exists() else 0
        assert found >= known, "stored views are lost"
        known = found
        if status == 0:
            assert os.listdir(run.parent) == ["run"], "other files remain after the run"
            assert read_run(run).record["lifts"] == whole.record["lifts"], "the lifts differ"
            run, known = folder / f"runs-{tally['ended']}" / "run", 0
    return tally


def kill_benchmark(folder: Path, _: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill a benchmark and its workers at random moments; finished episodes are kept, and none runs twice."""
    chance, tally, out, known = random.Random(seed), Counter[str](), folder / "out", 0
    words = ["benchmark", "--suite=smoke", "--scenes=tower", "--planner=random", "--views=2", "--jobs=2"]
    command = [sys.executable, "-m", "caryatid", *words, f"--out={out}", *SMALL]
    for number in range(kills + 1):
        seeds = f"--seeds={4 * (kills if number == kills else number + 1)}"
        process = subprocess.Popen([*command, seeds, "--quiet"], start_new_session=True)
        if number == kills:
            assert process.wait() == 0
        else:
            time.sleep(chance.uniform(0.5, 6.0))
            tally["killed" if process.poll() is None else "ended before"] += 1
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        if (out / RESULTS).exists():
            with ResultStore(out / RESULTS) as store:
                assert len(store.outcomes) >= known, "a finished episode is lost"
                known = len(store.outcomes)
    keys = [line["key"] for line in map(json.loads, (out / RESULTS).open()) if "key" in line]
    assert len(keys) == len(set(keys)) == 4 * kills, "an episode is missing or ran twice"
    return tally


def kill_compiling(folder: Path, _: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill the first compilation at random moments; no compiler outlives it, and the next run completes."""
    chance, tally = random.Random(seed), Counter[str]()
    code = "from caryatid.simulation.warm_up import warm_up; warm_up()"
    for number in range(kills):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / f"kernels-{number // 5}")}
        process = subprocess.Popen([sys.executable, "-c", code], env=environment)
        time.sleep(chance.uniform(0.5, 15.0))
        tally["killed" if process.poll() is None else "ended before"] += 1
        process.kill()
        process.wait()
        _wait_for(lambda: not _processes_of(str(folder)), 5.0)
        assert not _processes_of(str(folder)), "a compiler outlives its command"
        if number % 5 == 4 or number == kills - 1:
            subprocess.run([sys.executable, "-c", code], env=environment, check=True)
            tally["completed"] += 1
    return tally


def _processes_of(text: str) -> list[int]:
    """Return the processes whose command line contains a text."""
    return [p.pid for p in psutil.process_iter(["cmdline"]) if text in " ".join(p.info["cmdline"] or ())]


def _finish(arguments: Sequence[object], said: Path) -> None:
    """Run a command to its end."""
    process = start(arguments, said)
    process.join()
    assert process.exitcode == 0, said.read_text()


def _wait_for(condition: Callable[[], bool], seconds: float) -> None:
    """Wait until a condition holds, but at most this long [s]."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not condition():
        time.sleep(0.0005)


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
        while not stop.is_set():
            try:
                with socket.create_connection((where.hostname, where.port), 10.0) as open_one:
                    open_one.settimeout(10.0)
                    open_one.sendall(chance.choice(kinds))
                    answer = open_one.recv(64)
                tally[answer[9:12].decode("latin-1") or "closed"] += 1
            except OSError:
                tally["closed"] += 1
            stop.wait(0.05)

    threads = [Thread(target=send, args=(number,), daemon=True) for number in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield tally
    finally:
        stop.set()
        for thread in threads:
            thread.join(20.0)


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
    assert service.pid is not None
    os.kill(service.pid, signal.SIGTERM)
    service.join()
    assert service.exitcode == 0, "the service did not stop cleanly"
    for name, order in orders.items():
        scene = Scene(segmentation="labels")
        for number in order:
            scene.update(views[number])
        assert found[name] == (len(order), graph_to_json(scene.graph)), "a view is lost, or the graph differs"
    assert not [status for status in answers if status.startswith("5") and status != "503"], answers
    return orders, seconds, memory, answers


KILLS: dict[str, tuple[Callable[[Path, Sequence[View], int, int], Counter[str]], int]] = {
    "add": (kill_adding, 1),
    "take": (kill_taking, 1),
    "serve": (kill_serving, 1),
    "runs": (kill_runs, 2),
    "clear": (kill_clearing, 4),
    "benchmark": (kill_benchmark, 4),
    "compile": (kill_compiling, 10),
}
"""Name → what to kill, and the divisor of the number of kills for commands that take long."""


def main(
    *,
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME…")] = (),
    kills: int = 200,
    seed: int = 0,
    views: int = 1000,
    clients: int = 50,
    hostile: int = 10,
    sessions: int = 8,
) -> None:
    """Kill commands and put load on a service; check that no acknowledged data is lost.

    Args:
        only: Checks to run: any of add, take, serve, runs, clear, benchmark, compile, load.
        kills: Number of kills for `add`, `take` and `serve` each; half as many for `runs`, a quarter for
            `clear` and `benchmark`, a tenth for `compile`.
        seed: Seed of the random moments.
        views: Number of views in the load test.
        clients: Number of clients that send these views.
        hostile: Number of clients that send invalid requests meanwhile.
        sessions: Number of sessions the views go to; the service keeps four of them open.
    """
    around = views_around("clutter", max(12, views))
    for what, (kill_some, divisor) in KILLS.items():
        if only and what not in only:
            continue
        begun = time.monotonic()
        with TemporaryDirectory() as folder:
            tally = kill_some(Path(folder), around[:12], kills // divisor, seed)
        figures = ", ".join(f"{count} {name}" for name, count in sorted(tally.items()))
        print(f"{what}: {figures}; nothing lost ({time.monotonic() - begun:.0f} s)", flush=True)
    if only and "load" not in only:
        return
    begun = time.monotonic()
    load: dict[str, Any] = {"clients": clients, "sessions": sessions, "hostile": hostile}
    with TemporaryDirectory() as folder:
        options = ("--open-sessions", 4)
        _, seconds, memory, answers = put_load(Path(folder), around[:views], options=options, **load)
    seconds.sort()
    level = [max(memory[k * views // 5 : (k + 1) * views // 5]) for k in range(5)]
    print(
        f"{views} views, {clients} clients, {sessions} sessions: none lost, graphs equal, "
        f"{views / (time.monotonic() - begun):.1f} views/s; a view and its next view take "
        f"{seconds[len(seconds) // 2]:.2f} s in the median, {seconds[-1]:.2f} s at most; "
        f"peak memory in each fifth of the answers: {', '.join(f'{m:.0f}' for m in level)} MB; "
        f"{hostile} hostile clients got {dict(sorted(answers.items()))}"
    )


if __name__ == "__main__":
    tyro.cli(main)
