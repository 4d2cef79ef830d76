"""Measure the viewer: the time until a view is shown, CPU time of the loop's process, and memory."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import psutil
import viser
from rows import Effort, Row, median
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin, Subprotocol
from zstandard import ZstdDecompressor

from caryatid.config import Config
from caryatid.exploration import Step, explore
from caryatid.sensing.views import Cloud
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.viewer.page import Page

POINTS = 300_000
"""Number of points of the cloud that is shown."""
SHOWN, COST, GROWTH = 150.0, 2.0, 1.0
"""Targets: time until a view is shown [ms], share of the loop's CPU time [%], memory per view [MB]."""


def measure_viewer(effort: Effort) -> list[Row]:
    """Measure the page with a cloud of 300,000 points, and its cost to the exploration of `clutter`."""
    config = Config()
    simulation = make_simulation(load_scene("clutter"), config, noise="carmine", seed=0)
    began = time.process_time()
    steps = list(explore(simulation.camera, simulation.robot, config=config, early_stop=False))
    exploring = time.process_time() - began
    large = replace(steps[-1], cloud=_enlarged(steps[-1].cloud), stop=None)

    page = Page("benchmark", config)
    page.show_layer("cloud", True)
    root, token = page.url.rsplit("/", 1)
    address, protocol = f"{root.replace('http', 'ws')}/{token}", Subprotocol(f"viser-v{viser.__version__}")
    with connect(address, origin=Origin(root), subprotocols=[protocol], max_size=None) as browser:
        shown = [_until_shown(page, _numbered(large, k), browser) for k in range(effort.runs + 2)][2:]
    page.close()

    page = Page("benchmark", config)
    began = time.process_time()
    for step in steps:
        page.add(step)
        page.wait()
    cost = time.process_time() - began
    sizes = []
    counts = [effort.views // 10, effort.views // 2, effort.views]
    for first, last in zip([len(steps), *counts], counts, strict=False):
        for k in range(first, last):
            page.add(_numbered(large, k))
        page.wait()
        sizes.append(psutil.Process().memory_info().rss / 1e6)
    page.close()

    value, spread = median([1e3 * t for t in shown])
    what = f"from a view of {POINTS:,} points to its arrival in the browser"
    more, share = f"memory of one more view of {POINTS:,} points", 100.0 * cost / exploring
    growth = (sizes[-1] - sizes[0]) / (counts[-1] - counts[0])
    note = "; ".join(f"{size:.0f} MB after {n} views" for n, size in zip(counts, sizes, strict=True))
    return [
        Row("viewer.shown", what, value, "ms", spread, len(shown), target=SHOWN),
        Row("viewer.cost", "CPU time of an exploration for its page", share, "%", target=COST),
        Row("viewer.memory", more, growth, "MB", target=GROWTH, note=note),
    ]


def _enlarged(cloud: Cloud) -> Cloud:
    """Make a cloud of `POINTS` points: those of another, repeated with small random offsets."""
    large = cloud.select(np.arange(POINTS) % len(cloud))
    noise = np.random.default_rng(0).normal(0.0, 0.002, (POINTS, 3))
    return replace(large, points_world=large.points_world + noise)


def _numbered(step: Step, index: int) -> Step:
    """Copy a step as if it were that of another view, so that all of it is sent again."""
    return replace(step, index=index, graph=replace(step.graph), cloud=replace(step.cloud))


def _until_shown(page: Page, step: Step, browser: Connection) -> float:
    """Add a step; return the time [s] until a browser has its 3D scene and its text."""
    page.wait()
    time.sleep(0.2)
    began, text = time.perf_counter(), f"View {step.index + 1} of {step.index + 1}<".encode()
    page.add(step)
    while text not in _texts(browser.recv(timeout=30.0)):
        pass
    return time.perf_counter() - began


def _texts(message: str | bytes) -> bytes:
    """Return the text of a viser message, without its arrays: zstd data between a header and the arrays."""
    assert isinstance(message, bytes)
    return ZstdDecompressor().decompress(message[16 : 16 + int.from_bytes(message[8:16], "little")])
