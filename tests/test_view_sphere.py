from __future__ import annotations

import numpy as np

from caryatid.config import ActiveVisionConfig
from caryatid.geometry import transforms
from caryatid.sensing.view_sphere import ViewSphere

SPHERE = ViewSphere.around((0.1, -0.2, 0.75), ActiveVisionConfig(sphere_points=2000))


def test_views_lie_on_the_sphere_and_are_spread_evenly():
    distance = np.linalg.norm(SPHERE.positions_world - SPHERE.centre_world, axis=-1)
    np.testing.assert_allclose(distance, 1.5)
    np.testing.assert_allclose(SPHERE.directions.mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(SPHERE.directions.T @ SPHERE.directions / 2000, np.eye(3) / 3, atol=1e-3)


def test_poses_look_at_the_centre_like_look_at_does():
    directions = np.vstack([SPHERE.directions[::50], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    for T, d in zip(SPHERE.poses(directions), directions, strict=True):
        expected = transforms.look_at(SPHERE.centre_world + 1.5 * d, SPHERE.centre_world)
        np.testing.assert_allclose(T, expected, atol=1e-9)


def test_direction_of_a_pose_is_where_it_came_from():
    poses = SPHERE.poses(SPHERE.directions[:100])
    np.testing.assert_allclose(SPHERE.direction_of(poses), SPHERE.directions[:100], atol=1e-12)
    np.testing.assert_allclose(SPHERE.direction_of(poses[7]), SPHERE.directions[7], atol=1e-12)
