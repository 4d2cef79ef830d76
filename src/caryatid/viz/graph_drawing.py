"""The support graph drawn: layers in the order of support, few crossings, even spacing.

networkx' `multipartite_layout` ignores edges: on the shared scenes it draws some forty crossings and
ten edges through vertices, where this draws none.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import replace
from itertools import chain, pairwise
from statistics import fmean
from xml.etree.ElementTree import Element

import networkx as nx
import numpy as np
import shapely

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.viz.colours import ink_on, object_colour, object_stripes
from caryatid.viz.pictures import DOUBT, INK, WRONG, Picture, area, group, keep_apart, line, text

Place = tuple[float, float]
"""Across, in vertices' widths from the leftmost, and layer, 0 is that of support surfaces."""
Pair = tuple[str, str]


def arrange(graph: SupportGraph) -> tuple[dict[str, Place], dict[Pair, list[Place]]]:
    """Lay out a support graph: each object above what supports it, surfaces alone on the lowest layer.

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
    wide = widths(graph)
    x = _abscissae(rows, joined, wide)
    ends = (x[i] - (width - 1.0) / 2.0 for i, width in wide.items())
    left = min((*x.values(), *ends), default=0.0)
    at = {name: (x[name] - left, float(level)) for name, level in layer.items()}
    routes = {pair: [at[name] for name in chain] for pair, chain in chains.items()}
    return {o.id: at[o.id] for o in graph.objects}, routes


def layers(graph: SupportGraph) -> dict[str, int]:
    """Layer of each object in the support order: 0 for surfaces, else one more than its highest supporter.

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
    pairs += [(s.id, o.id) for s in graph.support_surfaces for o in graph.movable]
    for below, above in pairs:
        if not nx.has_path(order, above, below):
            order.add_edge(below, above)
    return {name: k for k, names in enumerate(nx.topological_generations(order)) for name in names}


def widths(graph: SupportGraph) -> dict[str, float]:
    """Width of each support surface, by its id: that of what rests on it; empty if there is only one."""
    surfaces = graph.support_surfaces
    carried = {o.id: sum(s.supporter == o.id for s in graph.supports) for o in surfaces}
    return {i: max(2.4, float(count)) for i, count in carried.items()} if len(surfaces) > 1 else {}


