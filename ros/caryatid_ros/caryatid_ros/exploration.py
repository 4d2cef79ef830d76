"""What the node does: its action and services, in terms of a few functions that a node provides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError, InputError, PlanningError, in_one_line
from caryatid.exploration import Explorer
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.mask_sources import mask_source, without_ignored
from caryatid.manipulation.order import plan_order
from caryatid.planning.candidates import Candidates, Posture
from caryatid.planning.decision import Decision
from caryatid.planning.planners import make_planner
from caryatid.robots import OwnViews, Robot, RobotMaker, Surroundings, Unreachable, find_robot, view_sphere_of
from caryatid.robots.protocol import refusal_of
from caryatid.runtime.parallel import cores
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sessions.session import reached_candidates, table_floor
from caryatid_ros import messages
from caryatid_ros.messages import Make

POLL = 0.05
"""Time between two looks at images and transforms [s]."""


@dataclass(frozen=True, slots=True)
class Settings:
    """The node's parameters."""

    world_frame: str = "map"  # level, fixed frame of the graph and the views
    depth_topic: str = "/camera/aligned_depth_to_color/image_raw"  # registered to colour, rectified
    colour_topic: str = "/camera/color/image_raw"  # of the same size; empty = none
    info_topic: str = "/camera/color/camera_info"  # of these images
    config: str = ""  # TOML file of caryatid's settings; empty = defaults
    masks: str = ""  # source of masks, onnx:FILE; empty = automatic segmentation
    ignore: str = ""  # grey PNG, not 0 where the images show the robot itself; empty = nowhere
    planner: str = "support"  # planner of the next view
    robot: str = "humanoid"  # which views are reachable: humanoid, arm:FILE.npz or module:callable
    seed: int = 0  # of every random choice
    slop: float = 0.02  # maximum time between the images of a view [s]
    image_timeout: float = 5.0  # maximum wait for images and their transform [s]
    move_timeout: float = 120.0  # maximum wait until the camera is at the next view [s]
    position_tolerance: float = 0.03  # maximum distance from the next view on arrival [m]
    angle_tolerance: float = 0.05  # maximum rotation from the next view on arrival [rad]


@dataclass(frozen=True, slots=True)
class Connection:
    """What the logic needs of a node.

    Attributes:
        images: Returns the newest depth image, camera info, and colour image or None; None before the first.
        lookup: Returns the geometry_msgs/TransformStamped target ← source at a stamp; None = the newest.
            Raises LookupError if it is unknown.
        publish: Publishes a message under a name: `support_graph`, `markers` or `decision`.
        now: Returns the time of the ROS clock [s].
        sleep: Waits [s].
        make: Makes a message.
    """

    images: Callable[[], tuple[Any, Any, Any] | None]
    lookup: Callable[[str, str, Any], Any]
    publish: Callable[[str, Any], None]
    now: Callable[[], float]
    sleep: Callable[[float], None]
    make: Make = messages.make_message


class Cancelled(Exception):  # noqa: N818
    """The client has cancelled the goal."""


