"""Two objects taken for one: parts of the points that shapes of their own explain at a lower cost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caryatid.config import ExplanationConfig, FitConfig, SplitConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import KINDS
from caryatid.geometry.transforms import Array
from caryatid.objects.description_length import (
    Evidence,
    Explanation,
    around,
    border_cost,
    explain,
    first_look,
    lies_on,
    point_costs,
    price,
)

Groups = NDArray[np.intp]
Hints = Callable[[], Sequence[NDArray[np.bool_]]]


@dataclass(frozen=True, eq=False, slots=True)
class Pair:
    """Points taken for two objects.

    Attributes:
        second: Which points (N,) are the second's.
        explanations: Of both.
        cost: Of both and of the border between them [nats].
    """

    second: NDArray[np.bool_]
    explanations: tuple[Explanation, Explanation]
    cost: float


def split(
    evidence: Evidence,
    whole: Explanation,
    hints: Hints = list,
    *,
    up: Array,
    config: SplitConfig,
    costs: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> Groups | None:
    """Part points that several shapes explain at a lower cost than one.

    Tried are the patches that the single shape does not explain, given hints, and cuts across the vertical,
    where one object lies on another, and across the two horizontal directions of the points' faces, where
    they stand side by side. From each such start the points go to the shape that explains them better, and
    the shapes are fitted anew.

    Args:
        evidence: The points of what is taken for one object.
        whole: Its best single explanation.
        hints: Gives points (N,) that may be an object of their own; asked only where something is tried.
        up: Unit vector (3,) upwards.
        config: What is tried.
        costs: What explanations cost.
        fit_config: Settings of the fits.
        rng: Source of the samples.

    Returns:
        Group of each point (N,), from 0, or None where one object is the better explanation.
    """
    all_hints = cache(hints)
    groups = np.zeros(len(evidence.points), dtype=np.intp)
    waiting = [(np.arange(len(groups)), whole)]
    while waiting:
        index, single = waiting.pop()
        part = evidence.select(index)

        def own_hints(index: Groups = index) -> list[NDArray[np.bool_]]:
            return [h[index] for h in all_hints()]

        found = _best_pair(part, single, own_hints, up, config, costs, fit_config, rng)
        if found is None:
            continue
        groups[index[found.second]] = groups.max() + 1
        sides = (index[~found.second], index[found.second])
        waiting += zip(sides, found.explanations, strict=True)
    return groups if groups.any() else None


def unexplained(
    evidence: Evidence, whole: Explanation, near: NDArray[np.intp], costs: ExplanationConfig
) -> Array:
    """Mean cost (N,) [nats] of the points around each point (`near`), under the single explanation.

    Args:
        evidence: N points of what may be several objects.
        whole: The single explanation.
        near: Indices (N, K) of the points around each.
        costs: Prices.
    """
    return np.asarray(_costs(whole, evidence, costs)[near].mean(axis=1))


def _costs(explanation: Explanation, evidence: Evidence, costs: ExplanationConfig) -> Array:
    """Cost (N,) [nats] of each point under an explanation, before its weight."""
    if explanation.shape is None:
        return np.full(len(evidence.points), costs.irregular)
    return point_costs(explanation.shape, evidence, costs)


def _best_pair(
    evidence: Evidence,
    whole: Explanation,
    hints: Hints,
    up: Array,
    config: SplitConfig,
    costs: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> Pair | None:
    """How the points are best taken for two objects; None where one is better."""
    least = config.min_points * costs.spacing**2 / costs.reading
    if evidence.weights.sum() < 2.0 * least:
        return None
    near = around(evidence.points, costs.neighbours)
    bad = unexplained(evidence, whole, near, costs)
    excess = float(np.maximum(bad - costs.usual, 0.0) @ evidence.weights)
    free = whole.cost - price(whole.shape, costs) - float(_costs(whole, evidence, costs) @ evidence.weights)
    if excess + free < costs.parameter_cost * min(kind.parameters for kind in KINDS.values()):
        return None
    starts = list(_starts(evidence, bad, hints(), up, config, costs))
    quick = first_look(fit_config, costs)
    looks = _settled(evidence, starts, near, 0, config, costs, quick, rng)
    tried = sorted((look.cost, k) for k, look in enumerate(looks) if look is not None)[: config.finalists]
    finalists = [starts[k] for _, k in tried]
    full = replace(fit_config, polish=1, search_points=fit_config.max_points)
    best, least_cost = None, whole.cost
    for pair in _settled(evidence, finalists, near, config.rounds, config, costs, full, rng):
        if pair is None or pair.cost >= least_cost or _is_layer(evidence, pair, costs):
            continue
        best, least_cost = pair, pair.cost
    return best


def _is_layer(evidence: Evidence, pair: Pair, costs: ExplanationConfig) -> bool:
    """Whether one side is but a layer of points on the other's surface, as a view that is off leaves them."""
    return any(
        lies_on(other.shape, evidence.points[side], costs)
        for side, other in ((pair.second, pair.explanations[0]), (~pair.second, pair.explanations[1]))
        if other.shape is not None
    )


