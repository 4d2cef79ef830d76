"""The last step of fits: where seen and hidden sides lie, and how uncertain they are."""

from __future__ import annotations

import math

import numpy as np
import shapely

from caryatid.config import FitConfig
from caryatid.fitting.least_squares import CONVERGED, NOISE_FLOOR, levenberg_marquardt, normal_equations
from caryatid.fitting.search import TRIM
from caryatid.geometry import BOX, CYLINDER, SPHERE
from caryatid.geometry.points import quantile
from caryatid.geometry.shapes import Shape, Uncertainty
from caryatid.geometry.signed_distance import in_frame, signed_distances
from caryatid.geometry.transforms import Array, rigid
from caryatid.runtime.parallel import kernel

Seen = tuple[bool, bool, bool, bool, bool, bool]
"""Which sides -x, +x, -y, +y, -z, +z of an object points confirm."""


def close_hidden_faces(
    shape: Shape, seen: Seen, points: Array, config: FitConfig
) -> tuple[Shape, float, float, Uncertainty]:
    """Refine a fitted shape without the pulls that its search needs, and estimate its uncertainty.

    The sides that points confirm are refined by least squares alone, with the others out of the way: neither
    the pull on the extents nor points beyond a rim shift them. Then each unseen side is put where the points
    on the faces beside it end: at the likeliest end of an even density blurred by the fit's own noise, which
    neither a trimmed share nor the spread of the noise biases. A side without such points stays.

    Returns:
        The shape, the mean distance of its points (N, 3) [m], all finite, truncated at the threshold [m],
        the share of them within it, and the uncertainty of the shape.
    """
    # Of 3 mm of noise, four points sharing an error, 3500 points leave 0.1 mm on a side: far less than the
    # error of registration.
    points = points[np.linspace(0, len(points) - 1, min(len(points), 3500)).astype(np.intp)]
    origin = points.mean(axis=0)
    kind, axes, centre, half = shape.row
    # If no step of least squares was better yet, a shape may still be below the shortest extent.
    points, kept = points - origin, np.stack([centre - origin, np.maximum(half, config.min_extent / 2.0)])
    hidden = ~np.array(seen).reshape(3, 2) & (kind != SPHERE)
    if kind == CYLINDER:
        # Any part of the mantle determines all of it.
        hidden[:2] = hidden[:2].all()
    # Unseen sides are moved out of the way, beyond all noise.
    low, high = 0.05 * hidden.T
    refined = np.concatenate([axes, [kept[0] + axes @ ((high - low) / 2.0), kept[1] + (low + high) / 2.0]])
    levenberg_marquardt(kind, refined, points, config.steps, config.min_extent, 0.0, CONVERGED)
    if kind == BOX and sum(seen) == 1:
        _square_up(refined, int(np.flatnonzero(seen)[0]) // 2, points)
    R, middle, half = refined[:3], refined[3].copy(), refined[4]
    distance = np.abs(signed_distances(kind, R, middle, half, points))
    near = distance[distance < config.threshold]
    sigma = max(1.4826 * quantile(near, 0.5), NOISE_FLOOR) if len(near) > 0 else config.threshold
    own, before, closed = in_frame(R, middle, points), in_frame(R, middle, kept[:1])[0], half.copy()
    unsure = np.zeros((3, 2))
    for axis in range(3):
        ends = [-half[axis], half[axis]]
        for side in np.flatnonzero(hidden[axis]):
            sign = 2.0 * side - 1.0
            end, variance = _end(kind, half, own, axis, sign, sigma, config)
            if variance == np.inf:
                end, variance = kept[1, axis], config.max_extent**2 / 12.0
                if kind == BOX or axis == 2:
                    end += sign * before[axis]
            ends[side], unsure[axis, side] = sign * end, variance
        short = max(config.min_extent - (ends[1] - ends[0]), 0.0)
        low, high = (ends[0], ends[1] + short) if hidden[axis, 1] else (ends[0] - short, ends[1])
        closed[axis] = (high - low) / 2.0
        middle += R[:, axis] * (high + low) / 2.0
    if len(near) == 0 or not 2.0 * closed.max() <= config.max_extent:
        R, (middle, closed) = axes, kept
    information = np.empty((9, 9))
    normal_equations(kind, refined, points, 2.5 * sigma, information, np.empty(9))
    information *= len(points) / (config.correlated * sigma**2)
    found = shape.from_extents(rigid(R, middle + origin), 2.0 * closed)
    distance = np.abs(signed_distances(kind, R, middle, closed, points))
    residual = float(np.minimum(distance, config.threshold).mean())
    inliers = np.count_nonzero(distance < config.threshold) / len(points)
    return found, residual, inliers, deviations(kind, unsure, information, config)


def _square_up(shape: Array, axis: int, points: Array) -> None:
    """Turn a box (5, 3) about an axis, 0 to 2, to the smallest rectangle around its points (N, 3).

    A single face leaves that turn to the noise of its rim in least squares.
    """
    u, v = (axis + 1) % 3, (axis + 2) % 3
    places = (points @ shape[:3])[:, [u, v]]
    rectangle = shapely.get_coordinates(shapely.oriented_envelope(shapely.MultiPoint(places)))
    along = rectangle[-1] - rectangle[-2] if len(rectangle) > 1 else np.array([1.0, 0.0])
    turn = np.arctan2(along[1], along[0])
    turn -= np.round(turn / (np.pi / 2.0)) * (np.pi / 2.0)
    c, s = np.cos(turn), np.sin(turn)
    first, second = shape[:3, u].copy(), shape[:3, v].copy()
    shape[:3, u], shape[:3, v] = c * first + s * second, c * second - s * first


def deviations(kind: int, unsure: Array, information: Array, config: FitConfig) -> Uncertainty:
    """Standard deviations of a shape from the normal equations of its last fit.

    Args:
        kind: Code of the shape.
        unsure: Variance (3, 2) [m²] of the lower and upper sides that no point confirms, 0 for the others.
        information: Inverse covariance (9, 9), unseen sides out of the way; rows and columns as of
            `least_squares.normal_equations`.
        config: The longest extent, and the error of registration.
    """
    # A radian for a rotation that nothing determines.
    prior = np.repeat([config.max_extent, 1.0, config.max_extent], 3)
    covariance = np.linalg.inv(information + np.diag(prior**-2.0))
    # Rounding may leave a variance a little below zero.
    variance = np.maximum(np.diagonal(covariance), 0.0)
    # The half extents along x, y, z have these columns: round ones share one.
    columns = {BOX: [6, 7, 8], SPHERE: [6, 6, 6]}.get(kind, [6, 6, 8])
    centre, half, both = variance[:3, None], variance[columns, None], covariance[range(3), columns][:, None]
    sides = np.where(unsure > 0.0, unsure, np.maximum(centre + half + both * (-2.0, 2.0), 0.0))
    floor, hidden = config.registration**2, unsure.any(axis=1, keepdims=True)
    across = sides.sum(axis=1, keepdims=True)
    return Uncertainty(
        position=np.sqrt(np.where(hidden, across / 4.0, centre) + floor)[:, 0],
        rotation=np.sqrt(variance[3:6]),
        sizes=np.sqrt(np.where(hidden, across, 4.0 * half) + floor)[:, 0],
        sides=np.sqrt(sides.ravel() + floor),
    )


def _end(
    kind: int, half: Array, own: Array, axis: int, sign: float, sigma: float, config: FitConfig
) -> tuple[float, float]:
    """Where points (N, 3) beside one side end along its direction [m], and the variance; infinite if few do.

    Points on a cylinder's ends show where its mantle is, those on a box's other faces where a face is.
    """
    growing = kind == CYLINDER and axis < 2
    along = sign * own[:, axis]
    if kind == BOX:
        u, v = (axis + 1) % 3, (axis + 2) % 3
        off = np.maximum(np.abs(own[:, u]) - half[u], np.abs(own[:, v]) - half[v])
    else:
        reach = np.sqrt(own[:, 0] ** 2 + own[:, 1] ** 2)
        off = np.abs(own[:, 2]) - half[2] if growing else reach - half[0]
        along = reach if growing else along
    found = along[np.abs(off) < 3.0 * sigma]
    if len(found) < config.min_points:
        return 0.0, np.inf
    start = quantile(found, 1.0 - TRIM)
    span = start if growing else start - quantile(found, TRIM)
    window = max(4.0 * sigma, 0.1 * span)
    close = found[found > start - window - 12.0 * sigma]
    end, deviation = likeliest_end(close, start, sigma, window, growing)
    return end, deviation * deviation * config.correlated + config.rim**2


@kernel
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
