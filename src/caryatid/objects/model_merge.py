"""One object taken for two: neighbours that one shape explains at a lower cost than two."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from caryatid.config import ExplanationConfig, FitConfig
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.objects.description_length import (
    Evidence,
    Explanation,
    around,
    border_cost,
    explain,
    explained_by,
    first_look,
    joined,
    lies_on,
    point_costs,
    price,
)

Pair = tuple[int, int]


def united(
    evidence: Mapping[int, Evidence],
    alone: Mapping[int, Explanation],
    changed: set[int],
    apart: MutableMapping[Pair, int],
    *,
    costs: ExplanationConfig,
    fit_config: FitConfig,
    seed: int,
) -> Pair | None:
    """Find the pair of neighbours that it is best to take for one.

    Args:
        evidence: Points of each object, by label.
        alone: Its explanation as an object of its own.
        changed: Only pairs with one of these are looked at.
        apart: Pairs found to be two, with the number of points they had then; they are looked at again when
            they have grown. Added to.
        costs: What explanations cost.
        fit_config: Settings of the fits.
        seed: Seed of the fits.

    Returns:
        The larger object and the one it takes in, or None where all are better apart.
    """
    bounds = {k: (e.points.min(axis=0), e.points.max(axis=0)) for k, e in evidence.items()}
    pairs = [
        (a, b)
        for a, b in combinations(sorted(evidence), 2)
        if {a, b} & changed
        and _size(evidence, (a, b)) >= costs.growth * apart.get((a, b), 0)
        and _near(evidence[a].points, evidence[b].points, bounds[a], bounds[b], costs.reach)
    ]
    rngs = [np.random.default_rng([seed, a, b]) for a, b in pairs]
    gains = _gains([_Two.of(pair, evidence, alone, costs) for pair in pairs], costs, fit_config, rngs)
    best: tuple[float, Pair] | None = None
    for (a, b), gain in zip(pairs, gains, strict=True):
        if gain <= 0.0:
            apart[a, b] = _size(evidence, (a, b))
        elif best is None or gain > best[0]:
            larger = len(evidence[a].points) >= len(evidence[b].points)
            best = gain, (a, b) if larger else (b, a)
    return None if best is None else best[1]


@dataclass(frozen=True, eq=False, slots=True)
class _Two:
    """Two neighbours that may be one object.

    Attributes:
        both: Points of both, those of the first one first.
        second: Which points (N,) are the second's.
        shapes: Those of the two that have one.
        smooth: Share of the border between them without a concave crease [1].
        cost: Of the two as two objects [nats].
        one_lies_on_the_other: Most points of the one may be of the other's surface.
    """

    both: Evidence
    second: NDArray[np.bool_]
    shapes: list[Shape]
    smooth: float
    cost: float
    one_lies_on_the_other: bool

    @classmethod
    def of(
        cls,
        pair: Pair,
        evidence: Mapping[int, Evidence],
        alone: Mapping[int, Explanation],
        costs: ExplanationConfig,
    ) -> _Two:
        first, other = (evidence[k] for k in pair)
        both = joined(first, other)
        second = np.arange(len(both.points)) >= len(first.points)
        border, smooth = border_cost(second, both, around(both.points, costs.neighbours), costs)
        shapes = [alone[k].shape for k in pair]
        on = zip(shapes, (other, first), strict=True)
        return cls(
            both,
            second,
            [s for s in shapes if s is not None],
            smooth,
            alone[pair[0]].cost + alone[pair[1]].cost + border,
            any(s is not None and lies_on(s, e.points, costs) for s, e in on),
        )


def _gains(
    pairs: Sequence[_Two],
    costs: ExplanationConfig,
    fit_config: FitConfig,
    rngs: Sequence[np.random.Generator],
) -> list[float]:
    """How much less [nats] one object costs than two; nothing where it leaves one of them unexplained.

    Two become one without a shape only where most of the border between them has no concave crease, so that
    one surface goes on: nearly all of it where both have shapes of their own.
    """
    found = [[explained_by(shape, two.both, costs) for shape in two.shapes] for two in pairs]
    open_ = [k for k, two in enumerate(pairs) if not two.one_lies_on_the_other]
    for config in (
        first_look(fit_config, costs),
        replace(fit_config, polish=1, search_points=fit_config.max_points),
    ):
        ones = explain([pairs[k].both for k in open_], costs, config, [rngs[k] for k in open_])
        for k, one in zip(open_, ones, strict=True):
            found[k].append(one)
        open_ = [k for k in open_ if min(e.cost for e in found[k]) <= pairs[k].cost + price(None, costs)]
    gains = [two.cost if two.one_lies_on_the_other else 0.0 for two in pairs]
    for k in open_:
        gains[k] = _gain(pairs[k], min(found[k], key=lambda e: e.cost), costs)
    return gains


def _gain(two: _Two, one: Explanation, costs: ExplanationConfig) -> float:
    """How much less one object with the best explanation costs."""
    if one.shape is None:
        least = costs.smooth_border if len(two.shapes) == 2 else 0.5
        return two.cost - one.cost if two.smooth > least else 0.0
    cost = point_costs(one.shape, two.both, costs)
    if max(cost[two.second].mean(), cost[~two.second].mean()) > costs.irregular:
        return 0.0
    return two.cost - one.cost


def _size(evidence: Mapping[int, Evidence], pair: Pair) -> int:
    return len(evidence[pair[0]].points) + len(evidence[pair[1]].points)


def _near(
    a: Array, b: Array, bounds_a: tuple[Array, Array], bounds_b: tuple[Array, Array], reach: float
) -> bool:
    """Whether some of two objects' points (N, 3), with their least and greatest, lie within reach [m]."""
    if not ((bounds_a[0] <= bounds_b[1] + reach) & (bounds_b[0] <= bounds_a[1] + reach)).all():
        return False
    mine = _within(a, bounds_b[0] - reach, bounds_b[1] + reach)
    theirs = _within(b, bounds_a[0] - reach, bounds_a[1] + reach)
    if len(mine) == 0 or len(theirs) == 0:
        return False
    return bool(cdist(mine, theirs, "sqeuclidean").min() <= reach**2)


def _within(points: Array, low: Array, high: Array) -> Array:
    """Those of the points (N, 3) that lie between two corners (3,)."""
    return points[((points >= low) & (points <= high)).all(axis=1)]
