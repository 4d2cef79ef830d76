"""How scenes, steps, graphs and shapes show themselves in a notebook.

Jupyter asks the value at the end of a cell for its `_repr_html_`; the classes answer with `draw_cell`. A cell
is small, loads nothing, runs no script, and takes its colours from the page around it, light or dark.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.exploration import Step
from caryatid.geometry.shapes import Cylinder, Shape, Sphere
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.manipulation.order import Order
from caryatid.planning.decision import Decision
from caryatid.scene import Scene
from caryatid.sensing.views import Cloud, View
from caryatid.viz.colours import NOTHING_COLOUR, object_colour
from caryatid.viz.drawings import Picture, draw_cloud, draw_image, draw_solid, picture_svg
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.report import sensor_azimuth, template
from caryatid.viz.tables import Table, census, object_table, order_table, point_table, size_of, support_table

IMAGE_WIDTH = 320
"""Width a camera's image is reduced to [px]; smaller than in the report."""


@dataclass(frozen=True, slots=True)
class Cell:
    """All a notebook shows of one object.

    Attributes:
        title: What it is.
        lead: The rest of the first line.
        note: A sentence below it.
        facts: Names and values.
        pictures: Pictures and their captions, side by side.
        tables: Tables, one below the other.
        colour: Colour of the chip before the title, `#rrggbb`, or empty.
    """

    title: str
    lead: str = ""
    note: str = ""
    facts: tuple[tuple[str, str], ...] = ()
    pictures: tuple[tuple[Picture, str], ...] = ()
    tables: tuple[Table, ...] = ()
    colour: str = ""


def draw_cell(shown: object) -> str:
    """Write what a notebook shows of an object as HTML.

    Args:
        shown: A `Scene`, `Step`, `SupportGraph`, `SceneObject`, shape, `View`, `Cloud`, `Decision` or
            `Order`.

    Raises:
        TypeError: There is no cell for this kind of object.
    """
    return template("cell.html.jinja").render(cell=_cell(shown), svg=picture_svg)


@singledispatch
def _cell(shown: object) -> Cell:
    raise TypeError(f"a {type(shown).__name__} has no cell of its own")


@_cell.register
def _of_scene(scene: Scene) -> Cell:
    if scene.views == 0:
        return Cell("Scene", "nothing has been seen yet", note="update(view) takes in a first view.")
    graph = scene.graph
    count = f"{scene.views} view{'s' * (scene.views > 1)}, {len(scene.cloud):,} points"
    pictures = (_graph(graph), _cloud(scene.cloud, graph, scene.T_world_camera))
    tables = (object_table(graph), support_table(graph))
    return Cell("Scene", f"{count}, {census(graph)}", pictures=pictures, tables=tables)


@_cell.register
def _of_step(step: Step) -> Cell:
    pictures: tuple[tuple[Picture, str], ...] = ()
    if step.view is not None:
        pictures = (_image(step.view, step.labels, step.graph, "segments and fitted shapes"),)
    travelled = f"{np.degrees(step.angle_travelled):.0f}° and {step.path_travelled:.1f} m travelled"
    return Cell(
        f"View {step.index}",
        f"{census(step.graph)}; {travelled}",
        note=f"Next: {step.decision.why}" if step.decision is not None else f"Stopped: {step.stop}",
        pictures=(*pictures, _graph(step.graph)),
        tables=(object_table(step.graph), support_table(step.graph), point_table(step.decision)),
    )


@_cell.register
def _of_graph(graph: SupportGraph) -> Cell:
    pictures = (_graph(graph),) if graph.objects else ()
    return Cell(
        "SupportGraph", census(graph), pictures=pictures, tables=(object_table(graph), support_table(graph))
    )


@_cell.register
def _of_object(item: SceneObject) -> Cell:
    cell = _of_shape(item.shape)
    facts = [("found in", f"{item.occurrences} of {item.opportunities} views")]
    facts += [("residual", f"{1e3 * item.residual:.1f} mm{', a poor fit' if item.poor_fit else ''}")]
    facts += [("why", item.why)] if item.why else []
    facts += [("doubtful", item.doubt)] if item.doubt else []
    lead = "support surface" if item.role == "support_surface" else cell.title.lower()
    colour = object_colour(item.label)
    pictures = ((draw_solid(item.shape, colour), ""),)
    return Cell(item.id, lead, facts=(*cell.facts, *facts), pictures=pictures, colour=colour)


