"""What one sees of each stage of the loop: points, shapes, planes of contact, graphs, the view sphere."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib import pyplot as plt
from matplotlib.patches import FancyArrowPatch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree
from solids import Eye, draw_solids

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import SUPPORT_LABEL, Cloud
from caryatid.viz import colours
from caryatid.viz.graph_drawing import arrange

HALO = (patheffects.withStroke(linewidth=3.5, foreground="white"),)
"""Sets letters and lines off from what is behind them."""
CERTAIN, UNCERTAIN = "#3b4252", "#d55e00"
"""Colours of supports."""
PLANE = 0.042
"""Half the side of a separating plane as drawn [m]."""
NORMAL = 0.05
"""Length of its normal as drawn [m]."""
LAYER = 1.0
"""Height of a layer of a graph in widths of a vertex."""
BESIDE = 0.13
"""How far what is written on an edge stands beside it, in the same unit."""
DISC = 370
"""Width and height of the sphere as drawn [px]."""
CORNERS = ((1, 1), (1, -1), (-1, -1), (-1, 1))


def colour_of(item: SceneObject) -> tuple[float, float, float]:
    """The object's colour in all pictures, 0…1."""
    red, green, blue = colours.rgb(colours.object_colour(item.label))
    return red / 255.0, green / 255.0, blue / 255.0


def on_table(graph: SupportGraph) -> list[SceneObject]:
    """All objects but the table."""
    return [o for o in graph.objects if o.role == "object"]


def plate(panel: Any, at: Array, item: SceneObject, size: float = 9.0, unheld: bool = False) -> None:
    """Write an object's id on a plate of its colour, with a dashed rim where nothing is known to hold it."""
    colour = colours.object_colour(item.label)
    rim = {"edgecolor": "#b3301b", "linestyle": "--", "linewidth": 2.0}
    box = {"boxstyle": "round,pad=0.3", "facecolor": colour, "edgecolor": "white", "linewidth": 0.8}
    box |= rim if unheld else {}
    ink = colours.ink_on(colour)
    panel.text(*at, item.id, fontsize=size, color=ink, ha="center", va="center", bbox=box, zorder=6)


def show_points(panel: Any, cloud: Cloud, eye: Eye) -> None:
    """Show the points, each in its object's colour, the nearer ones over those behind them."""
    assert cloud.labels is not None
    pixels = np.rint(eye.project(cloud.points_world)).astype(np.intp)
    towards = eye.T_world_camera[:3, 3] - cloud.points_world
    facing = np.sum(towards * cloud.normals_world, axis=1) > 0.0
    light = 0.55 + 0.45 * np.abs(cloud.normals_world @ transforms.unit(np.array([0.3, -0.5, 1.0])))
    shade = colours.label_colours(cloud.labels) / 255.0 * light[:, None]
    shade = np.where(facing[:, None], shade, 0.35 * shade + 0.65)
    shade[cloud.labels == SUPPORT_LABEL] = 0.82
    image = np.ones((eye.height, eye.width, 3))
    order = np.argsort(-np.linalg.norm(towards, axis=1), kind="stable")
    surface = cloud.labels[order] == SUPPORT_LABEL
    order = np.concatenate([order[surface], order[~surface]])
    for du in (0, 1):
        for dv in (0, 1):
            u, v = pixels[order, 0] + du, pixels[order, 1] + dv
            inside = (u >= 0) & (u < eye.width) & (v >= 0) & (v < eye.height)
            image[v[inside], u[inside]] = shade[order[inside]]
    panel.imshow(image)
    framed(panel, eye)


def show_shapes(panel: Any, objects: Sequence[SceneObject], top: float, eye: Eye, pale: float = 0.0) -> None:
    """Show shapes as solids on the table, washed out by a share of white, each with its id."""
    image, seen = draw_solids([o.shape for o in objects], [colour_of(o) for o in objects], top, eye)
    panel.imshow(image * (1.0 - pale) + pale)
    for position, item in enumerate(objects):
        v, u = np.nonzero(seen == position)
        at = np.array([np.median(u), np.median(v)]) if len(u) else eye.project(item.centre_world[None])[0]
        plate(panel, at, item)
    framed(panel, eye)


