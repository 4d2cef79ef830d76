"""The support graph drawn: layers in the order of support, few crossings, even spacing.

networkx' `multipartite_layout` ignores edges: on the shared scenes it draws some forty crossings and
ten edges through vertices, where this draws none.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from dataclasses import replace
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np

from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.viz.colours import ink_on, object_colour, object_stripes
from caryatid.viz.pictures import DOUBT, INK, WRONG, Picture, keep_apart

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Place = tuple[float, float]
"""Across, in vertices' widths from the leftmost, and layer, 0 is the table's."""
Pair = tuple[str, str]


def arrange(graph: SupportGraph) -> tuple[dict[str, Place], dict[Pair, list[Place]]]:
    """Lay out a support graph: each object above what supports it, the table alone on the lowest layer.

    Long edges bend around the vertices of the layers they pass; vertices are ordered by the mean of their
    neighbours (fewer crossings) and spaced as near to it as their width allows.

    Returns:
        The place of each object by its id; and of each edge (supporter, supported) the places it passes, one
        on each layer, from supporter to supported.
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
    rows: list[list[Hashable]] = [[] for _ in range(max(layer.values(), default=-1) + 1)]
    for name, level in layer.items():
        rows[level].append(name)
    x = _abscissae(rows, joined, None if graph.support_surface is None else graph.support_surface.id)
    left = min(x.values(), default=0.0)
    at = {name: (x[name] - left, float(level)) for name, level in layer.items()}
    routes = {pair: [at[name] for name in chain] for pair, chain in chains.items()}
    return {o.id: at[o.id] for o in graph.objects}, routes


def layers(graph: SupportGraph) -> dict[str, int]:
    """Layer of each object in the support order: 0 for the table, else one more than its highest supporter.

    Edges count in the order bottom-up, doubtful bottom-up, lean, top-down (reversed, because what
    presses from above lies higher); one that would close a cycle is left out.
    """
    order = nx.DiGraph()
    order.add_nodes_from(o.id for o in graph.objects)
    rank = {"bottom-up": 0, "lean": 2, "top-down": 3}
    pairs = [
        support.pair[::-1] if support.kind == "top-down" else support.pair
        for support in sorted(graph.supports, key=lambda s: rank[s.kind] + s.doubtful)
    ]
    if graph.support_surface is not None:
        table = graph.support_surface.id
        pairs += [(table, o.id) for o in graph.objects if o.id != table]
    for below, above in pairs:
        if not nx.has_path(order, above, below):
            order.add_edge(below, above)
    return {name: k for k, names in enumerate(nx.topological_generations(order)) for name in names}


def _abscissae(
    rows: Sequence[Sequence[Hashable]], joined: nx.Graph[Hashable], table: str | None
) -> dict[Hashable, float]:
    """Return x of each name: rows ordered by their neighbours' means, spaced as wide as their vertices.

    The table draws the others to the middle and stays there.
    """
    from scipy.optimize import isotonic_regression

    x = {name: k - (len(row) - 1) / 2.0 for row in rows for k, name in enumerate(row)}
    for sweep in range(24):  # Rounds in which vertices move towards their neighbours.
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

PITCH, NODE = np.array([78.0, -110.0]), np.array([56.0, 40.0])
"""From vertex to vertex within a layer, and from layer to layer; width and height of a vertex [px]."""