@_cell.register(Shape)
def _of_shape(shape: Shape) -> Cell:
    x, y, z = shape.T_world_object[:3, 3]
    facts = [("size", f"{size_of(shape)} mm"), ("centre", f"{x:.3f}, {y:.3f}, {z:.3f} m")]
    if not isinstance(shape, Sphere):
        vertical = np.abs(shape.T_world_object[2, :3])
        upright = vertical[2] if isinstance(shape, Cylinder) else vertical.max()
        facts.append(("leans", f"{np.degrees(np.arccos(min(upright, 1.0))):.0f}° off the vertical"))
    facts.append(("volume", f"{1e6 * shape.volume:,.0f} cm³"))
    return Cell(type(shape).__name__, facts=tuple(facts), pictures=((draw_solid(shape, NOTHING_COLOUR), ""),))


@_cell.register
def _of_view(view: View) -> Cell:
    height, width = view.depth.shape
    labels = np.zeros(view.depth.shape, dtype=np.int32) if view.labels is None else view.labels
    depth = view.depth[view.valid]
    readings = "none"
    if depth.size:
        near, far = np.percentile(depth, (1.0, 99.0))
        readings = f"{view.valid.mean():.0%} of the pixels, {near:.2f} to {far:.2f} m"
    facts = (
        ("size", f"{width} × {height} px"),
        ("readings", readings),
        ("colour", "yes" if view.rgb is not None else "none"),
        ("labels", "none" if view.labels is None else f"{len(np.unique(labels[labels > 0]))} objects"),
        ("camera", _pose(view.T_world_camera)),
        ("focal length", f"{view.K[0, 0]:.1f} px"),
    )
    caption = "segments" if view.rgb is not None else "depth: near is bright"
    return Cell("View", view.name, facts=facts, pictures=(_image(view, labels, SupportGraph(), caption),))


@_cell.register
def _of_cloud(cloud: Cloud) -> Cell:
    pictures = (_cloud(cloud, SupportGraph(), None),) if len(cloud) else ()
    return Cell("Cloud", f"{cloud.name}, {len(cloud):,} points", pictures=pictures)


@_cell.register
def _of_decision(decision: Decision) -> Cell:
    facts = (
        ("camera", _pose(decision.T_world_camera)),
        ("saliency", f"{decision.saliency:.3f}"),
        ("path cost", f"{decision.cost:.3f}"),
        ("score", f"{decision.score:.3f}"),
    )
    return Cell("Decision", decision.why, facts=facts, tables=(point_table(decision),))


@_cell.register
def _of_order(order: Order) -> Cell:
    count = len(order.steps)
    lead = f"{count} object{'s' * (count != 1)} to take, {'safe' if order.safe else 'not safe'}"
    return Cell("Order", lead, note=order.refusal, tables=(order_table(order),))


def _graph(graph: SupportGraph) -> tuple[Picture, str]:
    return draw_graph(graph), "supporter → supported; dashed: uncertain"


def _cloud(cloud: Cloud, graph: SupportGraph, T_world_camera: Array | None) -> tuple[Picture, str]:
    picture = draw_cloud(cloud, graph, sensor_azimuth(cloud, T_world_camera))
    return picture, "the points, with the shapes fitted to them" if graph.objects else "the points"


def _image(view: View, labels: NDArray[np.int32], graph: SupportGraph, caption: str) -> tuple[Picture, str]:
    """A view as small as it is shown, so that it is drawn in a quarter of the time."""
    step = max(1, round(view.depth.shape[1] / IMAGE_WIDTH))
    height, width = (n // step * step for n in view.depth.shape)
    small = View(
        depth=view.depth[:height:step, :width:step],
        K=np.diag([1.0 / step, 1.0 / step, 1.0]) @ view.K,
        T_world_camera=view.T_world_camera,
        rgb=None if view.rgb is None else np.asarray(Image.fromarray(view.rgb[:height, :width]).reduce(step)),
        name=view.name,
    )
    return draw_image(small, labels[:height:step, :width:step], graph, IMAGE_WIDTH), caption


def _pose(T_world_camera: Array | None) -> str:
    """Say where a camera is and how far it looks down from its pose (4, 4), or that this is not known."""
    if T_world_camera is None:
        return "pose not known"
    x, y, z = T_world_camera[:3, 3]
    down = np.degrees(np.arcsin(np.clip(-T_world_camera[2, 2], -1.0, 1.0)))
    return f"at {x:.2f}, {y:.2f}, {z:.2f} m, looking {down:.0f}° down".replace("-", "−")
