"""Fit a box, a cylinder or a sphere to the oriented points of each object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.fitting.hidden_faces import Seen, close_hidden_faces
from caryatid.fitting.least_squares import CONVERGED, ROUGHLY, levenberg_marquardt
from caryatid.fitting.scoring import bare_share, judge
from caryatid.fitting.search import search
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.geometry import transforms
from caryatid.geometry.shapes import KINDS, Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import on_threads
from caryatid.sensing.voxel_map import FREE, VoxelMap

SHRINK = 2e-5
"""Pull on every extent in the search [m]: keeps sides that hold no points near; the last fit has none."""
SIZE_PENALTY = 0.0125
"""Cost [m] per square metre of mean squared extent: 1.25e-4·size² (size in dm)."""
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
    if space is not None:
        _ = space.states  # They are found on all threads, which tasks on threads cannot wait for.
    return on_threads(lambda k: _fit(objects[k].finite(), config, rngs[k], space), len(objects))


def candidates(
    objects: Sequence[Oriented],
    *,
    config: FitConfig,
    rngs: Sequence[np.random.Generator],
    whole: bool = True,
) -> list[list[Fit]]:
    """Return, for each object, the best fit of each shape that could be fitted, least cost first.

    Args:
        objects: As of `fit_many`.
        config: As of `fit_many`.
        rngs: As of `fit_many`.
        whole: Whether sides that should have been seen whole cost where they are bare.
    """

    def found(k: int) -> list[Fit]:
        fits, points = _candidates(objects[k].finite(), config, rngs[k])
        return sorted((_with_bare(f, points) for f in fits), key=lambda f: f.cost) if whole else fits

    return on_threads(found, len(objects))


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
    across = np.equal(shape.ties, shape.ties[0])
    return _count_free(
        voxels.states, voxels.origin_world, size, shape.T_world_object, *ticks, across, half[0] ** 2
    )


@njit(cache=True, nogil=True)
def _count_free(states, origin, size, T, x, y, z, across, limit):  # type: ignore[no-untyped-def]
    """Points of a grid that lie within a shape's round sides, and how many of them lie in free voxels."""
    inside, free = 0, 0
    for u in x:
        for v in y:
            for w in z:
                if across[0] * u * u + across[1] * v * v + across[2] * w * w > limit:
                    continue
                inside += 1
                i = math.floor((T[0, 0] * u + T[0, 1] * v + T[0, 2] * w + T[0, 3] - origin[0]) / size)
                j = math.floor((T[1, 0] * u + T[1, 1] * v + T[1, 2] * w + T[1, 3] - origin[1]) / size)
                k = math.floor((T[2, 0] * u + T[2, 1] * v + T[2, 2] * w + T[2, 3] - origin[2]) / size)
                if 0 <= i < states.shape[0] and 0 <= j < states.shape[1] and 0 <= k < states.shape[2]:
                    free += states[i, j, k] == FREE
    return inside, free


def _fit(
    oriented: Oriented, config: FitConfig, rng: np.random.Generator, space: VoxelMap | None
) -> Fit | FitFailure:
    """Do as `fit` does with points that are all finite."""
    if len(oriented) < config.min_points:
        return FitFailure(f"{len(oriented)} points are fewer than the {config.min_points} a shape needs")
    fits, points = _candidates(oriented, config, rng)
    best, least = None, np.inf
    for f in fits:
        if f.cost >= least:
            break
        # A shape pays for what it fills of the space seen free, too.
        priced = _with_bare(f, points)
        total = priced.cost
        if space is not None:
            inside, free = free_inside(f.shape, space, 1.2 * space.config.size)
            total += FREE_WEIGHT * (free / max(inside, 1))
        if total < least:
            best, least = priced, total
    if best is None:
        return FitFailure(f"every shape exceeds the longest extent of {config.max_extent:g} m")
    shape, residual, inliers, uncertainty = close_hidden_faces(best.shape, best.seen, oriented.points, config)
    poor = residual > config.max_residual
    return replace(best, shape=shape, residual=residual, inliers=inliers, poor=poor, uncertainty=uncertainty)


