"""Is any view lost that was acknowledged? Processes killed at random moments, and eight clients at once.

    python benchmarks/durability.py [--kills 200] [--views 200]

`caryatid session add` and `caryatid serve` are killed; after each kill the session is opened and its graph
compared with that of the same views without any kill. Then clients put load on a service.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

import numpy as np
import psutil

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

FORKING = """
import os, sys, json
import caryatid.cli, caryatid.cli.sessions, caryatid.service.serving
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        command = json.loads(line)
        sys.stdin.close()
        os.dup2(os.open(command["out"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
        os.dup2(1, 2)
        status = 1
        try:
            status = caryatid.cli.main(command["arguments"])
        finally:
            sys.stdout.flush()
            os._exit(status)
    print(child, flush=True)
    ended = os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    print(ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status, flush=True)
    sys.stdin.readline()
    os.waitpid(child, 0)
"""
"""Runs commands in processes that have imported everything and begun nothing.

Their numbers stay theirs until this side has heard how they ended, so that no other process is killed.
"""


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


def depth_png(view: View) -> bytes:
    """Depth as a robot sends it."""
    return png(np.round(1e3 * view.depth).astype(np.uint16))


def labels_png(view: View) -> bytes:
    """Labels as a robot sends them."""
    if view.labels is None:
        raise ValueError("the simulated camera labels what it sees")
    return png(view.labels.astype(np.uint16))


def graphs_of(views: Sequence[View]) -> list[str]:
    """graph.json after none, one, two … of the views."""
    scene = Scene(segmentation="labels")
    texts = [graph_text(scene.graph)]
    for view in views:
        texts.append(graph_text(scene.update(view)))
    return texts


def write_files(folder: Path, views: Sequence[View]) -> None:
    """Write depth-N.png, labels-N.png and camera-N.json of each view."""
    for number, view in enumerate(views):
        (folder / f"depth-{number}.png").write_bytes(depth_png(view))
        (folder / f"labels-{number}.png").write_bytes(labels_png(view))
        camera = {"K": view.K.tolist(), "T_world_camera": view.pose.tolist()}
        (folder / f"camera-{number}.json").write_text(json.dumps(camera))


class Starter:
    """Starts commands of caryatid in processes that have everything imported, one at a time."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", FORKING], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._to: IO[str] = self._process.stdin
        self._from: IO[str] = self._process.stdout

    def start(self, arguments: Sequence[object], out: Path) -> int:
        """Start a command, its output to a file; returns its process id."""
        print(
            json.dumps({"arguments": [str(a) for a in arguments], "out": str(out)}), file=self._to, flush=True
        )
        return int(self._from.readline())

    def end(self) -> int:
        """Wait for the command; returns its exit status, negative where a signal ended it."""
        status = int(self._from.readline())
        print(file=self._to, flush=True)
        return status

    def kill(self, process: int) -> int:
        """Kill a command that was started and not waited for; returns its exit status as `end`."""
        os.kill(process, signal.SIGKILL)
        return self.end()

    def close(self) -> None:
        """End it."""
        self._process.communicate()


def kill_adding(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `session add` at random moments; every other time once it has begun to write.

    Returns what became of the views: killed before or after they were kept, or not killed in time.

    Raises:
        AssertionError: A view was lost, or a session does not open, or is not what its views make it.
    """
    chance, tally, graphs = random.Random(seed), Counter[str](), graphs_of(views)
    write_files(folder, views)
    starter, session, usual = Starter(), folder / "session-0", 1.0
    Session.begin(session, segmentation="labels").close()
    known = 0
    while tally["kept"] + tally["not kept"] < kills:
        arguments: list[object] = ["session", "add", session, "--depth", folder / f"depth-{known}.png"]
        arguments += ["--camera", folder / f"camera-{known}.json", "--json"]
        arguments += ["--labels", folder / f"labels-{known}.png", "--number", known]
        begun = time.monotonic()
        process = starter.start(arguments, folder / "said")
        if tally["acknowledged"] == 0:
            status = starter.end()
        else:
            _wait(session, chance, usual, writing=sum(tally.values()) % 2 == 1)
            status = starter.kill(process)
        with Session.open(session, read_only=True) as opened:
            found = opened.views
            assert found in (known, known + 1), f"{found} views where {known} were acknowledged"
            assert graph_text(opened.graph) == graphs[found], "the session is not what its views make it"
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
            session = folder / f"session-{sum(tally.values())}"
            Session.begin(session, segmentation="labels").close()
            known = 0
    starter.close()
    return tally


def kill_serving(
    folder: Path, views: Sequence[View], kills: int, seed: int, clients: int = 2
) -> Counter[str]:
    """Kill `serve` while clients add views to a session each.

    Returns how many views were acknowledged, and kept without that.

    Raises:
        AssertionError: A view was lost, or a session does not open, or is not what its views make it.
    """
    chance, tally, graphs, starter = random.Random(seed), Counter[str](), graphs_of(views), Starter()
    kept = {f"table-{n}": 0 for n in range(clients)}
    for name in kept:
        Session.begin(folder / name, segmentation="labels").close()
    faults: list[Exception] = []
    sent = [(depth_png(v), v.K.tolist(), v.pose.tolist(), labels_png(v)) for v in views]
    for _ in range(kills):
        (folder / "said").unlink(missing_ok=True)
        process = starter.start(["serve", folder, "--port", 0, "--json"], folder / "said")
        address = address_of(folder / "said")
        acknowledged, robot = dict(kept), RobotClient(address)

        def add(name: str, acknowledged: dict[str, int] = acknowledged, robot: RobotClient = robot) -> None:
            try:
                while acknowledged[name] < len(sent):
                    depth, K, T_world_camera, labels = sent[acknowledged[name]]
                    number = acknowledged[name]
                    told = robot.add(name, depth, K, T_world_camera, labels=labels, number=number)
                    assert told["view"] == number
                    acknowledged[name] = number + 1
            except (OSError, http.client.HTTPException):
                return  # the service is gone
            except Exception as fault:
                faults.append(fault)

        threads = [threading.Thread(target=add, args=(name,), daemon=True) for name in kept]
        for thread in threads:
            thread.start()
        _wait_for_views(threads, acknowledged, chance.choice((0, 1, 1, 2, 3)))
        time.sleep(chance.uniform(0.0, 0.4))
        starter.kill(process)
        robot.patience = 0.0
        for thread in threads:
            thread.join(30.0)
        if faults:
            raise faults[0]
        tally["kills"] += 1
        for name in list(kept):
            with Session.open(folder / name) as opened:
                found, sure = opened.views, acknowledged[name]
                assert found in (sure, sure + 1), f"{found} views where {sure} were acknowledged"
                assert graph_text(opened.graph) == graphs[found], "a session is not what its views make it"
                tally["acknowledged"] += sure - kept[name]
                tally["kept unsaid"] += found - sure
                kept[name] = found
            if found == len(views):
                del kept[name]
                kept[f"{name}-"] = 0
                Session.begin(folder / f"{name}-", segmentation="labels").close()
    starter.close()
    return tally


def _wait(session: Path, chance: random.Random, usual: float, *, writing: bool) -> None:
    """Wait for a random moment of an `add`: of all its time, or of that after it has begun to write."""
    end = time.monotonic() + 1.1 * usual * (1.0 if writing else chance.random())
    while time.monotonic() < end:
        if writing and any((session / "views").glob(".partial-*")):
            time.sleep(chance.uniform(0.0, 0.04))
            return
        time.sleep(0.0005)


def _wait_for_views(threads: Sequence[threading.Thread], acknowledged: dict[str, int], more: int) -> None:
    """Wait until so many more views are acknowledged, or there are no more to come."""
    wanted = sum(acknowledged.values()) + more
    while sum(acknowledged.values()) < wanted and any(thread.is_alive() for thread in threads):
        time.sleep(0.002)


def address_of(said: Path) -> str:
    """Where a service that was just started is."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        try:
            return str(json.loads(said.read_text())["address"])
        except (OSError, ValueError):
            time.sleep(0.005)
    raise RuntimeError(f"the service does not start: {said.read_text()}")


@dataclass
class Outcome:
    """What a load came to.

    Attributes:
        order: Of each session which of the views each of its views is.
        seconds: How long each answer took [s].
        memory: Of the service after each answer [MB].
    """

    order: dict[str, list[int]] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)


def put_load(
    folder: Path, views: Sequence[View], *, clients: int, sessions: int, options: Sequence[object] = ()
) -> Outcome:
    """Have clients add views to sessions of a service, each view once, as fast as they can.

    View n goes to session n modulo their number; client n adds every n-th view.

    Raises:
        AssertionError: A view was lost, or a graph is not that of its views added one by one.
    """
    outcome, starter = Outcome(), Starter()
    service = starter.start(["serve", folder / "sessions", "--port", 0, "--json", *options], folder / "said")
    address, memory = address_of(folder / "said"), psutil.Process(service)
    names = [f"table-{n}" for n in range(sessions)]
    for name in names:
        RobotClient(address).begin(name, segmentation="labels")
        outcome.order[name] = []
    turns = {name: threading.Lock() for name in names}
    faults: list[BaseException] = []

    def work(client: int) -> None:
        robot = RobotClient(address, patience=120.0)
        try:
            for number in range(client, len(views), clients):
                view, name = views[number], names[number % sessions]
                begun = time.monotonic()
                # Otherwise two clients would be after one number, and one would have to ask again.
                with turns[name]:
                    robot.add(
                        name, depth_png(view), view.K.tolist(), view.pose.tolist(), labels=labels_png(view)
                    )
                    outcome.order[name].append(number)
                robot.next(name)
                outcome.seconds.append(time.monotonic() - begun)
                outcome.memory.append(memory.memory_info().rss / 1e6)
        except BaseException as fault:
            faults.append(fault)

    threads = [threading.Thread(target=work, args=(n,)) for n in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    graphs = {} if faults else {name: RobotClient(address).graph(name) for name in names}
    counts = {} if faults else {name: RobotClient(address).views(name) for name in names}
    os.kill(service, signal.SIGTERM)
    status = starter.end()
    starter.close()
    if faults:
        raise faults[0]
    assert status == 0, "the service did not stop as it ought to"
    for name, order in outcome.order.items():
        assert counts[name] == len(order), "a view is lost"
        scene = Scene(segmentation="labels")
        for number in order:
            scene.update(views[number])
        assert graphs[name] == graph_to_json(scene.graph), "views one by one give another graph"
    return outcome


def main() -> int:
    """Kill and put load, and say what became of the views."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=200, help="kills of each of the two")
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments")
    parser.add_argument("--views", type=int, default=200, help="views of the load")
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--open-sessions", type=int, default=4, help="fewer than sessions: they take turns")
    options = parser.parse_args()
    views = views_around("clutter", max(12, options.views))
    for what, kill in (("session add", kill_adding), ("serve", kill_serving)):
        with TemporaryDirectory() as folder:
            begun = time.monotonic()
            tally = (
                kill(Path(folder), views[:12], options.kills, options.seed) if options.kills else Counter()
            )
            figures = ", ".join(f"{count} {name}" for name, count in sorted(tally.items()))
            print(f"{what}: {figures}; none lost ({time.monotonic() - begun:.0f} s)", flush=True)
    with TemporaryDirectory() as folder:
        begun, limit = time.monotonic(), ("--open-sessions", options.open_sessions)
        known = {"clients": options.clients, "sessions": options.sessions, "options": limit}
        outcome = put_load(Path(folder), views[: options.views], **known)
        rate = options.views / (time.monotonic() - begun)
    seconds, memory = sorted(outcome.seconds), outcome.memory
    print(
        f"{options.views} views, {options.clients} clients, {options.sessions} sessions: none lost, graphs "
        f"equal, {rate:.1f} views/s; view and next view {seconds[len(seconds) // 2]:.2f} s in the median, "
        f"at most {seconds[-1]:.2f} s; memory {memory[0]:.0f} to {memory[-1]:.0f} MB"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
