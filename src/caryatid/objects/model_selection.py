"""One object or two: splitting and merging compare the description lengths of both explanations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caryatid.config import Config, ExplanationConfig
from caryatid.geometry.shapes import KINDS, Shape
from caryatid.geometry.transforms import UP, Array
from caryatid.objects.compounds import box_axes
from caryatid.objects.description_length import (
    Evidence,
    Explanation,
    best_compound,
    best_explanation,
    colour_evidence,
    explain,
    explain_sides,
    explained,
    point_costs,
    price,
    side_colours,
    unity,
)
from caryatid.runtime.parallel import kernel, on_threads
from caryatid.segmentation.segments import PLAIN

Groups = NDArray[np.intp]
Mask = NDArray[np.bool_]
Pair = tuple[int, int]

GROWTH = 1.3
"""A decision for one object or two is revised once the number of points has grown by this factor [1]."""
CONNECTED = 0.02
"""Maximum gap between points of one part [m]; twice their spacing and more."""


@dataclass(frozen=True, eq=False, slots=True)
class TwoObjects:
    """Points taken for two objects.

    Attributes:
        second: Which points (N,) are the second's.
        explanations: Of both.
        border: Cost of the border between them [nats].
        others: Evidence of colours and views against two [nats].
        by_colour: Whether their colours alone pay for another object.
    """

    second: Mask
    explanations: tuple[Explanation, Explanation]
    border: float
    others: float
    by_colour: bool

    @property
    def cost(self) -> float:
        """Cost of both and of being two [nats]."""
        return self.explanations[0].cost + self.explanations[1].cost + self.border + self.others


def split(
    evidence: Evidence,
    whole: Explanation,
    *,
    config: Config,
    rng: np.random.Generator,
) -> Groups | None:
    """Split points that several shapes explain at a lower cost than one.

    Where one shape does not explain all points, pieces with free space between them are two objects.
    Otherwise the hypotheses are: segments of views, as hints; the patches that the single shape does not
    explain; cuts across the vertical, where one object lies on another; and cuts across the two main
    horizontal directions of the faces, where objects stand side by side. From each hypothesis, points go to
    the shape that explains them better and both shapes are fitted again, in turn.

    Args:
        evidence: The points of what is taken for one object.
        whole: Its best single explanation.
        config: What is tried, what it costs, and how shapes are fitted.
        rng: Source of the samples.

    Returns:
        Group of each point (N,), from 0, or None where one object is the better explanation.
    """
    if not explained(whole, evidence, config.explanation):
        pieces = _separated_pieces(evidence, config)
        if pieces is not None:
            return pieces
    hints = evidence.shown(config.split.min_points)
    parts = _parts(evidence, whole, np.arange(len(evidence)), hints, config, rng)
    if parts is None:
        return None
    groups = np.zeros(len(evidence), dtype=np.intp)
    for number, (index, _) in enumerate(parts):
        groups[index] = number
    return groups


def _parts(
    evidence: Evidence,
    whole: Explanation,
    index: Groups,
    hints: Sequence[Mask],
    config: Config,
    rng: np.random.Generator,
) -> list[tuple[Groups, float]] | None:
    """Points of each object among those with this index, and its cost [nats]; None if they are one object."""
    own = evidence.select(index)
    found = best_division(own, whole, [h[index] for h in hints], config, rng)
    if found is None or found.cost >= whole.cost:
        return None
    parts: list[tuple[Groups, float]] = []
    border = found.border + found.others
    for side, explanation in zip((~found.second, found.second), found.explanations, strict=True):
        further = _parts(evidence, explanation, index[side], hints, config, rng)
        parts += further or [(index[side], explanation.cost)]
    compound = best_compound(own, config, border + sum(cost for _, cost in parts))
    return parts if compound.shape is None else None


def best_division(
    evidence: Evidence,
    whole: Explanation,
    hints: Sequence[Mask],
    config: Config,
    rng: np.random.Generator,
) -> TwoObjects | None:
    """Find the best division of points into two objects; None if none can cost less than one.

    Args:
        evidence: The points.
        whole: Their best explanation as one object.
        hints: Points (N,) that may be an object of their own.
        config: What is tried, what it costs, and how shapes are fitted.
        rng: Source of the samples.
    """
    costs = config.explanation
    if len(evidence) < 2 * config.split.min_points:
        return None
    tree = cKDTree(evidence.points)
    near, pairs = _neighbours(tree), tree.query_pairs(CONNECTED, output_type="ndarray")
    own = point_costs(whole.shape, evidence, costs)
    misfit = own[near].mean(axis=1)
    excess = float(np.maximum(misfit - costs.usual, 0.0).sum()) * evidence.weight
    free = whole.cost - price(whole.shape, costs) - float(own.sum()) * evidence.weight
    starts = [h for h in hints if h.any() and not h.all()]
    hinted = len(starts)
    colours = max((_colours(evidence, start, costs) for start in starts), default=0.0)
    if excess + free + colours < costs.parameter_cost * min(kind.parameters for kind in KINDS.values()):
        return None
    starts += _hypotheses(evidence, misfit, config)
    looks = _settled(evidence, starts, hinted, near, pairs, config, rng, first_look=True)
    # The best two of those with a shape for one side at least are settled with full fits.
    shaped = {k: look.cost for k, look in looks.items() if any(e.shape for e in look.explanations)}
    tried = sorted(sorted(shaped, key=shaped.__getitem__)[:2])
    hinted = sum(k < hinted for k in tried)
    settled = _settled(evidence, [starts[k] for k in tried], hinted, near, pairs, config, rng)
    proper = [two for two in settled.values() if two.by_colour or not _is_layer(evidence, two)]
    return min(proper, key=lambda two: two.cost, default=None)


def _colours(evidence: Evidence, second: Mask, costs: ExplanationConfig) -> float:
    return colour_evidence(evidence.select(~second), evidence.select(second), costs)


def _is_layer(evidence: Evidence, two: TwoObjects) -> bool:
    """Whether one side is only a layer of points on the other's surface, left by a misaligned view."""
    sides = evidence.points[two.second], evidence.points[~two.second]
    # 9 mm: a view that is off by 3σ leaves points that far from a surface.
    return any(
        isinstance(other.shape, Shape) and float((other.shape.signed_distance(side) < 0.009).mean()) >= 0.8
        for side, other in zip(sides, two.explanations, strict=True)
    )


