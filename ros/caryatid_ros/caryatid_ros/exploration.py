"""The explored scene: views are added, next views and orders planned, and removals reported, as messages."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from caryatid.config.settings import read_settings
from caryatid.errors import InputError, NoSurfaceError
from caryatid.exploration import Explorer
from caryatid.graph import SceneObject
from caryatid.io.bags import is_rectified
from caryatid.io.mask_sources import mask_source, without_ignored
from caryatid.planning.planners import make_planner
from caryatid.robots import find_robot
from caryatid.scene import Scene
from caryatid.sessions.carried_camera import CarriedCamera
from caryatid.sessions.session import Session, SessionConflictError
from caryatid_ros import messages
from caryatid_ros.messages import Make, make_message
from caryatid_ros.parameters import Settings

log = logging.getLogger(__name__)


class Exploration:
    """One scene, explored goal by goal; a session keeps it. One thread at a time may change it.

    Args:
        settings: The node's parameters.
        publish: Called with the name of a topic and a message.
        make: Makes a message.
        planning_scene: Shows the graph, and an object that was lifted, to a motion planner.

    Attributes:
        scene: The newest scene; it is replaced, and changes only when it takes over views that the background
            has finished.
        graph: Its graph as a message.
        max_views: Default maximum number of views of a goal.

    Raises:
        InputError: The settings, masks, planner, robot or session cannot be used.
    """

    def __init__(
        self,
        settings: Settings,
        publish: Callable[[str, Any], None],
        make: Make = make_message,
        planning_scene: Any = None,
    ) -> None:
        self._settings, self._publish, self._make = settings, publish, make
        self._config = read_settings(Path(settings.config) if settings.config else None, [])
        self.max_views = self._config.active.max_views
        self._planning_scene = planning_scene
        own = settings.masks and "masks" not in settings.topics
        self._masks = mask_source(settings.masks, self._config, settings.seed) if own else None
        self._robot = CarriedCamera(find_robot(settings.robot))
        make_planner(settings.planner)
        self._session = self._opened() if settings.session else None
        self._explorer = Explorer(robot=self._robot)
        self._replace(
            Scene(self._config, seed=settings.seed) if self._session is None else self._session.scene
        )
        self.graph = self._make("caryatid_msgs/msg/SupportGraph")
        self.header = self._make("std_msgs/msg/Header", frame_id=settings.world_frame)

    def _opened(self) -> Session:
        """The session, which is created if it does not exist."""
        folder, s = Path(self._settings.session).expanduser(), self._settings
        own = self._config, s.seed
        try:
            return Session.begin(folder, own[0], seed=own[1], planner=s.planner, robot=s.robot)
        except SessionConflictError:
            session = Session.open(folder)
        if (session.beginning.settings, session.beginning.seed) != own:
            raise InputError(folder, "was begun with another config or seed", "use those, or another folder")
        log.info("%s: continues with %d views and %d reports", folder, session.views, session.reports)
        return session

    def _replace(self, scene: Scene) -> None:
        self.scene = self._explorer.scene = self._robot.scene = scene

    def begin(self, goal: Any) -> Any:
        """Begin a goal with the scene of the goals before, or put that aside; return the graph."""
        explorer = Explorer(
            robot=self._robot, planner=self._settings.planner, config=self._config,
            seed=self._settings.seed, goal=goal.goal or None, until=goal.until or None,
            budget=self._settings.budget or None,
        )  # fmt: skip
        if not goal.restart:
            explorer.step, self._explorer = self._explorer.step, explorer
            self._replace(self.scene)
            return self.graph
        if self._session is not None:
            folder, number = Path(self._settings.session).expanduser(), 1
            while (aside := folder.with_name(f"{folder.name}.{number}")).exists():
                number += 1
            folder.rename(aside)
            log.info("%s: the earlier session is now %s", folder, aside)
            self._session.close()
            self._session = self._opened()
        self._explorer = explorer
        if self._planning_scene is not None:
            self._planning_scene.release()
        self.graph = self._make("caryatid_msgs/msg/SupportGraph")
        self._replace(explorer.scene)
        return self.graph

    def look(self, depth: Any, info: Any, others: Mapping[str, Any], transform: Any) -> Any:
        """Add a view of a depth image with its camera info, `colour` and `masks`, and transform.

        The graph is published and returned.

        Raises:
            CaryatidError: The view cannot be used. Without a table, it is kept until another one shows it.
        """
        T_world_camera = messages.matrix_of(transform.rotation, transform.translation, "camera")
        rectified = self._settings.rectified or is_rectified(self._settings.depth_topic)
        view = messages.view_of(depth, info, others.get("colour"), T_world_camera, rectified=rectified)
        if self._settings.ignore:
            view = without_ignored(
                view, Path(self._settings.ignore).expanduser(), self._config.recording.max_pixels
            )
        if "masks" in others:
            frames = {self._settings.world_frame: np.eye(4), depth.header.frame_id: T_world_camera}
            view = messages.with_masks(view, others["masks"], frames)
        view = view if self._masks is None else self._masks(view)
        explorer, step, failure = self._explorer, self._explorer.step, None
        scene = self.scene if self.scene.open else self.scene.copy()
        explorer.scene, self._robot.scene, self._robot.T_world_camera = scene, scene, T_world_camera
        try:
            try:
                explorer.look(view)
            except NoSurfaceError as error:
                failure = error
                if len(scene.waiting) == len(self.scene.waiting):
                    raise
            if self._session is not None:
                self._session.keep(view, scene)
        except BaseException:
            explorer.step = explorer.step if scene is self.scene else step
            self._replace(self.scene)
            raise
        self._replace(scene)
        if failure is not None:
            raise failure
        self.header.stamp = depth.header.stamp
        self.publish()
        log.info("view %s added: %s%s", view.name, scene, f", {len(scene.open)} open" if scene.open else "")
        return self.graph

    def finish(self) -> Any:
        """Wait for views that are still being added; the graph is published and returned."""
        if self._settings.budget:
            self._explorer.finish()
            self.publish()
        return self.graph

    def publish(self, lifted: SceneObject | None = None) -> None:
        """Publish the graph, in all its forms, and an object that was lifted."""
        scene = self.scene
        self.graph = messages.graph_message(self._make, scene.graph, scene.new_changes, self.header)
        self._publish("support_graph", self.graph)
        self._publish("markers", messages.markers_message(self._make, scene.graph, self.header))
        if find_spec("vision_msgs") is not None:
            self._publish("detections", messages.detections_message(self._make, scene.graph, self.header))
        if self._planning_scene is not None:
            self._planning_scene.show(scene.graph, scene.voxels, lifted)

    def plan(self, refusal: str) -> tuple[Any, str | None]:
        """Plan the next view, or another one if that was refused: its Decision, or why there is none."""
        step = self._explorer.put_aside(refusal) if refusal else self._explorer.plan()
        stop = step.stop or (None if refusal else self._explorer.reason_to_stop())
        if stop is not None and self.scene.open:
            self.finish()
            step = self._explorer.plan()
            stop = step.stop or self._explorer.reason_to_stop()
        if stop is not None or step.decision is None:
            return None, stop
        return messages.decision_message(self._make, step.decision, self.header), None

    def remove(self, request: Any, response: Any) -> None:
        """Report that an object was removed or moved, publish the graph, and fill in a Removed response."""
        self.finish()
        motion, T, scene, before = request.motion, None, self._known().copy(), self.scene.graph
        if request.moved:
            T = messages.matrix_of(motion.rotation, motion.translation, "motion")
        if self._session is not None:
            self._session.take(request.object, T)
            scene = self._session.scene
        elif T is None:
            scene.removed(request.object)
        else:
            scene.moved(request.object, T)
        self._replace(scene)
        self.publish(None if request.moved else before[request.object])
        response.graph = self.graph

    def order(self, request: Any, response: Any) -> None:
        """Plan a removal order, and fill in an Order response; another thread may change the scene."""
        found = self._known().copy().order(
            goal=request.goal or None, gripper=request.gripper or None, hands=request.hands or 1,
            steps=request.steps or None,
        )  # fmt: skip
        response.lifts = messages.lift_messages(self._make, found)
        response.safe, response.message = found.safe, found.refusal

    def _known(self) -> Scene:
        if not self.scene.views:
            raise InputError("scene", "has no views", "send a goal to explore first")
        return self.scene
