"""Nearest neighbours of points among themselves, beside SciPy's tree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from caryatid.geometry.neighbours import SHARE, nearest_neighbours


@pytest.mark.parametrize(("size", "count"), [(1, 1), (5, 5), (SHARE, 4), (SHARE + 1, 9), (700, 12)])
@pytest.mark.parametrize("axis", range(3))
def test_distances_are_those_of_the_tree(size, count, axis):
    rng = np.random.default_rng([size, axis])
    points = rng.normal(size=(size, 3))
    points[:, axis] *= 5.0
    found = nearest_neighbours(points, count)
    expected, _ = cKDTree(points).query(points, k=count)
    distances = np.linalg.norm(points[found] - points[:, None], axis=-1)
    np.testing.assert_allclose(distances, expected.reshape(size, count), atol=1e-12)
    np.testing.assert_array_equal(found[:, 0], np.arange(size))


def test_points_at_the_same_place_are_each_others_neighbours():
    points = np.repeat(np.random.default_rng(0).normal(size=(40, 3)), 3, axis=0)
    found = nearest_neighbours(points, 3)
    assert (np.sort(found, axis=1) // 3 == np.arange(120)[:, None] // 3).all()
    assert all(len(set(row)) == 3 for row in found.tolist())


def test_points_in_a_row_and_no_points():
    row = np.outer(np.arange(10.0), [0.0, 0.0, 1.0])
    assert (np.abs(nearest_neighbours(row, 2)[1:, 1] - np.arange(1, 10)) == 1).all()
    assert nearest_neighbours(np.zeros((0, 3)), 0).shape == (0, 0)
