"""Description length: the cost of explaining points by shapes, in nats. The lowest cost decides."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from caryatid.config import Config, ExplanationConfig, FitConfig
from caryatid.fitting.primitives import as_shape, count_free, fit_each
from caryatid.geometry import BOX
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.transforms import Array
from caryatid.objects.compounds import (
    Compound,
    count_free_in_slab,
    open_boxes,
    point_costs_on,
    revolutions,
    shape_costs,
)
from caryatid.runtime.parallel import kernel
from caryatid.segmentation.segments import PLAIN, colour_shares
from caryatid.sensing.voxel_map import VoxelMap

NOTHING_SEEN = np.zeros((0, 0, 0), dtype=np.int8), np.zeros(3), 1.0
"""Space of which nothing is known."""


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """Oriented points of the objects to explain, and the known space around them.

    Attributes:
        points: (N, 3) [m], thinned: a place counts once, because all points there share their errors.
        normals: Unit normals (N, 3).
        weight: Independent readings each point stands for [1].
        noise: Standard deviation of the points from their surfaces [m].
        voxels: Space seen free, or None if unknown.
        rgb: Colours (N, 3), or None.
        segments: Segment (V, N) on which each of V views shows them, 0 = none; or None.
    """

    points: Array
    normals: Array
    weight: float
    noise: float
    voxels: VoxelMap | None
    rgb: NDArray[np.uint8] | None = None
    segments: NDArray[np.int32] | None = None

    def __len__(self) -> int:
        return len(self.points)

    def select(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> Evidence:
        """Return the evidence of some of the points, by a mask (N,) or indices (M,)."""
        rgb = None if self.rgb is None else self.rgb[kept]
        segments = None if self.segments is None else self.segments[:, kept]
        return replace(self, points=self.points[kept], normals=self.normals[kept], rgb=rgb, segments=segments)

    def joined(self, other: Evidence) -> Evidence:
        """Return the evidence of two objects together, without segments; noise and space are the same."""
        points = np.concatenate([self.points, other.points])
        normals = np.concatenate([self.normals, other.normals])
        known = self.rgb is not None and other.rgb is not None
        rgb = np.concatenate([self.rgb, other.rgb]) if known else None
        return replace(self, points=points, normals=normals, rgb=rgb, segments=None)

    def shown(self, least: int) -> list[NDArray[np.bool_]]:
        """Points (N,) that a view shows as a segment of its own, beside others."""
        return [
            own == label
            for own in (() if self.segments is None else self.segments)
            for label in np.unique(own[own > 0])
            if least <= np.count_nonzero(own == label) < 0.9 * np.count_nonzero(own)
        ]


@dataclass(frozen=True, eq=False, slots=True)
class Explanation:
    """The best shape for some points.

    Attributes:
        shape: The shape or compound, or None if the points cost less as an irregular object.
        cost: Cost of all the points and of the object itself [nats].
    """

    shape: Shape | Compound | None
    cost: float


def price(shape: Shape | Compound | None, config: ExplanationConfig) -> float:
    """Price [nats] of an object: that of its shape's parameters; an irregular one has as many as a box."""
    return config.parameter_cost * (Box if shape is None else shape).parameters


def point_costs(shape: Shape | Compound | None, evidence: Evidence, config: ExplanationConfig) -> Array:
    """Cost (N,) [nats] of each point on a shape, or on an irregular object, before its weight."""
    if shape is None:
        return np.full(len(evidence), config.irregular)
    seen = evidence.points, evidence.normals, evidence.noise, config
    return shape_costs(shape, *seen) if isinstance(shape, Shape) else shape.costs(*seen)


def explained(explanation: Explanation, evidence: Evidence, config: ExplanationConfig) -> bool:
    """Whether a shape explains points about as well as true shapes do, with no free space inside it."""
    own = explanation.cost - price(explanation.shape, config)
    return explanation.shape is not None and own <= config.usual * evidence.weight * len(evidence)


def colour_evidence(first: Evidence, second: Evidence, config: ExplanationConfig) -> float:
    """Evidence [nats] of colours for two objects, or, if negative, for one; none from two prints."""
    if first.rgb is None or second.rgb is None:
        return 0.0
    sides = first.rgb, second.rgb, np.concatenate([first.rgb, second.rgb])
    alone, other, both = (plain_colour(rgb, config)[0] for rgb in sides)
    return both - alone - other


def unity(evidence: Evidence, second: NDArray[np.bool_], config: ExplanationConfig) -> float:
    """Evidence [nats] of views that points, and a second side (N,) of them, are one object; 0 if not.

    Each point of the side with fewer in a view speaks, by the share of the other side's on its segment.
    """
    points = 0.0
    for own in () if evidence.segments is None else evidence.segments:
        one, other = own[second & (own > 0)], own[~second & (own > 0)]
        if len(one) and len(other):
            counts = [np.bincount(side, minlength=int(own.max()) + 1) for side in (one, other)]
            same = float(counts[0] @ counts[1]) / (len(one) * len(other))
            points += (2.0 * same - 1.0) * min(len(one), len(other))
    return config.sighted * evidence.weight * max(points, 0.0)


