from __future__ import annotations

import numpy as np
import pytest
from raycast import K, from_the_side, table_scene

from caryatid.config import CloudConfig
from caryatid.geometry import transforms
from caryatid.sensing.clouds import estimate_normals, oriented_points
from caryatid.sensing.views import View

CONFIG = CloudConfig()
SPHERE = (np.array([0.0, 0.0, 0.87]), 0.12)


def angles(a, b):
    return np.degrees(transforms.angle_between(a, b))


def test_normals_of_a_noisy_sphere_point_outwards():
    T = from_the_side(distance=0.9)
    view = table_scene(T, spheres=[SPHERE], sigma=0.001)
    points, normals, pixels = oriented_points(view, CONFIG)
    on_sphere = view.labels.ravel()[pixels] == 1
    outward = points[on_sphere] - SPHERE[0]
    assert np.median(angles(normals[on_sphere], outward)) < 6.0
    assert np.einsum("ij,ij->i", normals, T[:3, 3] - points).min() > 0.0


def test_normals_do_not_smooth_over_depth_edges_and_need_readings():
    depth = np.full((60, 80), 1.0, dtype=np.float32)
    depth[:, 40:], depth[:20], depth[10, 10], depth[:5] = 1.1, 0.0, 1.0, 5.0
    _, normals, pixels = oriented_points(View(depth=depth, K=K), CONFIG)
    assert pixels.min() >= 20 * 80
    beside = np.isin(pixels % 80, range(38, 42))
    assert beside.sum() == 4 * 40
    np.testing.assert_allclose(normals[beside], np.broadcast_to((0.0, 0.0, -1.0), (160, 3)), atol=1e-3)


def test_normals_of_a_cloud_follow_rigid_motion_and_face_the_viewpoint():
    rng = np.random.default_rng(0)
    directions = transforms.unit(rng.normal(size=(2000, 3)))
    points, viewpoint = 0.1 * directions, np.array([0.0, 0.0, 3.0])
    normals = estimate_normals(points, viewpoint, 12)
    upper = directions[:, 2] > 0.3
    assert angles(normals[upper], directions[upper]).max() < 12.0
    assert (np.einsum("ij,ij->i", normals, viewpoint - points) >= 0.0).all()
    T = transforms.rigid(transforms.random_rotation(rng), (0.3, -0.2, 0.5))
    moved = estimate_normals(transforms.transform(T, points), transforms.transform(T, viewpoint), 12)
    np.testing.assert_allclose(moved, transforms.rotate(T, normals), atol=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_normals_of_degenerate_clouds_face_the_viewpoint(count):
    points = np.outer(np.arange(count), (0.01, 0.0, 0.0))
    normals = estimate_normals(points, np.array([0.0, 0.0, 1.0]), 8)
    assert normals.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0)
    assert (normals[:, 2] > 0.9).all()