def _settled(
    evidence: Evidence,
    starts: Sequence[Mask],
    hinted: int,
    near: Groups,
    pairs: Groups,
    config: Config,
    rng: np.random.Generator,
    *,
    first_look: bool = False,
) -> dict[int, TwoObjects]:
    """Fit both sides of each start, assign each point to the side that explains it better, and iterate.

    A first look only makes quick fits of the sides as they are.
    Colours count only for the first, `hinted` starts, where a view showed a border between the sides:
    elsewhere a border of colours may be part of a print.

    Returns:
        The division each start converges to, by its index; none if one side is left with too few points.
    """
    seconds = np.array(starts, dtype=np.bool_).reshape(-1, len(evidence))
    known, found = np.arange(len(seconds)), list[Explanation]()
    for turn in range(0 if first_look else -config.split.rounds, 1):
        counts = seconds[known].sum(axis=1)
        known = known[np.minimum(counts, len(evidence) - counts) >= config.split.min_points]
        sides = np.stack([~seconds[known], seconds[known]], axis=1).reshape(-1, len(evidence))
        quick = first_look or turn < 0
        found = explain_sides(evidence, sides, config.explanation, config.fit, rng, first_look=quick)
        for k, *pair in zip(known.tolist() if turn < 0 else [], found[::2], found[1::2], strict=False):
            # To the shape that explains a point better, together with the points around it.
            cost = np.stack([point_costs(e.shape, evidence, config.explanation) for e in pair])
            if k < hinted and evidence.rgb is not None:
                rgb, second = evidence.rgb, seconds[k]
                colours = side_colours(rgb, (rgb[~second], rgb[second]), config.explanation)
                cost = cost * evidence.weight + colours
            cost = (cost + cost[:, near].mean(axis=2)) / 2.0
            seconds[k] = cost[1] < cost[0]
            _keep_connected(pairs, seconds[k])
    borders = _borders(evidence, seconds[known], near, config)
    others = unity(evidence, seconds[known], config.explanation)
    settled: dict[int, TwoObjects] = {}
    for n, k in enumerate(known.tolist()):
        gain = _colours(evidence, seconds[k], config.explanation) if k < hinted else 0.0
        pays = gain > price(None, config.explanation)
        sides_explained = found[2 * n], found[2 * n + 1]
        settled[k] = TwoObjects(seconds[k], sides_explained, float(borders[n]), float(others[n]) - gain, pays)
    return settled


def _hypotheses(evidence: Evidence, misfit: Array, config: Config) -> Iterator[Mask]:
    """Masks (N,) of points that may be one object: poorly explained patches, and sides of cuts."""
    poor = misfit > config.explanation.irregular
    if poor.any():
        part = _components(evidence.points[poor])
        for number in np.argsort(-np.bincount(part))[:3]:
            start = np.zeros(len(misfit), dtype=bool)
            start[np.flatnonzero(poor)[part == number]] = True
            yield start
    shares = np.linspace(0.0, 1.0, config.split.cuts + 2)[1:-1]
    for direction in box_axes(evidence.normals, UP):
        height = evidence.points @ direction
        for level in np.quantile(height, shares):
            yield height > level


