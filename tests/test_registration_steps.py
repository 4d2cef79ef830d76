"""The steps of registration: readings to surfels, surfels to correspondences, pairs of views to poses."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from synthetic import TABLE_TOP
from test_registration import CONFIG, seen_from

from caryatid.geometry import transforms
from caryatid.sensing import pose_graph
from caryatid.sensing.registration import find_correspondences, index_patches, step_down
from caryatid.sensing.surfels import even_sample, fit_planes, gather, surfels_of
from caryatid.sensing.views import SUPPORT_LABEL

EDGE, NOISE = 0.05, 0.001
PIVOT = np.array([0.02, -0.01, 0.03])
TWISTS = np.array([[0.004, -0.002, 0.003, 0.01, -0.02, 0.015], [-0.01, 0.006, 0.002, 0.03, 0.02, -0.05]])
STILL, MOVING = np.array([0, 0, 1, 2]), np.array([1, 2, 2, 3])


def readings(count=4000):
    """Points of several labels around the origin, in clumps of a few a voxel; label 0 is among them."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.06, 0.06, (count, 3))
    normals = transforms.unit(rng.normal(size=(count, 3)) + np.array([0.0, 0.0, 1.5]))
    return points, normals, rng.choice([0, 1, 2, SUPPORT_LABEL], count).astype(np.int32)


def test_the_order_of_readings_changes_no_patch():
    cloud = readings()
    shuffled = np.random.default_rng(1).permutation(len(cloud[0]))
    voxels, kinds, sums = gather(*cloud, 0.01, 0.03)
    other_voxels, other_kinds, other = gather(*(x[shuffled] for x in cloud), 0.01, 0.03)
    np.testing.assert_array_equal(voxels, other_voxels)
    np.testing.assert_array_equal(kinds, other_kinds)
    np.testing.assert_allclose(sums, other, rtol=1e-9, atol=1e-15)


def test_patches_are_the_same_bytes_on_any_number_of_threads():
    threads = numba.get_num_threads()
    expected = gather(*readings(), 0.01, 0.03)
    numba.set_num_threads(1)
    try:
        alone = gather(*readings(), 0.01, 0.03)
    finally:
        numba.set_num_threads(threads)
    assert [a.tobytes() for a in alone] == [e.tobytes() for e in expected]


def test_nothing_makes_no_patches():
    points, normals, labels = readings(count=20)
    for cloud in ((points, normals, 0 * labels), (points[:0], normals[:0], labels[:0])):
        assert [len(x) for x in gather(*cloud, 0.01, 0.03)] == [0, 0, 0]


def test_sides_that_determine_no_plane_do_no_harm():
    line = np.outer(np.arange(5.0), (1.0, 0.0, 0.0))
    points, side = np.concatenate([line, np.zeros((3, 3))]), np.array([0] * 5 + [2] * 3)
    normals, widths, heights = fit_planes(points, side, 0.001)
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(widths, 0.0, atol=1e-15)
    np.testing.assert_allclose(heights, 0.0, atol=1e-12)


def test_patches_are_better_than_readings_and_flat_sides_are_flat():
    patches, _ = surfels_of(seen_from(180.0, sigma=3e-3), CONFIG, same_labels=True)
    table = patches[patches[:, 7] == SUPPORT_LABEL]
    assert np.abs(table[:, 2] - TABLE_TOP).std() < 1e-3
    np.testing.assert_array_equal(table[:, 3:6], np.tile(table[0, 3:6], (len(table), 1)))
    assert set(np.unique(patches[:, 7])) == {1, 2, 3, 4, SUPPORT_LABEL}


def test_the_sample_is_even_over_sides():
    patches, side = surfels_of(seen_from(180.0), CONFIG, same_labels=True)
    sample = even_sample(side, 200)
    assert len(np.unique(sample)) == 200
    picked, whole = np.bincount(side[sample]), np.bincount(side)
    scarce = picked[(whole > 0) & (whole > picked)]
    assert scarce.max() <= scarce.min() + 1
    np.testing.assert_array_equal(even_sample(side, 10**6), np.arange(len(patches)))


