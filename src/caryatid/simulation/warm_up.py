"""Compile all kernels after installation: `python -m caryatid.simulation.warm_up`.

numba compiles a kernel at its first call and caches it on disk, so calling everything that uses kernels, on
small images, is enough. Without it, the first run compiles what it needs.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from caryatid.config import Config, SensorConfig, VoxelConfig
from caryatid.exploration import explore, next_best_view
from caryatid.fitting.least_squares import levenberg_marquardt
from caryatid.fitting.primitives import fit
from caryatid.geometry.shapes import Box, Primitives
from caryatid.geometry.solids import Solid
from caryatid.planning.planners import BUILT_IN
from caryatid.scene import Scene
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation


def is_warm() -> bool:
    """Whether kernels were compiled before, if perhaps of an earlier version."""
    return any(Path(levenberg_marquardt._cache.cache_path).glob("*.nbi"))


def warm_up() -> None:
    """Explore by colour and depth and with labels, take point clouds, use all planners, and fit a shape."""
    config = Config(
        sensor=SensorConfig(width=160, height=120, focal=131.25),
        active=replace(Config().active, sphere_points=400, max_views=2),
        voxels=VoxelConfig(size=0.02),
    )
    simulation = make_simulation(load_scene("tower"), config, noise="carmine", seed=0)
    known = simulation.camera, simulation.robot
    list(explore(*known, config=config, segmentation="auto"))
    cloud = next(explore(*known, config=config, segmentation="labels")).cloud
    assert cloud.labels is not None
    Scene(config).update(replace(cloud, labels=None))
    Scene(config).update(replace(cloud, labels=np.where(cloud.labels == SUPPORT_LABEL, 0, cloud.labels)))
    scene = Scene(config, segmentation="auto")
    scene.update(simulation.camera.capture(simulation.robot.T_world_camera))
    for planner in BUILT_IN:
        next_best_view(scene, simulation.robot, planner=planner)
    box = Box(np.eye(4), np.array([0.1, 0.2, 0.1]))
    points, normals = box.surface(0.01)
    Primitives.of([box]).gradient(0, points)
    fit(points, normals, config=Config().fit, rng=np.random.default_rng(0))
    Solid.from_extents(np.eye(4), np.ones(3)).signed_distance(points)


if __name__ == "__main__":
    warm_up()
