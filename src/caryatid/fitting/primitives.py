"""Fit a box, a cylinder or a sphere to the oriented points of each object."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from caryatid.config import FitConfig
from caryatid.errors import InputError, check_type
from caryatid.fitting.hidden_faces import Seen, close_hidden_faces
from caryatid.fitting.least_squares import CONVERGED, levenberg_marquardt
from caryatid.fitting.search import TRIM, search
from caryatid.geometry import BOX, CYLINDER, SPHERE, transforms
from caryatid.geometry.points import quantile
from caryatid.geometry.polygons import area, hull
from caryatid.geometry.shapes import KINDS, Shape, Uncertainty
from caryatid.geometry.signed_distance import copy, gradient, in_frame, sample_surface
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import inner, kernel
from caryatid.sensing.voxel_map import FREE, VoxelMap

FREE_WEIGHT = 0.01
"""Cost of a shape whose whole inside was seen free [m]; in proportion for a share of it."""
ALONG = 0.7
"""Cosine of the angle to a side up to which the gradient at a point confirms the side [1]: 45°."""
CONFIRMED = 0.02
"""Share of the points that must confirm a side [1]."""
BARE_SPACING = 0.008
"""Spacing of the samples on a side that count points near it [m]; a point within twice that is near one."""


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """A shape and how well it explains the points.

    Attributes:
        shape: In the points' frame.
        residual: Mean absolute distance of the points to the surface, truncated at the threshold [m].
        inliers: Share of the points within the threshold [1].
        seen: Which sides (-x, +x, -y, +y, -z, +z of the object) points confirm.
        cost: The cost that model choice compares [m].
        poor: No shape explains the points within the configured residual; for the chosen fit only.
        uncertainty: Its uncertainty, for the chosen fit only.
    """

    shape: Shape
    residual: float
    inliers: float
    seen: Seen
    cost: float
    poor: bool = False
    uncertainty: Uncertainty | None = None


@dataclass(frozen=True, slots=True)
class FitFailure:
    """No shape could be fitted; `reason` says why, in words."""

    reason: str


def fit(
    points: Array,
    normals: Array,
    *,
    config: FitConfig,
    rng: np.random.Generator,
    space: VoxelMap | None = None,
) -> Fit | FitFailure:
    """Fit the best of box, cylinder and sphere.

    The result does not depend on the frame of the points, only on their order and the generator. Sides
    without points lie where the points of the faces beside them end.

    Args:
        points: (N, 3) [m], in any frame.
        normals: Unit normals (N, 3) towards the sensor.
        config: Limits and thresholds.
        rng: Source of the samples.
        space: Space seen free, for points in the world frame; shapes do not fill it.

    Raises:
        InputError: Points and normals differ in shape, or an argument is of another type.
    """
    check_type("config", config, FitConfig, "give a FitConfig, such as caryatid.Config().fit")
    check_type("rng", rng, np.random.Generator, "give a generator, such as np.random.default_rng(0)")
    for name, values in (("points", points), ("normals", normals)):
        if np.shape(values) != (len(points), 3):
            reason = f"has shape {np.shape(values)}"
            raise InputError(name, reason, "give points (N, 3) [m] and a unit normal (N, 3) for each")
    points, normals = _finite(points, normals)
    if len(points) < config.min_points:
        return FitFailure(f"{len(points)} points are too few, a shape needs {config.min_points}")
    fits, judged_by = _ranked(points, normals, config, rng)
    best, least = None, np.inf
    for f in fits:
        if f.cost >= least:
            break
        # A shape also pays for the free space that it fills.
        priced = _with_bare(f, judged_by)
        total = priced.cost
        if space is not None:
            inside, free = free_inside(f.shape, space, 1.2 * space.config.size)
            total += FREE_WEIGHT * (free / max(inside, 1))
        if total < least:
            best, least = priced, total
    if best is None:
        return FitFailure(f"every shape exceeds the maximum extent of {config.max_extent:g} m")
    shape, residual, inliers, uncertainty = close_hidden_faces(best.shape, best.seen, points, config)
    poor = residual > config.max_residual
    return replace(best, shape=shape, residual=residual, inliers=inliers, poor=poor, uncertainty=uncertainty)


def candidates(
    points: Array, normals: Array, *, config: FitConfig, rng: np.random.Generator, whole: bool = True
) -> list[Fit]:
    """Return the best fit of each shape that could be fitted, lowest cost first; none if points are few.

    Arguments are as in `fit`. With `whole`, sides that should have been seen cost by their bare share.
    """
    fits, judged_by = _ranked(*_finite(points, normals), config, rng)
    return sorted((_with_bare(f, judged_by) for f in fits), key=lambda f: f.cost) if whole else fits


def free_inside(shape: Shape, voxels: VoxelMap, inset: float) -> tuple[int, int]:
    """The space well inside a shape: all of it, and how much was seen free [voxels].

    Args:
        shape: In the world frame.
        voxels: The voxel map.
        inset: How far inside the surface to begin [m]; a surface voxel may be half free.

    Returns:
        Number of cubes of a voxel's size, 0 if the shape is too thin, and of those in voxels seen free.
    """
    kind, R, centre, half = shape.row
    inside, free = count_free(kind, R, centre, half - inset, *voxels.space)
    return inside, free


@kernel
def count_free(kind, R, centre, half, states, origin, size):  # type: ignore[no-untyped-def]
    """Count the cubes of a grid in a shape, and those whose centres lie in free voxels."""
    inside = free = 0
    if not min(half[0], half[1], half[2]) > 0.0:
        return inside, free
    first, count = np.zeros(3), np.ones(3, np.intp)
    for a in range(3):
        # A row of cubes begins at the surface; one that does not fit in lies in the middle.
        if half[a] > size / 2.0:
            first[a] = size / 2.0 - half[a]
            count[a] = math.ceil((half[a] - first[a]) / size)
    for i in range(count[0]):
        u = first[0] + i * size
        for j in range(count[1]):
            v = first[1] + j * size
            for k in range(count[2]):
                w = first[2] + k * size
                across = u * u + (v * v if kind != BOX else 0.0) + (w * w if kind == SPHERE else 0.0)
                if across > half[0] * half[0]:
                    continue
                inside += 1
                free += is_free(R, centre, u, v, w, states, origin, size)
    return inside, free


@inner
def is_free(R, centre, u, v, w, states, origin, size):  # type: ignore[no-untyped-def]
    """Whether a point in the frame of a shape lies in a voxel seen free."""
    x = math.floor((R[0, 0] * u + R[0, 1] * v + R[0, 2] * w + centre[0] - origin[0]) / size)
    y = math.floor((R[1, 0] * u + R[1, 1] * v + R[1, 2] * w + centre[1] - origin[1]) / size)
    z = math.floor((R[2, 0] * u + R[2, 1] * v + R[2, 2] * w + centre[2] - origin[2]) / size)
    if 0 <= x < states.shape[0] and 0 <= y < states.shape[1] and 0 <= z < states.shape[2]:
        return states[x, y, z] == FREE
    return False


def _finite(points: Array, normals: Array) -> tuple[Array, Array]:
    """Points that are finite and have finite normals, in the layout that kernels take."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    normals = np.ascontiguousarray(normals, dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        if np.isfinite(points.sum() + normals.sum()):
            return points, normals
    finite = (np.isfinite(points) & np.isfinite(normals)).all(axis=1)
    return points[finite], normals[finite]


