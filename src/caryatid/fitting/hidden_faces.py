"""The last step of fits: seen sides where their points lie, others where points beside them end; how sure."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.fitting.least_squares import CONVERGED, NOISE_FLOOR, levenberg_marquardt, normal_equations
from caryatid.fitting.search import TRIM
from caryatid.geometry import BOX, CYLINDER, SPHERE
from caryatid.geometry.points import quantile
from caryatid.geometry.shapes import Primitives, Shape, Uncertainty
from caryatid.geometry.signed_distance import in_frame, signed_distances
from caryatid.geometry.transforms import Array, rigid

Seen = tuple[bool, bool, bool, bool, bool, bool]
"""Which sides -x, +x, -y, +y, -z, +z of an object points bear out."""


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
    # Of 3 mm of noise, four points sharing an error, 3500 points leave 0.1 mm on a side: far less than the
    # error of registration.
    points = points[np.linspace(0, len(points) - 1, min(len(points), 3500)).astype(np.intp)]
    origin = points.mean(axis=0)
    kind, R, centre, half = Primitives.of([shape]).row(0)
    sides, centre, points = np.array(seen), centre - origin, points - origin
    # Where no step of least squares was better yet, a shape may still be thinner than it may be.
    half = np.maximum(half, config.min_extent / 2.0)
    # Unseen sides are moved out of the way, beyond all noise; a round side is seen as a whole, and a sphere
    # stays.
    opening = 0.05
    unseen_mantle = kind == CYLINDER and not sides[:4].any()
    flat = np.array([kind == BOX, kind == BOX, kind != SPHERE])
    low, high = np.where(flat, opening * ~sides.reshape(3, 2).T, 0.0)
    middle = centre + np.einsum("ab,b->a", R, (high - low) / 2.0)
    refined = np.concatenate([R, [middle, half + (low + high) / 2.0]])
    turned, middle, opened = refined[:3], refined[3], refined[4]
    if unseen_mantle:
        opened[:2] += opening
    levenberg_marquardt(kind, refined, points, config.steps, config.min_extent, 0.0, CONVERGED)
    distance = np.abs(signed_distances(kind, turned, middle, opened, points))
    near = distance[distance < config.threshold]
    sigma = max(1.4826 * quantile(near, 0.5), NOISE_FLOOR) if len(near) else config.threshold
    information = np.empty((9, 9))
    normal_equations(kind, refined, points, 2.5 * sigma, information, np.empty(9))
    # Each unseen side is put where points end, or back where it was.
    hidden, closed = np.full(6, config.max_extent / np.sqrt(12.0)), opened.copy()
    own = np.ascontiguousarray(in_frame(turned, middle, points).T)
    before = in_frame(turned, middle, centre[None])[0]
    if unseen_mantle:
        end, hidden[:4] = _end(kind, opened, own, 0, 1.0, sigma, config) or (half[0], hidden[0])
        closed[:2] = end
    for axis in np.flatnonzero(flat & ~sides.reshape(3, 2).all(axis=1)).tolist():
        ends = [-opened[axis], opened[axis]]
        for side, sign in ((0, -1.0), (1, 1.0)):
            if not sides[2 * axis + side]:
                found = _end(kind, opened, own, axis, sign, sigma, config)
                ends[side] = sign * found[0] if found else before[axis] + sign * half[axis]
                hidden[2 * axis + side] = found[1] if found else hidden[2 * axis + side]
        short = max(config.min_extent - (ends[1] - ends[0]), 0.0)
        if sides[2 * axis + 1]:
            ends[0] -= short
        else:
            ends[1] += short
        closed[axis] = (ends[1] - ends[0]) / 2.0
        middle += turned[:, axis] * (ends[1] + ends[0]) / 2.0
    if 2.0 * closed.max() <= config.max_extent and len(near):
        R, centre, half = turned, middle, closed
    distance = np.abs(signed_distances(kind, R, centre, half, points))
    residual = float(np.minimum(distance, config.threshold).mean())
    inliers = float((distance < config.threshold).mean())
    uncertainty = deviations(kind, sides, hidden, information * len(points), sigma, config)
    return shape.from_extents(rigid(R, centre + origin), 2.0 * half), residual, inliers, uncertainty


def deviations(
    kind: int, seen: NDArray[np.bool_], unseen: Array, information: Array, sigma: float, config: FitConfig
) -> Uncertainty:
    """Standard deviations of a shape from the normal equations of its last fit.

    Args:
        kind: Code of the shape.
        seen: Which sides (6,) points bear out.
        unseen: Standard deviation (6,) [m] of the sides that no point bears out.
        information: Sum over the points of the products of their derivatives (9, 9), unseen sides out of the
            way; rows and columns as of `least_squares.normal_equations`.
        sigma: Robust standard deviation [m] of the points' distances to the shape.
        config: How many points share an error, and the error of registration.
    """
    # A radian for a rotation that nothing determines.
    prior = np.array([config.max_extent] * 3 + [1.0] * 3 + [config.max_extent] * 3)
    information = information / (config.correlated * sigma**2)
    covariance = np.linalg.inv(information + np.diag(prior**-2.0))
    # Rounding may leave a variance a little below zero.
    variance = np.maximum(np.diagonal(covariance), 0.0)
    # The half extents along x, y, z have these columns: round ones share one.
    columns = {BOX: (6, 7, 8), SPHERE: (6, 6, 6)}.get(kind, (6, 6, 8))
    centre, half, both = variance[:3], variance[list(columns)], covariance[range(3), columns]
    borne_out = seen.copy()
    if kind != BOX:
        # Any part of a round surface tells where all of it is.
        borne_out[:4] |= seen[:4].any()
    borne_out |= kind == SPHERE
    low = np.where(borne_out[0::2], np.maximum(centre + half - 2.0 * both, 0.0), unseen[0::2] ** 2)
    high = np.where(borne_out[1::2], np.maximum(centre + half + 2.0 * both, 0.0), unseen[1::2] ** 2)
    determined = borne_out[0::2] & borne_out[1::2]
    floor = config.registration**2
    return Uncertainty(
        position=np.sqrt(np.where(determined, centre, (low + high) / 4.0) + floor),
        rotation=np.sqrt(variance[3:6]),
        sizes=np.sqrt(np.where(determined, 4.0 * half, low + high) + floor),
        sides=np.sqrt(np.stack([low, high], axis=1).ravel() + floor),
    )


def _end(
    kind: int, half: Array, own: Array, axis: int, sign: float, sigma: float, config: FitConfig
) -> tuple[float, float] | None:
    """Where points (3, N) beside one side end along its direction, and its deviation [m]; None if few tell.

    Points of a cylinder's ends tell where its mantle is, those of a box's other faces where a face is.
    """
    round_ = kind == CYLINDER and axis != 2
    along = sign * own[axis]
    if kind == CYLINDER:
        reach = np.sqrt(own[0] ** 2 + own[1] ** 2)
        off = np.abs(own[2]) - half[2] if round_ else reach - half[0]
        along = reach if round_ else along
    else:
        u, v = (axis + 1) % 3, (axis + 2) % 3
        off = np.maximum(np.abs(own[u]) - half[u], np.abs(own[v]) - half[v])
    found = along[np.abs(off) < 3.0 * sigma]
    if len(found) < config.min_points:
        return None
    start = quantile(found, 1.0 - TRIM)
    span = start if round_ else start - quantile(found, TRIM)
    window = max(4.0 * sigma, 0.1 * span)
    close = found[found > start - window - 12.0 * sigma]
    end, deviation = likeliest_end(close, start, sigma, window, round_)
    return end, math.sqrt(deviation * deviation * config.correlated + config.rim * config.rim)


@njit(cache=True, error_model="numpy")
def likeliest_end(coordinates, start, sigma, window, growing):  # type: ignore[no-untyped-def]
    """Upper end [m] of points (N,) whose density is even up to it, and its standard deviation [m].

    With Gaussian noise the density near an end e is c·Φ((e − u)/σ). Its likelihood is greatest where
    Σ φ(z)/Φ(z) = c·σ with z = (e − u)/σ; c, in a window [m] below e, and e are found in turn, from a start
    within a few σ of the end. Stray points beyond are taken to be a thousandth as dense. Along the radius of
    a disc the density is growing.
    """
    end, density = start, 0.0
    for _ in range(3):  # Both change by a hundredth of σ in the last round.
        top, count = end - 2.0 * sigma, 0
        for u in coordinates:
            count += top - window < u <= top
        density = max(count, 1) / window
        if growing:
            density *= end / max(top - window / 2.0, 1e-6)
        low, high = end - 6.0 * sigma, end + 6.0 * sigma
        for _ in range(14):  # To 12 σ / 2¹⁴.
            middle = 0.5 * (low + high)
            slope = -density * sigma
            for u in coordinates:
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
