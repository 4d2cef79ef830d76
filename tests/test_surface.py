"""The support surface: its compiled loops agree with NumPy, and what is over it."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from raycast import TABLE, from_the_side, table_scene

from caryatid.config import CloudConfig, SurfaceConfig
from caryatid.geometry import transforms
from caryatid.segmentation.outlines import (
    within_prism,
    within_prism_reference,
)
from caryatid.segmentation.support_plane import find_support_surface
from caryatid.segmentation.support_plane_kernels import (
    plane_gains,
    plane_gains_reference,
    plane_inliers,
    plane_inliers_reference,
)
from caryatid.sensing.clouds import oriented_points

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def cloud():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, size=(3000, 3)) * (1.0, 1.0, 0.03)
    return points, transforms.unit(UP + rng.normal(0.0, 0.3, size=(3000, 3)))


@pytest.mark.parametrize("penalty", [0.0, 1.0])
def test_planes_score_as_by_numpy(cloud, penalty):
    rng = np.random.default_rng(1)
    planes = transforms.unit(UP + rng.normal(0.0, 0.03, size=(77, 3))), rng.uniform(-0.02, 0.02, size=77)
    gains = plane_gains(*cloud, *planes, 0.01, 0.95, penalty)
    np.testing.assert_allclose(gains, plane_gains_reference(*cloud, *planes, 0.01, 0.95, penalty), atol=1e-9)
    assert gains.max() > 100.0
    assert np.unique(gains).size > 70


def test_inliers_of_a_plane_are_those_of_numpy(cloud):
    among = np.arange(3000) % 3 > 0
    for offset in (0.002, 3.0):
        plane = transforms.unit((0.01, -0.02, 1.0)), offset
        found = plane_inliers(*cloud, among, plane, 0.004, 0.95)
        for ours, theirs in zip(
            found, plane_inliers_reference(*cloud, among, plane, 0.004, 0.95), strict=True
        ):
            np.testing.assert_allclose(ours, theirs, atol=1e-12)
        assert (found[1] > 100) == (offset < 1.0)


def test_what_is_over_an_outline_is_as_by_numpy(cloud):
    corners = np.array([[-0.3, -0.2], [0.3, -0.25], [0.35, 0.2], [-0.1, 0.3]])
    edges = transforms.unit(np.roll(corners, -1, axis=0) - corners)
    outward = np.stack([edges[:, 1], -edges[:, 0]], axis=-1)
    sides = np.column_stack([outward, np.sum(outward * corners, axis=1)])
    prism = cloud[0], np.array([0.01, 0.0, 0.001]), np.eye(3), sides, -0.005, 0.01, 0.02
    inside = within_prism(*prism)
    np.testing.assert_array_equal(inside, within_prism_reference(*prism))
    assert 0.1 < inside.mean() < 0.5


def test_what_is_over_the_table_goes_by_height_and_distance():
    points, normals, _ = oriented_points(table_scene(from_the_side()), CloudConfig())
    surface = find_support_surface(points, normals, UP, SurfaceConfig(), np.random.default_rng(0))
    asked = np.random.default_rng(1).uniform((-0.5, -0.6, TABLE - 0.1), (0.5, 0.6, TABLE + 0.2), (4000, 3))
    over = surface.over(asked, 0.01, 0.15, 0.05)
    height, outside = surface.height(asked), surface.distance_outside(asked)
    np.testing.assert_array_equal(over, (height > 0.01) & (height < 0.15) & (outside <= 0.05))
    assert 0.1 < over.mean() < 0.9


def test_a_view_gives_the_same_on_any_number_of_threads():
    view = table_scene(from_the_side(), sigma=0.001)
    before = numba.get_num_threads()
    found = []
    try:
        for threads in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(threads)
            points, normals, _ = oriented_points(view, CloudConfig())
            surface = find_support_surface(points, normals, UP, SurfaceConfig(), np.random.default_rng(0))
            found.append((points.tobytes(), normals.tobytes(), surface.outline_world.tobytes()))
    finally:
        numba.set_num_threads(before)
    assert found[0] == found[1]