def _abscissae(
    rows: Sequence[Sequence[Hashable]], joined: nx.Graph[Hashable], wide: Mapping[str, float]
) -> dict[Hashable, float]:
    """Return x of each name: rows ordered by their neighbours' means, spaced as wide as their vertices.

    A single vertex on the lowest layer, such as the table, draws the others to the middle and stays there.
    """
    from scipy.optimize import isotonic_regression

    x = {name: k - (len(row) - 1) / 2.0 for row in rows for k, name in enumerate(row)}
    for sweep in range(24):  # Rounds in which vertices move towards their neighbours.
        for row in rows if sweep % 2 == 0 else reversed(rows):
            if not row or (row is rows[0] and len(row) == 1):
                continue
            pull = 0.8 if wide and row is rows[0] else 1.0  # Surfaces move together with what they carry.
            wish = {n: pull * fmean(x[other] for other in joined[n] or [n]) for n in row}
            ordered = sorted(row, key=lambda name: (wish[name], x[name]))
            width = np.array([wide.get(name, 1.0) if isinstance(name, str) else 0.4 for name in ordered])
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
    """Draw the support graph: support surfaces below, what they carry above them, doubt in dashes.

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
    wide = widths(graph)
    passed += [(places[i][0] + (width - 1.0) / 2.0, 0.0) for i, width in wide.items()]
    span, tall = np.max(passed, axis=0) * pitch * (1.0, -1.0) + (92.0, 76.0)
    width = max(span, least)  # In less space the letters of small graphs grow too large.
    height = max(tall, 0.73 * min(width, least))
    corner = np.array([(width - span) / 2.0 + 46.0, (height + tall) / 2.0 - 30.0])
    bars = {i: width * pitch[0] / 2.0 - 11.0 for i, width in wide.items()}
    bars = bars or {o.id: width / 2.0 - 12.0 for o in graph.support_surfaces}
    edges, notes, words = [], [], []
    for support in graph.supports:
        points = corner + pitch * routes[support.pair]
        if support.pair[::-1] in routes:
            points[:, 0] += 8.0 * np.sign(points[0, 1] - points[-1, 1])  # Beside the edge that leads back.
        edges.append(_from_rim_to_rim(points, support, bars))
        notes.append(edges[-1][-2:].mean(axis=0))
        kind = "" if support.kind == "bottom-up" else f"{support.kind} "
        mark = marks.get(support.pair, "")
        words.append(mark if mark == "missing" else f"{mark}{kind}{support.belief:.2f}")
    plates = np.array([[7.4 * len(word) + 4.0, 16.0] for word in words]).reshape(-1, 2)
    plates_at = keep_apart(np.reshape(notes, (-1, 2)), plates, np.array([width, height]))

    parts = []
    for support, points, word, (x, y) in zip(graph.supports, edges, words, plates_at, strict=True):
        colour = WRONG if support.pair in marks else DOUBT if support.doubtful else INK
        thickness = max(1.4 if support.pair in marks else 0.6, 2.4 * support.belief)
        parts.append(_edge(support, _course(points, plates_at, plates), colour, thickness))
        parts.append(text(x, y, word, 12.0, colour))
    for item in graph.objects:
        at, half = corner + pitch * places[item.id], NODE / 2.0
        if item.id in bars:
            middle = at[0] if wide else width / 2.0
            at, half = np.array([middle, at[1] - 6.0]), np.array([bars[item.id], 14.0])
        parts.append(_node(item, at, half, supported=item.id in bars or bool(graph.supporters(item.id))))
    return Picture("support graph, from the support surface upwards", width, height, parts)


def _from_rim_to_rim(points: Array, support: Support, bars: Mapping[str, float]) -> Array:
    """The points (N, 2) of an edge, its ends moved to the rims of its vertices, towards where it comes from.

    It meets a support surface, of half a width [px], right below its neighbour.
    """
    points, most = points.copy(), NODE[0] / 2.0 - 8.0
    for end, other, vertex in ((0, 1, support.supporter), (-1, -2, support.supported)):
        across, along = points[other] - points[end]
        half = bars.get(vertex, 0.0) - 8.0
        shift = np.clip(across, -half, half) if vertex in bars else np.clip(0.2 * across, -most, most)
        points[end] += (shift, 0.0)
        points[end, 1] += np.sign(along) * (NODE[1] / 2.0 + 2.0)
    return points


def _course(points: Array, centres: Array, sizes: Array) -> Array:
    """The course (M, 2) of a line that passes points (N, 2) upright, with gaps (NaN) at all notes.

    Nothing is painted behind notes, whose centres and sizes are (E, 2) [px].
    """
    t = np.linspace(0.0, 1.0, 49)[:, None]
    # A cubic Bézier, level in between.
    ease = np.hstack([t * t * (3.0 - 2.0 * t), t**3 + 1.5 * t * (1.0 - t)])
    course = np.concatenate([points[:1], *(a + (b - a) * ease[1:] for a, b in pairwise(points))])
    hidden = np.any(np.all(np.abs(course[:, None] - centres) < sizes / 2.0, axis=2), axis=1)
    return np.where(hidden[:, None], np.nan, course)


def _edge(support: Support, course: Array, colour: str, width: float) -> Element:
    """An arrow along a course; its head needs a straight end."""
    kind = f"edge {support.supporter} {support.supported} {'doubtful' if support.doubtful else 'sure'}"
    title = f"{support.supporter} supports {support.supported}: {support.why}".rstrip(": ")
    tip = course[-1]
    course = course[~(np.linalg.norm(course - tip, axis=1) < 12.0)]
    along = transforms.unit(tip - course[~np.isnan(course[:, 0])][-1])
    neck = tip - 10.0 * along
    head = np.array([tip, neck + 4.4 * along[::-1] * (1.0, -1.0), neck + 4.4 * along[::-1] * (-1.0, 1.0)])
    dashes = f"{3.5 * width:.3g} {2.6 * width:.3g}" if support.doubtful else "none"
    shaft = line(np.vstack([course, neck]), colour, width, stroke_dasharray=dashes, stroke_linecap="butt")
    return group([shaft, area(head, colour)], kind, title)


def _node(item: SceneObject, at: Array, half: Array, *, supported: bool) -> Element:
    """A vertex of half a width and height [px]; a support surface has no evidence."""
    angle, surface = np.linspace(0.0, np.pi, 24), item.role == "support_surface"
    outline = half * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    inner = []
    if item.shape.kind == "cylinder":
        lid = half * np.stack([np.cos(angle), 0.25 * np.sin(angle)], axis=-1)
        middle = np.array([0.0, half[1] - 5.0])
        outline = np.concatenate([lid + middle, lid[::-1] * (1.0, -1.0) - middle])
        inner.append(line(at + lid - middle, INK, 1.2))
    elif item.shape.kind == "sphere":
        outline = half * np.stack([np.cos(2.0 * angle), np.sin(2.0 * angle)], axis=-1)
    elif item.shape.kind == "solid":  # a box without its corners
        outline = np.repeat(outline, 2, axis=0)
        outline[[1, 2, 5, 6], 0] *= 0.75
        outline[[0, 3, 4, 7], 1] *= 0.65
    rise = np.array([(-half[1], half[1]), (half[1], -half[1])])
    for turn in object_stripes(item.label):
        stripes = [rise * (turn, 1.0) + (x, 0.0) for x in np.arange(-80.0, 81.0, 10.0)]
        seen = shapely.intersection(shapely.linestrings(stripes), shapely.polygons(outline))
        inner += [line(at + s.coords, "#ffffff", 1.0, opacity=0.5) for s in seen if not s.is_empty]
    colour, kind, rim = object_colour(item.label), f"node {item.id}", {"stroke": INK, "stroke_width": "1.2"}
    if not supported:
        kind += " unsupported"
        rim = {"stroke": DOUBT, "stroke_width": "2.4", "stroke_dasharray": "5 3.6"}
    name, lift = (f"{item.id} · support surface", 0.0) if surface else (item.id, 4.0)
    words = [text(at[0], at[1] - lift, name, 13.0, ink_on(colour), font_weight="bold")]
    if not surface:
        evidence = f"{item.occurrences}/{item.opportunities}"
        words.append(text(at[0], at[1] + 10.0, evidence, 9.5, ink_on(colour)))
    return group(
        [area(at + outline, colour, **rim), *inner, *words], kind, f"{item.title}: {item.shape.kind}"
    )
