"""The last word on fits: seen sides where their points lie, all others where the points beside them end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.fitting.hidden_face_kernels import Polished, PolishJob, polish_one
from caryatid.fitting.jobs import RefineJob, refine_one
from caryatid.fitting.least_squares import CONVERGED, NOISE_FLOOR, RIDGE, ROBUST_WIDTH
from caryatid.fitting.uncertainty import Uncertainty, estimate
from caryatid.geometry import BOX, CYLINDER
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array, rigid
from caryatid.runtime.parallel import for_each

Seen = tuple[bool, bool, bool, bool, bool, bool]


@dataclass(frozen=True, eq=False, slots=True)
class Polish:
    """A shape to be polished.

    Attributes:
        shape: As found by the search, in the points' frame.
        seen: Which sides points bear out.
        points: (N, 3) [m], all finite.
    """

    shape: Shape
    seen: Seen
    points: Array


@dataclass(frozen=True, eq=False, slots=True)
class Refined:
    """A polished shape.

    Attributes:
        shape: In the points' frame.
        residual: Mean absolute distance of the points to the surface, truncated at the threshold [m].
        inliers: Share of the points within the threshold.
        uncertainty: How far off it may be.
    """

    shape: Shape
    residual: float
    inliers: float
    uncertainty: Uncertainty


def polish(found: Sequence[Polish], config: FitConfig) -> list[Refined]:
    """Refine fitted shapes without the pulls that the search for them needs, and say how sure they are.

    The sides that points bear out are refined by least squares alone, the others out of the way: neither the
    pull on the extents nor points beyond a rim shift them. Then each unseen side is put where the points on
    the faces beside it end: at the likeliest end of an even density blurred by the fit's own noise, which
    neither a trimmed share nor the spread of the noise biases. A side without such points stays.

    Args:
        found: The shapes and their points.
        config: Limits and thresholds.
    """
    if not found:
        return []
    points = [_some(one.points, config.final_points) for one in found]
    origins = [p.mean(axis=0) for p in points]
    posed = Primitives.of([one.shape for one in found])
    count = len(found)
    kinds = posed.kinds
    first = np.cumsum([0, *(len(p) for p in points)])
    together = np.concatenate([p - origin for p, origin in zip(points, origins, strict=True)])
    rows = Polished(
        posed.R,
        posed.centres - np.stack(origins),
        posed.half,
        np.empty((count, 6)),
        np.empty(count),
        np.empty((count, 9, 9)),
        np.empty(count),
        np.empty(count),
    )
    seen = np.array([one.seen for one in found])
    R = rows.R.copy()
    centre, half = _opened(kinds, R, rows.centre, rows.half, seen, config.opening)
    refined = RefineJob(
        np.arange(count),
        kinds,
        first[:-1].copy(),
        first[1:].copy(),
        np.ones(count, dtype=np.intp),
        together,
        RIDGE,
        config.steps,
        config.min_extent,
        0.0,
        ROBUST_WIDTH,
        NOISE_FLOOR,
        CONVERGED,
        R,
        centre,
        half,
    )
    for_each(refine_one, count, refined)
    job = PolishJob(kinds, seen, first, together, R, centre, half, **_settings(config), **rows._asdict())
    for_each(polish_one, count, job)
    information = rows.information * np.diff(first)[:, None, None]
    uncertainties = estimate(kinds, seen, rows.hidden, information, rows.sigma, config)
    return [
        Refined(
            type(one.shape).from_extents(rigid(rows.R[k], rows.centre[k] + origins[k]), 2.0 * rows.half[k]),
            float(rows.residual[k]),
            float(rows.inliers[k]),
            uncertainties[k],
        )
        for k, one in enumerate(found)
    ]


def _opened(
    kinds: NDArray[np.intp], R: Array, centre: Array, half: Array, seen: NDArray[np.bool_], opening: float
) -> tuple[Array, Array]:
    """Centres (P, 3) and half extents (P, 3) once unseen sides are moved out of the way.

    A round side is seen as a whole; a sphere stays.
    """
    flat = (kinds == BOX)[:, None] | ((kinds == CYLINDER)[:, None] & (np.arange(3) == 2))
    low, high = (np.where(flat, opening * ~seen[:, side::2], 0.0) for side in range(2))
    unseen = (kinds == CYLINDER) & ~seen[:, :4].any(axis=1)
    grown = half + (low + high) / 2.0
    grown[unseen, :2] += opening
    return centre + np.einsum("pab,pb->pa", R, (high - low) / 2.0), grown


def _some(points: Array, count: int) -> Array:
    """Of points (N, 3) at most `count`, evenly chosen."""
    if len(points) <= count:
        return points
    return points[np.linspace(0, len(points) - 1, count).astype(np.intp)]


def _settings(config: FitConfig) -> dict[str, Any]:
    """Settings and constants by their names in the kernel's job."""
    names = (
        "threshold",
        "trim",
        "max_extent",
        "min_extent",
        "min_points",
        "face_width",
        "stray",
        "correlated",
        "rim",
    )
    constants = {"robust_width": ROBUST_WIDTH, "noise_floor": NOISE_FLOOR}
    return {name: getattr(config, name) for name in names} | constants
