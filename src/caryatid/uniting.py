"""One object taken for two: neighbours that one shape explains at a lower cost than two."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from caryatid.config import ExplanationConfig, FitConfig
from caryatid.explanation import (
    Evidence,
    Explanation,
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
    best: tuple[float, Pair] | None = None
    for a in sorted(evidence):
        for b in sorted(k for k in evidence if k > a):
            size = len(evidence[a].points) + len(evidence[b].points)
            if not {a, b} & changed or size < costs.growth * apart.get((a, b), 0):
                continue
            if not _near(evidence[a], evidence[b], costs.reach):
                continue
            rng = np.random.default_rng([seed, a, b])
            gain = _gain((evidence[a], evidence[b]), (alone[a], alone[b]), costs, fit_config, rng)
            if gain <= 0.0:
                apart[a, b] = size
            elif best is None or gain > best[0]:
                larger = len(evidence[a].points) >= len(evidence[b].points)
                best = gain, (a, b) if larger else (b, a)
    return None if best is None else best[1]


def _gain(
    evidence: tuple[Evidence, Evidence],
    alone: tuple[Explanation, Explanation],
    costs: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> float:
    """How much less [nats] one object costs than two; nothing where it leaves one of them unexplained.

    Two become one without a shape only where most of the border between them has no concave crease, so that
    one surface goes on: nearly all of it where both have shapes of their own.
    """
    both = joined(*evidence)
    second = np.arange(len(both.points)) >= len(evidence[0].points)
    border, smooth = border_cost(second, both, costs)
    two = alone[0].cost + alone[1].cost + border
    shapes = [e.shape for e in alone if e.shape is not None]
    for points, other in ((evidence[1].points, alone[0].shape), (evidence[0].points, alone[1].shape)):
        if other is not None and lies_on(other, points, costs):
            return two
    found = [explained_by(shape, both, costs) for shape in shapes]
    for config in (first_look(fit_config, costs), replace(fit_config, polish=1)):
        one = min([*found, explain(both, costs, config, rng)], key=lambda e: e.cost)
        if one.cost > two + price(None, costs):
            return 0.0
        found.append(one)
    if one.shape is None:
        least = costs.smooth_border if len(shapes) == len(alone) else 0.5
        return two - one.cost if smooth > least else 0.0
    cost = point_costs(one.shape, both, costs)
    if max(cost[second].mean(), cost[~second].mean()) > costs.irregular:
        return 0.0
    return two - one.cost


def _near(a: Evidence, b: Evidence, reach: float) -> bool:
    """Whether some points of two objects lie within reach [m] of each other."""
    low_a, high_a, low_b, high_b = (f(e.points, axis=0) for e in (a, b) for f in (np.min, np.max))
    if ((low_a > high_b + reach) | (low_b > high_a + reach)).any():
        return False
    distance, _ = cKDTree(a.points).query(b.points, distance_upper_bound=reach)
    return bool(np.isfinite(distance).any())
