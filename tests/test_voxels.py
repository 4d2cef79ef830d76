from __future__ import annotations

import numpy as np
import pytest

from caryatid import frames
from caryatid.config import VoxelConfig
from caryatid.kernels import rays
from caryatid.shapes import Box, Sphere
from caryatid.views import View
from caryatid.voxels import FREE, OCCUPIED, UNKNOWN, VoxelMap

K = np.array([[100.0, 0.0, 79.5], [0.0, 100.0, 59.5], [0.0, 0.0, 1.0]])
CONFIG = VoxelConfig(size=0.02, extent=(0.8, 0.8, 0.6), below=0.2, stride=1, margin=0.02)


def wall_view(distance: float = 1.0, noise: np.ndarray | float = 0.0) -> View:
    """A camera 1 m from the origin on the -x side that sees a plane across its axis."""
    T_world_camera = frames.look_at((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    depth = (np.full((120, 160), distance) + noise).astype(np.float32)
    return View(depth, K, T_world_camera)


def random_rays(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(-1.0, 1.0, (count, 3)), rng.uniform(-1.0, 1.0, (count, 3))


def test_carve_agrees_with_its_reference():
    rng = np.random.default_rng(0)
    _, ends = random_rays(rng, 200)
    ends[:3] = [[0.5, 0.013, 0.017], [0.011, -0.6, 0.017], [0.011, 0.013, 0.7]]
    t_to = rng.uniform(0.2, 1.0, len(ends))
    origin = np.array([-0.3, -0.4, -0.2])
    for start in (np.array([0.011, 0.013, 0.017]), np.array([-0.9, 0.2, 0.5])):
        compiled, reference = np.zeros((2, 13, 17, 11), dtype=np.uint8)
        rays.carve(compiled, start, ends, t_to, origin, 0.05)
        rays.carve_reference(reference, start, ends, t_to, origin, 0.05)
        assert reference.sum() > 100
        np.testing.assert_array_equal(compiled, reference)


def test_blocked_agrees_with_its_reference():
    rng = np.random.default_rng(1)
    points, targets = random_rays(rng, 25)
    targets[0] = points[0]
    occupied = (rng.random((13, 17, 11)) < 0.02).astype(np.uint8)
    asked = rng.random((25, 25)) < 0.8
    origin = np.array([-0.3, -0.4, -0.2])
    for clearance in (0.0, 0.4):
        args = (occupied, points, targets, asked, clearance, origin, 0.05)
        compiled, reference = rays.blocked(*args), rays.blocked_reference(*args)
        assert 20 < reference.sum() < 605
        np.testing.assert_array_equal(compiled, reference)
        assert not compiled[~asked].any()


def test_a_new_map_knows_nothing():
    voxels = VoxelMap.around((0.1, 0.2, 0.3), CONFIG)
    assert voxels.states.shape == (40, 40, 30)
    assert (voxels.states == UNKNOWN).all()
    np.testing.assert_allclose(voxels.origin_world, (-0.3, -0.2, 0.1))
    assert not voxels.blocked(np.zeros((2, 3)), np.ones((3, 3)), 0.0).any()


def test_a_view_clears_its_rays_and_fills_their_ends():
    before = VoxelMap.around((0.0, 0.0, 0.0), CONFIG)
    voxels = before.integrate(wall_view(), 3.0)
    points = np.array([[-0.2, 0.01, 0.01], [0.005, 0.01, 0.01], [0.1, 0.01, 0.01], [5.0, 0.0, 0.0]])
    assert voxels.state_at(points).tolist() == [FREE, OCCUPIED, UNKNOWN, UNKNOWN]
    assert (before.states == UNKNOWN).all(), "the map that was given has changed"


def test_readings_beyond_the_range_are_free_space_up_to_it():
    voxels = VoxelMap.around((0.0, 0.0, 0.0), CONFIG).integrate(wall_view(distance=1.3), 1.1)
    assert voxels.state_at(np.array([[0.05, 0.01, 0.01], [0.15, 0.01, 0.01]])).tolist() == [FREE, UNKNOWN]
    assert not (voxels.states == OCCUPIED).any()


def test_pixels_without_a_reading_say_nothing():
    voxels = VoxelMap.around((0.0, 0.0, 0.0), CONFIG).integrate(wall_view(distance=0.0), 3.0)
    assert (voxels.states == UNKNOWN).all()


def test_a_surface_survives_depth_noise_and_a_registration_error():
    rng = np.random.default_rng(2)
    voxels = VoxelMap.around((0.0, 0.0, 0.0), CONFIG)
    offsets = [0.0, 0.01, -0.01]
    for offset in offsets:
        noise = rng.normal(0.0, 0.003, (120, 160))
        voxels = voxels.integrate(wall_view(1.0 + offset, noise), 3.0)
    y, z = np.meshgrid(np.linspace(-0.3, 0.3, 31), np.linspace(-0.15, 0.3, 21))
    points = np.column_stack([np.full(y.size, -0.25), y.ravel(), z.ravel()])
    targets = np.array([[0.4, 0.0, 0.0]])
    assert voxels.blocked(points, targets, 0.0).all(), "there is a hole in the wall"
    assert (voxels.state_at(points) == FREE).all()


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


def test_lines_of_sight_stop_at_what_is_occupied_and_leave_the_clearance_out():
    box = Box(frames.rigid(np.eye(3), (0.0, 0.0, 0.0)), np.array([0.1, 0.1, 0.1]))
    voxels = VoxelMap.around((0.0, 0.0, 0.0), CONFIG).with_shapes([box])
    points = np.array([[-0.2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    targets = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-0.2, 0.0, 1.0]])
    assert voxels.blocked(points, targets, 0.0).tolist() == [[True, False, False], [True, True, True]]
    assert voxels.blocked(points, targets, 0.12).tolist() == [[True, False, False], [False, False, False]]
    asked = np.array([[False, True, True], [True, False, True]])
    assert voxels.blocked(points, targets, 0.0, asked).tolist() == [[False] * 3, [True, False, True]]


def test_shapes_fill_the_voxels_inside_them_and_only_those():
    ball = Sphere(frames.rigid(np.eye(3), (0.38, 0.0, 0.1)), 0.1)
    voxels = VoxelMap.around((0.0, 0.0, 0.0), CONFIG).with_shapes([ball])
    centres = voxels.centres_world(np.argwhere(voxels.states == OCCUPIED))
    assert len(centres) > 100
    assert (ball.signed_distance(centres) < 0.0).all()
    everywhere = voxels.centres_world(np.argwhere(voxels.states == UNKNOWN))
    assert (ball.signed_distance(everywhere) >= 0.0).all()
    outside = Sphere(frames.rigid(np.eye(3), (3.0, 0.0, 0.1)), 0.1)
    assert not (VoxelMap.around((0.0, 0.0, 0.0), CONFIG).with_shapes([outside]).states == OCCUPIED).any()


def test_a_view_without_a_pose_is_refused():
    from caryatid.errors import InputError

    view = View(np.ones((12, 16), dtype=np.float32), K)
    with pytest.raises(InputError, match="no camera pose"):
        VoxelMap.around((0.0, 0.0, 0.0), CONFIG).integrate(view, 3.0)
