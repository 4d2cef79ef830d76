"""The last step of fits: seen sides where their points lie, all others where the points beside them end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.fitting.least_squares import (
    CONVERGED,
    NOISE_FLOOR,
    ROBUST_WIDTH,
    levenberg_marquardt,
    normal_equations,
)
from caryatid.fitting.search import TRIM
from caryatid.fitting.uncertainty import Uncertainty, estimate
from caryatid.geometry import BOX, CYLINDER, SPHERE
from caryatid.geometry.points import quantile
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.signed_distance import local, write_distances
from caryatid.geometry.transforms import Array, rigid
from caryatid.runtime.parallel import for_each

Seen = tuple[bool, bool, bool, bool, bool, bool]
"""Which sides -x, +x, -y, +y, -z, +z of an object points bear out."""
OPENING = 0.05
"""How far unseen sides are moved out of the way [m]; beyond all noise."""
FACE_WIDTH = 3.0
"""Points within as many standard deviations of a face are the face's [1]; 99.7 % of them."""
STRAY = 1e-3
"""Density of stray points beyond a face's rim, as a share of that on the face [1]."""
FINAL_POINTS = 3500
"""Points the last refinement looks at [1]; of 3 mm of noise, four points sharing an error, they leave 0.1 mm
on a side: far less than the error of registration."""
HALVINGS = 14
"""Bisections of the search for an end: to 12 σ / 2¹⁴."""
ROUNDS = 3
"""How often density and end are found from one another; they change by a hundredth of σ in the last."""


class Closing(NamedTuple):
    """P shapes whose hidden faces are to be closed.

    Attributes:
        kinds: Codes of the shapes (P,).
        seen: Sides (P, 6) that points bear out.
        first: Index of each object's first point, and the number of all points (P + 1,).
        points: (N, 3) [m], object after object, each about its own origin.
        threshold, …, rim: Settings by their names in `FitConfig`.
        R: Axes (P, 3, 3); replaced.
        centre: (P, 3) [m]; replaced.
        half: Half extents (P, 3) [m]; replaced.
        opened_centre: (P, 3) [m] with unseen sides out of the way; replaced.
        opened_half: Half extents (P, 3) [m] then; replaced.
        hidden: Standard deviation (P, 6) [m] of where unseen sides are; written to.
        information: Normal equations (P, 9, 9) of the opened shape; written to.
        scores: Robust standard deviation of the distances [m], residual [m], inliers (P, 3); written to.
    """

    kinds: NDArray[np.int64]
    seen: NDArray[np.bool_]
    first: NDArray[np.int64]
    points: Array
    threshold: float
    max_extent: float
    min_extent: float
    min_points: int
    steps: int
    correlated: float
    rim: float
    R: Array
    centre: Array
    half: Array
    opened_centre: Array
    opened_half: Array
    hidden: Array
    information: Array
    scores: Array


SETTINGS = tuple(name for name in Closing._fields if hasattr(FitConfig, name))
"""What the kernels need to know of the settings."""


