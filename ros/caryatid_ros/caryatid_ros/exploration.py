"""The explored scene: views are added, next views and removal orders planned, and removals reported."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from caryatid.config.settings import read_settings
from caryatid.errors import InputError, NoSurfaceError
from caryatid.exploration import Explorer, Step
from caryatid.geometry.transforms import Array
from caryatid.io.mask_sources import mask_source, without_ignored
from caryatid.manipulation.order import Order, plan_order
from caryatid.planning.candidates import Candidates, Posture
from caryatid.planning.planners import make_planner
from caryatid.robots import OwnViews, Robot, RobotMaker, Surroundings, Unreachable, find_robot, view_sphere_of
from caryatid.robots.protocol import refusal_of
from caryatid.runtime.parallel import cores
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import View
from caryatid.sessions.session import Session, SessionConflictError, reached_candidates, table_floor
from caryatid_ros.parameters import Settings

log = logging.getLogger(__name__)


class CarriedCamera(OwnViews):
    """A `Robot` that a motion planner moves: the camera's pose, and a model of what it reaches.

    Args:
        maker: Makes the model, with the table as its only obstacle.
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


class Exploration:
    """One scene, explored goal by goal; a session keeps it. One thread at a time may change it.

    Args:
        settings: The node's parameters.

    Attributes:
        scene: The newest scene; it is replaced, and never changes, so that other threads may read it.
        max_views: Default maximum number of views of a goal.

    Raises:
        InputError: The settings, masks, planner, robot or session cannot be used.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._config = read_settings(Path(settings.config) if settings.config else None, [])
        self.max_views = self._config.active.max_views
        self._masks = mask_source(settings.masks, self._config, settings.seed) if settings.masks else None
        self._robot = CarriedCamera(find_robot(settings.robot))
        make_planner(settings.planner)
        self._session = self._opened() if settings.session else None
        self._explorer = Explorer(robot=self._robot)
        self._replace(
            Scene(self._config, seed=settings.seed) if self._session is None else self._session.scene
        )

    def _opened(self) -> Session:
        """The session, which is created if it does not exist."""
        folder, own = self._settings.session, (self._config, self._settings.seed)
        planner, robot = self._settings.planner, self._settings.robot
        try:
            return Session.begin(folder, own[0], seed=own[1], planner=planner, robot=robot)
        except SessionConflictError:
            session = Session.open(folder)
        if (session.beginning.settings, session.beginning.seed) != own:
            session.close()
            raise InputError(folder, "was begun with another config or seed", "use those, or another folder")
        log.info("%s: continues with %d views and %d reports", folder, session.views, session.reports)
        return session

    def _replace(self, scene: Scene) -> None:
        self.scene = self._explorer.scene = self._robot.scene = scene

    def begin(self, goal: str, until: float, restart: bool) -> None:
        """Begin a goal with the scene of the goals before; with restart, put that aside.

        Raises:
            InputError: `until` is out of range.
        """
        explorer = Explorer(
            robot=self._robot, planner=self._settings.planner, config=self._config,
            seed=self._settings.seed, goal=goal or None, until=until or None,
        )  # fmt: skip
        explorer.step, self._explorer = None if restart else self._explorer.step, explorer
        if restart and self._session is not None:
            folder, number = Path(self._settings.session), 1
            self._session.close()
            while (aside := folder.with_name(f"{folder.name}.{number}")).exists():
                number += 1
            folder.rename(aside)
            log.info("%s: the earlier session is now %s", folder, aside)
            self._session = self._opened()
        self._replace(explorer.scene if restart else self.scene)

    def look(self, view: View) -> None:
        """Add a view; once this returns, it is part of the scene and of the session.

        Raises:
            CaryatidError: The view cannot be used. Without a table, it is kept until another one shows it.
        """
        if self._settings.ignore:
            view = without_ignored(view, Path(self._settings.ignore), self._config.recording.max_pixels)
        view = view if self._masks is None else self._masks(view)
        before, scene = self.scene, self.scene.copy()
        self._explorer.scene = self._robot.scene = scene
        self._robot.T_world_camera = view.pose
        step = self._explorer.step
        try:
            try:
                self._explorer.look(view)
            except NoSurfaceError:
                if len(scene.waiting) > len(before.waiting):
                    self._kept(view, scene)
                raise
            self._kept(view, scene)
        except BaseException:
            self._explorer.step = step
            self._replace(self.scene)
            raise

    def _kept(self, view: View, scene: Scene) -> None:
        if self._session is not None:
            self._session.keep(view, scene)
        self._replace(scene)

    def plan(self) -> Step:
        """Plan the next view; `stop` of the step says why there is none, or why it is not worth its path."""
        step = self._explorer.plan()
        return replace(step, stop=step.stop or self._explorer.reason_to_stop())

    def put_aside(self, why: str) -> Step:
        """Put the next view aside, to which the camera cannot go for a reason, and plan another."""
        return self._explorer.put_aside(why)

    def removed(self, object_id: str, T: Array | None) -> None:
        """Report that an object was removed, or moved by a transform (4, 4); the session keeps the report.

        Raises:
            InputError: The object is unknown.
        """
        scene = self.known().copy()
        if self._session is not None:
            self._session.take(object_id, T)
            scene = self._session.scene
        elif T is None:
            scene.removed(object_id)
        else:
            scene.moved(object_id, T)
        self._replace(scene)

    def order(self, goal: str, hands: int, steps: int) -> Order:
        """Plan a removal order; other threads may change the scene meanwhile.

        Raises:
            InputError: The goal or the number of hands cannot be used.
        """
        scene = self.known()
        return plan_order(
            scene.graph, scene.config, goal=goal or None, hands=hands or 1, steps=steps or None,
            seed=scene.seed, threads=cores(), voxels=scene.voxels,
        )  # fmt: skip

    def known(self) -> Scene:
        """Return the scene.

        Raises:
            InputError: It has no views yet.
        """
        if not self.scene.views:
            raise InputError("scene", "has no views", "send a goal to explore first")
        return self.scene
