"""Fit a box, a cylinder or a sphere to the oriented points of each object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.fitting.free_space import free_share
from caryatid.fitting.hidden_faces import Polish, polish
from caryatid.fitting.jobs import FitJob, RefineJob, bare_one, judge_one, refine_one, search_one
from caryatid.fitting.least_squares import (
    CONVERGED,
    NOISE_FLOOR,
    RIDGE,
    ROBUST_WIDTH,
    ROUGHLY,
)
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.geometry.shapes import KINDS, Shape
from caryatid.geometry.transforms import Array, rigid
from caryatid.runtime.parallel import for_each
from caryatid.sensing.voxel_map import VoxelMap

Seen = tuple[bool, bool, bool, bool, bool, bool]

SETTINGS = tuple(name for name in FitJob._fields if hasattr(FitConfig, name))
"""What the kernels are told of the settings."""


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


PROMISING = 2.0
"""Kinds of shape that cost more than so many times the best one after the first refinement get no second one
[1]: that ends where a step gains a thousandth, so no more of them can halve what is left."""

HOPEFUL = 4.0
"""The same where only the first start of each kind is refined yet [1]: the others may halve what it found,
and twice the best may still win."""


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
    results: list[Fit | FitFailure] = []
    chosen: list[Polish] = []
    finite = [o.finite() for o in objects]
    for part, found in zip(finite, _candidates(finite, config, rngs), strict=True):
        if not found:
            results.append(FitFailure(_failure_reason(len(part), config)))
            continue
        best = found[0] if space is None else _least_free(found, space, config)
        results.append(best)
        chosen.append(Polish(best.shape, best.seen, part.points))
    polished = iter(polish(chosen, config))
    for number, result in enumerate(results):
        if isinstance(result, Fit):
            last = next(polished)
            results[number] = replace(
                result,
                shape=last.shape,
                residual=last.residual,
                inliers=last.inliers,
                poor=last.residual > config.max_residual,
                uncertainty=last.uncertainty,
            )
    return results


def candidates(
    objects: Sequence[Oriented], *, config: FitConfig, rngs: Sequence[np.random.Generator]
) -> list[list[Fit]]:
    """Return, for each object, the best fit of each shape that could be fitted, least cost first.

    Arguments as of `fit_many`.
    """
    return _candidates([o.finite() for o in objects], config, rngs)


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
    job = _job(
        kinds,
        np.cumsum([0, *(len(part) for part in parts)]),
        np.concatenate([part.points - origin for part, origin in zip(parts, origins, strict=True)]),
        np.concatenate([part.normals for part in parts]),
        np.array(every),
        np.stack(samples),
        config,
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
    _improve(job, np.flatnonzero(started[:, 0]) * room, job.every, ROUGHLY, config)
    started[:, 0] = False
    first = np.zeros(groups, dtype=np.intp)
    started &= (_promising(job, first, HOPEFUL, config) | ~_within(job, first, config))[:, None]
    job.cost[:, 1:] = np.where(started[:, 1:], 0.0, np.inf)
    _improve(job, np.flatnonzero(started), job.every, ROUGHLY, config)
    best = np.argmin(job.cost, axis=1)
    promising = _promising(job, best, PROMISING, config)
    found = np.flatnonzero(promising)
    # Kinds are compared once least squares on all the points have nothing left to gain.
    last = (best + 1) % room
    for part in (job.R, job.centre, job.half):
        part[found, last[found]] = part[found, best[found]]
    _improve(job, found * room + last[found], np.ones_like(job.every), CONVERGED, config)
    better = found[job.cost[found, last[found]] < job.cost[found, best[found]]]
    best[better] = last[better]
    best[~_within(job, best, config)] = -1
    found = np.flatnonzero(best >= 0)
    for_each(bare_one, len(found), job._replace(rows=found * room + best[found]))
    return best


def _improve(
    job: FitJob, rows: NDArray[np.intp], every: NDArray[np.intp], converged: float, config: FitConfig
) -> None:
    """Refine some of a job's shapes on every so many points of their objects (P,), and judge them by all."""
    groups, room = job.cost.shape
    each = groups // len(every) * room
    refined = RefineJob(
        rows,
        np.tile(np.repeat(job.kinds, room), len(every)),
        np.repeat(job.first[:-1], each),
        np.repeat(job.first[1:], each),
        np.repeat(every, each),
        job.points,
        RIDGE,
        config.steps,
        config.min_extent,
        config.shrink,
        ROBUST_WIDTH,
        NOISE_FLOOR,
        converged,
        job.R.reshape(-1, 3, 3),
        job.centre.reshape(-1, 3),
        job.half.reshape(-1, 3),
    )
    for_each(refine_one, len(rows), refined)
    for_each(judge_one, len(rows), job._replace(rows=rows))
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


def _least_free(found: Sequence[Fit], space: VoxelMap, config: FitConfig) -> Fit:
    """The fit of least cost (ascending) once it pays for what it fills of the space seen free."""
    inset = config.free_inset * space.config.size
    best, least = found[0], np.inf
    for f in found:
        if f.cost >= least:
            break
        cost = f.cost + config.free_weight * free_share(f.shape, space, inset)
        if cost < least:
            best, least = f, cost
    return best


def _job(
    kinds: NDArray[np.intp],
    first: NDArray[np.intp],
    points: Array,
    normals: Array,
    every: NDArray[np.intp],
    samples: NDArray[np.intp],
    config: FitConfig,
) -> FitJob:
    """Objects' points, and room for the shapes that are tried."""
    shapes = len(every) * len(kinds), config.polish + 1
    return FitJob(
        np.zeros(0, dtype=np.intp),
        kinds,
        first,
        points,
        normals,
        every,
        samples,
        **{name: getattr(config, name) for name in SETTINGS},
        R=np.empty((*shapes, 3, 3)),
        centre=np.empty((*shapes, 3)),
        half=np.empty((*shapes, 3)),
        seen=np.zeros((*shapes, 6), dtype=np.bool_),
        cost=np.full(shapes, np.inf),
        residual=np.empty(shapes),
        inliers=np.empty(shapes),
    )


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


def _failure_reason(count: int, config: FitConfig) -> str:
    if count < config.min_points:
        return f"{count} points are fewer than the {config.min_points} a shape needs"
    return f"every shape exceeds the longest extent of {config.max_extent:g} m"