def close_hidden_faces(
    found: Sequence[tuple[Shape, Seen, Array]], config: FitConfig
) -> list[tuple[Shape, float, float, Uncertainty]]:
    """Refine fitted shapes without the pulls that the search for them needs, and say how sure they are.

    The sides that points bear out are refined by least squares alone, the others out of the way: neither the
    pull on the extents nor points beyond a rim shift them. Then each unseen side is put where the points on
    the faces beside it end: at the likeliest end of an even density blurred by the fit's own noise, which
    neither a trimmed share nor the spread of the noise biases. A side without such points stays.

    Args:
        found: Of each object its shape, the sides that points bear out, and its finite points (N, 3) [m].
        config: Limits and thresholds.

    Returns:
        Of each the shape, the mean distance of its points truncated at the threshold [m], the share of them
        within it, and how far off the shape may be.
    """
    if not found:
        return []
    points = [_some(own, FINAL_POINTS) for _, _, own in found]
    origins = np.array([own.mean(axis=0) for own in points])
    shapes = Primitives.of([shape for shape, _, _ in found])
    count = len(found)
    centre, seen = shapes.centres - origins, np.array([seen for _, seen, _ in found])
    opened_centre, opened_half = _opened(shapes.kinds, shapes.R, centre, shapes.half, seen)
    job = Closing(
        shapes.kinds,
        seen,
        np.cumsum([0, *(len(own) for own in points)]),
        np.concatenate([own - origin for own, origin in zip(points, origins, strict=True)]),
        **{name: getattr(config, name) for name in SETTINGS},
        R=shapes.R,
        centre=centre,
        half=shapes.half,
        opened_centre=opened_centre,
        opened_half=opened_half,
        hidden=np.empty((count, 6)),
        information=np.empty((count, 9, 9)),
        scores=np.empty((count, 3)),
    )
    for_each(close_one, count, job)
    information = job.information * np.diff(job.first)[:, None, None]
    uncertainties = estimate(job.kinds, job.seen, job.hidden, information, job.scores[:, 0], config)
    return [
        (
            shape.from_extents(rigid(job.R[k], job.centre[k] + origins[k]), 2.0 * job.half[k]),
            float(job.scores[k, 1]),
            float(job.scores[k, 2]),
            uncertainties[k],
        )
        for k, (shape, _, _) in enumerate(found)
    ]