def _separated_pieces(evidence: Evidence, config: Config) -> Groups | None:
    """Find pieces beyond `explanation.reach` of the largest that free space parts from it.

    Returns:
        Piece (N,) of each point, 0 = the largest and what is not parted from it, or None where none is.
    """
    points, voxels, least = evidence.points, evidence.voxels, config.split.min_points
    piece = _components(points, config.explanation.reach)
    sizes = np.bincount(piece)
    if voxels is None or np.count_nonzero(sizes >= least) < 2:
        return None
    largest = int(sizes.argmax())
    body = points[piece == largest]
    tree = cKDTree(body)
    groups = np.zeros(len(points), dtype=np.intp)
    for number in np.flatnonzero(sizes >= least):
        own = points[piece == number]
        gap, near = tree.query(own)
        begin, end = own[gap.argmin()], body[near[gap.argmin()]]
        steps = np.arange(1.0, max(gap.min() // voxels.config.size, 1.0))[:, None] * voxels.config.size
        between = begin + steps / max(float(gap.min()), 1e-9) * (end - begin)
        if voxels.empty_at(between).any():
            groups[piece == number] = groups.max() + 1
    return groups if groups.any() else None


def _components(points: Array, gap: float = CONNECTED) -> Groups:
    """Connected part (N,) of each point, from 0; a gap [m] parts two."""
    pairs = cKDTree(points).query_pairs(gap, output_type="ndarray")
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


@kernel
def _keep_connected(pairs, second):  # type: ignore[no-untyped-def]
    """Keep the largest connected part of the second side (N,), and of the first all but crumbs (2 cm²).

    Pairs (P, 2) of points are near each other. The side is changed.
    """
    for side, least in ((True, len(second)), (False, 8)):
        part, sizes = np.arange(len(second)), np.zeros(len(second), np.intp)
        for a, b in pairs:
            if second[a] == side and second[b] == side:
                while part[a] != a:
                    part[a] = a = part[part[a]]
                while part[b] != b:
                    part[b] = b = part[part[b]]
                part[max(a, b)] = min(a, b)
        for i in range(len(second)):
            part[i] = part[part[i]]
            sizes[part[i]] += second[i] == side
        largest = sizes.argmax()
        for i in range(len(second)):
            if (
                second[i] == side
                and part[i] != largest
                and sizes[part[i]] < min(least, sizes[largest] + side)
            ):
                second[i] = not side


def best_merge(
    evidence: Mapping[int, Evidence],
    plain: Mapping[int, Array | None],
    explain_alone: Callable[[int], Explanation],
    changed: set[int],
    gains: MutableMapping[Pair, float],
    apart: MutableMapping[Pair, int],
    *,
    distinct: Set[frozenset[int]] = frozenset(),
    config: Config,
    seed: int,
) -> Pair | None:
    """Find the pair of objects that it pays most to merge: neighbours, or sides of one colour.

    Args:
        evidence: Points of each object, by label.
        plain: Its main plain colour (3,), if it has one.
        explain_alone: Explains it as an object of its own.
        changed: Only pairs with one of these labels are considered.
        gains: Pairs compared before, with how much it pays to merge them. Updated in place.
        apart: Pairs found to be two objects, with the number of points they had then; they are considered
            again when they have grown. Updated in place.
        distinct: Pairs known to be two objects, whatever their points suggest.
        config: What explanations cost, and how shapes are fitted.
        seed: Seed of the fits.

    Returns:
        The larger object and the one merged into it, or None if no merge pays.
    """
    labels, points = sorted(evidence), [evidence[k].points for k in sorted(evidence)]
    gaps = _gaps(points, [plain[k] for k in labels], config.explanation)
    low, high = (np.array([f(p, axis=0) for p in points]).reshape(-1, 3) for f in (np.min, np.max))
    between = np.maximum(np.maximum(low[:, None] - high, low - high[:, None]), 0.0)
    near = np.triu(np.linalg.norm(between, axis=-1) <= gaps, 1)
    tree = cache(lambda k: cKDTree(points[k]))
    pairs = []
    for first, second in np.argwhere(near).tolist():
        a, b = labels[first], labels[second]
        grown = len(points[first]) + len(points[second]) >= GROWTH * apart.get((a, b), 0)
        known = not grown or (a, b) in gains
        if known or not {a, b} & changed or frozenset((a, b)) in distinct:
            continue
        if tree(first).count_neighbors(tree(second), gaps[first, second]) > 0:
            pairs.append((a, b))
    names = sorted({k for pair in pairs for k in pair})
    alone = dict(zip(names, on_threads(lambda n: explain_alone(names[n]), len(names)), strict=True))

    def gain_of(number: int) -> float:
        sides = [(evidence[k], alone[k]) for k in pairs[number]]
        return compare(sides, config, np.random.default_rng([seed, *pairs[number]])).gain

    gains.update(zip(pairs, on_threads(gain_of, len(pairs)), strict=True))
    for a, b in [pair for pair, gain in gains.items() if not gain > 0.0]:
        apart[a, b] = len(evidence[a]) + len(evidence[b])
        del gains[a, b]
    if not gains:
        return None
    a, b = max(sorted(gains), key=lambda pair: gains[pair])
    return (a, b) if len(evidence[a]) >= len(evidence[b]) else (b, a)


def _gaps(points: Sequence[Array], plain: Sequence[Array | None], costs: ExplanationConfig) -> Array:
    """Maximum gap (N, N) [m] between parts of one object: the longer one's length if they share a colour.

    Sides of a plain colour so far off may be its own.
    """
    length = np.array([np.linalg.norm(np.ptp(p, axis=0)) for p in points])
    colour = np.array([np.full(3, np.nan) if c is None else c for c in plain]).reshape(-1, 3)
    alike = np.linalg.norm(colour[:, None] - colour, axis=-1) <= PLAIN
    longer = np.maximum(np.maximum(length[:, None], length), costs.reach)
    return np.where(alike, longer, costs.reach)


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """Two objects, and one in their place.

    Attributes:
        alone: Cost of the two by their own shapes [nats].
        border: Cost of the border between the two [nats].
        one: The best explanation of all their points.
        colours: Evidence [nats] of colours for two, or, if negative, for one.
    """

    alone: float
    border: float
    one: Explanation
    colours: float

    @property
    def gain(self) -> float:
        """How much less one object costs than two [nats]; 0 if no shape explains both."""
        gain = self.alone + self.border - self.one.cost - self.colours
        return max(gain, 0.0) if self.one.shape is not None else 0.0


def compare(
    pair: Sequence[tuple[Evidence, Explanation]], config: Config, rng: np.random.Generator
) -> Comparison:
    """Compare two objects, each with its best explanation, with one: by shapes, a joint fit, and colours."""
    costs, ((first, alone), (second, other)) = config.explanation, pair
    both = first.joined(second)
    of_second = np.arange(len(both)) >= len(first)
    apart = alone.cost + other.cost
    border = float(_borders(both, of_second[None], _neighbours(cKDTree(both.points)), config)[0])
    one = best_explanation([e.shape for e in (alone, other) if e.shape is not None], both, costs)
    for first_look in (True, False):
        one = min(one, explain(both, costs, config.fit, rng, first_look=first_look), key=lambda e: e.cost)
        if one.cost > apart + border + price(None, costs):
            break
    if isinstance(one.shape, Shape):
        # Points that no shape explains are near the object; what stands out from it is another one.
        beyond = np.abs(one.shape.signed_distance(both.points)) / costs.reach - 1.0
        stray = costs.outlier * both.weight * float(np.maximum(beyond, 0.0).sum())
        one = replace(one, cost=one.cost + stray)
    found = Comparison(apart, border, one, colour_evidence(first, second, costs))
    # A compound has creases of its own: to it a border without one means nothing.
    compound = best_compound(both, config, apart - found.colours - found.gain)
    return found if compound.shape is None else replace(found, border=0.0, one=compound)


def _neighbours(tree: cKDTree) -> Groups:
    """Indices (N, 8) of the points (N, 3) nearest to each, itself among them: 2 cm square of them."""
    count = min(8, tree.n)
    return np.asarray(tree.query(tree.data, k=count)[1]).reshape(tree.n, count)


def _borders(evidence: Evidence, seconds: Mask, near: Groups, config: Config) -> Array:
    """Cost (S,) [nats] of the border of each of some second sides (S, N).

    A border costs where the surface continues, without a concave crease.
    """
    row, col = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
    between = evidence.points[col] - evidence.points[row]
    turn = evidence.normals[col] - evidence.normals[row]
    bend = np.einsum("ij,ij->i", turn, between) / np.maximum(np.linalg.norm(between, axis=1), 1e-9)
    smooth = bend > -np.sin(np.radians(config.segmentation.concavity))
    row, col = row[smooth], col[smooth]
    number = np.count_nonzero(seconds[:, row] != seconds[:, col], axis=1)
    return config.explanation.border * number * evidence.weight / near.shape[1]
