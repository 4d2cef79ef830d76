"""Compiled steps of the fits of many objects at once, each piece a thread: search, refinement, judgement.

`primitives` says in which order they come. The tests hold a NumPy reference of each step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.fitting.least_squares import levenberg_marquardt
from caryatid.fitting.ransac import search
from caryatid.fitting.scoring import bare_share, draw_in, misfit
from caryatid.fitting.single_face import of_one_face
from caryatid.geometry import SPHERE


class FitJob(NamedTuple):
    """Shapes of several kinds are fitted to the points of each of several objects, some of each kind.

    Object p and kind k have the shapes s = (p · K + k) · S … + S − 1.

    Attributes:
        rows: Which of the shapes are judged (M,).
        kinds: Codes of the kinds (K,).
        first: Index of each object's first point, and the number of all points (P + 1,).
        points: (N, 3) [m], object after object, each about its own origin.
        normals: Unit normals (N, 3).
        every: The search looks at every so many points of each object (P,).
        samples: Indices (P, K, B, 2) of the pairs of those points that hypotheses are made from.
        threshold, …, bare_spacing: Settings by their names in `FitConfig`.
        R: Axes (P · K, S, 3, 3).
        centre: (P · K, S, 3) [m].
        half: Half extents (P · K, S, 3) [m].
        seen: Sides -x, +x, -y, +y, -z, +z that points bear out (P · K, S, 6).
        cost: What model choice compares (P · K, S) [m]; of a shape that was not found it is infinite.
        residual: Mean truncated distance (P · K, S) [m].
        inliers: Share of the points within the threshold (P · K, S).
    """

    rows: NDArray[np.intp]
    kinds: NDArray[np.intp]
    first: NDArray[np.intp]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    every: NDArray[np.intp]
    samples: NDArray[np.intp]
    threshold: float
    trim: float
    max_radius: float
    max_extent: float
    min_extent: float
    confidence: float
    min_points: int
    side_share: float
    normal_weight: float
    size_penalty: float
    bare_weight: float
    bare_spacing: float
    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    seen: NDArray[np.bool_]
    cost: NDArray[np.float64]
    residual: NDArray[np.float64]
    inliers: NDArray[np.float64]


class RefineJob(NamedTuple):
    """Shapes to be refined by least squares, each on points of its own.

    Attributes:
        rows: Which of the shapes (M,).
        kinds: Their codes (J,).
        first: Index (J,) of the first of each one's points.
        end: Index (J,) after the last of them.
        every: Of these every so many (J,).
        points: (N, 3) [m].
        ridge: Added to the diagonal (9,), see `levenberg_marquardt`.
        steps, …, converged: See `levenberg_marquardt`.
        R: Axes (J, 3, 3); replaced.
        centre: (J, 3) [m]; replaced.
        half: Half extents (J, 3) [m]; replaced.
    """

    rows: NDArray[np.intp]
    kinds: NDArray[np.intp]
    first: NDArray[np.intp]
    end: NDArray[np.intp]
    every: NDArray[np.intp]
    points: NDArray[np.float64]
    ridge: NDArray[np.float64]
    steps: int
    min_extent: float
    shrink: float
    robust_width: float
    noise_floor: float
    converged: float
    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    half: NDArray[np.float64]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def search_one(group: int, job: FitJob) -> None:
    """Find shapes of one kind for one object to start from; those found have a cost of 0."""
    owner, number = group // len(job.kinds), group % len(job.kinds)
    kind, every = job.kinds[number], job.every[owner]
    first, end = job.first[owner], job.first[owner + 1]
    count = (end - first + every - 1) // every
    some, facing = np.empty((count, 3)), np.empty((count, 3))
    for i in range(len(some)):
        for a in range(3):
            some[i, a], facing[i, a] = job.points[first + i * every, a], job.normals[first + i * every, a]
    R, centre, half, cost = job.R[group], job.centre[group], job.half[group], job.cost[group]
    settings = (job.threshold, job.trim, job.max_radius, job.max_extent, job.confidence)
    count = search(kind, some, facing, job.samples[owner, number], settings, R, centre, half, cost)
    if kind != SPHERE and of_one_face(
        kind, some, facing, job.trim, job.min_extent, job.max_radius, job.max_extent,
        R[count], centre[count], half[count],
    ):  # fmt: skip
        count += 1
    for k in range(len(cost)):
        cost[k] = 0.0 if k < count else np.inf


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def refine_one(index: int, job: RefineJob) -> None:
    """Refine one of the shapes, and replace it."""
    row = job.rows[index]
    first, every = job.first[row], job.every[row]
    points = np.empty(((job.end[row] - first + every - 1) // every, 3))
    for i in range(len(points)):
        for a in range(3):
            points[i, a] = job.points[first + i * every, a]
    levenberg_marquardt(
        job.kinds[row], job.R[row], job.centre[row], job.half[row], points, job.steps, job.min_extent,
        job.shrink, job.robust_width, job.noise_floor, job.ridge, job.converged,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def judge_one(index: int, job: FitJob) -> None:
    """Draw in the sides of one of the shapes that no point bears out, and judge it by all the points."""
    row = job.rows[index]
    group, k = row // job.cost.shape[1], row % job.cost.shape[1]
    owner, kind = group // len(job.kinds), job.kinds[group % len(job.kinds)]
    points = job.points[job.first[owner] : job.first[owner + 1]]
    normals = job.normals[job.first[owner] : job.first[owner + 1]]
    R, centre, half = job.R[group, k], job.centre[group, k], job.half[group, k]
    least = max(job.min_points / 3.0, job.side_share * len(points))
    draw_in(
        kind, R, centre, half, points, normals, job.threshold, least, job.trim, job.min_extent,
        job.seen[group, k],
    )  # fmt: skip
    residual, turned, inliers = misfit(kind, R, centre, half, points, normals, job.threshold)
    size = 4.0 * (half[0] ** 2 + half[1] ** 2 + half[2] ** 2) / 3.0
    job.cost[group, k] = residual + job.normal_weight * turned + job.size_penalty * size
    job.residual[group, k], job.inliers[group, k] = residual, inliers


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def bare_one(index: int, job: FitJob) -> None:
    """Have one of the shapes pay for sides that should have been seen but are bare."""
    row = job.rows[index]
    group, k = row // job.cost.shape[1], row % job.cost.shape[1]
    owner, kind = group // len(job.kinds), job.kinds[group % len(job.kinds)]
    points = job.points[job.first[owner] : job.first[owner + 1]]
    job.cost[group, k] += job.bare_weight * bare_share(
        kind, job.R[group, k], job.centre[group, k], job.half[group, k], job.seen[group, k], points,
        job.bare_spacing,
    )  # fmt: skip
