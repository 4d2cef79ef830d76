"""Which points are kept in a voxel: compiled as by NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from caryatid.geometry.points import last_in_voxels, most_central

EDGES = np.array([0.0, 0.02, 0.05])


@pytest.fixture
def points():
    rng = np.random.default_rng(0)
    return rng.uniform(-0.15, 0.15, size=(4000, 3)) * (1.0, 1.0, 0.2)


def test_of_points_as_near_to_the_mean_the_first_is_kept():
    twice = np.repeat([[0.005, 0.005, 0.005], [0.013, 0.005, 0.005]], [2, 2], axis=0)
    assert most_central(twice, np.ones(4, dtype=np.int32), EDGES).tolist() == [0]


def test_nothing_is_kept_of_nothing():
    assert len(most_central(np.zeros((0, 3)), np.zeros(0, dtype=np.int32), EDGES)) == 0
    assert len(most_central(np.zeros((5, 3)), np.zeros(5, dtype=np.int32), EDGES)) == 0
    assert len(last_in_voxels(np.zeros((0, 3)), 0.02, 3)) == 0


def test_the_last_points_of_each_voxel_stay(points):
    voxel = np.floor(points / 0.03).astype(int)
    later = [(voxel[i:] == voxel[i]).all(axis=1).sum() for i in range(len(points))]
    np.testing.assert_array_equal(last_in_voxels(points, 0.03, 4), np.flatnonzero(np.array(later) <= 4))
