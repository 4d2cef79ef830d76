"""The next best view, and the robot's posture there."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from caryatid.errors import PlanningError
from caryatid.exploration import reachable_views
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array
from caryatid.io.json_files import Numbers
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision
from caryatid.robots import Robot
from caryatid.robots.floor import STEP, FloorGrid
from caryatid.robots.protocol import straight_lengths
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import ViewSphere


@dataclass(frozen=True, eq=False, slots=True)
class NextView:
    """The next best view.

    Attributes:
        number: Number of the next view, from 0.
        decision: Pose, waypoints (none with given candidates), expected gain, cost and reason.
        stop: Why another view may not be worth its path, or None.
    """

    number: int
    decision: Decision
    stop: str | None

    def to_json(self) -> dict[str, Any]:
        """Return the answer of `caryatid session next` and of the service."""
        d = self.decision
        waypoints = [posture.to_json() for posture in d.waypoints]
        there = waypoints[-1] if waypoints else dict.fromkeys(("platform", "camera_height", "gaze", "joints"))
        return {
            "view": self.number,
            "T_world_camera": d.T_world_camera.tolist(),
            "candidate": d.index,
            **there,
            "waypoints": waypoints,
            "expected_gain": d.saliency,
            "cost": d.cost,
            "score": d.score,
            "why": d.why,
            "stop": self.stop,
        }


REFUSED = "the robot cannot go there"
"""Reason to reject a view that a client refuses."""


@dataclass(frozen=True, eq=False)
class CandidateViews:
    """Views that a robot can reach, or cannot: candidates.json.

    Attributes:
        T_world_camera: Camera poses (N, 4, 4) [m] to choose from; OpenCV camera frame, world z up. Null for
            those that the session's robot reaches.
        path_length: Path length (N,) [m] to each, or null for straight lines.
        refused: Camera poses (M, 4, 4) [m] to which the robot cannot go after all, or null for none.
    """

    T_world_camera: Annotated[Array, Numbers(-1, 4, 4)] | None = None
    path_length: Annotated[Array, Numbers(-1)] | None = None
    refused: Annotated[Array, Numbers(-1, 4, 4)] | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of `Session.next`."""
        refused = () if self.refused is None else self.refused
        return {"candidates": self.T_world_camera, "path_length": self.path_length, "refused": refused}


def table_floor(scene: Scene) -> FloorGrid:
    """The floor around the table of a scene; the area under the table top is blocked."""
    assert scene.surface is not None
    assert scene.sphere is not None
    shape = scene.surface.shape
    top = float(scene.surface.point_world[2])
    T_world_box = transforms.rigid(shape.T_world_object[:3, :3], (*shape.T_world_object[:2, 3], top / 2.0))
    extents = np.array([*shape.extents[:2], max(abs(top), 2.0 * STEP)])
    box = Box(T_world_box, extents)
    return FloorGrid.from_boxes([box], scene.config.robot, scene.sphere.centre_world[:2])


def reached_candidates(robot: Robot, T_world_camera: Array, sphere: ViewSphere) -> Candidates:
    """Views that a robot can reach from its camera pose (4, 4), with or without its roll.

    If the robot cannot hold that pose, paths are straight lines.
    """
    for T in (T_world_camera, transforms.look_at(T_world_camera[:3, 3], sphere.centre_world)):
        with suppress(PlanningError):
            robot.move_to(T)
            return reachable_views(robot, sphere)
    found = reachable_views(robot, sphere)
    return found.from_elsewhere(straight_lengths(T_world_camera, found.T_world_camera))