def _settled(
    evidence: Evidence,
    starts: Sequence[NDArray[np.bool_]],
    near: NDArray[np.intp],
    rounds: int,
    config: SplitConfig,
    costs: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> list[Pair | None]:
    """Fit both sides of each start, give each point to the side that explains it better, and so on.

    Returns:
        What each start settles at; None where one side is left with too few points.
    """
    least = config.min_points * costs.spacing**2 / costs.reading
    settled: list[Pair | None] = [None] * len(starts)
    moving = dict(enumerate(starts))
    for number in range(rounds + 1):
        moving = {
            k: second
            for k, second in moving.items()
            if min(float(evidence.weights[s].sum()) for s in (~second, second)) >= least
        }
        sides = [evidence.select(s) for second in moving.values() for s in (~second, second)]
        found = explain(sides, costs, fit_config, rng.spawn(len(sides)))
        pairs = zip(found[0::2], found[1::2], strict=True)
        for (k, second), pair in zip(list(moving.items()), pairs, strict=True):
            moved = second
            if number < rounds:
                cost = np.stack([_costs(e, evidence, costs) for e in pair])
                cost = (cost + cost[:, near].mean(axis=2)) / 2.0
                moved = _connected(evidence.points, cost[1] < cost[0], config)
            if (moved == second).all():
                border, _ = border_cost(second, evidence, near, costs)
                settled[k] = Pair(second, pair, pair[0].cost + pair[1].cost + border)
                del moving[k]
            else:
                moving[k] = moved
    return settled


def _starts(
    evidence: Evidence,
    bad: Array,
    hints: Sequence[NDArray[np.bool_]],
    up: Array,
    config: SplitConfig,
    costs: ExplanationConfig,
) -> Iterator[NDArray[np.bool_]]:
    """Points (N,) that may be an object of their own."""
    yield from (h for h in hints if h.any() and not h.all())
    poor = bad > costs.irregular
    if poor.any():
        part = _components(evidence.points[poor], config.reach)
        sizes = np.bincount(part)
        for number in np.argsort(-sizes)[: config.patches]:
            start = np.zeros(len(bad), dtype=bool)
            start[np.flatnonzero(poor)[part == number]] = True
            yield start
    shares = np.linspace(0.0, 1.0, config.cuts + 2)[1:-1]
    for direction in _directions(evidence.normals, up):
        height = evidence.points @ direction
        for level in np.quantile(height, shares):
            yield height > level


def _directions(normals: Array, up: Array) -> list[Array]:
    """Up, and the two horizontal directions most faces look along."""
    level = normals - np.outer(normals @ up, up)
    length = np.linalg.norm(level, axis=1)
    upright = level[length > 0.5] / length[length > 0.5, None]
    if len(upright) == 0:
        return [up]
    x, y = transforms.perpendicular(up), np.cross(up, transforms.perpendicular(up))
    angle = np.angle(np.mean(((upright @ x) + 1j * (upright @ y)) ** 4)) / 4.0
    main = np.cos(angle) * x + np.sin(angle) * y
    return [up, main, np.cross(up, main)]


def _components(points: Array, reach: float) -> Groups:
    """Connected part (N,) of each point, from 0."""
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


def _connected(points: Array, second: NDArray[np.bool_], config: SplitConfig) -> NDArray[np.bool_]:
    """Keep the largest connected part of the second side, and of the first all that is no crumb."""
    result = second.copy()
    index = np.flatnonzero(second)
    if len(index):
        part = _components(points[index], config.reach)
        result[index[part != np.argmax(np.bincount(part))]] = False
    index = np.flatnonzero(~result)
    if len(index):
        part = _components(points[index], config.reach)
        sizes = np.bincount(part)
        result[index[(sizes < min(config.crumb, sizes.max()))[part]]] = True
    return result
