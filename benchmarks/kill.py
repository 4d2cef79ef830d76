"""Kills `caryatid session add` and `caryatid serve` at random moments: no view that was acknowledged is lost.

    python benchmarks/kill.py --kills 200

After each kill the session is opened and its graph compared with that of the same views without any kill.
"""

from __future__ import annotations

import argparse
import http.client
import json
import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from sessions import Starter, depth_png, graphs_of, labels_png, views_around, write_files

from caryatid.io.graph_json import graph_text
from caryatid.sensing.views import View
from caryatid.sessions import Session

from robot_client import RobotClient  # isort: skip


def kill_adding(folder: Path, views: Sequence[View], kills: int, seed: int) -> Counter[str]:
    """Kill `session add` at random moments; every other time once it has begun to write.

    Args:
        folder: An empty folder.
        views: Added one after the other; when they are used up the session begins anew.
        kills: How many times.
        seed: Of the moments.

    Returns:
        What became of the views: killed before or after they were kept, or not killed in time.

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

    Args:
        folder: An empty folder.
        views: Added one after the other; when they are used up a new session begins.
        kills: How many times.
        seed: Of the moments.
        clients: How many.

    Returns:
        How many views were acknowledged, and kept without that.

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
        address = _address(folder / "said")
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


def _address(said: Path) -> str:
    """Where a service that was just started is."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        try:
            return str(json.loads(said.read_text())["address"])
        except (OSError, ValueError):
            time.sleep(0.005)
    raise RuntimeError(f"the service does not start: {said.read_text()}")


def main() -> int:
    """Kill, and say what became of the views."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=200, help="kills of each of the two")
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments")
    options = parser.parse_args()
    views = views_around("clutter", 12)
    for what, kill in (("session add", kill_adding), ("serve", kill_serving)):
        with TemporaryDirectory() as folder:
            begun = time.monotonic()
            tally = kill(Path(folder), views, options.kills, options.seed)
            figures = ", ".join(f"{count} {name}" for name, count in sorted(tally.items()))
            sys.stdout.write(f"{what}: {figures}; none lost ({time.monotonic() - begun:.0f} s)\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
