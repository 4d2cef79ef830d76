"""How scenes, steps, graphs and shapes show themselves in a notebook.

Jupyter asks the value at the end of a cell for its `_repr_html_`; the classes answer with `draw_cell`. A cell
is small, loads nothing, runs no script, and takes its colours from the page around it, light or dark.
"""

from __future__ import annotations

from functools import singledispatch

import numpy as np
from numpy.typing import NDArray

from caryatid.exploration import Step
from caryatid.geometry.shapes import Cylinder, Shape, Sphere
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.manipulation.order import Order
from caryatid.planning.decision import Decision
from caryatid.scene import Scene
from caryatid.sensing.views import Cloud, View
from caryatid.viz.colours import object_colour
from caryatid.viz.drawings import draw_cloud, draw_image, draw_solid
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.pictures import picture_svg
from caryatid.viz.report import Figure, Section, sensor_azimuth, template
from caryatid.viz.tables import (
    census,
    count_of,
    object_table,
    order_table,
    point_table,
    size_of,
    support_table,
)


def draw_cell(shown: object) -> str:
    """Write what a notebook shows of an object as HTML.

    Args:
        shown: A `Scene`, `Step`, `SupportGraph`, `SceneObject`, shape, `View`, `Cloud`, `Decision` or
            `Order`.

    Raises:
        TypeError: There is no cell for this kind of object.
    """
    return cell_html(_cell_of(shown))


def cell_html(section: Section) -> str:
    """Write a section as one piece of HTML for a notebook or the viewer; every text in it is escaped."""
    return template("cell.html.jinja").render(cell=section, svg=picture_svg)


@singledispatch
def _cell_of(shown: object) -> Section:
    raise TypeError(f"a {type(shown).__name__} has no cell of its own")


@_cell_of.register
def _of_scene(scene: Scene) -> Section:
    if scene.views == 0:
        return Section("Scene", "nothing has been seen yet; update(view) takes in a first view.")
    lead = f"{count_of(scene.views, 'view')}, {len(scene.cloud):,} points, {census(scene.graph)}"
    figures = (_graph(scene.graph), _cloud(scene.cloud, scene.graph, scene.T_world_camera))
    return Section(
        "Scene", lead, figures=figures, tables=(object_table(scene.graph), support_table(scene.graph))
    )


@_cell_of.register
def _of_step(step: Step) -> Section:
    figures = [_graph(step.graph)]
    if step.view is not None:
        figures.insert(0, _image(step.view, step.labels, step.graph, "segments and fitted shapes"))
    travelled = f"{np.degrees(step.angle_travelled):.0f}° and {step.path_travelled:.1f} m travelled"
    return Section(
        f"View {step.index}",
        f"{census(step.graph)}; {travelled}",
        figures,
        [("next", step.decision.why) if step.decision is not None else ("stopped", f"{step.stop}")],
        tables=(object_table(step.graph), support_table(step.graph), point_table(step.decision)),
    )


@_cell_of.register
def _of_graph(graph: SupportGraph) -> Section:
    figures = (_graph(graph),) if graph.objects else ()
    return Section(
        "SupportGraph", census(graph), figures=figures, tables=(object_table(graph), support_table(graph))
    )


@_cell_of.register
def _of_object(item: SceneObject) -> Section:
    residual = f"{1e3 * item.residual:.1f} mm{', a poor fit' if item.poor_fit else ''}"
    facts = [("found in", f"{item.occurrences} of {item.opportunities} views"), ("residual", residual)]
    facts += [(name, said) for name, said in (("why", item.why), ("doubtful", item.doubt)) if said]
    lead = "support surface" if item.role == "support_surface" else item.shape.kind
    figures = (Figure("", draw_solid(item.shape, item.label)),)
    return Section(item.id, lead, figures, (*_size(item.shape), *facts), colour=object_colour(item.label))


@_cell_of.register(Shape)
def _of_shape(shape: Shape) -> Section:
    return Section(type(shape).__name__, facts=_size(shape), figures=(Figure("", draw_solid(shape)),))


def _size(shape: Shape) -> tuple[tuple[str, str], ...]:
    x, y, z = shape.T_world_object[:3, 3]
    facts = [("size", f"{size_of(shape)} mm"), ("centre", f"{x:.3f}, {y:.3f}, {z:.3f} m")]
    if not isinstance(shape, Sphere):
        vertical = np.abs(shape.T_world_object[2, :3])
        upright = vertical[2] if isinstance(shape, Cylinder) else vertical.max()
        facts.append(("leans", f"{np.degrees(np.arccos(min(upright, 1.0))):.0f}° off the vertical"))
    return (*facts, ("volume", f"{1e6 * shape.volume:,.0f} cm³"))


@_cell_of.register
def _of_view(view: View) -> Section:
    height, width = view.depth.shape
    labels = np.zeros(view.depth.shape, dtype=np.int32) if view.labels is None else view.labels
    readings = "none"
    if view.valid.any():
        near, far = np.percentile(view.depth[view.valid], (1.0, 99.0))
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
    return Section("View", view.name, facts=facts, figures=(_image(view, labels, SupportGraph(), caption),))


@_cell_of.register
def _of_cloud(cloud: Cloud) -> Section:
    figures = (_cloud(cloud, SupportGraph(), None),) if len(cloud) else ()
    return Section("Cloud", f"{cloud.name}, {len(cloud):,} points", figures=figures)


@_cell_of.register
def _of_decision(decision: Decision) -> Section:
    facts = (
        ("camera", _pose(decision.T_world_camera)),
        ("saliency", f"{decision.saliency:.3f}"),
        ("path cost", f"{decision.cost:.3f}"),
        ("score", f"{decision.score:.3f}"),
    )
    return Section("Decision", decision.why, facts=facts, tables=(point_table(decision),))


@_cell_of.register
def _of_order(order: Order) -> Section:
    lead = f"{count_of(len(order.steps), 'object')} to take, {'safe' if order.safe else 'not safe'}"
    return Section(
        "Order", lead, facts=[("refused", order.refusal)] * bool(order.refusal), tables=(order_table(order),)
    )


def _graph(graph: SupportGraph) -> Figure:
    return Figure("", draw_graph(graph), "supporter → supported; dashed: uncertain")


def _cloud(cloud: Cloud, graph: SupportGraph, T_world_camera: Array | None) -> Figure:
    picture = draw_cloud(cloud, graph, sensor_azimuth(cloud, T_world_camera))
    return Figure(
        "", picture, "the points, with the shapes fitted to them" if graph.objects else "the points"
    )


def _image(view: View, labels: NDArray[np.int32], graph: SupportGraph, caption: str) -> Figure:
    return Figure("", draw_image(view, labels, graph, 400), caption)


def _pose(T_world_camera: Array | None) -> str:
    """Say where a camera is and how far it looks down from its pose (4, 4), or that this is not known."""
    if T_world_camera is None:
        return "pose not known"
    x, y, z = T_world_camera[:3, 3]
    down = np.degrees(np.arcsin(np.clip(-T_world_camera[2, 2], -1.0, 1.0)))
    return f"at {x:.2f}, {y:.2f}, {z:.2f} m, looking {down:.0f}° down".replace("-", "−")