def plain_colour(rgb: NDArray[np.uint8], config: ExplanationConfig) -> tuple[float, Array | None]:
    """Cost [nats] of colours (N, 3), and the shares (3,) of the main plain colour; None for a print.

    A plain colour has two parameters: the shares add up to 1.
    """
    # Enough of them to include one of the most frequent colour.
    tried = rgb[:: max(1, len(rgb) // 64)]
    costs = colour_costs(rgb, colour_shares(tried), config).sum(axis=0) + 2.0 * config.parameter_cost
    best, printed = int(costs.argmin()), config.irregular * len(rgb)
    return (float(costs[best]), colour_shares(tried[best])) if costs[best] < printed else (printed, None)


def side_colours(
    rgb: NDArray[np.uint8], sides: Sequence[NDArray[np.uint8]], config: ExplanationConfig
) -> Array:
    """Cost (M, N) [nats] of colours (N, 3) on each of M things that have these colours."""
    plain = (plain_colour(side, config)[1] for side in sides)
    return np.stack(
        [
            np.full(len(rgb), config.irregular) if own is None else colour_costs(rgb, own[None], config)[:, 0]
            for own in plain
        ]
    )


def colour_costs(rgb: NDArray[np.uint8], plain: Array, config: ExplanationConfig) -> Array:
    """Cost (N, M) [nats] of colours (N, 3) on objects of plain colours with shares (M, 3)."""
    squares = cdist(colour_shares(rgb)[:, :2], plain[:, :2], "sqeuclidean") / (2.0 * PLAIN**2)
    return np.minimum(squares, config.outlier)


def best_explanation(
    shapes: Iterable[Shape | Compound],
    evidence: Evidence,
    config: ExplanationConfig,
    below: float | None = None,
) -> Explanation:
    """Explain points by the cheapest of some shapes, if it costs less than `below` [nats].

    Without a limit, it has to cost less than an irregular object.
    """
    best = Explanation(None, _cost(None, evidence, config) if below is None else below)
    for shape in shapes:
        cost = _cost(shape, evidence, config, best.cost)
        if cost < best.cost:
            best = Explanation(shape, cost)
    return best


def best_compound(evidence: Evidence, config: Config, below: float) -> Explanation:
    """Explain points by the cheapest compound, if any costs less than `below` [nats]."""
    if len(evidence) < 2 * config.fit.min_points:
        return Explanation(None, below)
    seen, costs = (evidence.points, evidence.normals), config.explanation
    bodies = revolutions(*seen, evidence.noise, evidence.weight, costs)
    return best_explanation(chain(bodies, open_boxes(*seen, config.fit.min_extent)), evidence, costs, below)


def _cost(
    shape: Shape | Compound | None, evidence: Evidence, config: ExplanationConfig, below: float = np.inf
) -> float:
    """Cost [nats] of points as one object: that of the points, of the free space inside it, and its price.

    Space is not checked if the cost without it already exceeds a limit [nats].
    """
    cost = float(point_costs(shape, evidence, config).sum()) * evidence.weight + price(shape, config)
    return cost if cost >= below else cost + free_cost(shape, evidence, config)


def free_cost(shape: Shape | Compound | None, evidence: Evidence, config: ExplanationConfig) -> float:
    """Cost [nats] of the space seen free inside a shape."""
    if shape is None or evidence.voxels is None:
        return 0.0
    if not isinstance(shape, Shape):
        return config.free_cost * shape.free(evidence.voxels)
    return config.free_cost * _count_free(*shape.row, evidence.noise, *evidence.voxels.space)


@kernel
def _count_free(kind, R, centre, half, noise, states, origin, size):  # type: ignore[no-untyped-def]
    """Number of voxels seen free well inside a shape."""
    # A surface voxel may be half free.
    inset = max(1.2 * size, 3.0 * noise)
    if kind == BOX and min(half[0], half[1], half[2]) <= inset:
        return count_free_in_slab(R, centre, half, states, origin, size)
    return count_free(kind, R, centre, half - inset, states, origin, size)[1]


@kernel
def _cheapest(  # type: ignore[no-untyped-def]
    kinds, rows, prices, points, normals, noise, weight, normal_weight, outlier, free_weight, below, states,
    origin, size,
):  # fmt: skip
    """Find the cheapest of some shapes (K, 5, 3) below a limit [nats], as `best_explanation` does.

    Returns:
        Its number, or −1, and its cost [nats].
    """
    best = -1
    for k in range(len(kinds)):
        R, centre, half = rows[k, :3], rows[k, 3], rows[k, 4]
        points_cost = point_costs_on(
            kinds[k], R, centre, half, points, normals, noise, normal_weight, outlier
        )
        cost = points_cost.sum() * weight + prices[k]
        if cost < below:
            cost += free_weight * _count_free(kinds[k], R, centre, half, noise, states, origin, size)
        if cost < below:
            best, below = k, cost
    return best, below


def explain(
    evidence: Evidence,
    config: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
    *,
    first_look: bool = False,
) -> Explanation:
    """Find the shape that explains points at the lowest cost.

    Args:
        evidence: The points.
        config: The costs of explanations.
        fit_config: Settings of the fits.
        rng: Source of the samples.
        first_look: Make a quick fit, which only tells what is worth a full one.
    """
    settings = _quick(fit_config) if first_look else _thorough(fit_config)
    kinds, rows, *_ = fit_each(evidence.points, evidence.normals, settings, rng)
    best, cost = _cheapest(
        np.array([kind.code for kind in kinds], dtype=np.intp), rows,
        config.parameter_cost * np.array([float(kind.parameters) for kind in kinds]),
        np.ascontiguousarray(evidence.points), np.ascontiguousarray(evidence.normals), evidence.noise,
        evidence.weight, config.normal_weight, config.outlier, config.free_cost,
        _cost(None, evidence, config), *(NOTHING_SEEN if evidence.voxels is None else evidence.voxels.space),
    )  # fmt: skip
    return Explanation(as_shape(kinds[best], rows[best]) if best >= 0 else None, cost)


@cache
def _quick(config: FitConfig) -> FitConfig:
    """Settings of a first look."""
    return replace(config, polish=1, hypotheses=10, steps=6, max_points=150)


@cache
def _thorough(config: FitConfig) -> FitConfig:
    """Settings of a full fit."""
    return replace(config, polish=1, search_points=config.max_points)
