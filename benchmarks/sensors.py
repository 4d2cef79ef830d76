"""Look at built-in scenes with the depth cameras that people have, from as far as they use them.

    python benchmarks/sensors.py [SENSORS…] [--scenes …] [--seeds 1] [--jobs 2] [--out FILE]

Five views lie on a sphere around the table top, with the usual error of registration, and segments are
automatic. Noise, tilt and edges are the models below, not recordings: `real.py` measures those. It prints F1
after each view; refused views, changes (none is right), and CPU time per view.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from operator import call
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from accuracy import EASY
from measures import Row, Spread, print_table, run_main
from rich.console import Console
from scipy import ndimage

from caryatid.config import NoiseConfig, SensorConfig
from caryatid.errors import CaryatidError, PerceptionError, WrongViewError
from caryatid.evaluation.scores import TrueScene, score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.simulation.camera import (
    Rendering,
    add_depth_noise,
    depth_edges,
    intrinsics,
    misregister,
    render,
)
from caryatid.simulation.scenes import load_scene

LOOKS = ((180.0, 40.0), (108.0, 55.0), (252.0, 40.0), (36.0, 55.0), (324.0, 40.0))
"""Azimuth and elevation of the views [deg]."""


@dataclass(frozen=True)
class Sensor:
    """A depth camera.

    Attributes:
        width, height, focal: Its image [px].
        distance: From the nearest object to the camera, along the optical axis [m].
        noise: Standard deviation of a reading at 1 m [m]; of stereo cameras it grows with z².
        blur: How far neighbouring readings share their noise [px]; 0 = not at all.
        waves: Standard deviation of slow waves in depth at 1 m [m].
        tilt: Standard deviation of the tilt of a plane [deg].
        ramps: Width of the ramp at a depth edge [px]; 0 = readings fly between both sides.
        baseline: Between the two cameras of a stereo camera [m], whose shadows have no readings; 0 = none.
    """

    width: int
    height: int
    focal: float
    distance: float
    noise: float = 0.0
    blur: float = 0.0
    waves: float = 0.0
    tilt: float = 1.0
    ramps: int = 0
    baseline: float = 0.0


SENSORS: Mapping[str, Sensor] = {
    "carmine": Sensor(640, 480, 525.0, 1.1),
    "d435": Sensor(1280, 720, 640.0, 0.4, 0.0025, 3.0, 0.0017, ramps=5, baseline=0.05),
    "d405": Sensor(1280, 720, 640.0, 0.25, 0.007, 3.0, 0.0049, ramps=5, baseline=0.018),
    "azure": Sensor(640, 576, 504.0, 1.0, 0.0015, 0.0, 0.0015),
    "lidar": Sensor(256, 192, 212.0, 0.8, 0.003, 2.5, ramps=3),
}
"""Each at a distance at which it is used. Stereo is assumed to be wrong by σ = 0.08 px of disparity; noise of
the others, waves and tilt are assumptions too."""


def read_depth(image: Rendering, sensor: Sensor, K: Array, rng: np.random.Generator) -> Array:
    """Depth (H, W) [m] as a sensor reads it, 0 = no reading; `carmine` is that of the simulator."""
    if sensor == SENSORS["carmine"]:
        return add_depth_noise(image.depth, image.incidence, NoiseConfig(), rng)

    def smooth(width: float) -> Array:
        drawn = rng.standard_normal(image.depth.shape)
        drawn = ndimage.gaussian_filter(drawn, width) if width else drawn
        return np.asarray(drawn / drawn.std())

    depth, seen = image.depth, (image.depth > 0.0) & (image.incidence < np.radians(82.0))
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
    row, column = np.indices(depth.shape)
    x, y = (column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]
    slope = np.radians(sensor.tilt) / np.median(depth[seen]) * rng.standard_normal((2, 1, 1))
    # Stereo measures 1/z, light its own time of flight.
    grow = 1.0 if sensor.baseline else inverse**2
    noise = grow * (sensor.noise * smooth(sensor.blur) + sensor.waves * smooth(25.0))
    if sensor.ramps:
        near = ndimage.maximum_filter(inverse, sensor.ramps) if sensor.baseline else inverse
        edge = ndimage.binary_dilation(depth_edges(depth, 0.015), iterations=sensor.ramps - 1)
        inverse = np.where(edge, ndimage.uniform_filter(near, sensor.ramps), inverse)
    else:
        low, high = ndimage.minimum_filter(inverse, 3), ndimage.maximum_filter(inverse, 3)
        between = low + (high - low) * rng.random(depth.shape)
        inverse = np.where(depth_edges(depth, 0.03), between, inverse)
    inverse = inverse + slope[0] * x + slope[1] * y + noise
    if sensor.baseline:
        # The second camera does not see what is left of something nearer.
        other = column - sensor.focal * sensor.baseline * inverse
        first = np.minimum.accumulate(other[:, ::-1], axis=1)[:, ::-1]
        seen &= ~ndimage.binary_opening(other > first + 1.0, np.ones((2, 2)))
    return np.where(seen & (inverse > 0.25), 1.0 / np.maximum(inverse, 0.25), 0.0)


def nearest(truth: TrueScene, away: Array) -> float:
    """How far the objects reach in a direction (3,), from the world's origin [m]."""
    return max(
        float(shape.T_world_object[:3, 3] @ away + shape.support(away[None])[0])
        for shape in truth.objects.values()
    )