def _opened(
    kinds: NDArray[np.intp], R: Array, centre: Array, half: Array, seen: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Centres (P, 3) and half extents (P, 3) once unseen sides are moved out of the way.

    A round side is seen as a whole; a sphere stays.
    """
    flat = (kinds == BOX)[:, None] | ((kinds == CYLINDER)[:, None] & (np.arange(3) == 2))
    low, high = (np.where(flat, OPENING * ~seen[:, side::2], 0.0) for side in range(2))
    unseen = (kinds == CYLINDER) & ~seen[:, :4].any(axis=1)
    grown = half + (low + high) / 2.0
    grown[unseen, :2] += OPENING
    return centre + np.einsum("pab,pb->pa", R, (high - low) / 2.0), grown


def _some(points: Array, count: int) -> Array:
    """Of points (N, 3) at most `count`, evenly chosen."""
    if len(points) <= count:
        return points
    return points[np.linspace(0, len(points) - 1, count).astype(np.intp)]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def close_one(row: int, job: Closing) -> None:
    """Refine the shape of one object with unseen sides out of the way, and put those where points end."""
    kind, seen = job.kinds[row], job.seen[row]
    points = job.points[job.first[row] : job.first[row + 1]]
    R, centre, opened = job.R[row].copy(), job.opened_centre[row], job.opened_half[row]
    levenberg_marquardt(kind, R, centre, opened, points, job.steps, job.min_extent, 0.0, CONVERGED)
    distance = np.empty(len(points))
    write_distances(kind, R, centre, opened, points, distance)
    distance = np.abs(distance)
    near = distance[distance < job.threshold]
    sigma = max(1.4826 * quantile(near, 0.5), NOISE_FLOOR) if len(near) > 0 else job.threshold
    normal_equations(kind, R, centre, opened, points, ROBUST_WIDTH * sigma, job.information[row], np.empty(9))
    job.hidden[row] = job.max_extent / np.sqrt(12.0)
    closed, middle = opened.copy(), centre.copy()
    if kind != SPHERE:
        _close(kind, R, centre, opened, seen, points, sigma, row, job, closed, middle)
    if 2.0 * closed.max() <= job.max_extent and len(near) > 0:
        job.R[row], job.centre[row], job.half[row] = R, middle, closed
    write_distances(kind, job.R[row], job.centre[row], job.half[row], points, distance)
    distance = np.abs(distance)
    job.scores[row, 0] = sigma
    job.scores[row, 1] = np.minimum(distance, job.threshold).mean()
    job.scores[row, 2] = (distance < job.threshold).mean()


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _close(  # type: ignore[no-untyped-def]
    kind, R, centre, opened, seen, points, sigma, row, job, closed, middle
):
    """Put unseen sides where the points end, or back where they were: half extents (3,) and centre (3,)."""
    own = np.empty((len(points), 3))
    for i in range(len(points)):
        own[i, 0], own[i, 1], own[i, 2] = local(R, centre, points, i)
    if kind == CYLINDER and not (seen[0] or seen[1] or seen[2] or seen[3]):
        rim, deviation = _end(kind, opened, own, 0, 1.0, sigma, job)
        closed[0] = closed[1] = job.half[row, 0] if np.isnan(rim) else rim
        if not np.isnan(rim):
            job.hidden[row, :4] = deviation
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
            rim, deviation = _end(kind, opened, own, axis, sign, sigma, job)
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
def _end(kind, half, own, axis, sign, sigma, job):  # type: ignore[no-untyped-def]
    """Where points (N, 3) beside one side end along its direction, and its deviation [m]; NaN if few tell.

    Points of a cylinder's ends tell where its mantle is, those of a box's other faces where a face is.
    """
    round_ = kind == CYLINDER and axis != 2
    coordinates = np.empty(len(own))
    count = 0
    for i in range(len(own)):
        reach = np.sqrt(own[i, 0] ** 2 + own[i, 1] ** 2)
        if round_:
            off = abs(own[i, 2]) - half[2]
        elif kind == CYLINDER:
            off = reach - half[0]
        else:
            u, v = (axis + 1) % 3, (axis + 2) % 3
            off = max(abs(own[i, u]) - half[u], abs(own[i, v]) - half[v])
        if abs(off) < FACE_WIDTH * sigma:
            coordinates[count] = reach if round_ else sign * own[i, axis]
            count += 1
    if count < job.min_points:
        return np.nan, np.nan
    found = coordinates[:count]
    start = quantile(found, 1.0 - TRIM)
    span = start if round_ else start - quantile(found, TRIM)
    end, deviation = likeliest_end(found, start, sigma, max(4.0 * sigma, 0.1 * span), round_)
    return end, np.sqrt(deviation * deviation * job.correlated + job.rim * job.rim)


@njit(cache=True, error_model="numpy")
def likeliest_end(
    coordinates: NDArray[np.float64], start: float, sigma: float, window: float, growing: bool
) -> tuple[float, float]:
    """Upper end [m] of points whose density is even up to it, and its standard deviation [m].

    With Gaussian noise the density near an end e is c·Φ((e − u)/σ). Its likelihood is greatest where
    Σ φ(z)/Φ(z) = c·σ with z = (e − u)/σ; c and e are found in turn, c within a window below e.

    Args:
        coordinates: (N,) [m].
        start: Where to begin [m], within a few σ of the end.
        sigma: Standard deviation of the noise along the coordinate [m].
        window: Length over which the density is measured [m].
        growing: The density grows with the coordinate, as on a disc along its radius.
    """
    close = coordinates[coordinates > start - window - 12.0 * sigma]
    end = start
    density = 0.0
    for _ in range(ROUNDS):
        top = end - 2.0 * sigma
        count = int(np.sum((close > top - window) & (close <= top)))
        density = max(count, 1) / window
        if growing:
            density *= end / max(top - window / 2.0, 1e-6)
        low, high = end - 6.0 * sigma, end + 6.0 * sigma
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            slope = -density * sigma
            for u in close:
                z = (middle - u) / sigma
                if -6.0 < z < 4.5:
                    within = 0.5 * math.erfc(-z * 0.7071067811865476)
                    slope += 0.3989422804014327 * math.exp(-0.5 * z * z) / (within + STRAY)
            if slope > 0.0:
                low = middle
            else:
                high = middle
        end = 0.5 * (low + high)
    return end, np.sqrt(sigma / (0.9 * max(density, 1e-9)))
