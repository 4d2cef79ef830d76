"""The support graph as a drawing: the table below, what it carries above it, doubt in dashes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.viz import colours, svg
from caryatid.viz.layout import Layout, Pair

COLUMN, ROW = 78.0, 110.0
"""Distance of vertices within a layer, and of layers [px]."""
NODE_WIDTH, NODE_HEIGHT = 56.0, 40.0
"""Size of a vertex [px]."""
STRIPE = 11.0
"""From stripe to stripe of vertices whose colour alone does not tell them from others [px]."""
STRIPE_STYLE = "fill:none;stroke:#fff;stroke-opacity:.5;stroke-width:3.2;stroke-dasharray:none"
"""How they look, whatever other lines of a vertex look like."""
BORDER, BOTTOM = 46.0, 30.0
"""Free space around the outermost vertices' centres, and below the table's [px]."""
LEAST_WIDTH = 560.0
"""Small graphs are drawn in this much space so that their letters do not grow [px]."""
PORT = 13.0
"""Distance of edges that meet the same side of a vertex [px]."""
BESIDE = 7.5
"""Graphs wider than this many vertices are too small to read beside another picture."""
LEAST_ASPECT = 0.73
"""Lowest ratio of height to width, so that the drawing fills its place beside the camera's picture."""
TEXT = 12.0
"""Height of letters [px]."""
TRIES = (0.5, 0.62, 0.38, 0.72, 0.28, 0.8, 0.2)
"""Where along an edge its evidence may be written, the best first."""


def draw_graph(graph: SupportGraph, layout: Layout) -> str:
    """Draw the support graph as SVG.

    Edges run from supporter to supported and carry occurrences/opportunities; uncertain ones are dashed,
    leaning and top-down ones say so. Vertices have the shape of their primitive, and a dashed rim where
    nothing is known to support them.

    Args:
        graph: What to draw.
        layout: Where, from `arrange`.
    """
    span = layout.width * COLUMN + 2.0 * BORDER
    width = max(span, LEAST_WIDTH)
    tall = max(layout.layers - 1, 0) * ROW + BORDER + BOTTOM
    height = tall if layout.width > BESIDE else max(tall, LEAST_ASPECT * width)
    floor = (height + tall) / 2.0 - BOTTOM
    left = (width - span) / 2.0 + BORDER

    def place(x: float, level: float) -> tuple[float, float]:
        return left + x * COLUMN, floor - level * ROW

    centre = {name: place(*at) for name, at in layout.position.items()}
    surface = graph.support_surface
    table = None if surface is None else surface.id
    ports = _ports(graph, layout)
    lines: list[tuple[Support, Array]] = []
    for support in graph.supports:
        if support.pair in layout.route:
            points = np.array([place(*at) for at in layout.route[support.pair]])
            lines.append((support, _trimmed(points, support, table, ports)))
        else:
            lines.append(
                (support, _arc(np.array(centre[support.supporter]), np.array(centre[support.supported])))
            )
    taken = [np.array([*at, NODE_WIDTH, NODE_HEIGHT]) for name, at in centre.items() if name != table]
    drawn = [_edge(support, line, lines, taken) for support, line in lines]
    nodes = [
        _table(o, width, floor) if o.id == table else _node(o, centre[o.id], graph) for o in graph.objects
    ]
    return svg.picture(
        width, height, *(line for line, _ in drawn), *nodes, *(note for _, note in drawn),
        name="support graph, from the support surface upwards", text_size=TEXT,
    )  # fmt: skip


def _ports(graph: SupportGraph, layout: Layout) -> dict[tuple[str, Pair], float]:
    """Where each edge meets its vertices: pixels aside of their middles, in the order the edges come from.

    Edges that meet a vertex from above and from below are spread each on their own.
    """
    meeting: dict[tuple[str, bool], list[tuple[float, Pair]]] = {}
    for pair in (s.pair for s in graph.supports if s.pair in layout.route):
        route = layout.route[pair]
        for name, (_, own), (x, level) in ((pair[0], route[0], route[1]), (pair[1], route[-1], route[-2])):
            meeting.setdefault((name, level > own), []).append((x, pair))
    ports = {}
    for (name, _), ends in meeting.items():
        pitch = min(PORT, (NODE_WIDTH - 10.0) / max(len(ends) - 1, 1))
        for k, (_, pair) in enumerate(sorted(ends)):
            ports[name, pair] = pitch * (k - (len(ends) - 1) / 2.0)
    return ports


