"""What a notebook shows of each kind of object."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.config import ReportConfig
from caryatid.exploration import Step
from caryatid.geometry.shapes import Shape, Sphere
from caryatid.graph import SceneObject, SupportGraph
from caryatid.manipulation.order import Order
from caryatid.planning.decision import Decision
from caryatid.scene import Scene
from caryatid.sensing.views import Cloud, View
from caryatid.viz.cloud import draw_cloud
from caryatid.viz.colours import NOTHING_COLOUR, object_colour
from caryatid.viz.graphs import BESIDE, draw_graph
from caryatid.viz.images import draw_image
from caryatid.viz.layout import arrange
from caryatid.viz.notebook import tables
from caryatid.viz.notebook.cell import Cell, Figure, render
from caryatid.viz.notebook.solids import draw_solid

if TYPE_CHECKING:
    from caryatid.geometry.transforms import Array

SMALL = ReportConfig(image_width=320, cloud_width=480, cloud_points=40_000)
"""Sizes of the report's pictures in a cell: smaller than they are there."""
PICTURE, DRAWING, WIDE, SOLID = 380, 460, 900, 150
"""Widths that pictures, graphs, wide graphs and single shapes take at the most [px]."""


def draw_cell(shown: object) -> str:
    """Write what a notebook shows of an object as HTML.

    Args:
        shown: A `Scene`, `Step`, `SupportGraph`, `SceneObject`, shape, `View`, `Cloud`, `Decision` or
            `Order`.

    Raises:
        TypeError: There is no cell for this kind of object.
    """
    return render(_cell(shown))


@singledispatch
def _cell(shown: object) -> Cell:
    raise TypeError(f"a {type(shown).__name__} has no cell of its own")


@_cell.register
def _of_scene(scene: Scene) -> Cell:
    if scene.views == 0:
        return Cell("Scene", "nothing has been seen yet", note="update(view) takes in a first view.")
    graph = scene.graph
    figures = (_graph(graph), _cloud(scene.cloud, graph, scene.T_world_camera))
    count = f"{scene.views} view{'s' if scene.views > 1 else ''}, {len(scene.cloud):,} points"
    return Cell("Scene", f"{count}, {tables.census(graph)}", figures=figures, tables=tables.of_graph(graph))


@_cell.register
def _of_step(step: Step) -> Cell:
    image = () if step.view is None else (_image(step.view, step.labels, step.graph),)
    figures = (*image, _graph(step.graph))
    note = f"Next: {step.decision.why}" if step.decision is not None else f"Stopped: {step.stop}"
    taken = f"{np.degrees(step.angle_travelled):.0f}° and {step.path_travelled:.1f} m travelled"
    return Cell(
        f"View {step.index + 1}",
        f"{tables.census(step.graph)}; {taken}",
        note=note,
        figures=figures,
        tables=(*tables.of_graph(step.graph), *tables.of_points(step.decision)),
    )


@_cell.register
def _of_graph(graph: SupportGraph) -> Cell:
    figures = (_graph(graph),) if graph.objects else ()
    return Cell("SupportGraph", tables.census(graph), figures=figures, tables=tables.of_graph(graph))


@_cell.register
def _of_object(item: SceneObject) -> Cell:
    cell = _of_shape(item.shape)
    facts = [("found in", f"{item.occurrences} of {item.opportunities} views")]
    facts += [("residual", f"{1e3 * item.residual:.1f} mm{', a poor fit' if item.poor_fit else ''}")]
    facts += [("why", item.why)] if item.why else []
    facts += [("doubtful", item.doubt)] if item.doubt else []
    said = "support surface" if item.role == "support_surface" else cell.title.lower()
    colour = object_colour(item.label)
    return Cell(
        item.id, said, figures=(_solid(item.shape, colour),), facts=(*cell.facts, *facts), colour=colour
    )


@_cell.register(Shape)
def _of_shape(shape: Shape) -> Cell:
    x, y, z = shape.T_world_object[:3, 3]
    facts = [("size", tables.size_of(shape)), ("centre", f"{x:.3f}, {y:.3f}, {z:.3f} m")]
    if not isinstance(shape, Sphere):
        facts.append(("leans", tables.lean_of(shape)))
    facts.append(("volume", f"{1e6 * shape.volume:,.0f} cm³"))
    return Cell(type(shape).__name__, figures=(_solid(shape, NOTHING_COLOUR),), facts=tuple(facts))


