"""Surfels: readings are averaged alike in any order and on any number of threads."""

from __future__ import annotations

import numba
import numpy as np

from caryatid.geometry import transforms
from caryatid.sensing.surfels import fit_planes, gather_patches

NEAR, FAR, LABEL_FAR = 0.01, 0.03, 9


def readings(seed=0, count=4000):
    """Points of several labels around the origin, in clumps of a few a voxel; label 0 is among them."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.06, 0.06, (count, 3))
    normals = transforms.unit(rng.normal(size=(count, 3)) + np.array([0.0, 0.0, 1.5]))
    return points, normals, rng.choice([0, 1, 2, LABEL_FAR], count).astype(np.int32)


def gathered(points, normals, labels):
    voxels, kinds, rows = gather_patches(points, normals, labels, NEAR, FAR, LABEL_FAR)
    order = np.lexsort((kinds, voxels))
    return kinds[order], rows[order]


def test_the_order_of_readings_changes_no_patch():
    cloud = readings()
    shuffled = np.random.default_rng(1).permutation(len(cloud[0]))
    kinds, rows = gathered(*cloud)
    other_kinds, other = gathered(*(x[shuffled] for x in cloud))
    np.testing.assert_array_equal(kinds, other_kinds)
    np.testing.assert_allclose(rows, other, rtol=1e-9, atol=1e-15)


def test_patches_are_the_same_bytes_on_any_number_of_threads():
    threads = numba.get_num_threads()
    expected = gather_patches(*readings(), NEAR, FAR, LABEL_FAR)
    numba.set_num_threads(1)
    try:
        alone = gather_patches(*readings(), NEAR, FAR, LABEL_FAR)
    finally:
        numba.set_num_threads(threads)
    assert [a.tobytes() for a in alone] == [e.tobytes() for e in expected]


def test_nothing_makes_no_patches():
    points, normals, labels = readings(count=20)
    for cloud in ((points, normals, 0 * labels), (points[:0], normals[:0], labels[:0])):
        assert [len(x) for x in gather_patches(*cloud, NEAR, FAR, LABEL_FAR)] == [0, 0, 0]


def test_sides_that_determine_no_plane_do_no_harm():
    line = np.outer(np.arange(5.0), (1.0, 0.0, 0.0))
    points, side = np.concatenate([line, np.zeros((3, 3))]), np.array([0] * 5 + [2] * 3)
    normals, widths, heights = fit_planes(points, side, 3, 0.001, 4)
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(widths, 0.0, atol=1e-15)
    np.testing.assert_allclose(heights, 0.0, atol=1e-12)
