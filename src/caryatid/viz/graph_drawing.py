"""The support graph drawn: layers in the order of support, few crossings, even spacing.

networkx' `multipartite_layout` takes no heed of edges: on the shared scenes it draws some forty crossings and
ten edges through vertices, where this draws one and none, and other ones in each process.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.viz.colours import ink_on, object_colour, object_stripes
from caryatid.viz.drawings import DOUBT, INK, PANEL, Picture, Rectangle, stage

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


# The drawing

COLUMN, ROW = 78.0, 110.0
"""Distance of vertices within a layer, and of layers [px]."""
NODE = np.array([56.0, 40.0])
"""Width and height of a vertex [px]."""
BORDER, BOTTOM = 46.0, 30.0
"""Free space around the outermost vertices' centres, and below the table's [px]."""
LEAST_WIDTH = 560.0
"""Small graphs are drawn in this much space so that their letters do not grow [px]."""
BESIDE = 7.5
"""Graphs wider than this many vertices are too small to read beside another picture."""
TEXT = 12.0
"""Height of letters [px]."""


def draw_graph(graph: SupportGraph) -> Picture:
    """Draw the support graph: the table below, what it carries above it, doubt in dashes.

    Edges run from supporter to supported and carry occurrences/opportunities; uncertain ones are dashed,
    leaning and top-down ones say so. Vertices have the shape of their primitive, and a dashed rim where
    nothing is known to support them.

    Args:
        graph: What to draw.
    """
    layout = arrange(graph)
    span = layout.width * COLUMN + 2.0 * BORDER
    width = max(span, LEAST_WIDTH)
    tall = max(layout.layers - 1, 0) * ROW + BORDER + BOTTOM
    height = tall if layout.width > BESIDE else max(tall, 0.73 * width)
    corner = np.array([(width - span) / 2.0 + BORDER, (height + tall) / 2.0 - BOTTOM])

    def place(at: tuple[float, float]) -> Array:
        return corner + np.array([COLUMN, -ROW]) * at

    centre = {name: place(at) for name, at in layout.position.items()}
    surface = graph.support_surface
    table = None if surface is None else surface.id
    ports = _ports(graph, layout)
    lines = {}
    for support in graph.supports:
        if support.pair in layout.route:
            points = np.array([place(at) for at in layout.route[support.pair]])
            lines[support.pair] = _trimmed(points, support, table, ports)
        else:
            lines[support.pair] = _arc(*(centre[name] for name in support.pair))
    plates = [np.concatenate([at, NODE]) for name, at in centre.items() if name != table]
    notes = {s.pair: _note_place(s, lines, plates) for s in graph.supports}

    def draw(figure: Any, where: Rectangle) -> None:
        axes, unit = stage(figure, where, (width, height))
        for support in graph.supports:
            _draw_edge(axes, support, lines[support.pair], notes[support.pair], unit)
        for item in graph.objects:
            if item.id == table:
                _draw_table(axes, item, width, corner[1], unit)
            else:
                _draw_node(axes, item, centre[item.id], graph, unit)

    return Picture("support graph, from the support surface upwards", width, height, draw)


def is_wide(graph: SupportGraph) -> bool:
    """Whether the drawing of a graph is too wide to be read beside another picture."""
    return arrange(graph).width > BESIDE


def _ports(graph: SupportGraph, layout: Layout) -> dict[tuple[str, Pair], float]:
    """Where each edge meets its vertices: pixels from their middles, in the order the edges come from.

    Edges that meet a vertex from above and from below are spread each on their own.
    """
    meeting: dict[tuple[str, bool], list[tuple[float, Pair]]] = {}
    for pair in (s.pair for s in graph.supports if s.pair in layout.route):
        route = layout.route[pair]
        for name, (_, own), (x, level) in ((pair[0], route[0], route[1]), (pair[1], route[-1], route[-2])):
            meeting.setdefault((name, level > own), []).append((x, pair))
    ports = {}
    for (name, _), ends in meeting.items():
        pitch = min(13.0, (NODE[0] - 10.0) / max(len(ends) - 1, 1))
        for k, (_, pair) in enumerate(sorted(ends)):
            ports[name, pair] = pitch * (k - (len(ends) - 1) / 2.0)
    return ports


def _trimmed(
    points: Array, support: Support, table: str | None, ports: Mapping[tuple[str, Pair], float]
) -> Array:
    """Let an edge (N, 2) begin and end at the rims of its vertices and bend smoothly."""
    line = points.copy()
    line[0, 0] += ports[support.supporter, support.pair]
    line[-1, 0] += ports[support.supported, support.pair]
    if support.supporter == table:
        line[0, 0] = line[1, 0]
    if support.supported == table:
        line[-1, 0] = line[-2, 0]
    down = 1.0 if line[-1, 1] > line[0, 1] else -1.0
    line[0, 1] += down * (NODE[1] / 2.0 + 1.0)
    line[-1, 1] -= down * (NODE[1] / 2.0 + 3.0)
    share = np.linspace(0.0, 1.0, 17)[:, None]
    wave = np.concatenate([(1.0 - np.cos(np.pi * share)) / 2.0, share], axis=1)
    return np.concatenate([a + wave * (b - a) for a, b in pairwise(line)])


def _arc(start: Array, end: Array) -> Array:
    """Join two vertices of one layer (2,): neighbours from side to side, others by an arc."""
    sign = 1.0 if end[0] > start[0] else -1.0
    near = abs(end[0] - start[0]) < 1.5 * COLUMN
    edge = np.array([sign * (NODE[0] / 2.0 + 3.0), 0.0]) if near else np.array([0.0, -NODE[1] / 2.0 - 3.0])
    a, b = start + edge, end + edge * (-1.0 if near else 1.0)
    rise = np.array([0.0, -8.0 if near else -0.62 * ROW])
    t = np.linspace(0.0, 1.0, 25)[:, None]
    return (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * (a + rise) + 3 * (1 - t) * t**2 * (b + rise) + t**3 * b


def _note(support: Support) -> str:
    evidence = f"{support.occurrences}/{support.opportunities}"
    return evidence if support.kind == "bottom-up" else f"{support.kind} {evidence}"


def _note_place(support: Support, lines: Mapping[Pair, Array], plates: list[Array]) -> Array:
    """Where beside its edge a note covers least (2,); it is added to the plates (x, y, width, height)."""
    line = lines[support.pair]
    size = np.array([len(_note(support)) * 0.6 * TEXT + 2.0, TEXT + 2.0])
    taken, around = np.array(plates).reshape(-1, 4), np.concatenate(list(lines.values()))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    best, least = line[len(line) // 2], np.inf
    for share in (0.5, 0.62, 0.38, 0.72, 0.28, 0.8, 0.2):
        at, before = (
            np.array([np.interp(s * along[-1], along, line[:, k]) for k in (0, 1)])
            for s in (share, share - 0.05)
        )
        ahead = (at - before) / max(float(np.linalg.norm(at - before)), 1e-9)
        across = np.array([ahead[1], -ahead[0]]) * (-1.0 if ahead[1] < 0.0 else 1.0)
        clear = float(np.abs(across) @ size) / 2.0 + 4.0
        for spot in (at + clear * across, at - clear * across):
            overlaps = np.clip((size + taken[:, 2:]) / 2 - np.abs(taken[:, :2] - spot), 0, size)
            crossed = (np.abs(around - spot) < size / 2.0).all(axis=1).sum()
            covered = float(overlaps.prod(axis=1).sum()) + 20.0 * float(crossed)
            if covered < least:
                best, least = spot, covered
    plates.append(np.concatenate([best, size]))
    return best


def _draw_edge(axes: Axes, support: Support, line: Array, note: Array, unit: float) -> None:
    colour = INK if support.certain else DOUBT
    title = f"{support.supporter} supports {support.supported}: {support.why}".rstrip(": ")
    back = transforms.unit(np.append(line[-1] - line[-2], 0.0))[:2]
    across = np.array([-back[1], back[0]])
    head = np.array([line[-1], line[-1] - 10.0 * back + 4.5 * across, line[-1] - 10.0 * back - 4.5 * across])
    dash = "-" if support.certain else (0, (3.5, 2.6))
    kind = f"edge {support.supporter} {support.supported} {'certain' if support.certain else 'uncertain'}"
    axes.plot(*line[:-1].T, color=colour, linewidth=1.7 * unit, linestyle=dash, gid=f"{kind}|{title}")
    axes.fill(*head.T, color=colour, linewidth=0.0)
    plate = {"facecolor": PANEL, "edgecolor": "none", "alpha": 0.8, "pad": 0.8 * unit}
    axes.text(
        note[0],
        note[1],
        _note(support),
        color=colour,
        fontsize=TEXT * unit,
        ha="center",
        va="center_baseline",
        bbox=plate,
    )


def _draw_node(axes: Axes, item: SceneObject, at: Array, graph: SupportGraph, unit: float) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    angle, half = np.linspace(0.0, np.pi, 24), NODE / 2.0
    match item.shape.kind:
        case "cylinder":
            lid = half * np.stack([np.cos(angle), 0.25 * np.sin(angle)], axis=-1)
            outline = np.concatenate(
                [lid + (0.0, half[1] - 5.0), lid[::-1] * (1.0, -1.0) - (0.0, half[1] - 5.0)]
            )
            axes.plot(*(at + lid - (0.0, half[1] - 5.0)).T, color=INK, linewidth=1.2 * unit, zorder=3.5)
        case "sphere":
            outline = half * np.stack([np.cos(2.0 * angle), np.sin(2.0 * angle)], axis=-1)
        case _:
            outline = half * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    unsupported = not graph.supporters(item.id)
    colour = object_colour(item.label)
    stability = graph.stability.get(item.id)
    remarks = [f"{item.id}: {item.shape.kind}, found in {item.occurrences} of {item.opportunities} views"]
    remarks += ["nothing is known to support it"] if unsupported else []
    remarks += ["looks unstable"] if stability is not None and not stability.stable else []
    rim = {"edgecolor": DOUBT, "linewidth": 2.4 * unit, "linestyle": (0, (2.1, 1.5))}
    if not unsupported:
        rim = {"edgecolor": INK, "linewidth": 1.2 * unit}
    stripes = "".join({1: "//", -1: "\\\\"}[direction] for direction in object_stripes(item.label))
    axes.add_artist(
        PathPatch(
            Path(np.concatenate([outline, outline[:1]]) + at, closed=True), facecolor=colour,
            hatch=stripes or None, hatchcolor=(1.0, 1.0, 1.0, 0.5), zorder=3.0,
            gid=f"node {item.id}{' unsupported' if unsupported else ''}|{'; '.join(remarks)}", **rim,
        )
    )  # fmt: skip
    centred: dict[str, Any] = {
        "color": ink_on(colour),
        "ha": "center",
        "va": "center_baseline",
        "zorder": 4.0,
    }
    axes.text(at[0], at[1] - 3.0, item.id, fontsize=13.0 * unit, fontweight="bold", **centred)
    axes.text(at[0], at[1] + 11.0, f"{item.occurrences}/{item.opportunities}", fontsize=9.5 * unit, **centred)


def _draw_table(axes: Axes, item: SceneObject, width: float, floor: float, unit: float) -> None:
    from matplotlib.patches import Rectangle as Plate

    colour = object_colour(item.label)
    plate = Plate(
        (12.0, floor - NODE[1] / 2.0), width - 24.0, 0.7 * NODE[1], facecolor=colour, edgecolor=INK,
        linewidth=1.2 * unit, gid=f"node {item.id} surface|{item.id}: the support surface",
    )  # fmt: skip
    axes.add_artist(plate)
    axes.text(
        width / 2.0, floor - 0.15 * NODE[1], f"{item.id} · support surface", fontsize=13.0 * unit,
        fontweight="bold", color="#111111", ha="center", va="center_baseline",
    )  # fmt: skip
