"""The support graph drawn: layers in the order of support, few crossings, even spacing.

networkx' `multipartite_layout` takes no heed of edges: on the shared scenes it draws some forty crossings and
ten edges through vertices, where this draws none.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.viz.colours import ink_on, object_colour, object_stripes
from caryatid.viz.pictures import DOUBT, INK, PANEL, Picture, keep_apart

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SWEEPS = 24
"""Rounds over the layers in which vertices move towards their neighbours."""

Pair = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Layout:
    """A layered drawing of a support graph, in units of one vertex' width and one layer's height.

    Attributes:
        position: Per object id (x, layer); layer 0 is the table's.
        route: Per edge (supporter, supported) points (x, layer) from supporter to supported, one for each
            layer passed.
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
    layer: dict[Hashable, int] = dict(layers(graph).items())
    joined: nx.Graph[Hashable] = nx.Graph()
    joined.add_nodes_from(layer)
    chains: dict[Pair, list[Hashable]] = {}
    for pair in (s.pair for s in graph.supports):
        first, last = layer[pair[0]], layer[pair[1]]
        up = 1 if last > first else -1
        between = {(pair, level): level for level in range(first + up, last, up)}
        layer |= between
        chains[pair] = [pair[0], *between, pair[1]]
        nx.add_path(joined, chains[pair])
    rows = [
        [n for n, at in layer.items() if at == level] for level in range(max(layer.values(), default=-1) + 1)
    ]
    x = _abscissae(rows, joined, None if graph.support_surface is None else graph.support_surface.id)
    low, width = min(x.values(), default=0.0), np.ptp(list(x.values())) if x else 0.0
    at = {name: (x[name] - low, float(level)) for name, level in layer.items()}
    route = {pair: [at[name] for name in chain] for pair, chain in chains.items()}
    return Layout({o.id: at[o.id] for o in graph.objects}, route, float(width), len(rows))


def layers(graph: SupportGraph) -> dict[str, int]:
    """Layer of each object in the support order: 0 for the table, else one more than its highest supporter.

    Edges count in the order certain bottom-up, uncertain bottom-up, lean, top-down (turned round, for what
    presses from above lies higher); one that would close a circle is left out.
    """
    order = nx.DiGraph()
    order.add_nodes_from(o.id for o in graph.objects)
    rank = {"bottom-up": 0, "lean": 2, "top-down": 3}
    for support in sorted(graph.supports, key=lambda s: rank[s.kind] + (not s.certain)):
        below, above = support.pair[::-1] if support.kind == "top-down" else support.pair
        if not nx.has_path(order, above, below):
            order.add_edge(below, above)
    surface = graph.support_surface
    level: dict[str, int] = {}
    for name in nx.topological_sort(order):
        floor = 0 if surface is None or name == surface.id else 1
        level[name] = max([floor, *(level[below] + 1 for below in order.predecessors(name))])
    return {o.id: level[o.id] for o in graph.objects}


def _abscissae(
    rows: Sequence[Sequence[Hashable]], joined: nx.Graph[Hashable], table: str | None
) -> dict[Hashable, float]:
    """Return x of each name: rows ordered by their neighbours' means, spaced as wide as their vertices.

    The table draws the others to the middle and stays there.
    """
    from scipy.optimize import isotonic_regression

    x = {name: k - (len(row) - 1) / 2.0 for row in rows for k, name in enumerate(row)}
    for sweep in range(SWEEPS):
        for row in rows if sweep % 2 == 0 else reversed(rows):
            if not row or row[0] == table:
                continue
            wish = {name: float(np.mean([x[other] for other in joined[name] or [name]])) for name in row}
            ordered = sorted(row, key=lambda name: (wish[name], x[name]))
            width = np.array([1.0 if isinstance(name, str) else 0.4 for name in ordered])
            offset = np.cumsum(width) - width / 2.0
            spaced = isotonic_regression(np.array([wish[name] for name in ordered]) - offset).x + offset
            x.update(zip(ordered, spaced.tolist(), strict=True))
    return x


# The drawing

COLUMN, ROW = 78.0, 110.0
"""Distance of vertices within a layer, and of layers [px]."""
NODE = np.array([56.0, 40.0])
"""Width and height of a vertex [px]."""
LEAST_WIDTH = 560.0
"""Small graphs are drawn in this much space so that their letters do not grow [px]."""
BESIDE = 680.0
"""Graphs wider than this are too small to read beside another picture [px]: of more than eight vertices."""


