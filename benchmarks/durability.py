"""Is any view lost that was acknowledged? Processes killed at random moments, and eight clients at once.

    python benchmarks/durability.py [--kills 200] [--views 200]

`caryatid session add` and `caryatid serve` are killed; after each kill the session is opened and its graph
compared with that of the same views without any kill. Then clients put load on a service. An `AssertionError`
says that a view was lost, or that a session does not open or is not what its views make it.
"""

from __future__ import annotations

import http.client
import json
import multiprocessing
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import numpy as np
import psutil
import tyro

from caryatid import cli
from caryatid.config import SensorConfig
from caryatid.geometry import transforms
from caryatid.io.graph_json import graph_text, graph_to_json
from caryatid.io.images import png
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.sessions import Session
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.scenes import load_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

from robot_client import RobotClient

SENSOR = SensorConfig(width=160, height=120, focal=131.25)
"""Small images: a view takes a tenth of a second, so that much happens in little time."""

FORKS = multiprocessing.get_context("forkserver")  # processes that have imported everything, begun nothing
FORKS.set_forkserver_preload(["caryatid.sessions.session", "caryatid.cli.sessions", "caryatid.service"])


def start(arguments: Sequence[object], said: Path) -> BaseProcess:
    """Start a command of caryatid in a process of its own, its output to a file."""
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
    """Kill a command; returns its exit status, -9 unless it ended before."""
    process.kill()
    process.join()
    assert process.exitcode is not None
    return process.exitcode


def address_of(said: Path) -> str:
    """Where a service that was just started is."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        try:
            return str(json.loads(said.read_text())["address"])
        except (OSError, ValueError):
            time.sleep(0.005)
    raise RuntimeError(f"the service does not start: {said.read_text()}")


def views_around(scene: str, count: int, seed: int = 0) -> list[View]:
    """Views of a scene from around it, with the noise of a Carmine, and depth in whole millimetres."""
    rng = np.random.default_rng(seed)
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
    """A view as a robot sends it."""
    assert view.labels is not None
    depth, labels = png(np.round(1e3 * view.depth).astype(np.uint16)), png(view.labels.astype(np.uint16))
    return {"depth": depth, "K": view.K.tolist(), "T_world_camera": view.pose.tolist(), "labels": labels}


def graphs_of(views: Sequence[View]) -> list[str]:
    """graph.json after none, one, two … of the views."""
    scene = Scene(segmentation="labels")
    return [graph_text(scene.graph), *(graph_text(scene.update(view)) for view in views)]


def views_in(session: Path, acknowledged: int, graphs: Sequence[str]) -> int:
    """How many views a session has after a kill: those acknowledged, and perhaps one more."""
    with Session.open(session) as opened:
        found = opened.views
        assert 0 <= found - acknowledged <= 1, f"{found} views where {acknowledged} were acknowledged"
        assert graph_text(opened.graph) == graphs[found], "the session is not what its views make it"
    return found


def kill_adding(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `session add` at random moments; every other time once it has begun to write.

    Returns what became of the views: killed before or after they were kept, or not killed in time.
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
        else:
            _wait(session, chance, usual, writing=sum(tally.values()) % 2 == 1)
        status = kill(process)
        found = views_in(session, known, graphs)
        if status == 0:
            usual = 0.7 * usual + 0.3 * (time.monotonic() - begun)
            assert found == known + 1, "a view that was acknowledged is lost"
            assert json.loads((folder / "said").read_text())["view"] == known
            tally["acknowledged"] += 1
        else:
            assert status == -9, (folder / "said").read_text()
            tally["kept" if found > known else "not kept"] += 1
        known = found
        if known == len(views):
            session, known = folder / f"session-{sum(tally.values())}", 0
            Session.begin(session, segmentation="labels").close()
    return tally


def kill_taking(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `session take` at random moments, while it takes one object after the other.

    Returns what became of the reports, as `kill_adding` does of views.
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
        if status == 0:
            usual = 0.7 * usual + 0.3 * (time.monotonic() - at)
            assert found == known + 1, "a report that was acknowledged is lost"
            tally["acknowledged"] += 1
        else:
            assert status == -9, (folder / "said").read_text()
            assert found in (known, known + 1)
            tally["kept" if found > known else "not kept"] += 1
        known = found
    return tally


def _wait(session: Path, chance: random.Random, usual: float, *, writing: bool) -> None:
    """Wait for a random moment of an `add`: of all its time, or of that after it has begun to write."""
    end = time.monotonic() + 1.1 * usual * (1.0 if writing else chance.random())
    while time.monotonic() < end:
        if writing and any((session / "views").glob(".partial-*")):
            time.sleep(chance.uniform(0.0, 0.04))
            return
        time.sleep(0.0005)


def kill_serving(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `serve` while two clients add views to a session each; returns what became of these."""
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


def put_load(
    folder: Path, views: Sequence[View], *, clients: int, sessions: int, options: Sequence[object] = ()
) -> tuple[dict[str, list[int]], list[float], list[float]]:
    """Have clients add views to sessions of a service, each view once, as fast as they can.

    View n goes to session n modulo their number; client n adds every n-th view.

    Returns:
        Of each session which of the views each of its views is; how long each answer took [s]; the memory of
        the service after each answer [MB].
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
            # Otherwise two clients would be after one number, and one would have to ask again.
            with turns[name]:
                robot.add(name, **sent(views[number]))
                orders[name].append(number)
            robot.next(name)
            seconds.append(time.monotonic() - begun)
            memory.append(watched.memory_info().rss / 1e6)

    with ThreadPoolExecutor(clients) as threads:
        list(threads.map(work, range(clients)))
    found = {name: (robot.views(name), robot.graph(name)) for name in names}
    assert service.pid is not None
    os.kill(service.pid, signal.SIGTERM)
    service.join()
    assert service.exitcode == 0, "the service did not stop as it ought to"
    for name, order in orders.items():
        scene = Scene(segmentation="labels")
        for number in order:
            scene.update(views[number])
        assert found[name] == (len(order), graph_to_json(scene.graph)), "a view is lost, or the graph differs"
    return orders, seconds, memory


def main(*, kills: int = 200, seed: int = 0, views: int = 200, clients: int = 8, sessions: int = 4) -> None:
    """Kill and put load, and say what became of the views.

    Args:
        kills: Kills of each of the two.
        seed: Seed of the moments.
        views: Views of the load.
        clients: Clients that put it.
        sessions: Sessions they add to; the service keeps four open.
    """
    around = views_around("clutter", max(12, views))
    for what, kill_some in (("session add", kill_adding), ("serve", kill_serving)):
        begun = time.monotonic()
        with TemporaryDirectory() as folder:
            tally = kill_some(Path(folder), around[:12], kills, seed)
        figures = ", ".join(f"{count} {name}" for name, count in sorted(tally.items()))
        print(f"{what}: {figures}; none lost ({time.monotonic() - begun:.0f} s)", flush=True)
    begun, limit = time.monotonic(), ("--open-sessions", 4)
    with TemporaryDirectory() as folder:
        _, seconds, memory = put_load(
            Path(folder), around[:views], clients=clients, sessions=sessions, options=limit
        )
    seconds.sort()
    print(
        f"{views} views, {clients} clients, {sessions} sessions: none lost, graphs equal, "
        f"{views / (time.monotonic() - begun):.1f} views/s; view and next view "
        f"{seconds[len(seconds) // 2]:.2f} s in the median, at most {seconds[-1]:.2f} s; "
        f"memory {memory[0]:.0f} to {memory[-1]:.0f} MB"
    )


if __name__ == "__main__":
    tyro.cli(main)
