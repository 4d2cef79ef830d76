"""Fit a box, a cylinder or a sphere to the oriented points of each object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.frames import Array
from caryatid.interior import free_share
from caryatid.kernels.fits import Fitted, Job, fit_one
from caryatid.kernels.parallel import for_each
from caryatid.polish import Polish, polish
from caryatid.refine import CODES, CONVERGED, NOISE_FLOOR, RIDGE, ROBUST_WIDTH, ROUGHLY, from_arrays
from caryatid.shapes import Box, Cylinder, Sphere
from caryatid.uncertainty import Uncertainty
from caryatid.voxels import VoxelMap

Seen = tuple[bool, bool, bool, bool, bool, bool]


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """A shape and how well it explains the points.

    Attributes:
        shape: In the points' frame.
        residual: Mean absolute distance of the points to the surface, truncated at the threshold [m].
        inliers: Share of the points within the threshold.
        seen: Which sides (-x, +x, -y, +y, -z, +z of the object) points bear out.
        cost: What model choice compares [m].
        poor: No shape explains the points within the configured residual.
        uncertainty: How far off it may be; of the fit that was chosen only.
    """

    shape: Box | Cylinder | Sphere
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
        """Return some of the points."""
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
    for number, found in enumerate(candidates(objects, config=config, rngs=rngs)):
        if not found:
            results.append(FitFailure(_failure_reason(len(objects[number].finite()), config)))
            continue
        best = found[0] if space is None else _least_free(found, space, config)
        results.append(best)
        chosen.append(Polish(best.shape, best.seen, objects[number].finite().points))
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
    finite = [o.finite() for o in objects]
    large = [k for k, o in enumerate(finite) if len(o) >= config.min_points]
    found: list[list[Fit]] = [[] for _ in objects]
    if not large:
        return found
    kinds = np.array([CODES[kind] for kind in config.shapes])
    parts, every, samples = [], [], []
    for k in large:
        part, rng = finite[k], rngs[k]
        count = min(len(part), config.max_points)
        every.append(max(1, count // config.search_points))
        if every[-1] > 1 or count < len(part):
            # Shuffled: points come row by row, and every so many of a row would leave out whole columns.
            part = part.select(rng.choice(len(part), count, replace=False))
        parts.append(part)
        searched = -(-len(part) // every[-1])
        samples.append(rng.integers(0, searched, size=(len(kinds), config.hypotheses, 2)))
    origins = [part.points.mean(axis=0) for part in parts]
    rows = _empty(len(parts) * len(kinds))
    job = Job(
        kinds,
        np.cumsum([0, *(len(part) for part in parts)]),
        np.concatenate([part.points - origin for part, origin in zip(parts, origins, strict=True)]),
        np.concatenate([part.normals for part in parts]),
        np.array(every),
        np.stack(samples),
        RIDGE,
        **_settings(config),
        **rows._asdict(),
    )
    for_each(fit_one, len(rows.found), job)
    for number, (k, origin) in enumerate(zip(large, origins, strict=True)):
        own = range(number * len(kinds), (number + 1) * len(kinds))
        fits = [
            _row(rows, row, config.shapes[row - own[0]], origin, config) for row in own if rows.found[row]
        ]
        found[k] = sorted(fits, key=lambda f: f.cost)
    return found


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


def _empty(count: int) -> Fitted:
    """Rows to be written to."""
    return Fitted(
        np.zeros(count, dtype=np.bool_),
        np.empty((count, 3, 3)),
        np.empty((count, 3)),
        np.empty((count, 3)),
        np.zeros((count, 6), dtype=np.bool_),
        np.full(count, np.inf),
        np.empty(count),
        np.empty(count),
    )


def _row(rows: Fitted, row: int, kind: str, origin: Array, config: FitConfig) -> Fit:
    """One row as a fit, in the frame of an object whose points were taken about an origin (3,) [m]."""
    s = [bool(b) for b in rows.seen[row]]
    residual = float(rows.residual[row])
    return Fit(
        from_arrays(kind, rows.R[row], rows.centre[row] + origin, rows.half[row]),
        residual,
        float(rows.inliers[row]),
        (s[0], s[1], s[2], s[3], s[4], s[5]),
        float(rows.cost[row]),
        residual > config.max_residual,
    )


def _settings(config: FitConfig) -> dict[str, Any]:
    """Settings and constants by their names in the kernel's job."""
    names = (
        "threshold",
        "trim",
        "max_radius",
        "max_extent",
        "min_extent",
        "confidence",
        "polish",
        "steps",
        "shrink",
        "min_points",
        "side_share",
        "normal_weight",
        "size_penalty",
        "bare_weight",
        "bare_spacing",
    )
    constants = {
        "robust_width": ROBUST_WIDTH,
        "noise_floor": NOISE_FLOOR,
        "rough": ROUGHLY,
        "converged": CONVERGED,
    }
    return {name: getattr(config, name) for name in names} | constants


def _failure_reason(count: int, config: FitConfig) -> str:
    if count < config.min_points:
        return f"{count} points are fewer than the {config.min_points} a shape needs"
    return f"every shape exceeds the longest extent of {config.max_extent:g} m"
