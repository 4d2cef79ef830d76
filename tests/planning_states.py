"""What planners are asked about in tests: a table, what stands on it, what is known and can be reached."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caryatid.config import ActiveVisionConfig, RobotConfig, VoxelConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import PlanningState
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.sensing.view_sphere import ViewSphere, direction
from caryatid.sensing.voxel_map import VoxelMap

CONFIG = ActiveVisionConfig()
SPHERE = ViewSphere.around((0.0, 0.0, 0.75), CONFIG)
HOME = direction(np.pi, np.deg2rad(35.0))


def box(label: int, centre: tuple[float, float, float], extents: tuple[float, float, float]) -> SceneObject:
    shape = Box(transforms.rigid(np.eye(3), centre), np.array(extents))
    return SceneObject(f"o{label}", label, shape, "object" if label else "support_surface")


TABLE = box(0, (0.0, 0.0, 0.73), (0.7, 1.0, 0.04))


def candidates(*walls: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Candidates:
    boxes = [((0.0, 0.0, 0.73), (0.35, 0.5, 0.02)), *walls]
    floor = FloorGrid.from_boxes(
        [b[0] for b in boxes], [b[1] for b in boxes], [np.eye(3)] * len(boxes), RobotConfig()
    )
    return HumanoidRobot(floor, RobotConfig(), SPHERE.poses(HOME[None])[0]).candidates(SPHERE)


OPEN = candidates()


def known(objects: list[SceneObject]) -> VoxelMap:
    """A map that has seen every voxel: the objects occupied, the rest free."""
    voxels = VoxelMap.around(SPHERE.centre_world, VoxelConfig())
    solid = voxels.solid([o.shape for o in objects])
    low = np.rint((solid.origin_world - voxels.origin_world) / voxels.config.size).astype(int)
    hits = np.zeros_like(voxels.hits)
    hits[tuple(slice(a, a + n) for a, n in zip(low, solid.grid.shape, strict=True))] = solid.grid
    return VoxelMap(voxels.origin_world, hits, 1 - hits, voxels.config)


def state(
    objects: list[SceneObject],
    supports: tuple[Support, ...] = (),
    visited: np.ndarray | None = None,
    offered: Candidates = OPEN,
    **settings: object,
) -> PlanningState:
    everything = [TABLE, *objects]
    return PlanningState(
        SupportGraph(tuple(everything), supports),
        SPHERE,
        known(everything),
        HOME[None] if visited is None else visited,
        offered,
        replace(CONFIG, **settings),
    )


CUBE = box(1, (0.0, 0.0, 0.80), (0.1, 0.1, 0.1))
ON_TABLE = Support("o0", "o1")
