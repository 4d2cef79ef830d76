"""Scenes, steps, graphs and shapes in a notebook.

Jupyter calls `_repr_html_` of the value at the end of a cell; the classes return `draw_cell`. The HTML is
small, loads nothing, runs no script, and takes its colours from the page around it, light or dark.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid.exploration import Step
from caryatid.geometry.shapes import Shape
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
    describe_order,
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


def _cell_of(shown: object) -> Section:
    match shown:
        case Scene(views=0):
            return Section("Scene", "no views yet; call update(view) with a first view.")
        case Scene(graph=graph, cloud=cloud):
            lead = f"{count_of(shown.views, 'view')}, {len(cloud):,} points, {census(graph)}"
            return _graph_cell("Scene", lead, graph, _cloud(cloud, graph, shown.T_world_camera))
        case Step(view=view, graph=graph):
            images = [] if view is None else [_image(view, shown.labels, graph, "segments and fitted shapes")]
            travelled = f"{np.degrees(shown.angle_travelled):.0f}° and {shown.path_travelled:.1f} m travelled"
            cell = _graph_cell(f"View {shown.index + 1}", f"{census(graph)}; {travelled}", graph, *images)
            following = ("stopped", f"{shown.stop}")
            if shown.decision is not None:
                following = ("next", shown.decision.why)
            tables = (*cell.tables, point_table(shown.decision))
            return Section(cell.title, cell.text, cell.figures, [following], tables)
        case SupportGraph():
            return _graph_cell("SupportGraph", census(shown), shown)
        case SceneObject():
            residual = f"{1e3 * shown.residual:.1f} mm{', poor fit' * shown.poor_fit}"
            views = f"{shown.occurrences} of {shown.opportunities} views"
            facts = [*_size(shown.shape), ("found in", views), ("residual", residual)]
            facts += [(name, said) for name, said in (("why", shown.why), ("doubtful", shown.doubt)) if said]
            lead = "support surface" if shown.role == "support_surface" else shown.shape.kind
            solid, colour = Figure("", draw_solid(shown.shape, shown.label)), object_colour(shown.label)
            return Section(shown.title, lead, [solid], facts, colour=colour)
        case Shape():
            return Section(type(shown).__name__, "", [Figure("", draw_solid(shown))], _size(shown))
        case View():
            return _view_cell(shown)
        case Cloud():
            figures = [_cloud(shown, SupportGraph(), None)] if len(shown) else []
            return Section("Cloud", f"{shown.name}, {len(shown):,} points", figures)
        case Decision():
            scores = {"saliency": shown.saliency, "path cost": shown.cost, "score": shown.score}
            facts = [("camera", _pose(shown.T_world_camera))]
            facts += [(name, f"{score:.3f}") for name, score in scores.items()]
            return Section("Decision", shown.why, facts=facts, tables=[point_table(shown)])
        case Order():
            return Section("Order", " ".join(describe_order(shown)), tables=[order_table(shown)])
    raise TypeError(f"a {type(shown).__name__} cannot be shown in a notebook")


def _graph_cell(title: str, lead: str, graph: SupportGraph, *others: Figure) -> Section:
    """A graph and its tables, with other pictures beside it."""
    drawn = Figure("", draw_graph(graph), "supporter → supported, with its probability; dashed: doubtful")
    figures = [drawn, *others] if graph.objects else others
    return Section(title, lead, figures, tables=[object_table(graph), support_table(graph)])


def _size(shape: Shape) -> list[tuple[str, str]]:
    x, y, z = shape.T_world_object[:3, 3]
    place, volume = f"{x:.3f}, {y:.3f}, {z:.3f} m", f"{1e6 * shape.volume:,.0f} cm³"
    return [("size", f"{size_of(shape)} mm"), ("centre", place), ("volume", volume)]


def _view_cell(view: View) -> Section:
    height, width = view.depth.shape
    labels = np.zeros(view.depth.shape, dtype=np.int32) if view.labels is None else view.labels
    readings = "none"
    if view.valid.any():
        near, far = np.percentile(view.depth[view.valid], (1.0, 99.0))
        readings = f"{view.valid.mean():.0%} of the pixels, {near:.2f} to {far:.2f} m"
    facts = [
        ("size", f"{width} × {height} px"),
        ("readings", readings),
        ("labels", "none" if view.labels is None else count_of(len(np.unique(labels[labels > 0])), "object")),
        ("camera", _pose(view.T_world_camera)),
        ("focal length", f"{view.K[0, 0]:.1f} px"),
    ]
    caption = "segments" if view.rgb is not None else "depth: near is bright"
    return Section("View", view.name, [_image(view, labels, SupportGraph(), caption)], facts)


def _cloud(cloud: Cloud, graph: SupportGraph, T_world_camera: Array | None) -> Figure:
    picture = draw_cloud(cloud, graph, sensor_azimuth(cloud, T_world_camera))
    return Figure("", picture, f"points{', with the fitted shapes' * bool(graph.objects)}")


def _image(view: View, labels: NDArray[np.int32], graph: SupportGraph, caption: str) -> Figure:
    return Figure("", draw_image(view, labels, graph, 400), caption)


def _pose(T_world_camera: Array | None) -> str:
    """Where a camera is and how far it looks down, from its pose (4, 4), in words."""
    if T_world_camera is None:
        return "unknown pose"
    x, y, z = T_world_camera[:3, 3]
    down = np.degrees(np.arcsin(np.clip(-T_world_camera[2, 2], -1.0, 1.0)))
    return f"at {x:.2f}, {y:.2f}, {z:.2f} m, looking {down:.0f}° down".replace("-", "−")
