"""Where to look next, and how the robot would stand there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from caryatid.config import Config
from caryatid.errors import InputError, PlanningError
from caryatid.exploration import next_best_view
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.json_files import Numbers, parse_json, read_json
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision
from caryatid.robots import (
    HUMANOID,
    OwnViews,
    Posture,
    Surroundings,
    Unreachable,
    find_robot,
    refusal_of,
    view_sphere_of,
)
from caryatid.robots.floor import STEP, FloorGrid
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import ViewSphere


@dataclass(frozen=True, eq=False, slots=True)
class NextView:
    """Where to look next.

    Attributes:
        number: Which view it would be, 0 the first.
        decision: Pose, expected gain, cost, and why.
        posture: How the session's robot would stand there; None where candidates were given.
        stop: Why another view may not pay, or None.
    """

    number: int
    decision: Decision
    posture: Posture | None
    stop: str | None

    def to_json(self) -> dict[str, Any]:
        """Return the answer of `caryatid session next` and of the service."""
        d, p = self.decision, self.posture
        return {
            "view": self.number,
            "T_world_camera": d.T_world_camera.tolist(),
            "candidate": d.index,
            "platform": None if p is None else [float(x) for x in p.platform_world],
            "camera_height": None if p is None else p.camera_height,
            "gaze": None if p is None else {"yaw": p.head_yaw, "pitch": p.head_pitch},
            "expected_gain": d.saliency,
            "cost": d.cost,
            "score": d.score,
            "why": d.why,
            "stop": self.stop,
        }


def plan_next(
    scene: Scene,
    T_world_cameras: Sequence[Array],
    planner: str,
    candidates: tuple[Array, Array | None] | None,
    stop: str | None,
    robot_name: str = HUMANOID,
) -> NextView:
    """Choose the next view.

    Args:
        scene: What is known, of at least one view.
        T_world_cameras: Where the views so far were taken (4, 4), the last one last.
        planner: Name of the planner.
        candidates: Poses (N, 4, 4) the robot reaches and the path length (N,) [m] to each, or None for
            straight lines; None for those of the robot of this name, which knows the table.
        stop: Why another view may not pay, or None.
        robot_name: As `find_robot` knows it.

    Raises:
        PlanningError: Nothing has been seen yet, or no view can be reached.
        InputError: A candidate is no pose, path lengths are not as many, or negative; or no such robot.
    """
    if scene.sphere is None:
        raise PlanningError("nothing has been seen yet; add a first view")
    robot: _Given | _NearTable
    if candidates is None:
        robot = _NearTable(scene, robot_name, T_world_cameras[-1])
    else:
        robot = _Given(T_world_cameras[-1], *candidates)
    sphere = view_sphere_of(robot, scene.sphere)
    visited = np.stack([sphere.direction_of(T) for T in T_world_cameras])
    decision = next_best_view(scene, robot, visited, planner=planner, seed=scene.seed)
    posture = robot.solve(decision.T_world_camera)
    return NextView(len(T_world_cameras), decision, posture if isinstance(posture, Posture) else None, stop)


@dataclass(frozen=True, eq=False, slots=True)
class _Reachable:
    """What a robot says it reaches."""

    T_world_camera: Annotated[Array, Numbers(-1, 4, 4)]
    path_length: Annotated[Array, Numbers(-1)] | None = None


def read_candidates(path: Path) -> tuple[Array, Array | None]:
    """Read poses (N, 4, 4) a robot reaches and the path length (N,) [m] to each, None where it is missing.

    Raises:
        InputError: A key is missing, or not a list of poses, or of lengths.
    """
    given = parse_json(_Reachable, read_json(path), path)
    return given.T_world_camera, given.path_length


def table_floor(scene: Scene, config: Config) -> FloorGrid:
    """The floor around the table: under its top, and everything on it, nobody can stand.

    Args:
        scene: What is known, of at least one view.
        config: How the robot stands.

    Raises:
        PlanningError: No view is known yet.
    """
    if scene.surface is None or scene.sphere is None:
        raise PlanningError("nothing has been seen yet; add a first view")
    shape = scene.surface.shape
    top = float(scene.surface.point_world[2])
    half = shape.extents / 2.0
    centre = np.array([*shape.T_world_object[:2, 3], top / 2.0])
    sides = np.array([half[0], half[1], max(abs(top) / 2.0, STEP)])
    R = shape.T_world_object[:3, :3]
    return FloorGrid.from_boxes([centre], [sides], [R], config.robot, scene.sphere.centre_world[:2])


class _NearTable(OwnViews):
    """A robot by the table, which stands where the last view was taken."""

    def __init__(self, scene: Scene, name: str, T_world_camera: Array) -> None:
        self.T_world_camera = T_world_camera
        floor = table_floor(scene, scene.config)
        if scene.sphere is None:
            raise PlanningError("nothing has been seen yet; add a first view")
        around = Surroundings(scene.sphere.centre_world, floor, scene.config)
        self._robot = find_robot(name)(around)
        self._placed = self._place(around.centre_world)

    def _place(self, centre_world: Array) -> bool:
        """Put it where the camera is, as it is held or without roll; returns whether it can stand there."""
        eye = self.T_world_camera[:3, 3]
        poses = [self.T_world_camera]
        if np.linalg.norm(eye - centre_world) > 1e-6:
            poses.append(transforms.look_at(eye, centre_world))
        for T in poses:
            if isinstance(self._robot.solve(T), Posture):
                self._robot.move_to(T)
                return True
        return False

    def view_sphere(self, proposed: ViewSphere) -> ViewSphere:
        return view_sphere_of(self._robot, proposed)

    def confirm(self, T_world_camera: Array) -> Unreachable | None:
        return refusal_of(self._robot, T_world_camera)

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        return self._robot.solve(T_world_camera)

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Views it reaches, with straight paths where it cannot stand at the camera's place."""
        found = self._robot.candidates(sphere)
        if self._placed:
            return found
        return found.from_elsewhere(_straight(self.T_world_camera, found.T_world_camera))

    def move_to(self, T_world_camera: Array) -> float:
        return self._robot.move_to(T_world_camera)


class _Given:
    """A robot that has said itself which views it reaches."""

    def __init__(self, T_world_camera: Array, poses: Array, path_length: Array | None) -> None:
        self.T_world_camera = T_world_camera
        self._poses = np.array([transforms.as_rigid(T, f"candidates[{n}]") for n, T in enumerate(poses)])
        self._poses = self._poses.reshape(-1, 4, 4)
        self._path_length = (
            _straight(T_world_camera, self._poses)
            if path_length is None
            else np.asarray(path_length, np.float64)
        )
        if self._path_length.shape != (len(self._poses),) or not (self._path_length >= 0.0).all():
            raise InputError(
                "path_length", "is not one length a candidate", "give as many as candidates, 0 or more"
            )

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        return Unreachable("the robot itself knows how it stands")

    def candidates(self, sphere: ViewSphere) -> Candidates:
        return Candidates(self._poses, sphere.direction_of(self._poses), self._path_length, {})

    def move_to(self, T_world_camera: Array) -> float:
        raise PlanningError("the robot moves itself")


def _straight(T_world_camera: Array, poses: Array) -> Array:
    """Straight path length (N,) [m] from one camera pose to others (N, 4, 4)."""
    return np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=-1)
