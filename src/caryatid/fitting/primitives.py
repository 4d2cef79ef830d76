"""Fit a box, a cylinder or a sphere to the oriented points of each object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.fitting.hidden_faces import Seen, close_hidden_faces
from caryatid.fitting.least_squares import CONVERGED, ROUGHLY, levenberg_marquardt
from caryatid.fitting.scoring import bare_share, judge
from caryatid.fitting.search import of_one_face, search
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.geometry import SPHERE, transforms
from caryatid.geometry.shapes import KINDS, Shape
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import on_threads
from caryatid.sensing.voxel_map import FREE, VoxelMap

SHRINK = 2e-5
"""Pull on every extent in the search [m]: keeps sides that hold no points near; the last fit has none."""
SIZE_PENALTY = 0.0125
"""Cost [m] per square metre of mean squared extent: 1.25e-4·size² (size in dm)."""
SIDE_SHARE = 0.02
"""Share of the points that must lie on a side for it to count as seen [1]."""
BARE_WEIGHT = 0.003
"""Cost of seen sides without any point near them [m]; a share of them in proportion."""
FREE_WEIGHT = 0.01
"""Cost of a shape whose whole inside was seen free [m]; a share of it in proportion."""


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """A shape and how well it explains the points.

    Attributes:
        shape: In the points' frame.
        residual: Mean absolute distance of the points to the surface, truncated at the threshold [m].
        inliers: Share of the points within the threshold [1].
        seen: Which sides (-x, +x, -y, +y, -z, +z of the object) points bear out.
        cost: What model choice compares [m].
        poor: No shape explains the points within the configured residual.
        uncertainty: How far off it may be; of the fit that was chosen only.
    """

    shape: Shape
    residual: float
    inliers: float
    seen: Seen
    cost: float
    poor: bool
    uncertainty: Uncertainty | None = None


@dataclass(frozen=True, slots=True)
class FitFailure:
    """No shape could be fitted.

    Attributes:
        reason: Why, for a person to read.
    """

    reason: str


@dataclass(frozen=True, eq=False, slots=True)
class Oriented:
    """The points of one object.

    Attributes:
        points: (N, 3) [m], in any frame.
        normals: Unit normals (N, 3) towards the sensor.
    """

    points: Array
    normals: Array

    def finite(self) -> Oriented:
        """Leave out points that are not finite, or whose normals are not; in the layout that kernels take."""
        points = np.ascontiguousarray(self.points, dtype=np.float64)
        normals = np.ascontiguousarray(self.normals, dtype=np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            total = points.sum() + normals.sum()
        every = Oriented(points, normals)
        if np.isfinite(total):
            return every
        finite = np.isfinite(points) & np.isfinite(normals)
        return every.select(np.flatnonzero(finite.all(axis=1)))

    def select(self, kept: NDArray[np.intp]) -> Oriented:
        """Return some of the points, by indices (M,)."""
        return Oriented(self.points[kept], self.normals[kept])

    def __len__(self) -> int:
        return len(self.points)


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
        space: What has been seen free, where points are in the world frame: shapes do not fill it.
    """
    return fit_many([Oriented(points, normals)], config=config, rngs=[rng], space=space)[0]


def fit_many(
    objects: Sequence[Oriented],
    *,
    config: FitConfig,
    rngs: Sequence[np.random.Generator],
    space: VoxelMap | None = None,
) -> list[Fit | FitFailure]:
    """Fit a shape to each of several objects, on all cores; each is fitted as it would be alone.

    Args:
        objects: Their points.
        config: Limits and thresholds.
        rngs: Source of the samples of each object, one of its own.
        space: What has been seen free, where points are in the world frame: shapes do not fill it.
    """
    finite = [o.finite() for o in objects]
    chosen = [_least_free(fits, space) for fits in candidates(finite, config=config, rngs=rngs)]
    return on_threads(lambda k: _completed(chosen[k], finite[k], config), len(finite))


def candidates(
    objects: Sequence[Oriented], *, config: FitConfig, rngs: Sequence[np.random.Generator]
) -> list[list[Fit]]:
    """Return, for each object, the best fit of each shape that could be fitted, least cost first.

    Arguments as of `fit_many`.
    """
    return on_threads(lambda k: _candidates(objects[k].finite(), config, rngs[k]), len(objects))


