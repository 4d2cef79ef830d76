"""What the benchmarks of sessions share: views of a small scene, and commands that start at once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from caryatid.config import SensorConfig
from caryatid.geometry import transforms
from caryatid.io.graph_json import graph_text
from caryatid.io.images import png
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.scenes import load_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

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

    def start(self, arguments: Sequence[object], out: Path) -> int:
        """Start a command; returns its process id.

        Args:
            arguments: After `caryatid`.
            out: File for what it says.
        """
        command = {"arguments": [str(a) for a in arguments], "out": str(out)}
        self._stdin.write(json.dumps(command) + "\n")
        self._stdin.flush()
        return int(self._stdout.readline())

    def end(self) -> int:
        """Wait for the command; returns its exit status, negative where a signal ended it."""
        status = int(self._stdout.readline())
        self._stdin.write("\n")
        self._stdin.flush()
        return status

    def kill(self, process: int) -> int:
        """Kill a command that was started and not waited for; returns its exit status as `end`."""
        os.kill(process, signal.SIGKILL)
        return self.end()

    def close(self) -> None:
        """End it."""
        self._process.communicate()

    @property
    def _stdin(self) -> Any:
        return self._process.stdin

    @property
    def _stdout(self) -> Any:
        return self._process.stdout
