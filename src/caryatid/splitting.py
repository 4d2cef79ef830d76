"""Two objects taken for one: parts of the points that shapes of their own explain at a lower cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caryatid import frames
from caryatid.config import ExplanationConfig, FitConfig, SplitConfig
from caryatid.explanation import (
    PARAMETERS,
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
from caryatid.frames import Array

Groups = NDArray[np.intp]


def split(
    evidence: Evidence,
    whole: Explanation,
    hints: Sequence[NDArray[np.bool_]] = (),
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
        hints: Points (N,) that may be an object of their own.
        up: Unit vector (3,) upwards.
        config: What is tried.
        costs: What explanations cost.
        fit_config: Settings of the fits.
        rng: Source of the samples.

    Returns:
        Group of each point (N,), from 0, or None where one object is the better explanation.
    """
    groups = np.zeros(len(evidence.points), dtype=np.intp)
    waiting = [(np.arange(len(groups)), whole)]
    while waiting:
        index, single = waiting.pop()
        part = evidence.select(index)
        kept = [h[index] for h in hints]
        found = _best_pair(part, single, kept, up, config, costs, fit_config, rng)
        if found is None:
            continue
        second, explanations = found
        groups[index[second]] = groups.max() + 1
        waiting += [(index[~second], explanations[0]), (index[second], explanations[1])]
    return groups if groups.any() else None


def unexplained(evidence: Evidence, whole: Explanation, costs: ExplanationConfig) -> Array:
    """Mean cost (N,) [nats] of the points around each point, under the single explanation."""
    return np.asarray(around(evidence.points, costs.neighbours) @ _costs(whole, evidence, costs))


def _costs(explanation: Explanation, evidence: Evidence, costs: ExplanationConfig) -> Array:
    """Cost (N,) [nats] of each point under an explanation, before its weight."""
    if explanation.shape is None:
        return np.full(len(evidence.points), costs.irregular)
    return point_costs(explanation.shape, evidence, costs)


def _best_pair(
    evidence: Evidence,
    whole: Explanation,
    hints: Sequence[NDArray[np.bool_]],
    up: Array,
    config: SplitConfig,
    costs: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> tuple[NDArray[np.bool_], tuple[Explanation, Explanation]] | None:
    """Which points are the second of two objects, and both explanations; None where one is better."""
    least = config.min_points * costs.spacing**2 / costs.reading
    if evidence.weights.sum() < 2.0 * least:
        return None
    near = around(evidence.points, costs.neighbours)
    bad = unexplained(evidence, whole, costs)
    excess = float(np.maximum(bad - costs.usual, 0.0) @ evidence.weights)
    free = whole.cost - price(whole.shape, costs) - float(_costs(whole, evidence, costs) @ evidence.weights)
    if excess + free < costs.parameter_cost * min(PARAMETERS.values()):
        return None
    quick = first_look(fit_config, costs)
    tried: list[tuple[float, int, NDArray[np.bool_]]] = []
    for start in _starts(evidence, bad, hints, up, config, costs):
        pair = _settled(evidence, start, near, 0, config, costs, quick, rng)
        if pair is not None:
            cost = pair[1][0].cost + pair[1][1].cost + border_cost(pair[0], evidence, costs)[0]
            tried.append((cost, len(tried), pair[0]))
    best, least_cost = None, whole.cost
    for _, _, start in sorted(tried, key=lambda t: t[:2])[: config.finalists]:
        pair = _settled(
            evidence, start, near, config.rounds, config, costs, replace(fit_config, polish=1), rng
        )
        if pair is None:
            continue
        cost = pair[1][0].cost + pair[1][1].cost + border_cost(pair[0], evidence, costs)[0]
        if cost < least_cost and not _is_layer(evidence, pair[0], pair[1], costs):
            best, least_cost = pair, cost
    return best


def _is_layer(
    evidence: Evidence,
    second: NDArray[np.bool_],
    pair: tuple[Explanation, Explanation],
    costs: ExplanationConfig,
) -> bool:
    """Whether one side is but a layer of points on the other's surface, as a view that is off leaves them."""
    return any(
        lies_on(other.shape, evidence.points[side], costs)
        for side, other in ((second, pair[0]), (~second, pair[1]))
        if other.shape is not None
    )


def _settled(
    evidence: Evidence,
    second: NDArray[np.bool_],
    near: scipy.sparse.csr_array,
    rounds: int,
    config: SplitConfig,
    costs: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> tuple[NDArray[np.bool_], tuple[Explanation, Explanation]] | None:
    """Fit both sides, give each point to the side that explains it better, and so on; None if one is left."""
    least = config.min_points * costs.spacing**2 / costs.reading
    for number in range(rounds + 1):
        sizes = [float(evidence.weights[s].sum()) for s in (~second, second)]
        if min(sizes) < least:
            return None
        pair = tuple(explain(evidence.select(s), costs, fit_config, rng) for s in (~second, second))
        if number == rounds:
            break
        cost = np.stack([_costs(e, evidence, costs) for e in pair])
        cost = (cost + (near @ cost.T).T) / 2.0
        moved = _connected(evidence.points, cost[1] < cost[0], config)
        if (moved == second).all():
            break
        second = moved
    return second, (pair[0], pair[1])


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
    x, y = frames.perpendicular(up), np.cross(up, frames.perpendicular(up))
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