def _with_bare(f: Fit, points: Array) -> Fit:
    """A fit that has paid for the share of the sides seen that is bare of points (N, 3): 3 mm if all are.

    The convex hull of its points covers a single flat side exactly, however small it is.
    """
    kind, axes, centre, half = f.shape.row
    sides = np.flatnonzero(f.seen) // 2
    if len(sides) == 1 and (kind == BOX or (kind == CYLINDER and sides[0] == 2)):
        across = np.delete(np.arange(3), sides[0])
        places = np.ascontiguousarray(((points - centre) @ axes)[:, across])
        whole = (4.0 if kind == BOX else np.pi) * float(half[across].prod())
        bare = max(1.0 - area(hull(places)) / whole, 0.0)
    else:
        bare = _bare_share(kind, axes, centre, half, np.array(f.seen), points)
    return replace(f, cost=f.cost + 0.003 * bare)


def _ranked(
    points: Array, normals: Array, config: FitConfig, rng: np.random.Generator
) -> tuple[list[Fit], Array]:
    """The best fit of each shape, lowest cost first, and the points (N, 3) by which they are scored."""
    if len(points) < config.min_points:
        return [], points
    count = min(len(points), config.max_points)
    every = max(1, count // config.search_points)
    if every > 1 or count < len(points):
        # Shuffled: points come row by row, and every n-th of a row would leave out whole columns.
        drawn = rng.choice(len(points), count, replace=False)
        points, normals = points[drawn], normals[drawn]
    origin = points.mean(axis=0)
    centred = points - origin
    some, facing = centred[::every].copy(), normals[::every].copy()
    kinds = [KINDS[kind] for kind in config.shapes]
    samples = rng.integers(0, -(-count // every), size=(len(kinds), config.hypotheses, 2))
    rows = len(kinds), config.polish + 2
    shapes, score = np.empty((*rows, 5, 3)), np.full((*rows, 3), np.inf)
    seen = np.empty((*rows, 6), dtype=np.bool_)
    best = best_of_each(
        np.array([kind.code for kind in kinds]), centred, normals, some, facing, samples, config.steps,
        config.threshold, config.max_radius, config.max_extent, config.min_extent, config.normal_weight,
        config.min_points, shapes, score, seen,
    )  # fmt: skip
    fits = []
    for number, (kind, row) in enumerate(zip(kinds, best.tolist(), strict=True)):
        if row >= 0:
            shapes[number, row, 3] += origin
            cost, residual, inliers = score[number, row].tolist()
            sides = tuple(seen[number, row].tolist())
            fits.append(Fit(as_shape(kind, shapes[number, row]), residual, inliers, sides, cost))
    return sorted(fits, key=lambda f: f.cost), points


def as_shape(kind: type[Shape], row: Array) -> Shape:
    """The shape of a kind with axes, centre and half extents (5, 3)."""
    return kind.from_extents(transforms.rigid(row[:3], row[3]), 2.0 * row[4])


@kernel
def best_of_each(  # type: ignore[no-untyped-def]  # noqa: D417
    kinds, points, normals, some, facing, samples, steps, threshold, max_radius, max_extent, min_extent,
    normal_weight, min_points, shapes, score, seen,
):  # fmt: skip
    """Fit each kind of shape: search among some points, least squares, score by all points.

    Args:
        kinds: Codes (K,).
        points: (N, 3) [m], about the origin.
        normals: Unit normals (N, 3).
        some: The points (M, 3) among which shapes are searched.
        facing: Their normals (M, 3).
        samples: Pairs (K, B, 2) of those points that hypotheses are made from; then settings as configured.
        shapes: S of each kind (K, S, 5, 3); written to, and so are the rest. All but two of them are
            hypotheses from the search, one is of a single face, one the last refinement of the best.
        score: Cost [m], infinite at first, mean distance [m] and share of inliers (K, S, 3).
        seen: Which sides points confirm (K, S, 6).

    Returns:
        Which of its shapes is the best of each kind (K,); −1 = none.
    """
    polish = shapes.shape[1] - 2
    best, found = np.zeros(len(kinds), np.intp), np.zeros(len(kinds), np.intp)
    within = np.zeros(len(kinds), np.bool_)
    least_seen = max(min_points / 3.0, CONFIRMED * len(points))  # Points that confirm a side.
    for turn in range(4):
        least = np.inf
        for k in range(len(kinds)):
            row = best[k]
            x, y, z = shapes[k, row, 4, 0], shapes[k, row, 4, 1], shapes[k, row, 4, 2]
            within[k] = score[k, best[k], 0] < np.inf and 2.0 * max(x, y, z) <= max_extent
            if within[k]:
                least = min(least, score[k, best[k], 0])
        for k in range(len(kinds)):
            first, last, step, used = 0, 0, 1, some
            if turn == 0:
                found[k] = search(
                    kinds[k], some, facing, samples[k], polish, threshold, max_radius, max_extent, min_extent,
                    shapes[k],
                )  # fmt: skip
                last, step = found[k], max(found[k] - 1, 1)
            elif turn == 1 and not (within[k] and score[k, best[k], 0] > 4.0 * least):
                # The first and the last start of each kind, of a single face, tell which kinds' others are
                # worth refining: those may halve what they found, and twice the best may still win.
                first, last = 1, found[k] - 1
            elif turn == 2 and within[k] and score[k, best[k], 0] <= 2.0 * least:
                # Kinds are compared when least squares on all the points gain nothing more. By now
                # they gain a thousandth a step, so kinds that cost twice as much as the best cannot catch up.
                first, last, used = polish + 1, polish + 2, points
                copy(shapes[k, best[k]], shapes[k, first])
            elif turn == 3 and not within[k]:
                best[k] = -1
            # A small pull on the extents keeps sides without points near; the last fit has none.
            for row in range(first, last, step):
                shape, converged = shapes[k, row], CONVERGED if turn == 2 else 10.0 * CONVERGED
                levenberg_marquardt(kinds[k], shape, used, steps, min_extent, 2e-5, converged)
                residual, turned, inliers = _judge(
                    kinds[k], shape, points, normals, threshold, least_seen, min_extent, seen[k, row]
                )
                x, y, z = shape[4, 0], shape[4, 1], shape[4, 2]
                # Of the mean squared extent a dm² costs 0.125 mm.
                size = 4.0 * (x * x + y * y + z * z) / 3.0
                cost = residual + normal_weight * turned + 0.0125 * size
                score[k, row, 0] = cost if cost == cost else np.inf
                score[k, row, 1], score[k, row, 2] = residual, inliers
                if score[k, row, 0] < score[k, best[k], 0]:
                    best[k] = row
    return best


@inner
def _judge(kind, shape, points, normals, threshold, least, min_extent, seen):  # type: ignore[no-untyped-def]
    """Find the sides that points confirm, draw the others in to where the points end, and score the shape.

    Points and unit normals are (N, 3); those nearer than the threshold [m] are the shape's, and a side needs
    at least `least` of them. The shape (5, 3) changes, down to a least extent [m]; `seen` (6,) is written to:
    whether the sides -x, +x, -y, +y, -z, +z are.

    Returns:
        Mean distance, truncated at the threshold [m]; mean of 1 − the cosine between normals, at most 1;
        share of the points within the threshold.
    """
    own, facing = in_frame(shape[:3], shape[3], points), in_frame(shape[:3], np.zeros(3), normals)
    counts, near, count = np.zeros(6), np.empty((len(points), 3)), 0
    hx, hy, hz = shape[4, 0], shape[4, 1], shape[4, 2]
    for i in range(len(points)):
        d, gx, gy, gz = gradient(kind, own[i, 0], own[i, 1], own[i, 2], hx, hy, hz)
        if not abs(d) < threshold:
            continue
        near[count, 0], near[count, 1], near[count, 2] = own[i, 0], own[i, 1], own[i, 2]
        count += 1
        if gx * facing[i, 0] + gy * facing[i, 1] + gz * facing[i, 2] > 0.5:
            for axis, g in enumerate((gx, gy, gz)):
                counts[2 * axis + (g > 0.0)] += abs(g) > ALONG
    for side in range(6):
        seen[side] = counts[side] >= least
    if kind != SPHERE:
        _draw_in(kind, shape, own, near[:count] if count > 0 else own, min_extent, seen)
    away = turned = 0.0
    inliers = 0
    count = len(points)
    hx, hy, hz = shape[4, 0], shape[4, 1], shape[4, 2]
    for i in range(count):
        d, gx, gy, gz = gradient(kind, own[i, 0], own[i, 1], own[i, 2], hx, hy, hz)
        away += min(abs(d), threshold)
        cosine = gx * facing[i, 0] + gy * facing[i, 1] + gz * facing[i, 2]
        turned += min(max(1.0 - cosine, 0.0), 1.0)
        inliers += abs(d) < threshold
    return away / count, turned / count, inliers / count


@inner
def _draw_in(kind, shape, own, near, min_extent, seen):  # type: ignore[no-untyped-def]
    """Move sides that are not seen inwards to where the near points end; all points move with the centre."""
    R, centre, half = shape[:3], shape[3], shape[4]
    shift, reach = np.zeros(3), np.empty(len(near))
    for axis in range(2 if kind == CYLINDER else 0, 3):
        low, high = -half[axis], half[axis]
        for i in range(len(near)):
            reach[i] = near[i, axis]
        if not seen[2 * axis]:
            low = min(max(low, quantile(reach, TRIM)), high - min_extent)
        if not seen[2 * axis + 1]:
            high = max(min(high, quantile(reach, 1.0 - TRIM)), low + min_extent)
        half[axis], shift[axis] = (high - low) / 2.0, (high + low) / 2.0
    for a in range(3):
        centre[a] += R[a, 0] * shift[0] + R[a, 1] * shift[1] + R[a, 2] * shift[2]
        for i in range(len(own)):
            own[i, a] -= shift[a]


@kernel
def _bare_share(kind, R, centre, half, seen, points):  # type: ignore[no-untyped-def]
    """Share of the seen sides' area without a point near it: a side that was seen should be seen whole.

    The shape has axes R (3, 3), a centre (3,) and half extents (3,) [m]; points are (N, 3).
    """
    own = in_frame(R, centre, points)
    axes = np.zeros((3, 3))
    axes[0, 0] = axes[1, 1] = axes[2, 2] = 1.0
    places, outward = sample_surface(kind, axes, np.zeros(3), half, BARE_SPACING)
    samples = bare = last = 0
    for k in range(len(places)):
        # A round side is the part of the surface whose outward normal is nearest to the side's direction.
        axis = 0
        for a in range(1, 3):
            if abs(outward[k, a]) > abs(outward[k, axis]):
                axis = a
        if not seen[2 * axis + (outward[k, axis] > 0.0)]:
            continue
        samples += 1
        found = False
        for n in range(-1, len(own)):
            i = last if n < 0 else n
            x, y, z = own[i, 0] - places[k, 0], own[i, 1] - places[k, 1], own[i, 2] - places[k, 2]
            if x * x + y * y + z * z <= 4.0 * BARE_SPACING * BARE_SPACING:
                found, last = True, i
                break
        bare += not found
    return bare / samples if samples > 0 else 1.0
