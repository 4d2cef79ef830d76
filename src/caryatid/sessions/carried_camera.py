"""A robot whose camera a motion planner moves."""

from __future__ import annotations

import numpy as np

from caryatid.geometry.transforms import Array
from caryatid.planning.candidates import Candidates
from caryatid.robots import OwnViews, Posture, Robot, RobotMaker, Surroundings, Unreachable, view_sphere_of
from caryatid.robots.protocol import refusal_of
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sessions.session import reached_candidates, table_floor


class CarriedCamera(OwnViews):
    """A `Robot` for an `Explorer` that looks while something else moves the camera.

    Args:
        maker: Makes the model of what it reaches, with the table as its only obstacle.

    Attributes:
        scene: The scene that shows the table; set it before each view.
        T_world_camera: Pose (4, 4) of the camera; set it before each view.
    """

    def __init__(self, maker: RobotMaker) -> None:
        self._maker = maker
        self._model: tuple[Scene, Robot] | None = None
        self.scene: Scene
        self.T_world_camera: Array = np.eye(4)

    @property
    def model(self) -> Robot:
        """The model beside the table as the newest view shows it."""
        scene = self.scene
        if self._model is None or self._model[0] is not scene:
            assert scene.sphere is not None
            place = Surroundings(scene.sphere.centre_world, table_floor(scene), scene.config)
            self._model = scene, self._maker(place)
        return self._model[1]

    def view_sphere(self, proposed: ViewSphere) -> ViewSphere:
        """Return the model's view sphere."""
        return view_sphere_of(self.model, proposed)

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that the model reaches."""
        return reached_candidates(self.model, self.T_world_camera, sphere)

    def confirm(self, T_world_camera: Array) -> Unreachable | None:
        """Return why the model rejects a chosen view (4, 4), or None."""
        return refusal_of(self.model, T_world_camera)

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Return the model's posture at a pose (4, 4), or why there is none."""
        return self.model.solve(T_world_camera)

    def move_to(self, T_world_camera: Array) -> float:
        """Raise RuntimeError: only the motion planner moves the camera."""
        raise RuntimeError("only the motion planner of the robot moves the camera")
