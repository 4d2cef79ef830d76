from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from caryatid.config import VoxelConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.sensing.solids import filled_reference
from caryatid.sensing.views import View
from caryatid.sensing.voxel_map import FREE, OCCUPIED, UNKNOWN, VoxelMap
from caryatid.sensing.voxel_map_kernels import (
    enter_view,
    enter_view_reference,
    states_of,
    states_of_reference,
    voxels_at,
    voxels_at_reference,
)

K = np.array([[100.0, 0.0, 79.5], [0.0, 100.0, 59.5], [0.0, 0.0, 1.0]])
CONFIG = VoxelConfig(size=0.02, extent=(0.8, 0.8, 0.6), below=0.2, stride=1, margin=0.02)


def wall_view(distance: float = 1.0, noise: np.ndarray | float = 0.0) -> View:
    """A camera 1 m from the origin on the -x side that sees a plane across its axis."""
    T_world_camera = transforms.look_at((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    depth = (np.full((120, 160), distance) + noise).astype(np.float32)
    return View(depth, K, T_world_camera)


def random_counts(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Hits and passes of a small map, full ones too."""
    hits = rng.choice([0, 0, 0, 1, 2, 255], (13, 17, 11)).astype(np.uint8)
    return hits, rng.choice([0, 1, 2, 5, 255], hits.shape).astype(np.uint8)


def a_view(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Depth, pinhole matrix and pose of a small image of scattered readings, some missing, some far."""
    depth = rng.uniform(0.2, 2.0, (23, 31)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0.0
    K = np.array([[30.0, 0.0, 15.2], [0.0, 28.0, 11.1], [0.0, 0.0, 1.0]])
    return depth, K, transforms.look_at(rng.uniform(-0.8, 0.8, 3), rng.uniform(-0.2, 0.2, 3))


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_entering_a_view_agrees_with_its_reference(stride: int):
    rng = np.random.default_rng(stride)
    for _ in range(3):
        hits, passes = random_counts(rng)
        args = (hits, passes, *a_view(rng), np.array([-0.3, -0.4, -0.2]), 0.05, stride, 0.07, 1.1)
        before = hits.copy(), passes.copy()
        compiled, reference = enter_view(*args), enter_view_reference(*args)
        for counted, right, old in zip(compiled, reference, before, strict=True):
            np.testing.assert_array_equal(counted, right)
            assert 5 < (counted != old).sum() < 0.9 * old.size
        np.testing.assert_array_equal((hits, passes), before)


def test_states_agree_with_their_reference():
    rng = np.random.default_rng(0)
    table = np.full((256, 256), FREE, dtype=np.int8)
    table[0, 0] = UNKNOWN
    table[:, 1:] = rng.choice([FREE, OCCUPIED], (256, 255))
    for _ in range(3):
        hits, passes = random_counts(rng)
        states, occupied = states_of(hits, passes, table, OCCUPIED)
        expected = states_of_reference(hits, passes, table, OCCUPIED)
        np.testing.assert_array_equal(states, expected[0])
        np.testing.assert_array_equal(occupied, expected[1])
        assert len(np.unique(states)) == 3


def test_the_voxels_of_points_agree_with_their_reference():
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3))
    args = (points, np.array([-0.3, -0.4, -0.2]), 0.05, (13, 17, 11))
    index = voxels_at(*args)
    np.testing.assert_array_equal(index, voxels_at_reference(*args))
    assert 10 < (index >= 0).sum() < 490


def shapes_about(rng: np.random.Generator) -> list:
    """Shapes in and about the map of `random_counts`, turned; one far away."""
    T = [transforms.rigid(transforms.random_rotation(rng), rng.uniform(-0.4, 0.5, 3)) for _ in range(6)]
    boxes = [Box(t, rng.uniform(0.05, 0.5, 3)) for t in T[:2]]
    cylinders = [Cylinder(t, 0.12, 0.3) for t in T[2:4]]
    return [*boxes, *cylinders, Sphere(T[4], 0.15), Sphere(transforms.rigid(np.eye(3), (9.0, 0.0, 0.0)), 0.2)]


def test_what_is_solid_agrees_with_its_reference():
    rng = np.random.default_rng(0)
    for shapes in ([], shapes_about(rng), shapes_about(rng)):
        hits, passes = random_counts(rng)
        hits[:4], hits[:, :, 9:] = 0, 0
        voxels = VoxelMap(np.array([-0.3, -0.4, -0.2]), hits, passes, VoxelConfig(size=0.05))
        solid = voxels.solid(shapes)
        whole = filled_reference(voxels.states == OCCUPIED, shapes, voxels.origin_world, 0.05)
        low = np.rint((solid.origin_world - voxels.origin_world) / 0.05).astype(int)
        window = tuple(slice(a, a + n) for a, n in zip(low, solid.grid.shape, strict=True))
        np.testing.assert_array_equal(solid.grid, whole[window])
        assert solid.grid.sum() == whole.sum() > 100
        assert shapes or solid.grid.shape == (9, 17, 9)
        centres = voxels.centres_world(np.indices(hits.shape).reshape(3, -1).T)
        np.testing.assert_array_equal(solid.holds(centres), whole.ravel() > 0)
        assert not solid.holds(centres + 5.0).any()


THREADED = """
import sys
import numba
import numpy as np
from test_voxels import K, shapes_about, wall_view
from caryatid.config import VoxelConfig
from caryatid.sensing.voxel_map import VoxelMap
voxels = VoxelMap.around((0.0, 0.0, 0.0), VoxelConfig())
for depth in (1.0, 1.2):
    voxels = voxels.integrate(wall_view(depth, np.random.default_rng(0).normal(0.0, 0.1, (120, 160))), 3.0)
solid = voxels.solid(shapes_about(np.random.default_rng(0)))
bytes_ = voxels.hits.tobytes() + voxels.passes.tobytes() + solid.grid.tobytes()
sys.stdout.write(f"{numba.get_num_threads()} {hash(bytes_)} {voxels.passes.sum()}")
"""


def test_the_number_of_threads_changes_no_bit():
    said = []
    for threads in ("1", "3"):
        path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
        env = os.environ | {"NUMBA_NUM_THREADS": threads, "PYTHONPATH": path, "PYTHONHASHSEED": "0"}
        run = subprocess.run(
            [sys.executable, "-c", THREADED], env=env, capture_output=True, text=True, check=True
        )
        said.append(run.stdout.split())
    assert [n for n, *_ in said] == ["1", "3"]
    assert said[0][1:] == said[1][1:]
    assert int(said[0][2]) > 10_000


def test_a_new_map_knows_nothing():
    voxels = VoxelMap.around((0.1, 0.2, 0.3), CONFIG)
    assert voxels.states.shape == (40, 40, 30)
    assert (voxels.states == UNKNOWN).all()
    np.testing.assert_allclose(voxels.origin_world, (-0.3, -0.2, 0.1))
    assert not voxels.solid().blocked(np.zeros((2, 3)), np.ones((3, 3)), 0.0).any()
    assert not voxels.solid().holds(np.zeros((2, 3))).any()


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
    assert voxels.solid().blocked(points, targets, 0.0).all(), "there is a hole in the wall"
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


def test_lines_of_sight_stop_at_what_is_solid_and_leave_the_clearance_out():
    box = Box(transforms.rigid(np.eye(3), (0.0, 0.0, 0.0)), np.array([0.1, 0.1, 0.1]))
    solid = VoxelMap.around((0.0, 0.0, 0.0), CONFIG).solid([box])
    points = np.array([[-0.2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    targets = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-0.2, 0.0, 1.0]])
    assert solid.blocked(points, targets, 0.0).tolist() == [[True, False, False], [True, True, True]]
    assert solid.blocked(points, targets, 0.12).tolist() == [[True, False, False], [False, False, False]]


def test_shapes_are_solid_inside_and_only_there():
    ball = Sphere(transforms.rigid(np.eye(3), (0.38, 0.0, 0.1)), 0.1)
    voxels = VoxelMap.around((0.0, 0.0, 0.0), CONFIG)
    solid = voxels.solid([ball])
    centres = voxels.centres_world(np.argwhere(voxels.states == UNKNOWN))
    inside = solid.holds(centres)
    assert inside.sum() > 100
    np.testing.assert_array_equal(inside, ball.signed_distance(centres) < 0.0)
    outside = Sphere(transforms.rigid(np.eye(3), (3.0, 0.0, 0.1)), 0.1)
    assert not VoxelMap.around((0.0, 0.0, 0.0), CONFIG).solid([outside]).grid.any()


def test_what_was_never_hit_is_not_occupied_however_misses_count():
    hits, passes = np.zeros((2, 3, 1, 1), dtype=np.uint8)
    hits[2], passes[1:] = 1, 9
    voxels = VoxelMap(np.zeros(3), hits, passes, VoxelConfig(miss=0.5))
    assert voxels.states.ravel().tolist() == [UNKNOWN, FREE, OCCUPIED]
    assert voxels.solid().grid.shape == (1, 1, 1)


def test_a_view_without_a_pose_is_refused():
    from caryatid.errors import InputError

    view = View(np.ones((12, 16), dtype=np.float32), K)
    with pytest.raises(InputError, match="no camera pose"):
        VoxelMap.around((0.0, 0.0, 0.0), CONFIG).integrate(view, 3.0)