def _trimmed(
    points: Array, support: Support, table: str | None, ports: dict[tuple[str, Pair], float]
) -> Array:
    """Let an edge (N, 2) begin and end at the rims of its vertices, and rise straight from the table."""
    line = points.copy()
    line[0, 0] += ports[support.supporter, support.pair]
    line[-1, 0] += ports[support.supported, support.pair]
    if support.supporter == table:
        line[0, 0] = line[1, 0]
    if support.supported == table:
        line[-1, 0] = line[-2, 0]
    down = 1.0 if line[-1, 1] > line[0, 1] else -1.0
    line[0, 1] += down * (NODE_HEIGHT / 2.0 + 1.0)
    line[-1, 1] -= down * (NODE_HEIGHT / 2.0 + 3.0)
    return _smooth(line)


def _smooth(line: Array) -> Array:
    """Round the bends of a line (N, 2): between two stops half a wave, upright at both."""
    share = np.linspace(0.0, 1.0, 17)[:, None]
    wave = 3.0 * share**2 - 2.0 * share**3
    pieces = []
    for a, b in pairwise(line):
        bent = np.concatenate([a[0] + (b[0] - a[0]) * wave, a[1] + (b[1] - a[1]) * share], axis=1)
        straight = a + (b - a) * share
        pieces.append(bent if len(line) > 2 else 0.35 * bent + 0.65 * straight)
    return np.concatenate(pieces)


