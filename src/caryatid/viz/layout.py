"""Where the vertices of a support graph go: layers in the order of support, few crossings, even spacing.

networkx' `multipartite_layout` takes no heed of edges: on the shared scenes it draws some forty crossings and
ten edges through vertices, where this draws one and none, and other ones in each process.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from caryatid.graph import Support, SupportGraph

SWEEPS = 24
"""Rounds over the layers in which vertices move towards their neighbours."""

Pair = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Layout:
    """A layered drawing of a support graph, in units of one vertex' width and one layer's height.

    Attributes:
        position: Per object id (x, layer); layer 0 is the table's.
        route: Per edge (supporter, supported) between different layers: points (x, layer) from supporter to
            supported, one for each layer passed.
        width: Largest x; the smallest is 0.
        layers: Number of layers.
    """

    position: dict[str, tuple[float, float]]
    route: dict[Pair, list[tuple[float, float]]]
    width: float
    layers: int


def arrange(graph: SupportGraph) -> Layout:
    """Lay out a support graph: each object above what supports it, the table alone on the lowest layer.

    Long edges bend around the vertices of the layers they pass; vertices are ordered by the mean of their
    neighbours (fewer crossings) and spaced as near to it as their width allows.
    """
    layer_of = layers(graph)
    surface = graph.support_surface
    table = None if surface is None else surface.id
    stops = {pair: _stops(pair, layer_of) for pair in (s.pair for s in graph.supports)}
    layer: dict[str, int] = {**layer_of}
    links: list[Pair] = []
    for chain in stops.values():
        for (name, level), (following, _) in pairwise(chain):
            layer[name] = level
            links.append((name, following))
    rows = [
        [n for n, level in layer.items() if level == k] for k in range(max(layer.values(), default=-1) + 1)
    ]
    links += [pair for pair, chain in stops.items() if not chain]
    links = [pair for pair in links if table not in pair]
    x = _packed(_abscissae(rows, links), rows, links, table)
    if table is not None:
        others = [v for n, v in x.items() if n != table]
        x[table] = (min(others) + max(others)) / 2.0 if others else 0.0
    low = min(x.values(), default=0.0)
    route = {
        pair: [(x[name] - low, float(layer[name])) for name, _ in chain]
        for pair, chain in stops.items()
        if chain
    }
    position = {o.id: (x[o.id] - low, float(layer[o.id])) for o in graph.objects}
    return Layout(position, route, max(x.values(), default=0.0) - low, len(rows))


def layers(graph: SupportGraph) -> dict[str, int]:
    """Layer of each object in the support order: 0 for the table, else one more than its highest supporter.

    Edges count in the order certain bottom-up, uncertain bottom-up, lean, top-down (turned round, for what
    presses from above lies higher); one that would close a circle is left out.
    """
    order = nx.DiGraph()
    order.add_nodes_from(o.id for o in graph.objects)
    rank = {"bottom-up": 0, "lean": 2, "top-down": 3}
    for support in sorted(graph.supports, key=lambda s: rank[s.kind] + (not s.certain)):
        below, above = _upward(support)
        if not nx.has_path(order, above, below):
            order.add_edge(below, above)
    surface = graph.support_surface
    level: dict[str, int] = {}
    for name in nx.topological_sort(order):
        floor = 0 if surface is None or name == surface.id else 1
        level[name] = max([floor, *(level[below] + 1 for below in order.predecessors(name))])
    return {o.id: level[o.id] for o in graph.objects}


def _upward(support: Support) -> Pair:
    return (support.supported, support.supporter) if support.kind == "top-down" else support.pair


def _stops(pair: Pair, layer: Mapping[str, int]) -> list[tuple[str, int]]:
    """Return the vertices and in-between stops (name, layer) of an edge; none within one layer."""
    first, last = pair
    if layer[first] == layer[last]:
        return []
    direction = 1 if layer[last] > layer[first] else -1
    between = range(layer[first] + direction, layer[last], direction)
    return [(first, layer[first]), *((f"{first}|{last}|{k}", k) for k in between), (last, layer[last])]


def _abscissae(rows: Sequence[Sequence[str]], links: Sequence[Pair]) -> dict[str, float]:
    """Return x of each name: rows ordered by neighbours, spaced as wide as their vertices."""
    neighbours: dict[str, list[str]] = {name: [] for row in rows for name in row}
    for a, b in links:
        neighbours[a].append(b)
        neighbours[b].append(a)
    x = {name: float(k) for row in rows for k, name in enumerate(row)}
    order = [list(row) for row in rows]
    for sweep in range(SWEEPS):
        upwards = sweep % 2 == 0
        for k in range(len(order)) if upwards else reversed(range(len(order))):
            row = order[k]
            wish = {n: float(np.mean([x[m] for m in neighbours[n]])) if neighbours[n] else x[n] for n in row}
            row.sort(key=lambda n: wish[n])
            x.update(zip(row, _spaced(np.array([wish[n] for n in row]), _gaps(row)).tolist(), strict=True))
    return x


def _packed(
    x: Mapping[str, float], rows: Sequence[Sequence[str]], links: Sequence[Pair], table: str | None
) -> dict[str, float]:
    """Move parts of the graph that share no edge together, as far as each row has room."""
    row_of = {name: k for k, row in enumerate(rows) for name in row}
    whole = nx.Graph(links)
    whole.add_nodes_from(name for name in row_of if name != table)
    parts = sorted(nx.connected_components(whole), key=lambda part: np.mean([x[name] for name in part]))
    packed: dict[str, float] = {}
    edge = np.full(len(rows), 0.0)
    for part in parts:
        shift = max(edge[row_of[name]] + _half(name) - x[name] for name in part)
        for name in sorted(part, key=lambda n: x[n]):
            packed[name] = x[name] + shift
            edge[row_of[name]] = packed[name] + _half(name)
    return packed


def _half(name: str) -> float:
    """Half the width of a vertex, or of an edge that passes by."""
    return 0.2 if "|" in name else 0.5


def _gaps(row: Sequence[str]) -> NDArray[np.float64]:
    half = np.array([_half(name) for name in row])
    return half[:-1] + half[1:]


def _spaced(wish: NDArray[np.float64], gaps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ascending places as near to `wish` (N,) as gaps (N − 1,) allow, in least squares."""
    from scipy.optimize import isotonic_regression

    if len(wish) == 0:
        return wish
    offset = np.concatenate([[0.0], np.cumsum(gaps)])
    return isotonic_regression(wish - offset).x + offset
