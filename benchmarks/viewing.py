"""How soon the viewer shows a view after it is computed, and what it costs the loop.

    python benchmarks/viewing.py

The first is measured in a headless Chromium, from the call that adds a view to the page having all its
points, with clouds of 300,000 and of a million points. The second compares turns of the loop on a scene whose
cloud grows to some 300,000 points, with a page that another process receives, and without. A machine without
a graphics card draws in software, where a picture of so many points takes longer than all else, and takes the
cores the loop wants: so views are also handed over to a page that has nothing to draw, and what receives the
page while the loop is measured does not draw it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from browser import browser

from caryatid.config import Config
from caryatid.config.settings import changed_settings
from caryatid.exploration import Step, explore
from caryatid.geometry.transforms import Array
from caryatid.sources import open_source
from caryatid.viewer.apart import PageApart
from caryatid.viewer.drawing import LAYERS
from caryatid.viewer.loop import Loop, standing_of
from caryatid.viewer.moments import Dots, Moment, moment_of_step
from caryatid.viewer.page import Page

SCENE = "clutter"
SIZES = (300_000, 1_000_000)
"""Points of the clouds that are shown [1]."""
LATEST, COSTS = 0.3, 0.05
"""A view is to be shown after this at the latest [s], and to cost the loop this share at the most [1]."""
FINE = {"sensor": {"width": 1120, "height": 840, "focal": 918.75}, "cloud": {"voxel": 0.0008}}
"""Settings that differ where the fused cloud of the measured loop is to have some 300,000 points."""
VIEWS = 8
"""Views of each loop [1]; the first is left out, it fits all objects."""

SEEN = """() => {
  window.arrivals = [];
  let before = null;
  setInterval(() => {
    const node = (window.__viserSceneTree?.getState() ?? {})["/cloud/points"];
    const points = node?.message?.props?.points;
    if (points && points !== before) {
      before = points;
      window.arrivals.push([performance.timeOrigin + performance.now(), points.byteLength]);
    }
  }, 2);
}"""
"""Notes in the page when [ms] the points of a view are there, and how many bytes."""


def moments(config: Config, count: int) -> list[Moment]:
    """The first views of the scene, in simulation."""
    opening = partial(open_source, SCENE, noise="carmine", segmentation=None, seed=0)
    loop = Loop(opening, config)
    taken = [loop.turn() for _ in range(count)]
    return [moment for moment in taken if moment is not None]


def with_points(moment: Moment, count: int, rng: np.random.Generator) -> Moment:
    """The same moment with so many points, drawn from its own and shaken a little."""
    dots = moment.dots
    assert dots is not None
    drawn = rng.integers(len(dots), size=count)
    points = dots.points_world[drawn] + rng.normal(0.0, 0.002, (count, 3)).astype(np.float32)
    return replace(moment, dots=Dots(points, dots.labels[drawn], None))


def latency(size: int, runs: int, *, drawn: bool) -> list[float]:
    """Seconds from adding a view of `size` points to the browser having them.

    Args:
        size: Points of each view.
        runs: Views.
        drawn: It is shown too; else all is hidden and the picture tiny, so that drawing, which the page takes
            turns with, takes as little as on a graphics card.
    """
    config, rng = Config(), np.random.default_rng(0)
    seen = moments(config, 3)
    page = Page("latency", config.support)
    page.add(seen[0])
    found = []
    with TemporaryDirectory() as folder, browser(Path(folder), (640, 480)) as tab:
        tab.open(page.url, resolution=0.5 if drawn else 0.05)
        tab.page.evaluate(SEEN)
        for layer in LAYERS:
            page.canvas.show_layer(layer, drawn)
        for run in range(runs):
            moment = replace(with_points(seen[run % 3], size, rng), index=run + 1)
            tab.page.wait_for_timeout(1000)
            came = len(tab.page.evaluate("window.arrivals"))
            started = time.time()
            page.add(moment)
            tab.page.wait_for_function(f"window.arrivals.length > {came}")
            at, length = tab.page.evaluate(f"window.arrivals[{came}]")
            assert length == 6 * size, "what came are the points that were added"
            found.append(at / 1000.0 - started)
    page.close()
    return found


def turns(config: Config, page: PageApart | None) -> tuple[Array, int]:
    """Turns of the loop but the first: seconds (N, 2) by clock and by processor, and points at its end."""
    source = open_source(SCENE, config, noise="carmine", segmentation=None, seed=0)
    marks, points = [_now()], 0
    for step in explore(source.camera, source.robot, config=config, early_stop=False):
        if page is not None:
            page.add(_moment(step, source.robot, config))
        marks.append(_now())
        points = len(step.cloud)
    return np.diff(marks, axis=0)[1:], points


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _moment(step: Step, robot: Any, config: Config) -> Moment:
    return moment_of_step(step, robot=standing_of(robot, config))


@contextmanager
def receiver(page: PageApart) -> Iterator[None]:
    """Another process that is sent all that a browser would be."""
    command = [sys.executable, __file__, "--receive", page.url]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield
        finally:
            process.terminate()


async def receive(url: str) -> None:
    """Take in what a page is sent, until the process is ended."""
    import viser
    from websockets.asyncio.client import connect

    protocol: Any = f"viser-v{viser.__version__}"
    async with connect(url.replace("http", "ws"), subprotocols=[protocol], max_size=None) as socket:
        sys.stdout.write("connected\n")
        sys.stdout.flush()
        async for _ in socket:
            pass


def cost(settings: dict[str, Any], runs: int) -> dict[str, Any]:
    """What the viewer costs a turn of the loop: medians of turns with it and without, taken in turns."""
    config = changed_settings(Config(), settings, "benchmark")
    config = replace(config, active=replace(config.active, max_views=VIEWS))
    turns(config, None)
    found: dict[bool, list[Array]] = {False: [], True: []}
    points = 0
    for run in range(2 * runs):
        watched = run % 2 == 1
        if watched:
            page = PageApart("cost", config.support)
            with receiver(page):
                seconds, points = turns(config, page)
            page.close()
        else:
            seconds, points = turns(config, None)
        found[watched].append(seconds)
    # The same view of every run is the same work: of each the fastest, which nothing else held up.
    without, with_it = (np.min(found[k], axis=0).mean(axis=0) for k in (False, True))
    return {
        "points": points,
        "turn_without": float(without[0]),
        "turn_with": float(with_it[0]),
        "cost": float(with_it[0] / without[0] - 1.0),
        "processor": float(with_it[1] / without[1] - 1.0),
    }


def main() -> int:
    """Measure, print a table, and fail where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", type=int, default=8, help="how often each is measured")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--receive", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.receive:
        asyncio.run(receive(options.receive))
        return 0
    document: dict[str, Any] = {"latency": {}, "cost": {}}
    for size in SIZES:
        for drawn in (False, True):
            found = latency(size, options.runs, drawn=drawn)
            how = "drawn in software" if drawn else "handed over"
            document["latency"][f"{size}, {how}"] = {"median": float(np.median(found)), "slowest": max(found)}
            print(f"{size:,} points, {how}: {np.median(found):.3f} s, at the latest {max(found):.3f} s")
    for name, settings in (("default", {}), ("fine", FINE)):
        result = cost(settings, options.runs)
        document["cost"][name] = result
        print(
            f"a turn at {result['points']:,} points takes {result['turn_without']:.3f} s, "
            f"with the viewer {result['turn_with']:.3f} s: {100.0 * result['cost']:+.1f} %, "
            f"and {100.0 * result['processor']:+.1f} % of the loop's own processor time"
        )
    if options.out is not None:
        options.out.write_text(json.dumps(document, indent=1) + "\n")
    soon = document["latency"][f"{SIZES[0]}, handed over"]["median"] <= LATEST
    return 0 if soon and document["cost"]["fine"]["cost"] <= COSTS else 1


if __name__ == "__main__":
    sys.exit(main())
