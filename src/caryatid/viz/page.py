"""One view, drawn: from a step, or a model, to the pictures and tables the report shows of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ReportConfig
from caryatid.graph import SupportGraph
from caryatid.sensing.views import Cloud, View
from caryatid.viz.cloud import draw_cloud
from caryatid.viz.graphs import BESIDE, draw_graph
from caryatid.viz.images import draw_image, draw_thumbnail
from caryatid.viz.layout import arrange
from caryatid.viz.rows import (
    ObjectRow,
    PointRow,
    SupportRow,
    object_rows,
    point_rows,
    support_rows,
)
from caryatid.viz.sphere import draw_sphere

if TYPE_CHECKING:
    from caryatid.exploration import Step


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture of the report.

    Attributes:
        kind: What it is of.
        svg: Its markup.
        heading: Its heading.
        caption: What is to be seen in it.
        wide: It takes the whole width of the page.
    """

    kind: Literal["camera", "graph", "cloud", "sphere"]
    svg: str
    heading: str
    caption: str
    wide: bool = False


@dataclass(frozen=True, slots=True)
class ViewPage:
    """One view, drawn: all the report says of it and none of its data.

    Attributes:
        index: Number of the view, from 0.
        name: The view's name, or the cloud's.
        figures: The pictures.
        objects: The table of objects.
        supports: The table of supports.
        points: The table of points of interest.
        choice: Why the next view was chosen, with its figures; empty where none was.
        reason: The same without figures.
        timings: Time of each stage [s].
        angle_travelled: Around the view sphere so far [rad].
        path_travelled: Over the floor so far [m].
        stop: Why the exploration ended here, or None.
        thumbnail: SVG of the view's picture, small, with its parts; empty for a cloud.
    """

    index: int
    name: str
    figures: tuple[Figure, ...]
    objects: tuple[ObjectRow, ...]
    supports: tuple[SupportRow, ...]
    points: tuple[PointRow, ...] = ()
    choice: str = ""
    reason: str = ""
    timings: Mapping[str, float] = field(default_factory=dict)
    angle_travelled: float = 0.0
    path_travelled: float = 0.0
    stop: str | None = None
    thumbnail: str = ""

    @property
    def number(self) -> str:
        """The view's number as its folder in the run has it."""
        return f"{self.index:02d}"


def draw_view(step: Step, config: ReportConfig | None = None) -> ViewPage:
    """Draw one step of an exploration, so that its images and clouds need not be kept.

    Args:
        step: What `explore` yields.
        config: Sizes of the pictures.
    """
    config = config or ReportConfig()
    page = draw_model(
        step.graph,
        step.cloud,
        view=step.view,
        labels=step.labels,
        azimuth=float(np.arctan2(*step.visited[0, 1::-1])) if len(step.visited) else None,
        config=config,
    )
    figures = page.figures
    if step.candidates is not None or step.decision is not None:
        sphere = Figure(
            "sphere", draw_sphere(step, config), "Where to look next", _sphere_caption(step), wide=True
        )
        figures = (*figures, sphere)
    return replace(
        page,
        index=step.index,
        name=step.name,
        figures=figures,
        points=point_rows(step.decision),
        choice=_choice(step),
        reason="" if step.decision is None else step.decision.why,
        timings=dict(step.timings),
        angle_travelled=step.angle_travelled,
        path_travelled=step.path_travelled,
        stop=step.stop,
    )


def draw_model(
    graph: SupportGraph,
    cloud: Cloud,
    *,
    view: View | None = None,
    labels: NDArray[np.int32] | None = None,
    azimuth: float | None = None,
    config: ReportConfig | None = None,
) -> ViewPage:
    """Draw a scene model without any planning: what `extract` finds in a view, or in a cloud.

    Args:
        graph: Objects and supports.
        cloud: The points they were fitted to, labelled.
        view: The newest view, or None for a cloud.
        labels: Label image (H, W) of the view, or None to leave its parts out.
        azimuth: Direction about the vertical from which the cloud is drawn, and from the opposite one [rad];
            None for the side of the sensor.
        config: Sizes of the pictures.
    """
    config = config or ReportConfig()
    figures = []
    thumbnail = ""
    if view is not None:
        parts = np.zeros(view.depth.shape, dtype=np.int32) if labels is None else labels
        kind = "colour image" if view.rgb is not None else "depth image, near bright and far dark"
        caption = (
            f"The {kind} around the objects, tinted by the parts found in it, with the outlines of the "
            "shapes fitted so far. Outlines are thin where something nearer hides them; what a pale name "
            "belongs to has no pixel here."
        )
        drawn = draw_image(view, parts, graph, config)
        thumbnail = draw_thumbnail(view, parts, graph, config)
        figures.append(Figure("camera", drawn, "What the camera saw", caption))
    caption = (
        "Arrows run from supporter to supported; beside them, in how many of the views that could have shown "
        "it the relation was found. Dashed arrows are uncertain; an object with a dashed rim has no known "
        "supporter."
    )
    layout = arrange(graph)
    drawn = draw_graph(graph, layout)
    figures.append(Figure("graph", drawn, "What supports what", caption, wide=bool(layout.width > BESIDE)))
    side_seen = _sensor_azimuth(view, cloud) if azimuth is None else azimuth
    for turn, side in ((0.0, "from the first view's side"), (np.pi, "from the opposite side")):
        drawn = draw_cloud(cloud, graph, side_seen + turn, config)
        caption = (
            f"{len(cloud):,} points fused so far in their objects' colours, with the fitted shapes. "
            "Pale: one looks at the inside of a surface, its other side has not been seen."
        )
        figures.append(Figure("cloud", drawn, f"The cloud {side}", caption))
    name = cloud.name if view is None else view.name
    return ViewPage(0, name, tuple(figures), object_rows(graph), support_rows(graph), thumbnail=thumbnail)


def _sensor_azimuth(view: View | None, cloud: Cloud) -> float:
    """Direction [rad] from the scene to the sensor; where unknown, the world's x runs away from it."""
    if view is not None and view.T_world_camera is not None:
        backward = -view.T_world_camera[:3, 2]
        return float(np.arctan2(backward[1], backward[0]))
    if cloud.viewpoint_world is not None and len(cloud):
        backward = cloud.viewpoint_world - cloud.points_world.mean(axis=0)
        return float(np.arctan2(backward[1], backward[0]))
    return float(np.pi)


def _sphere_caption(step: Step) -> str:
    said = (
        "The view sphere, coloured by saliency; washed out where the robot cannot bring its camera. Rays "
        "lead from points of interest to where they are best seen. Numbers: views made; next: the choice."
    )
    if step.candidates is not None:
        said += f" {len(step.candidates):,} views can be reached"
        refused = ", ".join(f"{count:,} {reason}" for reason, count in step.candidates.rejected.items())
        said += f"; refused: {refused}." if refused else "."
    return said


def _choice(step: Step) -> str:
    if step.decision is None:
        return ""
    d = step.decision
    return (
        f"{d.why.rstrip('.')}. Saliency {d.saliency:.2f}, cost of the way {d.cost:.2f}, score {d.score:.2f}."
    )
