"""Compiled last refinement of chosen shapes, an object a thread; see `caryatid.fitting.hidden_faces`.

The tests hold a NumPy reference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.fitting.edge_likelihood import likeliest_end
from caryatid.fitting.least_squares import normal_equations
from caryatid.geometry import CYLINDER, SPHERE
from caryatid.geometry.points import quantile
from caryatid.geometry.signed_distance import write_distances


class Polished(NamedTuple):
    """Shapes before and after, one a row.

    Attributes:
        R: Axes (P, 3, 3); replaced.
        centre: (P, 3) [m]; replaced.
        half: Half extents (P, 3) [m]; replaced.
        hidden: Standard deviation (P, 6) [m] of where unseen sides are; written to.
        sigma: Robust standard deviation (P,) [m] of the points' distances; written to.
        information: Normal equations (P, 9, 9) of the opened shape; written to.
        residual: Mean truncated distance (P,) [m]; written to.
        inliers: Share of the points within the threshold (P,); written to.
    """

    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    hidden: NDArray[np.float64]
    sigma: NDArray[np.float64]
    information: NDArray[np.float64]
    residual: NDArray[np.float64]
    inliers: NDArray[np.float64]


class PolishJob(NamedTuple):
    """The shapes to be refined.

    Attributes:
        kinds: Codes of the shapes (P,).
        seen: Sides (P, 6) that points bear out.
        first: Index of each object's first point, and the number of all points (P + 1,).
        points: (N, 3) [m], object after object, in the frames of the shapes' poses.
        R_opened: Axes (P, 3, 3) once unseen sides were moved out of the way and the others refined.
        centre_opened: (P, 3) [m] then.
        half_opened: Half extents (P, 3) [m] then.
        threshold, …, noise_floor: Settings by their names in `FitConfig`, constants by theirs in `refine`.
        R, …, inliers: The fields of `Polished`, (P, 3, 3) … (P,).
    """

    kinds: NDArray[np.intp]
    seen: NDArray[np.bool_]
    first: NDArray[np.intp]
    points: NDArray[np.float64]
    R_opened: NDArray[np.float64]
    centre_opened: NDArray[np.float64]
    half_opened: NDArray[np.float64]
    threshold: float
    trim: float
    max_extent: float
    min_extent: float
    min_points: int
    face_width: float
    stray: float
    correlated: float
    rim: float
    robust_width: float
    noise_floor: float
    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    hidden: NDArray[np.float64]
    sigma: NDArray[np.float64]
    information: NDArray[np.float64]
    residual: NDArray[np.float64]
    inliers: NDArray[np.float64]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def polish_one(row: int, job: PolishJob) -> None:
    """Close the opened shape of one object, and write it to its row with what is known of its errors."""
    kind, seen = job.kinds[row], job.seen[row]
    points = job.points[job.first[row] : job.first[row + 1]]
    R, centre, opened = job.R_opened[row], job.centre_opened[row], job.half_opened[row]
    distance = np.empty(len(points))
    write_distances(kind, R, centre, opened, points, distance)
    near = 0
    for i in range(len(distance)):
        if abs(distance[i]) < job.threshold:
            distance[near] = abs(distance[i])
            near += 1
    sigma = max(1.4826 * quantile(distance[:near], 0.5), job.noise_floor) if near > 0 else job.threshold
    job.sigma[row] = sigma
    normal_equations(
        kind, R, centre, opened, points, job.robust_width * sigma, job.information[row], np.empty(9)
    )
    for side in range(6):
        job.hidden[row, side] = job.max_extent / np.sqrt(12.0)
    closed, middle = np.empty(3), np.empty(3)
    for a in range(3):
        closed[a], middle[a] = opened[a], centre[a]
    if kind != SPHERE:
        _close(kind, R, centre, opened, seen, points, sigma, row, job, closed, middle)
    if 2.0 * max(closed[0], closed[1], closed[2]) <= job.max_extent and near > 0:
        for a in range(3):
            job.centre[row, a], job.half[row, a] = middle[a], closed[a]
            for b in range(3):
                job.R[row, a, b] = R[a, b]
    write_distances(kind, job.R[row], job.centre[row], job.half[row], points, distance)
    total = inliers = 0.0
    for i in range(len(distance)):
        total += min(abs(distance[i]), job.threshold)
        inliers += abs(distance[i]) < job.threshold
    job.residual[row], job.inliers[row] = total / len(distance), inliers / len(distance)


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _close(  # type: ignore[no-untyped-def]
    kind, R, centre, opened, seen, points, sigma, row, job, closed, middle
):
    """Put unseen sides where the points end, or back where they were: half extents (3,) and centre (3,)."""
    local = np.empty((len(points), 3))
    for i in range(len(points)):
        u, v, w = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        for a in range(3):
            local[i, a] = R[0, a] * u + R[1, a] * v + R[2, a] * w
    if kind == CYLINDER and not (seen[0] or seen[1] or seen[2] or seen[3]):
        rim, deviation = _end(kind, opened, local, 0, 1.0, sigma, job)
        closed[0] = closed[1] = job.half[row, 0] if np.isnan(rim) else rim
        if not np.isnan(rim):
            for side in range(4):
                job.hidden[row, side] = deviation
    for axis in range(3):
        if (kind == CYLINDER and axis < 2) or (seen[2 * axis] and seen[2 * axis + 1]):
            continue
        before = 0.0
        for a in range(3):
            before += R[a, axis] * (job.centre[row, a] - centre[a])
        low, high = -opened[axis], opened[axis]
        for side in range(2):
            if seen[2 * axis + side]:
                continue
            sign = 2.0 * side - 1.0
            rim, deviation = _end(kind, opened, local, axis, sign, sigma, job)
            end = before + sign * job.half[row, axis]
            if not np.isnan(rim):
                end, job.hidden[row, 2 * axis + side] = sign * rim, deviation
            if side == 0:
                low = end
            else:
                high = end
        short = max(job.min_extent - (high - low), 0.0)
        if seen[2 * axis + 1]:
            low -= short
        else:
            high += short
        closed[axis] = (high - low) / 2.0
        for a in range(3):
            middle[a] += R[a, axis] * (high + low) / 2.0


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _end(kind, half, local, axis, sign, sigma, job):  # type: ignore[no-untyped-def]
    """Where points (N, 3) beside one side end along its direction, and its deviation [m]; NaN if few tell.

    Points of a cylinder's ends tell where its mantle is, those of a box's other faces where a face is.
    """
    round_ = kind == CYLINDER and axis != 2
    coordinates = np.empty(len(local))
    count = 0
    for i in range(len(local)):
        x, y, z = local[i, 0], local[i, 1], local[i, 2]
        reach = np.sqrt(x * x + y * y)
        if round_:
            off = abs(z) - half[2]
        elif kind == CYLINDER:
            off = reach - half[0]
        else:
            u, v = (axis + 1) % 3, (axis + 2) % 3
            off = max(abs(local[i, u]) - half[u], abs(local[i, v]) - half[v])
        if abs(off) < job.face_width * sigma:
            coordinates[count] = reach if round_ else sign * local[i, axis]
            count += 1
    if count < job.min_points:
        return np.nan, np.nan
    found = coordinates[:count]
    start = quantile(found, 1.0 - job.trim)
    span = start if round_ else start - quantile(found, job.trim)
    window = max(4.0 * sigma, 0.1 * span)
    end, deviation = likeliest_end(found, start, sigma, window, round_, job.stray)
    return end, np.sqrt(deviation * deviation * job.correlated + job.rim * job.rim)
