"""Compiled fits of many objects at once: search, least squares and judgement, an object and a shape a thread.

The tests hold a NumPy reference of each step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.kernels.fitting import SPHERE, levenberg_marquardt
from caryatid.kernels.judging import bare_share, draw_in, misfit
from caryatid.kernels.ransac import search
from caryatid.kernels.starts import of_one_face


class Fitted(NamedTuple):
    """Shapes found, one a row; what does not count for a row holds anything.

    Attributes:
        found: Whether there is one (J,).
        R: Axes (J, 3, 3).
        centre: (J, 3) [m].
        half: Half extents (J, 3) [m].
        seen: Sides -x, +x, -y, +y, -z, +z that points bear out (J, 6).
        cost: What model choice compares (J,) [m].
        residual: Mean truncated distance (J,) [m].
        inliers: Share of the points within the threshold (J,).
    """

    found: NDArray[np.bool_]
    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    seen: NDArray[np.bool_]
    cost: NDArray[np.float64]
    residual: NDArray[np.float64]
    inliers: NDArray[np.float64]


class Job(NamedTuple):
    """One shape of each kind is fitted to each object; the row of object p and kind k is p · K + k.

    Attributes:
        kinds: Codes of the shapes (K,).
        first: Index of each object's first point, and the number of all points (P + 1,).
        points: (N, 3) [m], object after object, each about its own origin.
        normals: Unit normals (N, 3).
        every: The search and least squares look at every so many points of each object (P,).
        samples: Indices (P, K, B, 2) of the pairs of those points that hypotheses are made from.
        ridge: Added to the diagonal of least squares (9,), times the damping.

    Then settings by their names in `FitConfig`, constants by their names in `refine`, and the fields of
    `Fitted`, which are written to.
    """

    kinds: NDArray[np.intp]
    first: NDArray[np.intp]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    every: NDArray[np.intp]
    samples: NDArray[np.intp]
    ridge: NDArray[np.float64]
    threshold: float
    trim: float
    max_radius: float
    max_extent: float
    min_extent: float
    confidence: float
    polish: int
    steps: int
    shrink: float
    min_points: int
    side_share: float
    normal_weight: float
    size_penalty: float
    bare_weight: float
    bare_spacing: float
    robust_width: float
    noise_floor: float
    rough: float
    converged: float
    found: NDArray[np.bool_]
    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    seen: NDArray[np.bool_]
    cost: NDArray[np.float64]
    residual: NDArray[np.float64]
    inliers: NDArray[np.float64]


@njit(cache=True, error_model="numpy")
def fit_one(row: int, job: Job) -> None:
    """Fit the best shape of one kind to the points of one object, and write it to its row."""
    owner, number = row // len(job.kinds), row % len(job.kinds)
    kind, every, samples = job.kinds[number], job.every[owner], job.samples[owner, number]
    points = job.points[job.first[owner] : job.first[owner + 1]]
    normals = job.normals[job.first[owner] : job.first[owner + 1]]
    some, facing = points[::every].copy(), normals[::every].copy()
    settings = (job.threshold, job.trim, job.max_radius, job.max_extent, job.confidence)
    keep = job.polish
    R, centre, half = np.empty((keep + 1, 3, 3)), np.empty((keep + 1, 3)), np.empty((keep + 1, 3))
    count = search(kind, some, facing, samples, settings, R, centre, half, np.empty(keep + 1))
    if kind != SPHERE and of_one_face(
        kind, some, facing, job.trim, job.min_extent, job.max_radius, job.max_extent,
        R[count], centre[count], half[count],
    ):  # fmt: skip
        count += 1
    job.found[row] = False
    job.cost[row] = np.inf
    for k in range(count):
        _improve(row, kind, R[k], centre[k], half[k], some, points, normals, job.rough, job)
    if job.found[row]:
        # Kinds are compared once least squares on all the points have nothing left to gain.
        _improve(
            row, kind, job.R[row], job.centre[row], job.half[row], points, points, normals, job.converged, job
        )
        job.cost[row] += job.bare_weight * bare_share(
            kind, job.R[row], job.centre[row], job.half[row], job.seen[row], points, job.bare_spacing
        )


@njit(cache=True, error_model="numpy")
def _improve(  # type: ignore[no-untyped-def]
    row, kind, R, centre, half, some, points, normals, converged, job
):
    """Refine a shape on some points, judge it by all, and write it to the row where it costs less."""
    R, centre, half = levenberg_marquardt(
        kind, R.copy(), centre.copy(), half.copy(), some, job.steps, job.min_extent, job.shrink,
        job.robust_width, job.noise_floor, job.ridge, converged,
    )  # fmt: skip
    seen = np.empty(6, np.bool_)
    least = max(job.min_points / 3.0, job.side_share * len(points))
    draw_in(kind, R, centre, half, points, normals, job.threshold, least, job.trim, job.min_extent, seen)
    residual, turned, inliers = misfit(kind, R, centre, half, points, normals, job.threshold)
    size = 4.0 * (half[0] ** 2 + half[1] ** 2 + half[2] ** 2) / 3.0
    cost = residual + job.normal_weight * turned + job.size_penalty * size
    if not cost < job.cost[row]:
        return
    job.found[row] = 2.0 * max(half[0], half[1], half[2]) <= job.max_extent
    job.cost[row], job.residual[row], job.inliers[row] = cost, residual, inliers
    for a in range(3):
        job.centre[row, a], job.half[row, a] = centre[a], half[a]
        for b in range(3):
            job.R[row, a, b] = R[a, b]
    for side in range(6):
        job.seen[row, side] = seen[side]