def free_inside(shape: Shape, voxels: VoxelMap, inset: float) -> tuple[int, int]:
    """Of the space well inside a shape, how much there is and how much was seen free [voxels].

    Args:
        shape: In the world frame.
        voxels: What has been seen.
        inset: How far inside the surface to begin [m]; a surface voxel may be half free.

    Returns:
        Cubes of a voxel's size in all, none where the shape is too thin, and those in voxels seen free.
    """
    half, size = shape.extents / 2.0 - inset, voxels.config.size
    if half.min() <= 0.0:
        return 0, 0
    # A row of cubes begins at the surface; one that does not fit in lies in the middle.
    ticks = [np.arange(-h + size / 2.0, h, size) if h > size / 2.0 else np.zeros(1) for h in half]
    inside = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    across = np.equal(shape.ties, shape.ties[0])
    inside = inside[np.einsum("ij,ij->i", inside[:, across], inside[:, across]) <= half[0] ** 2]
    free = voxels.state_at(transforms.transform(shape.T_world_object, inside)) == FREE
    return len(inside), int(np.count_nonzero(free))


def _least_free(fits: Sequence[Fit], space: VoxelMap | None) -> Fit | None:
    """Of fits in order of their cost, the cheapest once it pays for what it fills of the space seen free."""
    best, least = None, np.inf
    for f in fits:
        if f.cost >= least:
            break
        cost = f.cost
        if space is not None:
            inside, free = free_inside(f.shape, space, 1.2 * space.config.size)
            cost += FREE_WEIGHT * (free / max(inside, 1))
        if cost < least:
            best, least = f, cost
    return best


def _completed(best: Fit | None, oriented: Oriented, config: FitConfig) -> Fit | FitFailure:
    """A fit with its hidden faces and its uncertainty."""
    if len(oriented) < config.min_points:
        return FitFailure(f"{len(oriented)} points are fewer than the {config.min_points} a shape needs")
    if best is None:
        return FitFailure(f"every shape exceeds the longest extent of {config.max_extent:g} m")
    shape, residual, inliers, uncertainty = close_hidden_faces(best.shape, best.seen, oriented.points, config)
    poor = residual > config.max_residual
    return replace(best, shape=shape, residual=residual, inliers=inliers, poor=poor, uncertainty=uncertainty)


