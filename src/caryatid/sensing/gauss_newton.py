"""Compiled least squares on the distances of partners; the tests hold it to plain NumPy."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.points import solve_positive
from caryatid.geometry.transforms import Array

SUMS = 29
"""Of a group of partners: how many; the sum of their distances [m], none counting more than an outlier; the
gradient (6,); the upper half of the matrix (6, 6), row by row."""


@njit(cache=True, error_model="numpy")
def normal_equations(
    rows: NDArray[np.float64], groups: NDArray[np.int64], count: int, outlier: float
) -> Array:
    """Sum up the robust normal equations of groups of rows.

    Args:
        rows: (R, CHUNK, 8) as of `partners.Search`.
        groups: Group (R,) of each task.
        count: How many groups there are.
        outlier: Distance beyond which partners lose their weight [m].

    Returns:
        Sums (G, SUMS), G = `count`.
    """
    sums, step = np.zeros((count, SUMS)), np.zeros(6)
    for task in range(len(rows)):
        _sum_up(rows[task], step, outlier, sums[groups[task]])
    return sums


@njit(cache=True, error_model="numpy")
def step_down(
    rows: NDArray[np.float64],
    twist: NDArray[np.float64],
    information: NDArray[np.float64],
    independent: float,
    outlier: float,
    steps: int,
    settled: float,
) -> Array:
    """Move a view such that its partners come to lie in each other's planes; the partners stay the same.

    Gauss–Newton on the robust distances and the view's pose as reported.

    Args:
        rows: (R, CHUNK, 8) as of `partners.Search`, found with the view where it is.
        twist: Where it is, from where it was reported (6,).
        information: Inverse covariance (6, 6) of the reported pose's twist.
        independent: Share of the partners that err independently.
        outlier: Distance beyond which partners lose their weight [m].
        steps: Steps at the most.
        settled: A smaller step is the last [m, rad].

    Returns:
        (10,): by how much the twist changes (6,); partners found and the sum of their distances [m], none
        counting more than an outlier, before and after.
    """
    result, step, gradient, hessian = np.zeros(10), np.zeros(6), np.zeros(6), np.zeros((6, 6))
    sums = np.zeros(SUMS)
    largest = np.inf
    for number in range(steps + 1):
        for k in range(SUMS):
            sums[k] = 0.0
        for task in range(len(rows)):
            _sum_up(rows[task], step, outlier, sums)
        if number == 0:
            result[6], result[7] = sums[0], sums[1]
        if number == steps or largest < settled:
            break
        k = 8
        for a in range(6):
            gradient[a] = independent * sums[2 + a]
            for b in range(6):
                gradient[a] += information[a, b] * (twist[b] + step[b])
            for b in range(a, 6):
                hessian[b, a] = information[a, b] + independent * sums[k]
                k += 1
        change = solve_positive(hessian, gradient)
        largest = 0.0
        for a in range(6):
            step[a] -= change[a]
            largest = max(largest, abs(change[a]))
    for a in range(6):
        result[a] = step[a]
    result[8], result[9] = sums[0], sums[1]
    return result


@njit(cache=True, error_model="numpy")
def _sum_up(rows, step, outlier, total):  # type: ignore[no-untyped-def]
    """Add rows (N, 8), after a step (6,) of the moving view, to the total (SUMS,)."""
    for i in range(len(rows)):
        row = rows[i]
        if row[7] == 0.0:
            continue
        distance = row[6]
        for a in range(6):
            distance += row[a] * step[a]
        far = distance / outlier
        weight = row[7] / ((1.0 + far * far) * (1.0 + far * far))
        total[0] += 1.0
        total[1] += min(abs(distance), outlier)
        k = 8
        for a in range(6):
            weighted = weight * row[a]
            total[2 + a] += weighted * distance
            for b in range(a, 6):
                total[k] += weighted * row[b]
                k += 1