def measure(name: str, scene: str, seed: int) -> list[Row]:
    """F1 after each view of a scene with a sensor."""
    sensor, simulated = SENSORS[name], load_scene(scene)
    model, rng = Scene(segmentation="auto", seed=seed), np.random.default_rng(seed)
    truth = true_scene_from_simulation(simulated)
    size = SensorConfig(sensor.width, sensor.height, sensor.focal)
    K, rows = intrinsics(size), list[Row]()
    centre = np.array([0.0, 0.0, next(iter(truth.surfaces.values())).height + 0.05])
    for number, (azimuth, elevation) in enumerate(LOOKS, 1):
        around, up = np.radians(azimuth), np.radians(elevation)
        away = np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
        T = transforms.look_at(
            centre + (nearest(truth, away) - centre @ away + sensor.distance) * away, centre
        )
        image = render(simulated, T, K, size)
        depth = read_depth(image, sensor, K, rng).astype(np.float32)
        reported = misregister(T, NoiseConfig(), rng) if number > 1 else T
        started, refused, before = time.process_time(), 0, len(model.changes)
        try:
            model.update(View(depth, K, reported, image.rgb, name=f"{scene} view {number}"))
        except (PerceptionError, WrongViewError):
            refused = 1
        took, found = time.process_time() - started, score(model.graph, truth)
        rows.append(
            {"sensor": name, "scene": scene, "seed": seed, "view": number, "f1": found.f1}
            | {"changes": len(model.changes) - before, "refused": refused, "cpu_seconds": took}
        )
    return rows


@dataclass(frozen=True)
class Sensors(Spread):
    """Measure with each sensor."""

    sensors: Annotated[tuple[str, ...], tyro.conf.Positional] = tuple(SENSORS)
    """Sensors to use. [default: all]"""
    scenes: tuple[str, ...] = EASY
    """Built-in scenes."""
    seeds: int = 1
    """Number of seeds, from 0."""

    def run(self, console: Console) -> int:
        """Measure and print."""
        if unknown := [name for name in self.sensors if name not in SENSORS]:
            raise CaryatidError(f"unknown sensor '{unknown[0]}': choose from {', '.join(SENSORS)}")
        tasks = [partial(measure, *task) for task in product(self.sensors, self.scenes, range(self.seeds))]
        frame = pd.DataFrame([row for part in self.each(call, tasks) for row in part])
        rest = frame.groupby("sensor", sort=False)[["refused", "changes", "cpu_seconds"]].mean()
        f1 = frame.pivot_table("f1", "sensor", "view", sort=False)
        print_table(f1.join(rest).round(3).reset_index(), console)
        self.write(frame.to_dict("records"))
        return 0


if __name__ == "__main__":
    run_main(Sensors)