def _with_bare(f: Fit, points: Array) -> Fit:
    """A fit that has paid for sides that should have been seen whole but are bare of points (N, 3)."""
    bare = bare_share(*Primitives.of([f.shape]).row(0), np.array(f.seen), points)
    return replace(f, cost=f.cost + BARE_WEIGHT * bare)


class _Trial(NamedTuple):
    """A shape of one kind on the way to a fit: what it costs and explains, and where it is, as of `Fit`."""

    cost: float
    residual: float
    inliers: float
    seen: NDArray[np.bool_]
    R: Array
    centre: Array
    half: Array


def _candidates(oriented: Oriented, config: FitConfig, rng: np.random.Generator) -> tuple[list[Fit], Array]:
    """Do as `candidates` does with points that are all finite; also those (N, 3) that fits are judged by."""
    if len(oriented) < config.min_points:
        return [], oriented.points
    count = min(len(oriented), config.max_points)
    every = max(1, count // config.search_points)
    if every > 1 or count < len(oriented):
        # Shuffled: points come row by row, and every so many of a row would leave out whole columns.
        oriented = oriented.select(rng.choice(len(oriented), count, replace=False))
    origin = oriented.points.mean(axis=0)
    points, normals = oriented.points - origin, oriented.normals.copy()
    some, facing = points[::every].copy(), normals[::every].copy()
    codes = [KINDS[kind].code for kind in config.shapes]
    samples = rng.integers(0, len(some), size=(len(codes), config.hypotheses, 2))
    least_seen = max(config.min_points / 3.0, 0.02 * len(points))  # Points that bear out a side.

    def improved(code: int, start: tuple[Array, ...], some: Array, converged: float) -> _Trial:
        """Refine a shape by some points, draw in the sides that no point bears out, and score it."""
        R, centre, half = (part.copy() for part in start)
        seen = np.empty(6, dtype=np.bool_)
        levenberg_marquardt(code, R, centre, half, some, config.steps, config.min_extent, SHRINK, converged)
        residual, turned, inliers = judge(
            code, R, centre, half, points, normals, config.threshold, least_seen, config.min_extent, seen
        )
        x, y, z = half.tolist()
        size = 4.0 * (x * x + y * y + z * z) / 3.0
        cost = residual + config.normal_weight * turned + SIZE_PENALTY * size
        return _Trial(np.inf if math.isnan(cost) else cost, residual, inliers, seen, R, centre, half)

    def within(trial: _Trial) -> bool:
        return trial.cost < np.inf and 2.0 * max(trial.half.tolist()) <= config.max_extent

    starts, best = {}, {}
    for code, pairs in zip(codes, samples, strict=True):
        found = search(
            code, some, facing, pairs, config.polish, config.threshold, config.max_radius, config.max_extent,
            config.min_extent,
        )  # fmt: skip
        if len(found[0]):
            starts[code] = list(zip(*found, strict=True))
            best[code] = improved(code, starts[code][0], some, ROUGHLY)
    # The first start of each kind tells which kinds' other starts are worth refining: those may halve what it
    # found, and twice the best may still win.
    least = min((trial.cost for trial in best.values() if within(trial)), default=np.inf)
    for code, trial in best.items():
        if not within(trial) or trial.cost <= 4.0 * least:
            others = [improved(code, start, some, ROUGHLY) for start in starts[code][1:]]
            best[code] = min(trial, *others, key=lambda t: t.cost) if others else trial
    # Kinds are compared once least squares on all the points have nothing left to gain. By now they gain a
    # thousandth a step, so kinds that cost twice as much as the best cannot catch up.
    least = min((trial.cost for trial in best.values() if within(trial)), default=np.inf)
    fits = []
    for kind, code in zip(config.shapes, codes, strict=True):
        if code not in best:
            continue
        trial = best[code]
        if within(trial) and trial.cost <= 2.0 * least:
            last = improved(code, trial[4:], points, CONVERGED)
            trial = last if last.cost < trial.cost else trial
        if within(trial):
            cost, residual, inliers, seen, R, centre, half = trial
            shape = KINDS[kind].from_extents(transforms.rigid(R, centre + origin), 2.0 * half)
            poor = residual > config.max_residual
            fits.append(Fit(shape, residual, inliers, tuple(seen.tolist()), cost, poor))
    return sorted(fits, key=lambda f: f.cost), points + origin
