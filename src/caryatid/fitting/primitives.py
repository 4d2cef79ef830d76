"""Fit a box, a cylinder or a sphere to the oriented points of each object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.fitting.explaining import free_inside
from caryatid.fitting.hidden_faces import Seen, close_hidden_faces
from caryatid.fitting.least_squares import CONVERGED, ROUGHLY, SHRINK, levenberg_marquardt
from caryatid.fitting.scoring import bare_share, draw_in, misfit
from caryatid.fitting.search import of_one_face, search
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.geometry import SPHERE
from caryatid.geometry.shapes import KINDS, Shape
from caryatid.geometry.transforms import Array, rigid
from caryatid.runtime.parallel import for_each
from caryatid.sensing.voxel_map import VoxelMap

PROMISING = 2.0
"""Kinds of shape that cost more than so many times the best one after the first refinement get no second one
[1]: that ends where a step gains a thousandth, so no more of them can halve what is left."""
HOPEFUL = 4.0
"""The same where only the first start of each kind is refined yet [1]: the others may halve what it found,
and twice the best may still win."""
SIZE_PENALTY = 0.0125
"""Cost [m] per square metre of mean squared extent: 1.25e-4·size² (size in dm)."""
SIDE_SHARE = 0.02
"""Share of the points that must lie on a side for it to count as seen [1]."""
BARE_WEIGHT = 0.003
"""Cost of seen sides without any point near them [m]; a share of them in proportion."""
FREE_WEIGHT = 0.01
"""Cost of a shape whose whole inside was seen free [m]; a share of it in proportion."""
FREE_INSET = 1.2
"""How far inside a shape free space is looked for [voxels]; a surface voxel may be half free."""


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
        rngs: Source of the samples of each object.
        space: What has been seen free, where points are in the world frame: shapes do not fill it.
    """
    finite = [o.finite() for o in objects]
    chosen = [_least_free(fits, space) if fits else None for fits in _candidates(finite, config, rngs)]
    found = [(f.shape, f.seen, o.points) for o, f in zip(finite, chosen, strict=True) if f]
    closed = iter(close_hidden_faces(found, config))
    results: list[Fit | FitFailure] = []
    for points, best in zip(finite, chosen, strict=True):
        if best:
            shape, residual, inliers, uncertainty = next(closed)
            best = replace(best, shape=shape, residual=residual, inliers=inliers, uncertainty=uncertainty)
            results.append(replace(best, poor=residual > config.max_residual))
        elif len(points) < config.min_points:
            results.append(
                FitFailure(f"{len(points)} points are fewer than the {config.min_points} a shape needs")
            )
        else:
            results.append(FitFailure(f"every shape exceeds the longest extent of {config.max_extent:g} m"))
    return results


def _least_free(fits: Sequence[Fit], space: VoxelMap | None) -> Fit:
    """Of fits in order of their cost, the cheapest once it pays for what it fills of the space seen free."""
    best, least = fits[0], np.inf
    for f in fits:
        if space is None or f.cost >= least:
            break
        inside, free = free_inside(f.shape, space, FREE_INSET * space.config.size)
        cost = f.cost + FREE_WEIGHT * (free / max(inside, 1))
        if cost < least:
            best, least = f, cost
    return best


def candidates(
    objects: Sequence[Oriented], *, config: FitConfig, rngs: Sequence[np.random.Generator]
) -> list[list[Fit]]:
    """Return, for each object, the best fit of each shape that could be fitted, least cost first.

    Arguments as of `fit_many`.
    """
    return _candidates([o.finite() for o in objects], config, rngs)


