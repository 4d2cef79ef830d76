from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from synthetic import random_motion

from caryatid import frames
from caryatid.kernels.fitting import BOX, CYLINDER, SPHERE
from caryatid.kernels.hypotheses import (
    any_within,
    count_agreeing,
    hypothesis_distances,
    trimmed_ranges,
)
from caryatid.shapes import Box, Cylinder, Sphere


def shapes_of(kind, count, rng):
    """Shapes of one kind in any pose."""
    poses = [random_motion(rng, 0.05) for _ in range(count)]
    if kind == BOX:
        return [Box(T, rng.uniform(0.03, 0.2, 3)) for T in poses]
    if kind == CYLINDER:
        return [Cylinder(T, *rng.uniform(0.03, 0.2, 2)) for T in poses]
    return [Sphere(T, rng.uniform(0.03, 0.1)) for T in poses]


@pytest.mark.parametrize("kind", [BOX, CYLINDER, SPHERE])
def test_distances_to_many_shapes_are_the_shapes_own(kind):
    rng = np.random.default_rng(0)
    shapes = shapes_of(kind, 5, rng)
    points = rng.uniform(-0.2, 0.2, (100, 3))
    T = np.array([s.T_world_object for s in shapes])
    valid = np.array([True, True, False, True, True])
    extents = np.array([s.extents for s in shapes])
    distance = hypothesis_distances(
        kind, T[:, :3, :3].copy(), T[:, :3, 3].copy(), extents / 2.0, valid, points
    )
    expected = np.array([np.abs(s.signed_distance(points)) for s in shapes])
    expected[~valid] = np.inf
    np.testing.assert_allclose(distance, expected, atol=1e-12)


@pytest.mark.parametrize("beyond", [0, 1, 7])
def test_the_trimmed_range_leaves_out_as_many_points_at_either_end(beyond):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(60, 3))
    directions = frames.unit(rng.normal(size=(4, 3)))
    ordered = np.sort(points @ directions.T, axis=0)
    low, high = trimmed_ranges(points, directions, beyond)
    np.testing.assert_allclose(low, ordered[beyond])
    np.testing.assert_allclose(high, ordered[-1 - beyond])


def test_samples_near_points_are_those_a_search_tree_finds():
    rng = np.random.default_rng(2)
    points, samples = rng.uniform(size=(80, 3)), rng.uniform(size=(200, 3))
    gap, _ = cKDTree(points).query(samples)
    found = any_within(samples, points, 0.1)
    np.testing.assert_array_equal(found, gap <= 0.1)
    assert 0 < found.sum() < len(samples)


def test_normals_are_counted_with_those_that_agree():
    normals = frames.unit(np.random.default_rng(3).normal(size=(70, 3)))
    expected = (normals @ normals.T > 0.8).sum(axis=1)
    np.testing.assert_array_equal(count_agreeing(normals, 0.8), expected)
