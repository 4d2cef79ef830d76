from __future__ import annotations

import numpy as np
import pytest
from raycast import K

from caryatid.config import CloudConfig
from caryatid.sensing.clouds import estimate_normals, oriented_points
from caryatid.sensing.views import View

CONFIG = CloudConfig()


def test_normals_do_not_smooth_over_depth_edges_and_need_readings():
    depth = np.full((60, 80), 1.0, dtype=np.float32)
    depth[:, 40:], depth[:20], depth[10, 10], depth[:5] = 1.1, 0.0, 1.0, 5.0
    _, normals, pixels = oriented_points(View(depth=depth, K=K), CONFIG)
    assert pixels.min() >= 20 * 80
    beside = np.isin(pixels % 80, range(38, 42))
    assert beside.sum() == 4 * 40
    np.testing.assert_allclose(normals[beside], np.broadcast_to((0.0, 0.0, -1.0), (160, 3)), atol=1e-3)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_normals_of_degenerate_clouds_face_the_viewpoint(count):
    points = np.outer(np.arange(count), (0.01, 0.0, 0.0))
    normals = estimate_normals(points, np.array([0.0, 0.0, 1.0]), 8)
    assert normals.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0)
    assert (normals[:, 2] > 0.9).all()