class FitJob(NamedTuple):
    """Shapes of several kinds are fitted to the points of each of several objects, some of each kind.

    Object p and kind k have the shapes s = (p · K + k) · S … + S − 1.

    Attributes:
        rows: Which of the shapes are improved (M,).
        kinds: Codes of the kinds (K,).
        first: Index of each object's first point, and the number of all points (P + 1,).
        points: (N, 3) [m], object after object, each about its own origin.
        normals: Unit normals (N, 3).
        every: Search and refinement look at every so many points of each object (P,).
        samples: Indices (P, K, B, 2) of the pairs of those points that hypotheses are made from.
        threshold, …, normal_weight: Settings by their names in `FitConfig`.
        converged: See `levenberg_marquardt`.
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
    max_radius: float
    max_extent: float
    min_extent: float
    min_points: int
    steps: int
    normal_weight: float
    converged: float
    R: NDArray[np.float64]
    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    seen: NDArray[np.bool_]
    cost: NDArray[np.float64]
    residual: NDArray[np.float64]
    inliers: NDArray[np.float64]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def search_one(group: int, job: FitJob) -> None:
    """Find shapes of one kind for one object to start from; those found have a cost of 0."""
    owner, number = group // len(job.kinds), group % len(job.kinds)
    kind, every = job.kinds[number], job.every[owner]
    some = job.points[job.first[owner] : job.first[owner + 1] : every].copy()
    facing = job.normals[job.first[owner] : job.first[owner + 1] : every].copy()
    R, centre, half, cost = job.R[group], job.centre[group], job.half[group], job.cost[group]
    count = search(
        kind, some, facing, job.samples[owner, number], job.threshold, job.max_radius, job.max_extent,
        R, centre, half, cost,
    )  # fmt: skip
    if kind != SPHERE and of_one_face(
        kind, some, facing, job.min_extent, job.max_radius, job.max_extent,
        R[count], centre[count], half[count],
    ):  # fmt: skip
        count += 1
    for k in range(len(cost)):
        cost[k] = 0.0 if k < count else np.inf


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def improve_one(index: int, job: FitJob) -> None:
    """Refine one of the shapes, draw in the sides no point bears out, and judge it by all the points."""
    row = job.rows[index]
    group, k = row // job.cost.shape[1], row % job.cost.shape[1]
    owner, kind = group // len(job.kinds), job.kinds[group % len(job.kinds)]
    points = job.points[job.first[owner] : job.first[owner + 1]]
    normals = job.normals[job.first[owner] : job.first[owner + 1]]
    R, centre, half = job.R[group, k], job.centre[group, k], job.half[group, k]
    some = points[:: job.every[owner]].copy()
    levenberg_marquardt(kind, R, centre, half, some, job.steps, job.min_extent, SHRINK, job.converged)
    least = max(job.min_points / 3.0, SIDE_SHARE * len(points))
    draw_in(kind, R, centre, half, points, normals, job.threshold, least, job.min_extent, job.seen[group, k])
    residual, turned, inliers = misfit(kind, R, centre, half, points, normals, job.threshold)
    size = 4.0 * (half[0] ** 2 + half[1] ** 2 + half[2] ** 2) / 3.0
    job.cost[group, k] = residual + job.normal_weight * turned + SIZE_PENALTY * size
    job.residual[group, k], job.inliers[group, k] = residual, inliers


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def bare_one(index: int, job: FitJob) -> None:
    """Have one of the shapes pay for sides that should have been seen but are bare."""
    row = job.rows[index]
    group, k = row // job.cost.shape[1], row % job.cost.shape[1]
    owner, kind = group // len(job.kinds), job.kinds[group % len(job.kinds)]
    points = job.points[job.first[owner] : job.first[owner + 1]]
    job.cost[group, k] += BARE_WEIGHT * bare_share(
        kind, job.R[group, k], job.centre[group, k], job.half[group, k], job.seen[group, k], points,
    )  # fmt: skip


SETTINGS = tuple(name for name in FitJob._fields if hasattr(FitConfig, name))
"""What the kernels need to know of the settings."""


def _candidates(
    objects: Sequence[Oriented], config: FitConfig, rngs: Sequence[np.random.Generator]
) -> list[list[Fit]]:
    """Do as `candidates` does with points that are all finite."""
    large = [k for k, o in enumerate(objects) if len(o) >= config.min_points]
    found: list[list[Fit]] = [[] for _ in objects]
    if not large:
        return found
    kinds = np.array([KINDS[kind].code for kind in config.shapes])
    parts, every, samples = [], [], []
    for k in large:
        part, rng = objects[k], rngs[k]
        count = min(len(part), config.max_points)
        every.append(max(1, count // config.search_points))
        if every[-1] > 1 or count < len(part):
            # Shuffled: points come row by row, and every so many of a row would leave out whole columns.
            part = part.select(rng.choice(len(part), count, replace=False))
        parts.append(part)
        searched = -(-len(part) // every[-1])
        samples.append(rng.integers(0, searched, size=(len(kinds), config.hypotheses, 2)))
    origins = [part.points.mean(axis=0) for part in parts]
    shapes = len(parts) * len(kinds), config.polish + 1
    job = FitJob(
        np.zeros(0, dtype=np.intp),
        kinds,
        np.cumsum([0, *(len(part) for part in parts)]),
        np.concatenate([part.points - origin for part, origin in zip(parts, origins, strict=True)]),
        np.concatenate([part.normals for part in parts]),
        np.array(every),
        np.stack(samples),
        **{name: getattr(config, name) for name in SETTINGS},
        converged=ROUGHLY,
        R=np.empty((*shapes, 3, 3)),
        centre=np.empty((*shapes, 3)),
        half=np.empty((*shapes, 3)),
        seen=np.zeros((*shapes, 6), dtype=np.bool_),
        cost=np.full(shapes, np.inf),
        residual=np.empty(shapes),
        inliers=np.empty(shapes),
    )
    best = _fitted(job, config)
    for number, (k, origin) in enumerate(zip(large, origins, strict=True)):
        fits = [
            _row(job, (group, best[group]), config.shapes[group - number * len(kinds)], origin, config)
            for group in range(number * len(kinds), (number + 1) * len(kinds))
            if best[group] >= 0
        ]
        found[k] = sorted(fits, key=lambda f: f.cost)
    return found


def _fitted(job: FitJob, config: FitConfig) -> NDArray[np.intp]:
    """Fit the shapes of a job, and tell which one of each object and kind is best (P · K,); -1 is none."""
    groups, room = job.cost.shape
    for_each(search_one, groups, job)
    # The first start of each kind tells which kinds' other starts are worth refining.
    started = job.cost < np.inf
    _improve(job, np.flatnonzero(started[:, 0]) * room)
    started[:, 0] = False
    first = np.zeros(groups, dtype=np.intp)
    started &= (_promising(job, first, HOPEFUL, config) | ~_within(job, first, config))[:, None]
    job.cost[:, 1:] = np.where(started[:, 1:], 0.0, np.inf)
    _improve(job, np.flatnonzero(started))
    best = np.argmin(job.cost, axis=1)
    promising = _promising(job, best, PROMISING, config)
    found = np.flatnonzero(promising)
    # Kinds are compared once least squares on all the points have nothing left to gain.
    last = (best + 1) % room
    for part in (job.R, job.centre, job.half):
        part[found, last[found]] = part[found, best[found]]
    _improve(job._replace(every=np.ones_like(job.every), converged=CONVERGED), found * room + last[found])
    better = found[job.cost[found, last[found]] < job.cost[found, best[found]]]
    best[better] = last[better]
    best[~_within(job, best, config)] = -1
    found = np.flatnonzero(best >= 0)
    for_each(bare_one, len(found), job._replace(rows=found * room + best[found]))
    return best


def _improve(job: FitJob, rows: NDArray[np.intp]) -> None:
    """Refine and judge some of a job's shapes."""
    for_each(improve_one, len(rows), job._replace(rows=rows))
    job.cost[np.isnan(job.cost)] = np.inf


