"""Correspondences between views: found only within reach, alike on any number of threads, well derived."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from caryatid.geometry import transforms
from caryatid.runtime.parallel import for_each
from caryatid.sensing.registration import (
    CHUNK,
    Search,
    find_correspondences,
    index_patches,
    step_down,
)

EDGE, MIN_COSINE, NORMAL_REACH, NOISE = 0.05, 0.9, 0.05, 0.001
PIVOT = np.array([0.02, -0.01, 0.03])
TWISTS = np.array(
    [[0.004, -0.002, 0.003, 0.01, -0.02, 0.015], np.zeros(6), [-0.01, 0.006, 0.002, 0.03, 0.02, -0.05]]
)


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


def views(count=3):
    indexed = [index_patches(patches(seed), EDGE) for seed in range(count)]
    before = np.cumsum([0, *(len(p) for p, _ in indexed)])
    starts = np.stack([s + n for (_, s), n in zip(indexed, before[:-1], strict=True)])
    samples = np.concatenate([patches(seed)[:130] for seed in range(count)])
    return np.concatenate([p for p, _ in indexed]), starts, samples


def tasks(pairs, stride=1):
    return np.array(
        [
            (130 * m + i, min(130 * m + i + CHUNK * stride, 130 * (m + 1)), stride, s, m)
            for s, m in pairs
            for i in range(0, 130, CHUNK * stride)
        ]
    )


def searched(reach, chunks, twists=TWISTS, shares=None):
    settings = (EDGE, reach, MIN_COSINE, NORMAL_REACH, NOISE)
    shares, rows = shares or len(chunks), np.zeros((len(chunks), CHUNK, 8))
    search = Search(*views(), chunks, shares, twists, PIVOT, *settings, rows)
    for_each(find_correspondences, shares, search)
    return search


def rows_of(reach, pairs=((0, 2), (1, 2), (0, 1)), stride=1, twists=TWISTS):
    return searched(reach, tasks(pairs, stride), twists).rows.reshape(-1, 8)


def found(*args, **options):
    rows = rows_of(*args, **options)
    return rows[rows[:, 7] > 0.0]


def test_patches_beyond_each_other_find_nothing():
    away = TWISTS + np.array([[0.0] * 6, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0] * 6])
    search = searched(0.1, tasks([(1, 2)]))
    assert search.rows.any()
    # What an earlier search found is gone.
    for_each(find_correspondences, search.shares, search._replace(twists=away))
    assert not search.rows.any()


@pytest.mark.parametrize("shares", [1, 2, 100])
def test_partners_are_the_same_bytes_in_any_number_of_shares(shares):
    chunks = tasks([(0, 2), (1, 2), (0, 1)])
    expected = searched(0.05, chunks).rows
    assert searched(0.05, chunks, shares=shares).rows.tobytes() == expected.tobytes()


def test_partners_are_the_same_bytes_on_any_number_of_threads():
    threads = numba.get_num_threads()
    expected = found(0.05)
    numba.set_num_threads(1)
    try:
        assert found(0.05).tobytes() == expected.tobytes()
    finally:
        numba.set_num_threads(threads)


def test_distances_change_as_the_derivative_says():
    step = 1e-5 * np.array([1.0, -2.0, 0.5, 3.0, 1.0, -2.0])
    before = rows_of(0.03)
    predicted = before[:, 6] + before[:, :6] @ step
    assert np.abs(predicted - before[:, 6]).max() > 2e-5
    # Two of the three pairs have the last view as the moving one. All views moved alike change nothing.
    for moved, expected, pairs in (([2], predicted, 2), ([0, 1, 2], before[:, 6], 3)):
        twists = TWISTS.copy()
        twists[moved] += step
        after = rows_of(0.03, twists=twists)[: pairs * 3 * CHUNK]
        same = (after[:, 7] == before[: len(after), 7]) & (after[:, 7] > 0.0)
        assert same.sum() > 0.9 * (after[:, 7] > 0.0).sum()
        # Normals that differ by several degrees make the derivative a little less than exact.
        np.testing.assert_allclose(after[same, 6], expected[: len(after)][same], atol=6e-7)


def test_without_steps_nothing_moves():
    rows = searched(0.05, tasks([(0, 2)])).rows
    result = step_down(rows, TWISTS[2], np.eye(6), 0.2, 0.01, 0, 0.0)
    assert not result[:6].any()
    np.testing.assert_array_equal(result[6:8], result[8:])