def _arc(start: Array, end: Array) -> Array:
    """Join two vertices of one layer by an arc over what lies between them."""
    sign = 1.0 if end[0] > start[0] else -1.0
    near = abs(end[0] - start[0]) < 1.5 * COLUMN
    edge = (
        np.array([sign * (NODE_WIDTH / 2.0 + 3.0), 0.0])
        if near
        else np.array([0.0, -NODE_HEIGHT / 2.0 - 3.0])
    )
    a, b = start + edge, end + edge * (-1.0 if near else 1.0)
    rise = np.array([0.0, -8.0 if near else -0.62 * ROW])
    t = np.linspace(0.0, 1.0, 25)[:, None]
    return (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * (a + rise) + 3 * (1 - t) * t**2 * (b + rise) + t**3 * b


def _edge(
    support: Support, line: Array, lines: Sequence[tuple[Support, Array]], taken: list[Array]
) -> tuple[str, str]:
    """Draw one edge with its head; the note on it goes where it covers least, and into `taken`."""
    back = line[-1] - line[-2]
    back = back / max(float(np.linalg.norm(back)), 1e-9)
    across = np.array([-back[1], back[0]])
    head = np.array([line[-1], line[-1] - 10.0 * back + 4.5 * across, line[-1] - 10.0 * back - 4.5 * across])
    kind = "edge" if support.certain else "edge uncertain"
    drawn = svg.element(
        "g",
        svg.tooltip(f"{support.supporter} supports {support.supported}: {support.why}".rstrip(": ")),
        svg.element("path", d=svg.path(line[:-1])),
        svg.element("path", d=svg.path(head, closed=True), class_="head"),
        class_=f"{kind} {support.kind}",
        data_edge=f"{support.supporter} {support.supported}",
    )
    note = f"{support.occurrences}/{support.opportunities}"
    if support.kind != "bottom-up":
        note = f"{support.kind} {note}"
    size = np.array([len(note) * svg.GLYPH_WIDTH * TEXT + 2.0, TEXT + 2.0])
    around = np.concatenate([other for _, other in lines])

    plates = np.array(taken).reshape(-1, 4)

    def covered(at: Array) -> float:
        overlaps = np.clip((size + plates[:, 2:]) / 2 - np.abs(plates[:, :2] - at), 0, size)
        return float(overlaps.prod(axis=1).sum()) + 20.0 * float(
            (np.abs(around - at) < size / 2.0).all(axis=1).sum()
        )

    at = min(_spots(line, size), key=covered)
    taken.append(np.concatenate([at, size]))
    words = svg.text(at[0], at[1] + 0.36 * TEXT, note, class_="note" if support.certain else "note uncertain")
    return drawn, words


def _spots(line: Array, size: Array) -> list[Array]:
    """Places for a note of `size` (2,) beside an edge (N, 2), right and left of it, the best first."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    spots = []
    for share in TRIES:
        at = np.array([np.interp(share * along[-1], along, line[:, k]) for k in range(2)])
        before = np.array([np.interp((share - 0.05) * along[-1], along, line[:, k]) for k in range(2)])
        ahead = (at - before) / max(float(np.linalg.norm(at - before)), 1e-9)
        across = np.array([ahead[1], -ahead[0]]) * (-1.0 if ahead[1] < 0.0 else 1.0)
        clear = float(np.abs(across) @ size) / 2.0 + 4.0
        spots += [at + clear * across, at - clear * across]
    return spots


def _node(item: SceneObject, at: tuple[float, float], graph: SupportGraph) -> str:
    x, y = at
    w, h = NODE_WIDTH, NODE_HEIGHT
    colour = colours.object_colour(item.label)
    unsupported = not graph.supporters(item.id)
    match item.shape.kind:
        case "cylinder":
            start = f"M{x - w / 2:.1f} {y - h / 2 + 5:.1f}a{w / 2} 5 0 0"
            lid, d = f"{start} 0 {w} 0", f"{start} 1 {w} 0v{h - 10}a{w / 2} 5 0 0 1 {-w} 0z"
            body = svg.element("path", d=d) + _stripes(item.label, x, y, (w, h - 18.0))
            body += svg.element("path", d=lid, fill="none")
        case "sphere":
            body = svg.element("ellipse", cx=x, cy=y, rx=w / 2, ry=h / 2)
            body += _stripes(item.label, x, y, (w, h), round_=True)
        case _:
            body = svg.element("rect", x=x - w / 2, y=y - h / 2, width=w, height=h, rx=3)
            body += _stripes(item.label, x, y, (w, h))
    stability = graph.stability.get(item.id)
    remarks = [f"{item.id}: {item.shape.kind}, extracted in {item.occurrences} of {item.opportunities} views"]
    remarks += ["nothing is known to support it"] if unsupported else []
    remarks += ["looks unstable"] if stability is not None and not stability.stable else []
    ink = colours.ink_on(colour)
    return svg.element(
        "g",
        svg.tooltip("; ".join(remarks)),
        body,
        svg.text(x, y + 4.0, item.id, fill=ink, stroke=colour, class_="id"),
        svg.text(
            x, y + 15.5, f"{item.occurrences}/{item.opportunities}", fill=ink, stroke=colour, class_="count"
        ),
        class_="node unsupported" if unsupported else "node",
        fill=colour,
        data_object=item.id,
    )


def _stripes(label: int, x: float, y: float, size: tuple[float, float], round_: bool = False) -> str:
    """Draw the stripes of an object's vertex, a rectangle or an ellipse about (x, y)."""
    import shapely

    directions = colours.object_stripes(label)
    if not directions:
        return ""
    w, h = size
    area = shapely.box(x - w / 2, y - h / 2, x + w / 2, y + h / 2)
    if round_:
        area = shapely.affinity.scale(shapely.Point(x, y).buffer(0.5), w, h)
    reach = w + h
    lines = [
        [(x + shift - d * reach, y + reach), (x + shift + d * reach, y - reach)]
        for d in directions
        for shift in np.arange(-w - h, w + h, STRIPE)
    ]
    parts = shapely.get_parts(shapely.intersection(shapely.MultiLineString(lines), area.buffer(-1.5)))
    data = "".join(svg.path(shapely.get_coordinates(part)) for part in parts)
    return svg.element("path", d=data, class_="stripes", style=STRIPE_STYLE)


def _table(item: SceneObject, width: float, y: float) -> str:
    return svg.element(
        "g",
        svg.tooltip(f"{item.id}: the support surface"),
        svg.element(
            "rect",
            x=12,
            y=y - NODE_HEIGHT / 2,
            width=width - 24,
            height=NODE_HEIGHT * 0.7,
            rx=3,
            class_="top",
        ),
        svg.text(
            width / 2, y - NODE_HEIGHT / 2 + 18.5, f"{item.id} · support surface", fill="#111111", class_="id"
        ),
        class_="node surface",
        fill=colours.object_colour(item.label),
        data_object=item.id,
    )