def draw_graph(
    graph: SupportGraph,
    wrong: Collection[Sequence[str]] = (),
    missing: Collection[Sequence[str]] = (),
    *,
    compact: bool = False,
) -> Picture:
    """Draw the support graph: the table below, what it carries above it, doubt in dashes.

    Edges run from supporter to supported and carry their probability, the thicker the higher it is; doubtful
    ones are dashed, leaning and top-down ones say so. Vertices have the shape of their primitive, and a
    dashed rim where nothing is known to support them.

    Args:
        graph: What to draw.
        wrong: Pairs of ids of its supports that the ground truth does not have; they are marked.
        missing: Pairs of ids of supports that it lacks; those between its objects are drawn too.
        compact: Draw it for a narrow panel, whose letters would otherwise be small.
    """
    pitch, least = (PITCH * (1.0, 0.75), 420.0) if compact else (PITCH, 560.0)
    ids, known = {o.id for o in graph.objects}, {s.pair for s in graph.supports}
    lacking = [Support(a, b, probability=0.0) for a, b in missing if {a, b} <= ids and (a, b) not in known]
    graph = replace(graph, supports=(*graph.supports, *lacking))
    marks = dict.fromkeys(map(tuple, wrong), "wrong ") | dict.fromkeys([s.pair for s in lacking], "missing")
    places, routes = arrange(graph)
    passed = [*places.values(), *chain.from_iterable(routes.values()), (0.0, 0.0)]
    span, tall = np.max(passed, axis=0) * pitch * (1.0, -1.0) + (92.0, 76.0)
    width = max(span, least)  # In less space the letters of small graphs grow too large.
    height = max(tall, 0.73 * min(width, least))
    corner = np.array([(width - span) / 2.0 + 46.0, (height + tall) / 2.0 - 30.0])
    table = None if graph.support_surface is None else graph.support_surface.id
    edges, notes, words = [], [], []
    for support in graph.supports:
        points = corner + pitch * routes[support.pair]
        if support.pair[::-1] in routes:
            points[:, 0] += 8.0 * np.sign(points[0, 1] - points[-1, 1])  # Beside the edge that leads back.
        edges.append(_from_rim_to_rim(points, support, table))
        notes.append(edges[-1][-2:].mean(axis=0))
        kind = "" if support.kind == "bottom-up" else f"{support.kind} "
        mark = marks.get(support.pair, "")
        words.append(mark if mark == "missing" else f"{mark}{kind}{support.belief:.2f}")
    plates = np.array([[7.4 * len(word) + 4.0, 16.0] for word in words]).reshape(-1, 2)
    plates_at = keep_apart(np.reshape(notes, (-1, 2)), plates, np.array([width, height]))

    def draw(axes: Axes) -> None:
        for support, points, word, place in zip(graph.supports, edges, words, plates_at, strict=True):
            line = _line_beside(points, plates_at, plates)
            _put_edge(axes, support, line, word, place, marked=support.pair in marks)
        for item in graph.objects:
            at, half = corner + pitch * places[item.id], NODE / 2.0
            if item.id == table:
                at, half = np.array([width / 2.0, at[1] - 6.0]), np.array([width / 2.0 - 12.0, 14.0])
            _put_node(axes, item, at, half, graph)

    return Picture("support graph, from the support surface upwards", width, height, draw)


def _from_rim_to_rim(points: Array, support: Support, table: str | None) -> Array:
    """The points (N, 2) of an edge, its ends moved to the rims of its vertices, towards where it comes from.

    It meets the table right below its neighbour.
    """
    points, most = points.copy(), NODE[0] / 2.0 - 8.0
    for end, other, vertex in ((0, 1, support.supporter), (-1, -2, support.supported)):
        across, along = points[other] - points[end]
        points[end] += (across if vertex == table else np.clip(0.2 * across, -most, most), 0.0)
        points[end, 1] += np.sign(along) * (NODE[1] / 2.0 + 2.0)
    return points


def _line_beside(points: Array, centres: Array, sizes: Array) -> tuple[Array, Array]:
    """A line that passes its points (N, 2) upright, with a gap at each note, as nothing is painted behind it.

    Args:
        points: Where it passes [px].
        centres: Centres (E, 2) of the notes of all edges [px].
        sizes: Their widths and heights (E, 2) [px].

    Returns:
        The rest of the line (M, 2), and whether each of its points begins a new piece (M,).
    """
    t = np.linspace(0.0, 1.0, 49)[:, None]
    ease = np.hstack(
        [t * t * (3.0 - 2.0 * t), t**3 + 1.5 * t * (1.0 - t)]
    )  # a cubic Bézier, level in between
    line = np.concatenate([points[:1], *(a + (b - a) * ease[1:] for a, b in pairwise(points))])
    beside = np.any(np.abs(line[:, None] - centres) > sizes / 2.0, axis=2)
    hidden = ~np.all(beside, axis=1)
    shown = ~hidden & (np.linalg.norm(line - line[-1], axis=1) > 12.0)  # the head needs a straight end
    shown[-1] = True
    gaps = np.cumsum(hidden)[shown]
    return line[shown], np.diff(gaps, prepend=-1) > 0