class CarriedCamera(OwnViews):
    """A `Robot` that a motion planner moves: the camera's pose, and a model of what it reaches.

    Args:
        maker: Makes the model, with the table as its only obstacle.
        scene: The scene that shows the table.
    """

    def __init__(self, maker: RobotMaker, scene: Scene) -> None:
        self._maker, self._scene = maker, scene
        self._model: tuple[int, Robot] | None = None
        self.T_world_camera: Array = np.eye(4)

    @property
    def model(self) -> Robot:
        """The model beside the table as the newest view shows it."""
        scene = self._scene
        if self._model is None or self._model[0] != scene.views:
            assert scene.sphere is not None
            place = Surroundings(scene.sphere.centre_world, table_floor(scene), scene.config)
            self._model = scene.views, self._maker(place)
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
    """One scene, explored goal by goal; its methods may be called from several threads.

    Args:
        settings: The node's parameters.
        connection: What the node provides.

    Raises:
        InputError: The settings, masks, planner or robot cannot be used.
    """

    def __init__(self, settings: Settings, connection: Connection) -> None:
        self._settings, self._ros = settings, connection
        self._config = read_settings(Path(settings.config) if settings.config else None, [])
        self._masks = mask_source(settings.masks, self._config, settings.seed) if settings.masks else None
        self._maker = find_robot(settings.robot)
        make_planner(settings.planner)
        self._explorer: Explorer | None = None
        self._header: Any = None
        self._scene_lock, self._goal_lock = Lock(), Lock()
        self._awaited, self._refusal = False, ""

    def explore(self, handle: Any) -> Any:
        """Take views until no further view is worth its path, and return an Explore result.

        Args:
            handle: Goal handle of an action server: its `request`, `is_cancel_requested`, `publish_feedback`,
                and `succeed`, `abort` or `canceled`, one of which is called at the end.
        """
        views, request = 0, handle.request
        if not self._goal_lock.acquire(blocking=False):
            handle.abort()
            return self._result("explore: another goal is running; cancel it, or wait for its result", 0)
        try:
            explorer, since, stop = self._prepared(request), self._ros.now(), None
            limit = request.max_views or self._config.active.max_views
            while stop is None:
                self._look(explorer, since, handle)
                views += 1
                stop = self._plan(explorer) if views < limit else f"maximum of {views} views reached"
                if stop is None:
                    since, stop = self._follow(explorer, views, handle)
            if request.goal and all(o.id != request.goal for o in explorer.scene.graph.objects):
                stop = f"{stop}; {request.goal} was not found"
            handle.succeed()
        except Cancelled:
            stop = "cancelled"
            handle.canceled()
        except CaryatidError as error:
            stop = in_one_line(error)
            handle.abort()
        finally:
            self._goal_lock.release()
        return self._result(stop, views)

    def order(self, request: Any) -> Any:
        """Plan a removal order, and return an Order response."""
        reply: dict[str, Any] = {"success": False}
        try:
            with self._scene_lock:
                scene, hands = self._known().scene, request.hands or 1
                found = plan_order(
                    scene.graph, scene.config, goal=request.goal or None, hands=hands,
                    steps=request.steps or None, seed=scene.seed, threads=cores(),
                )  # fmt: skip
            lifts = messages.lift_messages(self._ros.make, found)
            reply = {"success": True, "safe": found.safe, "message": found.refusal, "lifts": lifts}
        except CaryatidError as error:
            reply["message"] = in_one_line(error)
        return self._ros.make("caryatid_msgs/srv/Order/Response", **reply)

    def removed(self, request: Any) -> Any:
        """Report that an object was removed or moved, and return a Removed response."""
        reply: dict[str, Any] = {"success": False}
        try:
            with self._scene_lock:
                scene, motion = self._known().scene, request.motion
                if request.moved:
                    T = messages.matrix_of(motion.rotation, motion.translation, "motion")
                    scene.moved(request.object, T)
                else:
                    scene.removed(request.object)
                reply = {"success": True, "graph": self._published(scene)}
        except CaryatidError as error:
            reply["message"] = in_one_line(error)
        return self._ros.make("caryatid_msgs/srv/Removed/Response", **reply)

    def refused(self, request: Any) -> Any:
        """Report that the camera cannot go to the next view, and return a Refused response."""
        reply: dict[str, Any] = {"success": self._awaited}
        if self._awaited:
            self._refusal = request.reason or "the motion planner refuses it"
        else:
            reply["message"] = "no next view is awaited"
        return self._ros.make("caryatid_msgs/srv/Refused/Response", **reply)

    def _known(self) -> Explorer:
        if self._header is None or self._explorer is None:
            raise InputError("scene", "has no views", "send a goal to explore first")
        return self._explorer

    def _prepared(self, request: Any) -> Explorer:
        """An explorer for a goal, with the scene of the goals before."""
        before, settings = self._explorer, self._settings
        explorer = Explorer(
            planner=settings.planner, config=self._config, seed=settings.seed, masks=self._masks,
            goal=request.goal or None, until=request.until or None,
        )  # fmt: skip
        with self._scene_lock:
            if before is None or request.restart:
                self._robot, self._header = CarriedCamera(self._maker, explorer.scene), None
            else:
                explorer.scene, explorer.step = before.scene, before.step
            explorer.robot, self._explorer = self._robot, explorer
        return explorer

    def _look(self, explorer: Explorer, since: float, handle: Any) -> None:
        """Add a view that is not older than a time [s]."""

        def new() -> Any:
            found = self._ros.images()
            return found if found and messages.seconds_of(found[0].header.stamp) >= since else None

        def late() -> InputError:
            age = (
                "none arrived" if self._ros.images() is None else "the newest is older than the goal or move"
            )
            remedy = "check the topics, that their stamps agree, and use_sim_time"
            return InputError(
                settings.depth_topic, f"no image in {settings.image_timeout:g} s: {age}", remedy
            )

        settings = self._settings
        depth, info, colour = self._poll(handle, settings.image_timeout, new, late)
        T_world_camera = self._camera_pose(depth.header.frame_id, depth.header.stamp)
        view = messages.view_of(depth, info, colour, T_world_camera)
        if settings.ignore:
            view = without_ignored(view, Path(settings.ignore), self._config.recording.max_pixels)
        with self._scene_lock:
            self._robot.T_world_camera, self._camera_frame = T_world_camera, depth.header.frame_id
            explorer.look(view)
            fields = {"stamp": depth.header.stamp, "frame_id": settings.world_frame}
            self._header = self._ros.make("std_msgs/msg/Header", **fields)
            self._published(explorer.scene)

    def _plan(self, explorer: Explorer) -> str | None:
        """Plan the next view; return why there is none, or why it is not worth its path."""
        with self._scene_lock:
            step = explorer.plan()
            return step.stop or explorer.reason_to_stop()

    def _follow(self, explorer: Explorer, views: int, handle: Any) -> tuple[float, str | None]:
        """Have the camera moved to the next view, or to another if it is refused.

        Returns:
            The time of arrival [s], and why the camera can go to no further view, or None.
        """
        assert explorer.step is not None
        while (decision := explorer.step.decision) is not None:
            try:
                return self._awaited_at(decision, views, handle), None
            except PlanningError as error:
                with self._scene_lock:
                    explorer.put_aside(str(error))
        return self._ros.now(), explorer.step.stop

    def _awaited_at(self, decision: Decision, views: int, handle: Any) -> float:
        """Publish the next view, wait until the camera is there, and return the time [s].

        Raises:
            PlanningError: It was reported that the camera cannot go there.
        """
        settings = self._settings
        self._awaited, self._refusal = True, ""
        message = messages.decision_message(self._ros.make, decision, self._header)
        self._ros.publish("decision", message)
        fields = {"views": views, "decision": message}
        handle.publish_feedback(self._ros.make("caryatid_msgs/action/Explore/Feedback", **fields))

        def away() -> tuple[float, float]:
            T = transforms.invert(decision.T_world_camera) @ self._camera_pose(self._camera_frame, None)
            return float(np.linalg.norm(T[:3, 3])), float(Rotation.from_matrix(T[:3, :3]).magnitude())

        def arrived() -> float | None:
            if self._refusal:
                raise PlanningError(self._refusal)
            distance, angle = away()
            there = distance <= settings.position_tolerance and angle <= settings.angle_tolerance
            return self._ros.now() if there else None

        def late() -> InputError:
            where = "is {:.2f} m and {:.2f} rad from the next view".format(*away())
            reason = f"{where} after {settings.move_timeout:g} s"
            remedy = "move it there, call the service refused, or raise move_timeout or the tolerances"
            return InputError("camera", reason, remedy)

        try:
            return float(self._poll(handle, settings.move_timeout, arrived, late))
        finally:
            self._awaited = False

    def _poll(
        self, handle: Any, seconds: float, ready: Callable[[], Any], late: Callable[[], InputError]
    ) -> Any:
        """Wait for a result other than None, a cancellation, or until a time [s] is over."""
        until = self._ros.now() + seconds
        while not handle.is_cancel_requested:
            if (found := ready()) is not None:
                return found
            if self._ros.now() > until:
                raise late()
            self._ros.sleep(POLL)
        raise Cancelled

    def _camera_pose(self, frame: str, stamp: Any) -> Array:
        """Pose (4, 4) of the camera's frame in the world at a stamp, or the newest one."""
        name = f"transform {self._settings.world_frame} ← {frame}"
        try:
            found = self._ros.lookup(self._settings.world_frame, frame, stamp).transform
        except LookupError as error:
            when = "" if stamp is None else f" at {messages.seconds_of(stamp):.3f} s"
            reason, remedy = f"is unknown{when} ({error})", "publish it in tf, or set world_frame"
            raise InputError(name, reason, remedy) from None
        return messages.matrix_of(found.rotation, found.translation, name)

    def _published(self, scene: Scene) -> Any:
        """Publish the graph and its markers, and return the graph's message."""
        graph = messages.graph_message(self._ros.make, scene.graph, scene.new_changes, self._header)
        self._ros.publish("support_graph", graph)
        self._ros.publish("markers", messages.markers_message(self._ros.make, scene.graph, self._header))
        return graph

    def _result(self, message: str, views: int) -> Any:
        fields: dict[str, Any] = {"message": message, "views": views}
        if self._header is not None and self._explorer is not None:
            scene = self._explorer.scene
            fields["graph"] = messages.graph_message(
                self._ros.make, scene.graph, scene.new_changes, self._header
            )
        return self._ros.make("caryatid_msgs/action/Explore/Result", **fields)