def _candidates(oriented: Oriented, config: FitConfig, rng: np.random.Generator) -> list[Fit]:
    """Do as `candidates` does with the points of one object, which are all finite."""
    if len(oriented) < config.min_points:
        return []
    count = min(len(oriented), config.max_points)
    every = max(1, count // config.search_points)
    if every > 1 or count < len(oriented):
        # Shuffled: points come row by row, and every so many of a row would leave out whole columns.
        oriented = oriented.select(rng.choice(len(oriented), count, replace=False))
    kinds = np.array([KINDS[kind].code for kind in config.shapes])
    searched = -(-len(oriented) // every)
    origin = oriented.points.mean(axis=0)
    rows = _fit_kinds(
        kinds,
        oriented.points - origin,
        oriented.normals.copy(),
        every,
        rng.integers(0, searched, size=(len(kinds), config.hypotheses, 2)),
        config.polish + 1,
        config.threshold,
        config.max_radius,
        config.max_extent,
        config.min_extent,
        config.min_points,
        config.steps,
        config.normal_weight,
    )
    fits = []
    for kind, R, centre, half, seen, (cost, residual, inliers) in zip(config.shapes, *rows, strict=True):
        if cost < np.inf:
            shape = KINDS[kind].from_extents(transforms.rigid(R, centre + origin), 2.0 * half)
            scores = float(residual), float(inliers), tuple(seen.tolist()), float(cost)
            fits.append(Fit(shape, *scores, poor=bool(residual > config.max_residual)))
    return sorted(fits, key=lambda f: f.cost)


@njit(cache=True, error_model="numpy", nogil=True)
def _fit_kinds(  # type: ignore[no-untyped-def]
    kinds, points, normals, every, samples, rows,
    threshold, max_radius, max_extent, min_extent, min_points, steps, normal_weight,
):  # fmt: skip
    """Fit the best shape of each of K kinds to the points of one object, about their own origin.

    Args:
        kinds: Codes (K,).
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        every: Search and first refinement look at every so many points.
        samples: Indices (K, B, 2) of the pairs of those points that hypotheses are made from.
        rows: Shapes of each kind there is room for.
        threshold: A setting by its name in `FitConfig`, as are all that follow.
        max_radius: [m].
        max_extent: [m].
        min_extent: [m].
        min_points: [1].
        steps: [1].
        normal_weight: [m].

    Returns:
        Axes (K, 3, 3), centres and half extents (K, 3) [m], sides (K, 6) that points bear out; and (K, 3)
        what model choice compares [m], infinite where there is no shape, residual [m] and inliers.
    """
    count = len(kinds)
    some, facing = points[::every].copy(), normals[::every].copy()
    R, centre, half = np.empty((count, rows, 3, 3)), np.empty((count, rows, 3)), np.empty((count, rows, 3))
    seen, scores = np.zeros((count, rows, 6), np.bool_), np.full((count, rows, 3), np.inf)
    found, best = np.zeros(count, np.intp), np.zeros(count, np.intp)
    limits = threshold, min_extent, min_points, steps, normal_weight
    for k in range(count):
        found[k] = search(
            kinds[k], some, facing, samples[k], threshold, max_radius, max_extent, R[k], centre[k], half[k]
        )
        if kinds[k] != SPHERE and of_one_face(
            kinds[k], some, facing, min_extent, max_radius, max_extent,
            R[k, found[k]], centre[k, found[k]], half[k, found[k]],
        ):  # fmt: skip
            found[k] += 1
        if found[k] > 0:
            shape = R[k, 0], centre[k, 0], half[k, 0]
            _improve(kinds[k], shape, seen[k, 0], scores[k, 0], some, points, normals, ROUGHLY, limits)
    # The first start of each kind tells which kinds' other starts are worth refining: those may halve what it
    # found, and twice the best may still win.
    least = _least_within(half, scores, best, max_extent)
    for k in range(count):
        within = _within(half[k, 0], scores[k, 0], max_extent)
        if not within or scores[k, 0, 0] <= 4.0 * least:
            for row in range(1, found[k]):
                shape = R[k, row], centre[k, row], half[k, row]
                _improve(
                    kinds[k], shape, seen[k, row], scores[k, row], some, points, normals, ROUGHLY, limits
                )
                if scores[k, row, 0] < scores[k, best[k], 0]:
                    best[k] = row
    # Kinds are compared once least squares on all the points have nothing left to gain. By now they gain a
    # thousandth a step, so kinds that cost twice as much as the best cannot catch up.
    least = _least_within(half, scores, best, max_extent)
    for k in range(count):
        b = best[k]
        if _within(half[k, b], scores[k, b], max_extent) and scores[k, b, 0] <= 2.0 * least:
            row = (b + 1) % rows
            R[k, row], centre[k, row], half[k, row] = R[k, b], centre[k, b], half[k, b]
            shape = R[k, row], centre[k, row], half[k, row]
            _improve(
                kinds[k], shape, seen[k, row], scores[k, row], points, points, normals, CONVERGED, limits
            )
            if scores[k, row, 0] < scores[k, b, 0]:
                best[k] = row
    for k in range(count):
        b = best[k]
        if _within(half[k, b], scores[k, b], max_extent):
            bare = bare_share(kinds[k], R[k, b], centre[k, b], half[k, b], seen[k, b], points)
            scores[k, b, 0] += BARE_WEIGHT * bare
        else:
            scores[k, b, 0] = np.inf
        R[k, 0], centre[k, 0], half[k, 0] = R[k, b], centre[k, b], half[k, b]
        seen[k, 0], scores[k, 0] = seen[k, b], scores[k, b]
    return R[:, 0], centre[:, 0], half[:, 0], seen[:, 0], scores[:, 0]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _improve(  # type: ignore[no-untyped-def]
    kind, shape, seen, scores, some, points, normals, converged, limits
):
    """Refine a shape by some points, draw in the sides that none of all points bears out, and score it."""
    R, centre, half = shape
    threshold, min_extent, min_points, steps, normal_weight = limits
    levenberg_marquardt(kind, R, centre, half, some, steps, min_extent, SHRINK, converged)
    least = max(min_points / 3.0, SIDE_SHARE * len(points))
    residual, turned, inliers = judge(
        kind, R, centre, half, points, normals, threshold, least, min_extent, seen
    )
    size = 4.0 * (half[0] ** 2 + half[1] ** 2 + half[2] ** 2) / 3.0
    cost = residual + normal_weight * turned + SIZE_PENALTY * size
    scores[0], scores[1], scores[2] = np.inf if np.isnan(cost) else cost, residual, inliers


@njit(cache=True, inline="always")
def _within(half, scores, max_extent):  # type: ignore[no-untyped-def]
    """Whether a shape is one, and no longer than allowed."""
    return scores[0] < np.inf and 2.0 * half.max() <= max_extent


@njit(cache=True, no_cpython_wrapper=True)
def _least_within(half, scores, best, max_extent):  # type: ignore[no-untyped-def]
    """Least cost [m] of the best shapes of all kinds, of those no longer than allowed."""
    least = np.inf
    for k in range(len(best)):
        if _within(half[k, best[k]], scores[k, best[k]], max_extent):
            least = min(least, scores[k, best[k], 0])
    return least
