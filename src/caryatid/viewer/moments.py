"""What there is to see after one view: kept small, so that the page can go back to any of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.io.runs import RunView
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import Cloud, View
from caryatid.viz.colours import DEPTH_STOPS, scale

if TYPE_CHECKING:
    from caryatid.exploration import Step
    from caryatid.planning.candidates import Candidates
    from caryatid.planning.decision import Decision
    from caryatid.robots import Posture
    from caryatid.scene import Scene

MOST_POINTS = 1_000_000
"""Points of the fused cloud that are kept at the most, evenly picked."""
PICTURE_WIDTH = 240
"""Width a camera's picture is reduced to, about [px]."""


@dataclass(frozen=True, eq=False, slots=True)
class Dots:
    """The fused cloud as it is drawn.

    Attributes:
        points_world: (N, 3) [m].
        labels: Object each belongs to (N,), 65535 = the support surface, 0 = nothing.
        rgb: (N, 3), or None where a view had no colour.
    """

    points_world: NDArray[np.float32]
    labels: NDArray[np.uint16]
    rgb: NDArray[np.uint8] | None

    def __len__(self) -> int:
        return len(self.points_world)


@dataclass(frozen=True, eq=False, slots=True)
class Shot:
    """A view that was taken.

    Attributes:
        T_world_camera: Where from (4, 4).
        field_of_view: Vertical [rad].
        aspect: Width over height.
        picture: (H, W, 3) reduced in size, or None.
    """

    T_world_camera: Array
    field_of_view: float
    aspect: float
    picture: NDArray[np.uint8] | None


@dataclass(frozen=True, eq=False, slots=True)
class Standing:
    """How a robot stands.

    Attributes:
        posture: Platform, or base of an arm, and gaze.
        T_world_camera: Where its camera is (4, 4).
        platform: Radius of the platform [m].
        arm: It is an arm; then the platform is what it stands on.
    """

    posture: Posture
    T_world_camera: Array
    platform: float
    arm: bool


@dataclass(frozen=True, eq=False, slots=True)
class Moment:
    """What there is to see after one view.

    Attributes:
        index: Number of the view, 0 the first.
        name: The view's name.
        graph: The fused graph.
        dots: The fused cloud, or None where nobody kept it.
        shot: The newest view, or None for a cloud.
        sphere: The view sphere, or None where it is not known.
        visited: Unit directions (V, 3) of the views so far.
        candidates: The views that could be reached next, or None.
        decision: The next view, or None.
        robot: How the robot stands, or None where nobody knows.
        score: F1 of vertices and edges together, or None where the truth is not known.
        stop: Why this is the last view, or None.
        by_hand: The next view was chosen by a person.
        seconds: What the view took, without its capture [s].
    """

    index: int
    name: str
    graph: SupportGraph
    dots: Dots | None = None
    shot: Shot | None = None
    sphere: ViewSphere | None = None
    visited: Array = field(default_factory=lambda: np.zeros((0, 3)))
    candidates: Candidates | None = None
    decision: Decision | None = None
    robot: Standing | None = None
    score: float | None = None
    stop: str | None = None
    by_hand: bool = False
    seconds: float = 0.0

    def going_to(self, decision: Decision | None, *, by_hand: bool = False) -> Moment:
        """Return the moment with another next view."""
        return replace(self, decision=decision, by_hand=by_hand)


def moment_of_step(
    step: Step, *, most_points: int = MOST_POINTS, robot: Standing | None = None, score: float | None = None
) -> Moment:
    """Keep of a step what is drawn.

    Args:
        step: What `explore` yields.
        most_points: Points kept at the most, evenly picked.
        robot: How the robot stands.
        score: F1 where the truth is known.
    """
    return Moment(
        step.index,
        step.name,
        step.graph,
        dots_of(step.cloud, most_points),
        None if step.view is None else shot_of(step.view),
        step.sphere,
        step.visited,
        step.candidates,
        step.decision,
        robot,
        score,
        step.stop,
        seconds=sum(seconds for stage, seconds in step.timings.items() if stage != "capture"),
    )


def moment_of_scene(scene: Scene, *, most_points: int = MOST_POINTS) -> Moment:
    """What a scene knows now; it need not have been explored."""
    visited = np.zeros((0, 3))
    if scene.sphere is not None and scene.T_world_camera is not None:
        visited = scene.sphere.direction_of(scene.T_world_camera)[None]
    name = "nothing seen yet" if scene.views == 0 else f"after {scene.views} views"
    return Moment(
        max(scene.views - 1, 0),
        "after 1 view" if scene.views == 1 else name,
        scene.graph,
        dots_of(scene.cloud, most_points),
        sphere=scene.sphere,
        visited=visited,
    )


def moment_of_run_view(view: RunView, decision: Decision | None, score: float | None) -> Moment:
    """What a run folder says of one view: all but clouds, pictures and saliency."""
    shot = None
    if view.T_world_camera is not None and view.K is not None:
        width, height = 2.0 * view.K[0, 2] + 1.0, 2.0 * view.K[1, 2] + 1.0
        angle = 2.0 * float(np.arctan2(height / 2.0, view.K[1, 1]))
        shot = Shot(view.T_world_camera, angle, width / height, None)
    return Moment(view.index, view.name, view.graph, shot=shot, decision=decision, score=score)


def dots_of(cloud: Cloud, most_points: int) -> Dots:
    """Keep what is drawn of a cloud, `most_points` of it at the most, evenly picked."""
    stride = max(1, -(-len(cloud) // most_points))
    points = cloud.points_world[::stride].astype(np.float32)
    labels = np.zeros(len(points), np.uint16) if cloud.labels is None else cloud.labels[::stride]
    rgb = None if cloud.rgb is None else np.ascontiguousarray(cloud.rgb[::stride])
    return Dots(points, labels.astype(np.uint16), rgb)


def shot_of(view: View) -> Shot | None:
    """Keep a view's pose and its picture, small; without colour its depth; None where it has no pose."""
    if view.T_world_camera is None:
        return None
    height, width = view.depth.shape
    stride = max(1, width // PICTURE_WIDTH)
    if view.rgb is not None:
        picture = view.rgb[::stride, ::stride]
    else:
        depth = view.depth[::stride, ::stride].astype(np.float64)
        ends = np.quantile(depth[depth > 0.0], (0.02, 0.98)) if depth.any() else np.zeros(2)
        picture = scale((depth - ends[0]) / max(float(ends[1] - ends[0]), 1e-6), DEPTH_STOPS)
        picture[depth <= 0.0] = 0
    angle = 2.0 * float(np.arctan2(height / 2.0, view.K[1, 1]))
    return Shot(view.T_world_camera, angle, width / height, np.ascontiguousarray(picture))