def draw_graph(graph: SupportGraph) -> Picture:
    """Draw the support graph: the table below, what it carries above it, doubt in dashes.

    Edges run from supporter to supported and carry occurrences/opportunities; uncertain ones are dashed,
    leaning and top-down ones say so. Vertices have the shape of their primitive, and a dashed rim where
    nothing is known to support them.

    Args:
        graph: What to draw.
    """
    layout = arrange(graph)
    border, bottom = 46.0, 30.0
    span = layout.width * COLUMN + 2.0 * border
    width = max(span, LEAST_WIDTH)
    tall = max(layout.layers - 1, 0) * ROW + border + bottom
    height = tall if width > BESIDE else max(tall, 0.73 * width)
    corner = np.array([(width - span) / 2.0 + border, (height + tall) / 2.0 - bottom])
    centre = {name: corner + np.array([COLUMN, -ROW]) * at for name, at in layout.position.items()}
    table = None if graph.support_surface is None else graph.support_surface.id
    lines, notes = [], []
    for support in graph.supports:
        points = corner + np.array([COLUMN, -ROW]) * layout.route[support.pair]
        level = points[0, 1] == points[-1, 1]
        if not level and support.pair[::-1] in layout.route:
            points[:, 0] += 8.0 * np.sign(points[0, 1] - points[-1, 1])  # Beside the edge that leads back.
        line, note = _level(points) if level else _upright(points, support, table)
        lines.append(line)
        notes.append(note)
    words = [_note(support) for support in graph.supports]
    plates = np.array([[7.4 * len(word) + 4.0, 16.0] for word in words]).reshape(-1, 2)
    places = keep_apart(np.array(notes).reshape(-1, 2), plates, (width, height))

    def draw(axes: Axes) -> None:
        for support, line, word, place in zip(graph.supports, lines, words, places, strict=True):
            _put_edge(axes, support, line, word, place)
        for item in graph.objects:
            if item.id == table:
                _put_table(axes, item, width, corner[1])
            else:
                _put_node(axes, item, centre[item.id], graph)

    return Picture("support graph, from the support surface upwards", width, height, draw)


def _note(support: Support) -> str:
    evidence = f"{support.occurrences}/{support.opportunities}"
    return evidence if support.kind == "bottom-up" else f"{support.kind} {evidence}"


def _upright(points: Array, support: Support, table: str | None) -> tuple[Array, Array]:
    """Bend an edge (N, 2) smoothly from rim to rim; return it and where its note belongs.

    It meets its vertices off their middles, on the side it comes from; the table right below its neighbour.
    """
    line = points.copy()
    most = NODE[0] / 2.0 - 8.0
    line[0, 0] += np.clip(0.2 * (points[1, 0] - points[0, 0]), -most, most)
    line[-1, 0] += np.clip(0.2 * (points[-2, 0] - points[-1, 0]), -most, most)
    if support.supporter == table:
        line[0, 0] = line[1, 0]
    if support.supported == table:
        line[-1, 0] = line[-2, 0]
    down = np.sign(line[-1, 1] - line[0, 1])
    line[0, 1] += down * (NODE[1] / 2.0 + 1.0)
    line[-1, 1] -= down * (NODE[1] / 2.0 + 3.0)
    share = np.linspace(0.0, 1.0, 17)[:, None]
    wave = np.concatenate([(1.0 - np.cos(np.pi * share)) / 2.0, share], axis=1)
    bent = np.concatenate([a + wave * (b - a) for a, b in pairwise(line)])
    return bent, bent[-9]


