"""Calls everything that uses compiled kernels, on small images, so that they are compiled in advance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caryatid.config import Config, FitConfig, SegmentationMethod, SensorConfig, VoxelConfig
from caryatid.exploration import Step, explore, next_best_view
from caryatid.fitting.primitives import fit
from caryatid.geometry.shapes import Box, Primitives
from caryatid.geometry.solids import Solid
from caryatid.planning.planners import BUILT_IN
from caryatid.scene import Scene
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import Simulation, make_simulation


def warm_up(number: int) -> None:
    """Fit shapes, explore with and without fits and given segments, use all planners, and take a point cloud.

    Fitting takes nearly as long to compile as all the rest. So processes with even numbers begin with what
    needs no fits, and the others go through the parts in reverse order: they meet in the middle.
    """
    parts = [_explore_without_fits, _explore_by_colour_and_depth, _explore_with_labels, _fit]
    for part in parts if number % 2 == 0 else parts[::-1]:
        part()


def _explore_without_fits() -> None:
    _explore("auto", min_points=1_000_000)


def _fit() -> None:
    box = Box(np.eye(4), np.array([0.1, 0.2, 0.1]))
    points, normals = box.surface(0.01)
    Primitives.of([box]).gradient(0, points)
    fit(points, normals, config=Config().fit, rng=np.random.default_rng(0))
    Solid.from_extents(np.eye(4), np.ones(3)).signed_distance(points)


def _explore_by_colour_and_depth() -> None:
    config, simulation, _ = _explore("auto")
    scene = Scene(config, segmentation="auto")
    scene.update(simulation.camera.capture(simulation.robot.T_world_camera))
    for planner in BUILT_IN:
        next_best_view(scene, simulation.robot, planner=planner)


def _explore_with_labels() -> None:
    config, _, steps = _explore("labels")
    cloud = steps[0].cloud
    labels = cloud.labels
    Scene(config).update(replace(cloud, labels=None))
    if labels is not None:
        Scene(config).update(replace(cloud, labels=np.where(labels == SUPPORT_LABEL, 0, labels)))


def _explore(segmentation: SegmentationMethod, min_points: int = 12) -> tuple[Config, Simulation, list[Step]]:
    """Explore with a quarter of the usual image size, fitting objects with at least `min_points`."""
    config = Config(
        sensor=SensorConfig(width=160, height=120, focal=131.25),
        active=replace(Config().active, sphere_points=400, max_views=2),
        voxels=VoxelConfig(size=0.02),
        fit=FitConfig(min_points=min_points),
    )
    simulation = make_simulation(load_scene("tower"), config, noise="carmine", seed=0)
    steps = explore(simulation.camera, simulation.robot, config=config, segmentation=segmentation)
    return config, simulation, list(steps)