@_cell.register
def _of_view(view: View) -> Cell:
    height, width = view.depth.shape
    labels = np.zeros(view.depth.shape, dtype=np.int32) if view.labels is None else view.labels
    return Cell(
        "View",
        view.name,
        figures=(
            _image(view, labels, SupportGraph(), "" if view.rgb is not None else "depth: near is bright"),
        ),
        facts=(
            ("size", f"{width} × {height} px"),
            ("readings", tables.readings_of(view)),
            ("colour", "yes" if view.rgb is not None else "none"),
            ("labels", "none" if view.labels is None else f"{len(np.unique(labels[labels > 0]))} objects"),
            ("camera", tables.pose_of(view.T_world_camera)),
            ("focal length", f"{view.K[0, 0]:.1f} px"),
        ),
    )


@_cell.register
def _of_cloud(cloud: Cloud) -> Cell:
    figures = (_cloud(cloud, SupportGraph(), None),) if len(cloud) else ()
    return Cell("Cloud", f"{cloud.name}, {len(cloud):,} points", figures=figures)


@_cell.register
def _of_decision(decision: Decision) -> Cell:
    facts = (
        ("camera", tables.pose_of(decision.T_world_camera)),
        ("saliency", f"{decision.saliency:.3f}"),
        ("cost of the way", f"{decision.cost:.3f}"),
        ("score", f"{decision.score:.3f}"),
    )
    return Cell("Decision", decision.why, facts=facts, tables=tables.of_points(decision))


@_cell.register
def _of_order(order: Order) -> Cell:
    count = len(order.steps)
    said = f"{count} object{'s' if count != 1 else ''} to take, {'safe' if order.safe else 'not safe'}"
    return Cell("Order", said, note=order.refusal, tables=(tables.of_order(order),))


def _graph(graph: SupportGraph) -> Figure:
    layout = arrange(graph)
    width = WIDE if layout.width > BESIDE else DRAWING
    return Figure(draw_graph(graph, layout), width, "supporter → supported; dashed: uncertain")


def _image(
    view: View, labels: NDArray[np.int32], graph: SupportGraph, caption: str = "parts and fitted shapes"
) -> Figure:
    return Figure(draw_image(*_shrunk(view, labels), graph, SMALL), PICTURE, caption)


def _shrunk(view: View, labels: NDArray[np.int32]) -> tuple[View, NDArray[np.int32]]:
    """A view and its labels as small as they are shown: so they are drawn in a quarter of the time."""
    step = max(1, round(view.depth.shape[1] / SMALL.image_width))
    height, width = (n // step * step for n in view.depth.shape)
    small = View(
        depth=view.depth[:height:step, :width:step],
        K=np.diag([1.0 / step, 1.0 / step, 1.0]) @ view.K,
        T_world_camera=view.T_world_camera,
        rgb=None if view.rgb is None else np.asarray(Image.fromarray(view.rgb[:height, :width]).reduce(step)),
        name=view.name,
    )
    return small, labels[:height:step, :width:step]


def _cloud(cloud: Cloud, graph: SupportGraph, T_world_camera: Array | None) -> Figure:
    """The cloud from the side of the newest view, or of the sensor, or against the world's x."""
    backward = np.array([-1.0, 0.0, 0.0])
    if T_world_camera is not None:
        backward = -T_world_camera[:3, 2]
    elif cloud.viewpoint_world is not None:
        backward = cloud.viewpoint_world - cloud.points_world.mean(axis=0)
    azimuth = float(np.arctan2(backward[1], backward[0]))
    return Figure(
        draw_cloud(cloud, graph, azimuth, SMALL),
        PICTURE,
        "the points, with the shapes fitted to them" if graph.objects else "the points",
    )


def _solid(shape: Shape, colour: str) -> Figure:
    return Figure(draw_solid(shape, colour), SOLID)
