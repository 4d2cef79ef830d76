from __future__ import annotations

import numpy as np

from caryatid.config import VoxelConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Sphere
from caryatid.sensing.views import View
from caryatid.sensing.voxel_map import FREE, OCCUPIED, UNKNOWN, VoxelMap

K = np.array([[100.0, 0.0, 79.5], [0.0, 100.0, 59.5], [0.0, 0.0, 1.0]])
CONFIG = VoxelConfig(size=0.02, extent=(0.8, 0.8, 0.6), below=0.2, stride=1, margin=0.02)


def wall_view(distance: float = 1.0, noise: np.ndarray | float = 0.0) -> View:
    """A camera 1 m from the origin on the -x side that sees a plane across its axis."""
    T_world_camera = transforms.look_at((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    depth = (np.full((120, 160), distance) + noise).astype(np.float32)
    return View(depth, K, T_world_camera)


def test_a_view_clears_its_rays_and_fills_their_ends():
    before = VoxelMap.around((0.0, 0.0, 0.0), CONFIG)
    voxels = before.integrate(wall_view(), 3.0)
    points = np.array([[-0.2, 0.01, 0.01], [0.005, 0.01, 0.01], [0.1, 0.01, 0.01], [5.0, 0.0, 0.0]])
    assert voxels.state_at(points).tolist() == [FREE, OCCUPIED, UNKNOWN, UNKNOWN]
    assert (before.states == UNKNOWN).all(), "the map that was given has changed"


def test_readings_beyond_the_range_are_free_space_up_to_it_and_none_say_nothing():
    empty = VoxelMap.around((0.0, 0.0, 0.0), CONFIG)
    voxels = empty.integrate(wall_view(distance=1.3), 1.1)
    assert voxels.state_at(np.array([[0.05, 0.01, 0.01], [0.15, 0.01, 0.01]])).tolist() == [FREE, UNKNOWN]
    assert not (voxels.states == OCCUPIED).any()
    assert (empty.integrate(wall_view(distance=0.0), 3.0).states == UNKNOWN).all()


def test_a_stray_reading_is_gone_after_three_views_through_it():
    voxels = VoxelMap.around((0.0, 0.0, 0.0), CONFIG).integrate(wall_view(0.8), 3.0)
    point = np.array([[-0.195, 0.01, 0.01]])
    states = []
    for _ in range(4):
        states.append(int(voxels.state_at(point)[0]))
        voxels = voxels.integrate(wall_view(1.0), 3.0)
    assert states[:2] == [OCCUPIED, OCCUPIED]
    assert states[3] == FREE


def test_evidence_does_not_overflow():
    empty = VoxelMap.around((0.0, 0.0, 0.0), CONFIG)
    full = np.full_like(empty.hits, 255)
    voxels = VoxelMap(empty.origin_world, full, full, CONFIG).integrate(wall_view(), 3.0)
    assert voxels.hits.min() == 255
    assert voxels.passes.min() == 255


def test_lines_of_sight_stop_at_what_is_solid_and_leave_the_clearance_out():
    box = Box(transforms.rigid(np.eye(3), (0.0, 0.0, 0.0)), np.array([0.1, 0.1, 0.1]))
    occluders = VoxelMap.around((0.0, 0.0, 0.0), CONFIG).occluders([box])
    points = np.array([[-0.2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    targets = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-0.2, 0.0, 1.0]])
    assert occluders.blocked(points, targets, 0.0).tolist() == [[True, False, False], [True, True, True]]
    assert occluders.blocked(points, targets, 0.12).tolist() == [[True, False, False], [False, False, False]]


def test_shapes_are_solid_inside_and_only_there():
    ball = Sphere(transforms.rigid(np.eye(3), (0.38, 0.0, 0.1)), 0.1)
    voxels = VoxelMap.around((0.0, 0.0, 0.0), CONFIG)
    occluders = voxels.occluders([ball])
    centres = voxels.centres_world(np.argwhere(voxels.states == UNKNOWN))
    inside = occluders.holds(centres)
    assert inside.sum() > 100
    np.testing.assert_array_equal(inside, ball.signed_distance(centres) < 0.0)
    outside = Sphere(transforms.rigid(np.eye(3), (3.0, 0.0, 0.1)), 0.1)
    assert not VoxelMap.around((0.0, 0.0, 0.0), CONFIG).occluders([outside]).grid.any()
