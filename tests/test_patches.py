"""Readings are averaged to patches and patches to planes as plain NumPy does it."""

from __future__ import annotations

import numba
import numpy as np

from caryatid.geometry import transforms
from caryatid.sensing.surfel_kernels import fit_planes, gather_patches

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


def gathered_reference(points, normals, labels):
    points, normals, labels = (x[labels != 0] for x in (points, normals, labels))
    spacing = np.where(labels == LABEL_FAR, FAR, NEAR)
    cells = np.floor(points / spacing[:, None]).astype(int)
    way = np.argmax(np.abs(normals), axis=1)
    way += 3 * (normals[np.arange(len(way)), way] < 0.0)
    keys = np.column_stack([cells, 6 * labels + way])
    unique, owner = np.unique(keys, axis=0, return_inverse=True)
    rows = np.empty((len(unique), 9))
    for k in range(len(unique)):
        p, n = points[owner.ravel() == k], normals[owner.ravel() == k]
        mean, length = n.mean(axis=0), np.linalg.norm(n.mean(axis=0))
        spread = np.var((p - p.mean(axis=0)) @ (mean / length))
        rows[k] = len(p), *p.mean(axis=0), *(mean / length), length, spread / len(p)
    return unique[:, 3], rows


def test_patches_are_the_averages_of_their_readings():
    kinds, rows = gathered(*readings())
    expected_kinds, expected = gathered_reference(*readings())
    np.testing.assert_array_equal(kinds, expected_kinds)
    np.testing.assert_allclose(rows, expected, rtol=1e-9, atol=1e-15)
    assert rows[:, 0].max() > 10
    assert (kinds // 6 == 0).sum() == 0


def test_the_order_of_readings_changes_no_patch():
    cloud = readings()
    shuffled = np.random.default_rng(1).permutation(len(cloud[0]))
    kinds, rows = gathered(*cloud)
    other_kinds, other = gathered(*(x[shuffled] for x in cloud))
    np.testing.assert_array_equal(kinds, other_kinds)
    np.testing.assert_allclose(rows, other, rtol=1e-9, atol=1e-15)


def test_a_far_cloud_keeps_its_digits():
    points, normals, labels = readings()
    shift = np.array([90.0, -60.0, 30.0])
    np.testing.assert_allclose(
        gathered(points + shift, normals, labels)[1][:, 8],
        gathered_reference(points + shift, normals, labels)[1][:, 8],
        rtol=1e-6,
        atol=1e-12,
    )


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


def planes_reference(points, side, flat, rounds):
    weights, normals, widths, heights = np.ones(len(points)), [], [], np.zeros(len(points))
    for _ in range(rounds):
        normals, widths = [], []
        for s in range(side.max() + 1):
            w, p = weights[side == s], points[side == s]
            offset = p - np.average(p, axis=0, weights=w)
            values, vectors = np.linalg.eigh((offset.T * w) @ offset / w.sum())
            normals.append(vectors[:, 0])
            widths.append(values[1])
            heights[side == s] = offset @ vectors[:, 0]
        weights = 1.0 / (1.0 + (heights / flat) ** 2) ** 2
    return np.array(normals), np.array(widths), heights


def test_planes_are_those_of_least_spread():
    rng = np.random.default_rng(0)
    side = rng.integers(0, 6, 600)
    flat_points = rng.normal(size=(600, 3)) * (0.05, 0.02, 0.001)
    turns = np.stack([transforms.random_rotation(rng) for _ in range(6)])
    points = np.einsum("nij,nj->ni", turns[side], flat_points) + rng.normal(size=(6, 3))[side]
    points[::9] += 0.02 * rng.normal(size=points[::9].shape)
    normals, widths, heights = fit_planes(points, side, 6, 0.002, 4)
    expected_normals, expected_widths, expected = planes_reference(points, side, 0.002, 4)
    np.testing.assert_allclose(np.abs(np.sum(normals * expected_normals, axis=1)), 1.0, atol=1e-9)
    np.testing.assert_allclose(widths, expected_widths, rtol=1e-6)
    np.testing.assert_allclose(np.abs(heights), np.abs(expected), atol=1e-9)


def test_sides_that_determine_no_plane_do_no_harm():
    line = np.outer(np.arange(5.0), (1.0, 0.0, 0.0))
    points, side = np.concatenate([line, np.zeros((3, 3))]), np.array([0] * 5 + [2] * 3)
    normals, widths, heights = fit_planes(points, side, 3, 0.001, 4)
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(widths, 0.0, atol=1e-15)
    np.testing.assert_allclose(heights, 0.0, atol=1e-12)
