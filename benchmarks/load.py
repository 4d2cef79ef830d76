"""Eight clients add 200 views to four sessions of a service at once: is anything lost?

    python benchmarks/load.py

Graphs are compared with those of the same views added one by one; memory of the service is followed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil
from sessions import depth_png, labels_png, views_around

from caryatid.io.graph_json import graph_to_json
from caryatid.scene import Scene
from caryatid.sensing.views import View

from robot_client import RobotClient  # isort: skip


@dataclass
class Outcome:
    """What a load came to.

    Attributes:
        order: Of each session which of the views each of its views is.
        seconds: How long each answer took [s].
        memory: Of the service after each answer [MB].
        total: How long it took in all [s].
    """

    order: dict[str, list[int]] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)
    total: float = 0.0


def put_load(
    folder: Path, views: Sequence[View], *, clients: int, sessions: int, options: Sequence[object] = ()
) -> Outcome:
    """Have clients add views to sessions, each view once, as fast as they can.

    Args:
        folder: Folder of the service.
        views: All views; view n goes to session n modulo their number.
        clients: How many there are at once; client n adds every n-th view.
        sessions: How many sessions.
        options: Of `caryatid serve`.

    Raises:
        AssertionError: A view was lost, or a graph is not that of its views added one by one.
    """
    command = [sys.executable, "-m", "caryatid", "serve", str(folder), "--port", "0", "--json"]
    outcome, lock = Outcome(), threading.Lock()
    with subprocess.Popen([*command, *map(str, options)], stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None
        try:
            address = json.loads("".join(iter(service.stdout.readline, "}\n")) + "}")["address"]
            memory = psutil.Process(service.pid)
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
                        depth, labels = depth_png(view), labels_png(view)
                        # Otherwise two clients would be after one number, and one would have to ask again.
                        with turns[name]:
                            told = robot.add(name, depth, view.K.tolist(), view.pose.tolist(), labels=labels)
                            outcome.order[name].append(number)
                        robot.next(name)
                        with lock:
                            assert told["view"] < len(views)
                            outcome.seconds.append(time.monotonic() - begun)
                            outcome.memory.append(memory.memory_info().rss / 1e6)
                except BaseException as fault:
                    faults.append(fault)

            threads = [threading.Thread(target=work, args=(n,)) for n in range(clients)]
            begun = time.monotonic()
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            outcome.total = time.monotonic() - begun
            if faults:
                raise faults[0]
            graphs = {name: RobotClient(address).graph(name) for name in names}
            counts = {name: RobotClient(address).views(name) for name in names}
        finally:
            service.terminate()
    assert service.returncode == 0, "the service did not stop as it ought to"
    for name, order in outcome.order.items():
        assert counts[name] == len(order), "a view is lost"
        scene = Scene(segmentation="labels")
        for number in order:
            scene.update(views[number])
        assert graphs[name] == graph_to_json(scene.graph), "views one by one give another graph"
    return outcome


def main() -> int:
    """Put the load, and say what it came to."""
    parser = argparse.ArgumentParser(description="Put load on a service.")
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--open-sessions", type=int, default=4, help="fewer than sessions: they take turns")
    options = parser.parse_args()
    views = views_around("clutter", options.views)
    with TemporaryDirectory() as folder:
        outcome = put_load(
            Path(folder),
            views,
            clients=options.clients,
            sessions=options.sessions,
            options=("--open-sessions", options.open_sessions),
        )
    seconds, memory = sorted(outcome.seconds), outcome.memory
    sys.stdout.write(
        f"{len(views)} views, {options.clients} clients, {options.sessions} sessions: none lost, "
        f"graphs equal\n{len(views) / outcome.total:.1f} views/s; view and next view "
        f"{seconds[len(seconds) // 2]:.2f} s in the median, {seconds[-1]:.2f} s at the most\n"
        "memory [MB] after each fifth of the views: "
        f"{', '.join(f'{memory[(k + 1) * len(memory) // 5 - 1]:.0f}' for k in range(5))}\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