def _level(points: Array) -> tuple[Array, Array]:
    """Join two vertices of one layer: neighbours from side to side, others by an arc; its note's place."""
    start, end = points[0], points[-1]
    sign = np.sign(end[0] - start[0])
    near = abs(end[0] - start[0]) < 1.5 * COLUMN
    edge = np.array([sign * (NODE[0] / 2.0 + 3.0), 0.0]) if near else np.array([0.0, -NODE[1] / 2.0 - 3.0])
    a, b = start + edge, end + (-edge if near else edge)
    rise = np.array([0.0, -10.0 * sign if near else -0.62 * ROW])
    t = np.linspace(0.0, 1.0, 25)[:, None]
    arc = (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * (a + rise) + 3 * (1 - t) * t**2 * (b + rise) + t**3 * b
    return arc, arc[12] + (np.array([0.0, -sign * (NODE[1] / 2.0 + 6.0)]) if near else 0.0)


def _put_edge(axes: Axes, support: Support, line: Array, word: str, place: Array) -> None:
    colour = INK if support.certain else DOUBT
    title = f"{support.supporter} supports {support.supported}: {support.why}".rstrip(": ")
    back = transforms.unit(line[-1] - line[-2])
    across = np.array([-back[1], back[0]])
    head = np.array([line[-1], line[-1] - 10.0 * back + 4.5 * across, line[-1] - 10.0 * back - 4.5 * across])
    dash = "-" if support.certain else (0, (3.5, 2.6))
    kind = f"edge {support.supporter} {support.supported} {'certain' if support.certain else 'uncertain'}"
    axes.plot(*line[:-1].T, color=colour, linewidth=1.7, linestyle=dash, gid=f"{kind}|{title}")
    axes.fill(*head.T, color=colour, linewidth=0.0)
    plate = {"facecolor": PANEL, "edgecolor": "none", "pad": 0.8}
    axes.text(
        place[0], place[1], word, color=colour, fontsize=12.0, ha="center", va="center_baseline", bbox=plate
    )


def _put_node(axes: Axes, item: SceneObject, at: Array, graph: SupportGraph) -> None:
    angle, half = np.linspace(0.0, np.pi, 24), NODE / 2.0
    outline = half * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    if item.shape.kind == "cylinder":
        lid = half * np.stack([np.cos(angle), 0.25 * np.sin(angle)], axis=-1)
        middle = np.array([0.0, half[1] - 5.0])
        outline = np.concatenate([lid + middle, lid[::-1] * (1.0, -1.0) - middle])
        axes.plot(*(at + lid - middle).T, color=INK, linewidth=1.2, zorder=3.5)
    elif item.shape.kind == "sphere":
        outline = half * np.stack([np.cos(2.0 * angle), np.sin(2.0 * angle)], axis=-1)
    stability = graph.stability.get(item.id)
    unsupported = not graph.supporters(item.id)
    remarks = [f"{item.id}: {item.shape.kind}, found in {item.occurrences} of {item.opportunities} views"]
    remarks += ["nothing is known to support it"] if unsupported else []
    remarks += ["looks unstable"] if stability is not None and not stability.stable else []
    rim: dict[str, Any] = {"edgecolor": INK, "linewidth": 1.2}
    if unsupported:
        rim = {"edgecolor": DOUBT, "linewidth": 2.4, "linestyle": (0, (2.1, 1.5))}
    colour = object_colour(item.label)
    stripes = "".join({1: "//", -1: "\\\\"}[turn] for turn in object_stripes(item.label))
    axes.fill(
        *(outline + at).T, facecolor=colour, hatch=stripes or None, hatchcolor=(1, 1, 1, 0.5), zorder=3.0,
        gid=f"node {item.id}{' unsupported' if unsupported else ''}|{'; '.join(remarks)}", **rim,
    )  # fmt: skip
    text: dict[str, Any] = {"color": ink_on(colour), "ha": "center", "va": "center_baseline", "zorder": 4.0}
    axes.text(at[0], at[1] - 3.0, item.id, fontsize=13.0, fontweight="bold", **text)
    axes.text(at[0], at[1] + 11.0, f"{item.occurrences}/{item.opportunities}", fontsize=9.5, **text)


def _put_table(axes: Axes, item: SceneObject, width: float, floor: float) -> None:
    left, right, top = 12.0, width - 12.0, floor - NODE[1] / 2.0
    gid = f"node {item.id} surface|{item.id}: the support surface"
    colour, below = object_colour(item.label), top + 0.7 * NODE[1]
    corners = ([left, right, right, left], [top, top, below, below])
    axes.fill(*corners, facecolor=colour, edgecolor=INK, linewidth=1.2, gid=gid)
    axes.text(
        width / 2.0, floor - 0.15 * NODE[1], f"{item.id} · support surface", fontsize=13.0, fontweight="bold",
        color="#111111", ha="center", va="center_baseline",
    )  # fmt: skip