def _put_edge(
    axes: Axes, support: Support, line: tuple[Array, Array], word: str, place: Array, *, marked: bool
) -> None:
    """An arrow along a line, with its note."""
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path

    colour = WRONG if marked else DOUBT if support.doubtful else INK
    solid = not support.doubtful
    title = f"{support.supporter} supports {support.supported}: {support.why}".rstrip(": ")
    kind = f"edge {support.supporter} {support.supported} {'doubtful' if support.doubtful else 'sure'}"
    vertices, begins = line
    curve = Path(vertices, np.where(begins, Path.MOVETO, Path.LINETO))
    width = max(1.4 if marked else 0.6, 2.4 * support.belief)
    arrow = FancyArrowPatch(
        path=curve, arrowstyle="-|>,head_length=0.5,head_width=0.22", mutation_scale=20.0, color=colour,
        linewidth=width, linestyle="-" if solid else (0, (3.5, 2.6)), gid=f"{kind}|{title}",
    )  # fmt: skip
    axes.add_artist(arrow)
    axes.text(place[0], place[1], word, color=colour, fontsize=12.0, ha="center", va="center_baseline")


def _put_node(axes: Axes, item: SceneObject, at: Array, half: Array, graph: SupportGraph) -> None:
    """A vertex of half a width and height [px]; the table has no evidence and no supporter."""
    angle, table = np.linspace(0.0, np.pi, 24), item.role == "support_surface"
    outline = half * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    if item.shape.kind == "cylinder":
        lid = half * np.stack([np.cos(angle), 0.25 * np.sin(angle)], axis=-1)
        middle = np.array([0.0, half[1] - 5.0])
        outline = np.concatenate([lid + middle, lid[::-1] * (1.0, -1.0) - middle])
        axes.plot(*(at + lid - middle).T, color=INK, linewidth=1.2, zorder=3.5)
    elif item.shape.kind == "sphere":
        outline = half * np.stack([np.cos(2.0 * angle), np.sin(2.0 * angle)], axis=-1)
    elif item.shape.kind == "solid":  # a box without its corners
        outline = np.repeat(outline, 2, axis=0)
        outline[[1, 2, 5, 6], 0] *= 0.75
        outline[[0, 3, 4, 7], 1] *= 0.65
    kind, rim = f"node {item.id}", {"edgecolor": INK, "linewidth": 1.2}
    if not table and not graph.supporters(item.id):
        kind += " unsupported"
        rim = {"edgecolor": DOUBT, "linewidth": 2.4, "linestyle": (0, (2.1, 1.5))}
    colour = object_colour(item.label)
    stripes = "".join({1: "//", -1: "\\\\"}[turn] for turn in object_stripes(item.label))
    axes.fill(
        *(outline + at).T, facecolor=colour, hatch=stripes or None, hatchcolor=(1, 1, 1, 0.5), zorder=3.0,
        gid=f"{kind}|{item.id}: {item.shape.kind}", **rim,
    )  # fmt: skip
    text: dict[str, Any] = {"color": ink_on(colour), "ha": "center", "va": "center_baseline", "zorder": 4.0}
    name, rise = (f"{item.id} · support surface", 0.0) if table else (item.id, 3.0)
    axes.text(at[0], at[1] - rise, name, fontsize=13.0, fontweight="bold", **text)
    if not table:
        axes.text(at[0], at[1] + 11.0, f"{item.occurrences}/{item.opportunities}", fontsize=9.5, **text)