def show_planes(panel: Any, supports: Sequence[Support], eye: Eye) -> None:
    """Show the separating planes of supports, each with its normal from the lower object to the upper one."""
    for support in supports:
        if support.contact_world is None or support.normal_world is None:
            continue
        colour = CERTAIN if support.certain else UNCERTAIN
        normal = support.normal_world
        u = transforms.perpendicular(normal)
        v = np.cross(normal, u)
        corners = [support.contact_world + PLANE * (a * u + b * v) for a, b in CORNERS]
        panel.fill(*eye.project(np.array(corners)).T, facecolor=colour, edgecolor=colour, alpha=0.4, zorder=3)
        foot, head = eye.project(np.stack([support.contact_world, support.contact_world + NORMAL * normal]))
        style = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
        panel.annotate("", head, foot, arrowprops=style | {"path_effects": HALO}, zorder=5)
        panel.plot(*foot, "o", color=colour, markersize=3.5, zorder=5)


def show_interest(panel: Any, points: Sequence[PointOfInterest], eye: Eye) -> None:
    """Show points of interest in the colour of their saliency, with the start of their rays to the sphere."""
    for point in sorted(points, key=lambda p: p.saliency):
        foot, head = eye.project(
            np.stack([point.position_world, point.position_world + 0.16 * point.direction])
        )
        colour = colours.saliency_colour(point.saliency)
        panel.plot([foot[0], head[0]], [foot[1], head[1]], color="#2d3748", linewidth=2.6, zorder=3)
        panel.plot([foot[0], head[0]], [foot[1], head[1]], color=colour, linewidth=1.6, zorder=4)
        panel.plot(*foot, "o", color=colour, markersize=7, markeredgecolor="#2d3748", zorder=5)


def framed(panel: Any, eye: Eye) -> None:
    """Give a panel the frame of an eye."""
    panel.set_xlim(0, eye.width)
    panel.set_ylim(eye.height, 0)
    panel.axis("off")


def show_graph(panel: Any, graph: SupportGraph, counts: bool = True) -> None:
    """Draw a support graph: what is not certain dashed, with how often each support was found."""
    layout = arrange(graph)
    place = {name: np.array([x, LAYER * y]) for name, (x, y) in layout.position.items()}
    surface = graph.support_surface
    assert surface is not None
    width = max(layout.width, 1.0)
    ends = {s.pair: (place[s.supporter], place[s.supported]) for s in graph.supports}
    ends |= {p: (np.array([b[0], a[1]]), b) for p, (a, b) in ends.items() if p[0] == surface.id}
    for support in graph.supports:
        a, b = ends[support.pair]
        back = graph.support(support.supported, support.supporter) is not None
        colour = CERTAIN if support.certain else UNCERTAIN
        panel.add_patch(
            FancyArrowPatch(
                (float(a[0]), float(a[1])),
                (float(b[0]), float(b[1])),
                connectionstyle=f"arc3,rad={0.28 if back else 0.0}",
                arrowstyle="-|>,head_length=5,head_width=3",
                linestyle="-" if support.certain else (0, (3, 2)),
                color=colour,
                linewidth=1.7,
                shrinkA=11,
                shrinkB=12,
                zorder=2,
            )
        )
        if counts:
            kind = "" if support.kind == "bottom-up" else f"{support.kind} "
            text = f"{kind}{support.occurrences}/{support.opportunities}"
            others = [line for pair, line in ends.items() if pair != support.pair]
            at, align = _beside(a, b, others, back, 0.075 * len(text))
            panel.text(*at, text, fontsize=7.5, color=colour, ha=align, va="center", zorder=4)
    for item in on_table(graph):
        plate(panel, place[item.id], item, unheld=not graph.supporters(item.id))
    panel.plot([-0.5, width + 0.5], [0, 0], color=colours.SURFACE_COLOUR, linewidth=6, solid_capstyle="round")
    panel.text(width / 2.0, -0.32, f"{surface.id}, the table", fontsize=8, ha="center", va="center")
    panel.set_xlim(-0.8, width + 0.8)
    panel.set_ylim(-0.6, LAYER * (layout.layers - 1) + 0.5)
    panel.axis("off")