def _promising(job: FitJob, best: NDArray[np.intp], factor: float, config: FitConfig) -> NDArray[np.bool_]:
    """Whether a shape of each object and kind (P · K,) is one, and costs little more than the least."""
    cost = np.where(_within(job, best, config), job.cost[np.arange(len(best)), best], np.inf)
    costs = cost.reshape(len(job.every), -1)
    return np.asarray(((costs < np.inf) & (costs <= factor * costs.min(axis=1, keepdims=True))).ravel())


def _within(job: FitJob, best: NDArray[np.intp], config: FitConfig) -> NDArray[np.bool_]:
    """Whether the best shape of each object and kind (P · K,) is one, and no longer than allowed."""
    every = np.arange(len(best))
    fits = 2.0 * job.half[every, best].max(axis=1) <= config.max_extent
    return np.asarray(fits & (job.cost[every, best] < np.inf))


def _row(job: FitJob, row: tuple[int, int], kind: str, origin: Array, config: FitConfig) -> Fit:
    """One of a job's shapes as a fit, in the frame of the object's points before they were centred."""
    s = [bool(b) for b in job.seen[row]]
    residual = float(job.residual[row])
    return Fit(
        KINDS[kind].from_extents(rigid(job.R[row], job.centre[row] + origin), 2.0 * job.half[row]),
        residual,
        float(job.inliers[row]),
        (s[0], s[1], s[2], s[3], s[4], s[5]),
        float(job.cost[row]),
        residual > config.max_residual,
    )
