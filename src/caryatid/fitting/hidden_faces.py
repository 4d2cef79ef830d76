"""The last step of fits: seen sides where their points lie, all others where the points beside them end."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.fitting.least_squares import CONVERGED, NOISE_FLOOR, levenberg_marquardt, normal_equations
from caryatid.fitting.scoring import in_frame
from caryatid.fitting.search import TRIM
from caryatid.fitting.uncertainty import Uncertainty, estimate
from caryatid.geometry import BOX, CYLINDER, SPHERE
from caryatid.geometry.points import quantile
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.signed_distance import write_distances
from caryatid.geometry.transforms import Array, rigid

Seen = tuple[bool, bool, bool, bool, bool, bool]
"""Which sides -x, +x, -y, +y, -z, +z of an object points bear out."""
OPENING = 0.05
"""How far unseen sides are moved out of the way [m]; beyond all noise."""
FINAL_POINTS = 3500
"""Points the last refinement looks at [1]; of 3 mm of noise, four points sharing an error, they leave 0.1 mm
on a side: far less than the error of registration."""


def close_hidden_faces(
    shape: Shape, seen: Seen, points: Array, config: FitConfig
) -> tuple[Shape, float, float, Uncertainty]:
    """Refine a fitted shape without the pulls that the search for it needs, and say how sure it is.

    The sides that points bear out are refined by least squares alone, the others out of the way: neither the
    pull on the extents nor points beyond a rim shift them. Then each unseen side is put where the points on
    the faces beside it end: at the likeliest end of an even density blurred by the fit's own noise, which
    neither a trimmed share nor the spread of the noise biases. A side without such points stays.

    Args:
        shape: The shape.
        seen: The sides that points bear out.
        points: Its points (N, 3) [m], all finite.
        config: Limits and thresholds.

    Returns:
        The shape, the mean distance of its points truncated at the threshold [m], the share of them within
        it, and how far off the shape may be.
    """
    points = points[np.linspace(0, len(points) - 1, min(len(points), FINAL_POINTS)).astype(np.intp)]
    origin = points.mean(axis=0)
    kind, R, centre, half = Primitives.of([shape]).row(0)
    sides = np.array(seen)
    R, centre, half, hidden, information, sigma, residual, inliers = _close(
        kind, R, centre - origin, half, sides, points - origin,
        config.threshold, config.max_extent, config.min_extent, config.min_points, config.steps,
        config.correlated, config.rim,
    )  # fmt: skip
    uncertainty = estimate(kind, sides, hidden, information * len(points), sigma, config)
    return shape.from_extents(rigid(R, centre + origin), 2.0 * half), residual, inliers, uncertainty


@njit(cache=True, error_model="numpy", nogil=True)
def _close(  # type: ignore[no-untyped-def]
    kind, R, centre, half, seen, points,
    threshold, max_extent, min_extent, min_points, steps, correlated, rim,
):  # fmt: skip
    """Refine a shape with unseen sides out of the way, and put those where points about their origin end.

    Returns:
        Axes (3, 3), centre and half extents (3,) [m]; standard deviation (6,) [m] of where unseen sides are,
        normal equations (9, 9) of the opened shape, robust standard deviation of the distances [m]; residual
        [m] and inliers.
    """
    turned, middle, opened = R.copy(), centre.copy(), half.copy()
    _open(kind, turned, middle, opened, seen)
    levenberg_marquardt(kind, turned, middle, opened, points, steps, min_extent, 0.0, CONVERGED)
    distance = np.empty(len(points))
    write_distances(kind, turned, middle, opened, points, distance)
    distance = np.abs(distance)
    near = distance[distance < threshold]
    sigma = max(1.4826 * quantile(near, 0.5), NOISE_FLOOR) if len(near) > 0 else threshold
    information = np.empty((9, 9))
    normal_equations(kind, turned, middle, opened, points, 2.5 * sigma, information, np.empty(9))
    hidden = np.full(6, max_extent / np.sqrt(12.0))
    closed = opened.copy()
    if kind != SPHERE:
        # Each unseen side lies where points end, or where it was.
        own, before = in_frame(turned, middle, points), in_frame(turned, middle, centre.reshape(1, 3))[0]
        if kind == CYLINDER and not seen[:4].any():
            end, deviation = _end(kind, opened, own, 0, 1.0, sigma, min_points)
            closed[0] = closed[1] = half[0] if np.isnan(end) else end
            if not np.isnan(end):
                hidden[:4] = np.sqrt(deviation * deviation * correlated + rim * rim)
        for axis in range(2 if kind == CYLINDER else 0, 3):
            if seen[2 * axis] and seen[2 * axis + 1]:
                continue
            ends = np.array([-opened[axis], opened[axis]])
            for side in range(2):
                if seen[2 * axis + side]:
                    continue
                sign = 2.0 * side - 1.0
                end, deviation = _end(kind, opened, own, axis, sign, sigma, min_points)
                ends[side] = before[axis] + sign * half[axis] if np.isnan(end) else sign * end
                if not np.isnan(end):
                    hidden[2 * axis + side] = np.sqrt(deviation * deviation * correlated + rim * rim)
            short = max(min_extent - (ends[1] - ends[0]), 0.0)
            if seen[2 * axis + 1]:
                ends[0] -= short
            else:
                ends[1] += short
            closed[axis] = (ends[1] - ends[0]) / 2.0
            for a in range(3):
                middle[a] += turned[a, axis] * (ends[1] + ends[0]) / 2.0
    if 2.0 * closed.max() > max_extent or len(near) == 0:
        turned, middle, closed = R, centre, half
    write_distances(kind, turned, middle, closed, points, distance)
    distance = np.abs(distance)
    residual, inliers = np.minimum(distance, threshold).mean(), (distance < threshold).mean()
    return turned, middle, closed, hidden, information, sigma, residual, inliers


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _open(kind, R, centre, half, seen):  # type: ignore[no-untyped-def]
    """Move unseen sides out of the way; a round side is seen as a whole, and a sphere stays."""
    if kind == CYLINDER and not seen[:4].any():
        half[:2] += OPENING
    shift = np.zeros(3)
    for axis in range(3):
        if kind == BOX or (kind == CYLINDER and axis == 2):
            low, high = OPENING * (not seen[2 * axis]), OPENING * (not seen[2 * axis + 1])
            half[axis] += (low + high) / 2.0
            shift[axis] = (high - low) / 2.0
    for a in range(3):
        centre[a] += R[a, 0] * shift[0] + R[a, 2] * shift[2] + R[a, 1] * shift[1]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _end(kind, half, own, axis, sign, sigma, min_points):  # type: ignore[no-untyped-def]
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
        if abs(off) < 3.0 * sigma:
            coordinates[count] = reach if round_ else sign * own[i, axis]
            count += 1
    if count < min_points:
        return np.nan, np.nan
    found = coordinates[:count]
    start = quantile(found, 1.0 - TRIM)
    span = start if round_ else start - quantile(found, TRIM)
    return likeliest_end(found, start, sigma, max(4.0 * sigma, 0.1 * span), round_)


@njit(cache=True, error_model="numpy")
def likeliest_end(
    coordinates: NDArray[np.float64], start: float, sigma: float, window: float, growing: bool
) -> tuple[float, float]:
    """Upper end [m] of points whose density is even up to it, and its standard deviation [m].

    With Gaussian noise the density near an end e is c·Φ((e − u)/σ). Its likelihood is greatest where
    Σ φ(z)/Φ(z) = c·σ with z = (e − u)/σ; c and e are found in turn, c within a window below e. Stray points
    beyond are taken to be a thousandth as dense.

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
    for _ in range(3):  # Both change by a hundredth of σ in the last round.
        top = end - 2.0 * sigma
        count = int(np.sum((close > top - window) & (close <= top)))
        density = max(count, 1) / window
        if growing:
            density *= end / max(top - window / 2.0, 1e-6)
        low, high = end - 6.0 * sigma, end + 6.0 * sigma
        for _ in range(14):  # To 12 σ / 2¹⁴.
            middle = 0.5 * (low + high)
            slope = -density * sigma
            for u in close:
                z = (middle - u) / sigma
                if -6.0 < z < 4.5:
                    within = 0.5 * math.erfc(-z * 0.7071067811865476)
                    slope += 0.3989422804014327 * math.exp(-0.5 * z * z) / (within + 1e-3)
            if slope > 0.0:
                low = middle
            else:
                high = middle
        end = 0.5 * (low + high)
    return end, np.sqrt(sigma / (0.9 * max(density, 1e-9)))