def _beside(
    a: Array, b: Array, others: Sequence[tuple[Array, Array]], back: bool, width: float
) -> tuple[Array, str]:
    """Where the text of an edge from a to b goes, away from the others, and if it begins or ends there."""
    middle, along = (a + b) / 2.0, (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    side = np.array([along[1], -along[0]])
    if back:
        at = middle + (BESIDE + 0.14) * side
        return at, "left" if side[0] > 0.0 else "right"
    room = {}
    for sign in (1.0, -1.0):
        centre = middle + sign * np.array([BESIDE + width / 2.0, 0.0])
        room[sign] = min((_distance(centre, *line) for line in others), default=np.inf)
    sign = max(room, key=lambda s: (round(room[s], 2), s))
    return middle + np.array([sign * BESIDE, 0.0]), "left" if sign > 0.0 else "right"


def _distance(point: Array, a: Array, b: Array) -> float:
    """From a point to the line between two others."""
    share = np.clip((point - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-9), 0.0, 1.0)
    return float(np.linalg.norm(point - a - share * (b - a)))


def show_sphere(
    panel: Any,
    sphere: ViewSphere,
    decision: Decision,
    visited: Array,
    reachable: NDArray[np.intp] | None,
    others: Mapping[str, Array] | None = None,
) -> None:
    """Show the upper half of the view sphere from above: zenith in the middle, horizon on the rim.

    Args:
        panel: Where to.
        sphere: The view sphere.
        decision: Gives its saliency and the next view.
        visited: Unit directions (V, 3) of the views so far.
        reachable: Points of the sphere that can be reached; the others are washed out.
        others: Name → direction (3,) of what else is to be marked.
    """
    saliency = decision.sphere_saliency
    assert saliency is not None
    axis = np.linspace(-1.0, 1.0, DISC)
    x, y = np.meshgrid(axis, axis)
    polar, azimuth = np.hypot(x, y) * np.pi / 2.0, np.arctan2(y, x)
    level = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)], axis=-1)
    towards = np.concatenate([level, np.cos(polar)[..., None]], axis=-1)
    nearest = cKDTree(sphere.directions).query(towards)[1]
    shade = colours.scale(saliency, colours.SALIENCY_STOPS) / 255.0
    if reachable is not None:
        outside = ~np.isin(np.arange(len(shade)), reachable)
        grey = np.array(colours.rgb(colours.saliency_colour(0.0))) / 255.0
        shade[outside] = 0.72 * grey + 0.28 * shade[outside]
    image = np.where((polar <= np.pi / 2.0)[..., None], shade[nearest], 1.0)
    panel.imshow(image, extent=(-1.0, 1.0, -1.0, 1.0), origin="lower", interpolation="bilinear")
    for elevation in (0, 30, 60):
        panel.add_patch(_ring((90 - elevation) / 90.0))
        panel.text(
            0, (90 - elevation) / 90.0 + 0.015, f"{elevation}°", fontsize=7, ha="center", color="#4a5568"
        )
    for point in decision.points_of_interest:
        spot = _above(point.direction[None])[0]
        colour = colours.saliency_colour(point.saliency)
        panel.plot(*spot, "o", color=colour, markersize=5, markeredgecolor="#2d3748", zorder=4)
    for number, direction in enumerate(visited):
        _mark(panel, _above(direction[None])[0], str(number + 1), "#2d3748")
    _mark(panel, _above(sphere.direction_of(decision.T_world_camera)[None])[0], "next", "#111111", star=True)
    for name, direction in (others or {}).items():
        _mark(panel, _above(direction[None])[0], name, "#718096")
    panel.set_xlim(-1.1, 1.1)
    panel.set_ylim(-1.1, 1.13)
    panel.set_aspect("equal")
    panel.axis("off")


def _above(directions: Array) -> Array:
    """Where directions (N, 3) are drawn (N, 2), seen from above: x to the right, y up."""
    polar = np.arccos(np.clip(directions[:, 2], -1.0, 1.0)) / (np.pi / 2.0)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    return np.minimum(polar, 1.05)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)


def _ring(radius: float) -> Any:
    from matplotlib.patches import Circle

    return Circle((0, 0), radius, fill=False, edgecolor="#718096", linewidth=0.6, zorder=3)


def _mark(panel: Any, at: Array, text: str, colour: str, star: bool = False) -> None:
    marker, size = ("*", 15) if star else ("o", 8)
    panel.plot(*at, marker, color=colour, markersize=size, markeredgecolor="white", zorder=5)
    style = {"fontsize": 8.5, "fontweight": "bold", "ha": "center", "path_effects": HALO}
    panel.text(at[0], at[1] + 0.09, text, zorder=6, **style)


def png(figure: Any, palette: int | None = None) -> bytes:
    """Write a figure as PNG, of so many colours where a number is given."""
    written, packed = io.BytesIO(), io.BytesIO()
    figure.savefig(written, format="png")
    plt.close(figure)
    image = Image.open(written).convert("RGB")
    if palette is not None:
        image = image.quantize(palette, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    image.save(packed, format="png", optimize=True)
    return packed.getvalue()