def patches(seed, count=700):
    """Patches of three labels on the faces of a 30 cm cube, normals off by a few degrees."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.15, 0.15, (count, 3))
    axis = rng.integers(0, 3, count)
    sign = rng.choice([-1.0, 1.0], count)
    points[np.arange(count), axis] = 0.15 * sign + 0.002 * rng.normal(size=count)
    normals = 0.1 * rng.normal(size=(count, 3))
    normals[np.arange(count), axis] += sign
    return np.column_stack(
        [points, transforms.unit(normals), rng.uniform(1e-7, 1e-6, count), rng.integers(1, 4, count)]
    )


def rows(reach, twist=TWISTS[1], other_twist=TWISTS[0]):
    other = index_patches(patches(0), EDGE)
    return find_correspondences(patches(1)[:130], twist, *other, other_twist, PIVOT, EDGE, reach, NOISE)


def test_partners_are_the_nearest_in_place_and_direction():
    found, samples, others = rows(0.05, 0.0 * TWISTS[1], 0.0 * TWISTS[0]), patches(1)[:130], patches(0)
    offsets = others[:, :3] - samples[:, None, :3]
    squared = np.sum(offsets**2, axis=2)
    cosine = samples[:, 3:6] @ others[:, 3:6].T
    cost = squared + 2.0 * 0.05**2 * (1.0 - cosine)
    cost[(squared >= 0.05**2) | (cosine <= 0.9) | (samples[:, 7:] != others[:, 7])] = np.inf
    nearest = np.argmin(cost, axis=1)
    known = np.isfinite(cost.min(axis=1))
    assert 0 < known.sum() < 130
    np.testing.assert_array_equal(found[:, 7] > 0.0, known)
    mean = transforms.unit(samples[:, 3:6] + others[nearest, 3:6])
    distance = -np.einsum("ni,ni->n", offsets[np.arange(130), nearest], mean)
    np.testing.assert_allclose(found[known, 6], distance[known], atol=1e-12)
    np.testing.assert_allclose(found[known, :3], mean[known], atol=1e-12)
    variance = samples[:, 6] + others[nearest, 6] + NOISE**2
    np.testing.assert_allclose(1.0 / found[known, 7], variance[known], rtol=1e-9)


def test_patches_beyond_each_other_find_nothing():
    assert not rows(0.1, TWISTS[1] + np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])).any()


def test_distances_change_as_the_derivative_says():
    step = 1e-5 * np.array([1.0, -2.0, 0.5, 3.0, 1.0, -2.0])
    before = rows(0.03)
    predicted = before[:, 6] + before[:, :6] @ step
    assert np.abs(predicted - before[:, 6]).max() > 2e-5
    # Both views moved alike change nothing.
    for other_step, expected in ((0.0, predicted), (1.0, before[:, 6])):
        after = rows(0.03, TWISTS[1] + step, TWISTS[0] + other_step * step)
        same = (after[:, 7] == before[:, 7]) & (after[:, 7] > 0.0)
        assert same.sum() > 0.9 * (after[:, 7] > 0.0).sum()
        # Normals that differ by several degrees make the derivative a little less than exact.
        np.testing.assert_allclose(after[same, 6], expected[same], atol=6e-7)


def test_without_steps_nothing_moves():
    step, ends = step_down(rows(0.05), TWISTS[1], np.eye(6), 0.2, 0.01, 0, 0.0)
    assert not step.any()
    assert ends[0, 0] > 0


def positive(rng, count):
    A = rng.normal(size=(count, 6, 6))
    return A @ A.swapaxes(1, 2) + np.eye(6)


def pairs(seed):
    rng, edges = np.random.default_rng(seed), np.zeros(len(STILL), pose_graph.EDGE)
    edges["still"], edges["moving"], edges["apart"] = STILL, MOVING, 0.1 * rng.normal(size=(4, 6))
    edges["asked"], edges["found"] = (100, 100, 50, 50), (80.0, 20.0, 10.0, 50.0)
    edges["misfit"] = 0.08, 0.02, 0.01, 0.1
    edges["gradient"], edges["information"] = rng.normal(size=(4, 6)), positive(rng, 4)
    return edges


def cost(edges, twists, free, informations):
    change = twists[MOVING] - twists[STILL] - edges["apart"]
    quadratic = np.einsum("ei,eij,ej->", change, edges["information"], change) / 2.0
    prior = np.einsum("fi,fij,fj->", twists[free], informations, twists[free]) / 2.0
    return quadratic + prior + float(np.sum(edges["gradient"] * change))


def test_the_solution_is_the_minimum_and_the_matrix_its_curvature():
    rng = np.random.default_rng(0)
    edges, free, informations = pairs(0), np.array([1, 3]), positive(rng, 2)
    start = 0.1 * rng.normal(size=(4, 6))
    twists, hessian = pose_graph.solve(edges, start, free, informations)
    np.testing.assert_array_equal(twists[[0, 2]], start[[0, 2]])
    least = cost(edges, twists, free, informations)
    for _ in range(20):
        step = rng.normal(size=12)
        other = twists.copy()
        other[free] += step.reshape(2, 6)
        rise = cost(edges, other, free, informations) - least
        np.testing.assert_allclose(rise, step @ hessian @ step / 2.0, rtol=1e-9)


@pytest.mark.parametrize("edges", [pairs(1), pairs(1)[:0]], ids=["four pairs", "none"])
def test_views_that_may_not_move_do_not(edges):
    start = np.random.default_rng(1).normal(size=(4, 6))
    twists, _ = pose_graph.solve(edges, start, np.zeros(0, dtype=np.intp), np.zeros((0, 6, 6)))
    np.testing.assert_array_equal(twists, start)


def test_pairs_know_their_partners_and_which_of_them_moved():
    edges = pairs(3)
    np.testing.assert_array_equal(pose_graph.partners(edges, 5), [100.0, 90.0, 80.0, 50.0, 0.0])
    # 300 patches asked, 160 found partners 0.21 m off in all, the others count as 1 cm off.
    np.testing.assert_allclose(pose_graph.mean_misfit(edges, 0.01), (0.21 + 140 * 0.01) / 300)
    rest = pose_graph.among(edges, [0, 2, 3])
    np.testing.assert_array_equal(np.stack([rest["still"], rest["moving"]]), [[0, 2], [2, 3]])
    twists = np.zeros((4, 6))
    for pair in (0, 1, 3):
        twists[MOVING[pair]] = twists[STILL[pair]] + edges["apart"][pair]
    for moved in (twists, twists + 0.5):
        still = np.abs(pose_graph.change(edges, moved)).max(axis=1) < 1e-12
        np.testing.assert_array_equal(still, [True, True, False, True])
