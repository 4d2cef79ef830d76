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
from caryatid.fitting.primitives import as_shape, best_of_each, count_free
from caryatid.geometry import BOX
from caryatid.geometry.shapes import KINDS, Box, Shape
from caryatid.geometry.signed_distance import copy
from caryatid.geometry.transforms import Array
from caryatid.objects.compounds import (
    Compound,
    count_free_in_slab,
    open_boxes,
    point_costs_on,
    revolutions,
    shape_costs,
)
from caryatid.runtime.parallel import SHARES, for_each, kernel
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


def unity(evidence: Evidence, seconds: NDArray[np.bool_], config: ExplanationConfig) -> Array:
    """Evidence (S,) [nats] of views that each of some second sides (S, N) and the rest are one object.

    Each point of the side with fewer in a view speaks, by the share of the other side's on its segment.
    """
    points = np.zeros(len(seconds))
    for own in () if evidence.segments is None else evidence.segments:
        segments, index = np.unique(own, return_inverse=True)
        on_segment = (index[:, None] == np.flatnonzero(segments)).astype(np.float64)
        of_second = seconds @ on_segment
        of_first = on_segment.sum(axis=0) - of_second
        fewer = np.minimum(of_second.sum(axis=1), of_first.sum(axis=1))
        both = np.maximum(of_second.sum(axis=1) * of_first.sum(axis=1), 1.0)
        points += (2.0 * (of_first * of_second).sum(axis=1) / both - 1.0) * fewer
    return config.sighted * evidence.weight * np.maximum(points, 0.0)


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


def explain(
    evidence: Evidence,
    config: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
    *,
    first_look: bool = False,
) -> Explanation:
    """Find the shape that explains points at the lowest cost; see `explain_sides`."""
    whole = np.ones((1, len(evidence)), dtype=np.bool_)
    return explain_sides(evidence, whole, config, fit_config, rng, first_look=first_look)[0]


def explain_sides(
    evidence: Evidence,
    sides: NDArray[np.bool_],
    config: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
    *,
    first_look: bool = False,
) -> list[Explanation]:
    """Find the shape that explains each of some sides of points at the lowest cost.

    Args:
        evidence: The points.
        sides: Which points each side has (S, N).
        config: The costs of explanations.
        fit_config: Settings of the fits.
        rng: Source of the samples.
        first_look: Make quick fits, which only tell what is worth a full one.

    Returns:
        An explanation for each side, in order.
    """
    settings = _quick(fit_config) if first_look else _thorough(fit_config)
    kinds = [KINDS[kind] for kind in settings.shapes]
    best, shapes, costs = np.empty(len(sides), np.intp), np.empty((len(sides), 5, 3)), np.empty(len(sides))
    data = (
        np.ascontiguousarray(evidence.points), np.ascontiguousarray(evidence.normals), sides,
        rng.permutation(len(evidence)), rng.random((len(sides), len(kinds), settings.hypotheses, 2)),
        np.array([kind.code for kind in kinds]),
        np.array([float(config.parameter_cost * kind.parameters) for kind in kinds]),
        settings.polish, settings.steps, settings.max_points, settings.threshold, settings.max_radius,
        settings.max_extent, settings.min_extent, settings.normal_weight, settings.min_points,
        evidence.noise, evidence.weight, config.normal_weight, config.outlier, config.irregular,
        price(None, config), config.free_cost,
        *(NOTHING_SEEN if evidence.voxels is None else evidence.voxels.space), best, shapes, costs,
    )  # fmt: skip
    for_each(_explain_sides, min(SHARES, len(sides)), data)
    return [
        Explanation(as_shape(kinds[k], row) if k >= 0 else None, cost)
        for k, row, cost in zip(best.tolist(), shapes, costs.tolist(), strict=True)
    ]


@kernel
def _explain_sides(share, data):  # type: ignore[no-untyped-def]
    """Write the cheapest shape of each side in a share: its kind, or −1 for none, its numbers, its cost."""
    (
        points, normals, sides, order, draws, kinds, prices, polish, steps, max_points, threshold, max_radius,
        max_extent, min_extent, fit_normals, min_points, noise, weight, normal_weight, outlier, irregular,
        irregular_price, free_cost, states, origin, size, best, found, costs,
    ) = data  # fmt: skip
    for side in range(share, len(sides), SHARES):
        count = sides[side].sum()
        own, facing = np.empty((count, 3)), np.empty((count, 3))
        used, n = min(count, max_points), 0
        some, some_normals, middle = np.empty((used, 3)), np.empty((used, 3)), np.zeros(3)
        for i in order:
            if sides[side, i]:
                for a in range(3):
                    own[n, a], facing[n, a] = points[i, a], normals[i, a]
                    if n < used:
                        some[n, a], some_normals[n, a] = points[i, a], normals[i, a]
                        middle[a] += points[i, a] / used
                n += 1
        best[side], costs[side] = -1, irregular * count * weight + irregular_price
        if count < min_points:
            continue
        for i in range(used):
            for a in range(3):
                some[i, a] -= middle[a]
        samples = np.empty(draws.shape[1:], np.intp)
        for k in range(len(kinds)):
            for i in range(draws.shape[2]):
                for j in range(2):
                    samples[k, i, j] = int(draws[side, k, i, j] * used)
        shapes = np.empty((len(kinds), polish + 2, 5, 3))
        score = np.full((len(kinds), polish + 2, 3), np.inf)
        seen = np.empty((len(kinds), polish + 2, 6), np.bool_)
        rows = best_of_each(
            kinds, some, some_normals, some, some_normals, samples, steps, threshold, max_radius, max_extent,
            min_extent, fit_normals, min_points, shapes, score, seen,
        )  # fmt: skip
        for k in range(len(kinds)):
            if rows[k] < 0:
                continue
            shape = shapes[k, rows[k]]
            R, centre, half = shape[:3], shape[3], shape[4]
            for a in range(3):
                centre[a] += middle[a]
            own_costs = point_costs_on(kinds[k], R, centre, half, own, facing, noise, normal_weight, outlier)
            cost = own_costs.sum() * weight + prices[k]
            if cost < costs[side]:  # space is not looked up in vain
                cost += free_cost * _count_free(kinds[k], R, centre, half, noise, states, origin, size)
            if cost < costs[side]:
                best[side], costs[side] = k, cost
                copy(shape, found[side])


@cache
def _quick(config: FitConfig) -> FitConfig:
    """Settings of a first look."""
    return replace(config, polish=1, hypotheses=10, steps=6, max_points=150)


@cache
def _thorough(config: FitConfig) -> FitConfig:
    """Settings of a full fit."""
    return replace(config, polish=1)
