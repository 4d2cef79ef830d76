"""One goal of the action `explore`: it waits for images and for the camera, in a thread of its own."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from functools import partial
from threading import Lock
from typing import Any

import rclpy
from action_msgs.msg import GoalInfo, GoalStatus, GoalStatusArray
from caryatid_msgs.action import Explore
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from rclpy.qos import qos_profile_action_status_default
from rclpy.time import Time
from tf2_ros import TransformException

from caryatid.errors import InputError
from caryatid_ros.inbox import Inbox, seconds_of
from caryatid_ros.parameters import read_parameters

POLL = 0.05
"""Time between two looks at images, transforms and cancellations [s]."""
STILL = 0.2
"""Time before a view in which the camera must not have moved [s]."""
BEAT, SILENT = 0.5, 3.5
"""Time between two signs of life that the client must acknowledge, and how long it may not do so [s]."""
STALE = 1.0
"""Age of a transform that no longer says where the camera is, and longest step of a clock that counts [s]."""
CANCELLED = "cancelled"
"""Why a goal ended that its client cancelled."""


class EndedError(Exception):
    """The goal must end at once, for this reason."""


class Goal:
    """A goal that was accepted, with its handle, what arrives from the camera, and the transforms."""

    def __init__(self, node: Any, handle: Any, inbox: Inbox, buffer: Any) -> None:
        self._node, self._handle, self.inbox, self._buffer = node, handle, inbox, buffer
        self._settings, self._views, self._lock = read_parameters(node), 0, Lock()
        self._end, self._awaited, self._refusal = "", False, ""
        self._watched, self._told, self._beat = False, False, 0.0
        self._acknowledged: float | None = None
        topic, qos = "explore/_action/status", qos_profile_action_status_default
        self._status = node.create_publisher(GoalStatusArray, topic, qos)

    def end(self, why: str) -> None:
        """End the goal; once this returns, it publishes no further decision."""
        with self._lock:
            self._end = self._end or why

    def refuse(self, reason: str) -> bool:
        """Report that the camera cannot go to the next view; return whether one was awaited."""
        if self._awaited:
            self._refusal = reason or "the motion planner refuses it"
        return self._awaited

    def run(self) -> Any:
        """Take views until no further view is worth its path, and return the result."""
        node, result, finish, r = self._node, Explore.Result(), self._handle.abort, self._handle.request
        log = node.get_logger()
        log.info(f"goal: max_views {r.max_views}, goal '{r.goal}', until {r.until:g}, restart {r.restart}")
        try:
            result.message = self._explore(result)
            finish = self._handle.succeed
        except EndedError as error:
            result.message = str(error)
            if result.message == CANCELLED:
                finish = self._handle.canceled
                for _ in range(200):  # the action server, which was told to accept this, is about to do so
                    if self._handle.is_cancel_requested:
                        break
                    time.sleep(0.005)
        except Exception as error:
            result.message = node.sentence(error)
        result.views = self._views
        try:
            log.info(f"goal ended after {self._views} views: {result.message}")
            level = DiagnosticStatus.ERROR if finish == self._handle.abort else DiagnosticStatus.OK
            node.tell_stage(f"idle; the last goal ended: {result.message}", level)
            node.destroy_publisher(self._status)
            node.goal = None  # before its client knows, who may send the next one
            finish()
        except Exception as error:  # cancelled at this moment, or the node stops
            node.sentence(error)
        return result

    def _explore(self, result: Any) -> str:
        """Take the views, and return why no further one is worth its path."""
        s, r = self._settings, self._handle.request
        exploration = self._result("getting ready", self._node.prepared)
        start = self._now()
        since = self._until(s.image_timeout, lambda: now if (now := self._now()) > start else None)
        result.graph = self._do("beginning", exploration.begin, r)
        limit, stop = r.max_views or exploration.max_views, None
        while stop is None:
            self._node.tell_stage(f"waiting for images of view {self._views + 1}")
            view = self._until(s.image_timeout, partial(self._image, since))
            result.graph = self._do(f"adding view {self._views + 1}", exploration.look, *view)
            self._views += 1
            refusal = "" if self._views < limit else None
            stop = f"maximum of {self._views} views reached"
            while refusal is not None:
                decision, stop = self._do("planning the next view", exploration.plan, refusal)
                refusal = None if stop is not None else self._go(decision)
            since = self._now()
        result.graph = self._do("adding the last views", exploration.finish)
        unknown = r.goal and all(o.id != r.goal for o in result.graph.objects)
        return f"{stop}; {r.goal} was not found" if unknown else stop

    def _go(self, decision: Any) -> str | None:
        """Have the camera moved to the next view; return why it cannot go there, or None on arrival."""
        p, frame = decision.camera.pose.position, decision.camera.header.frame_id
        where = f"({p.x:.3f}, {p.y:.3f}, {p.z:.3f}) m in {frame}"
        with self._lock:  # what ends the goal waits for this, or this is not published
            self._check()
            self._awaited, self._refusal = True, ""
            self._node.publish("decision", decision)
            self._handle.publish_feedback(Explore.Feedback(views=self._views, decision=decision))
        self._node.get_logger().info(f"decision: next view at {where}: {decision.why}")
        self._node.tell_stage(f"waiting for the camera at {where}")
        try:
            self._until(self._settings.move_timeout, partial(self._arrived, decision.camera.pose))
        finally:
            self._awaited = False
        return self._refusal or None

    def _arrived(self, pose: Any) -> Any:
        """Whether the camera is at a pose, or was refused to go there; otherwise an error."""
        s, there = self._settings, self._transform(self._frame, Time())
        if self._refusal or isinstance(there, InputError):
            return bool(self._refusal) or there
        distance, angle = _between(there.translation, there.rotation, pose.position, pose.orientation)
        if distance <= s.position_tolerance and angle <= s.angle_tolerance:
            return True
        if (age := self._age(self._frame)) > STALE:
            reason = f"is {age:.1f} s old, so that nobody knows where the camera is"
            source = f"transform {s.world_frame} ← {self._frame}"
            return InputError(source, reason, "check what publishes it, and its clock")
        reason = (
            f"is {1e3 * distance:.1f} mm and {angle:.4f} rad from the next view after {s.move_timeout:g} s; "
            f"the tolerances are {1e3 * s.position_tolerance:g} mm and {s.angle_tolerance:g} rad"
        )
        remedy = "move it there, call the service refused, or raise move_timeout or the tolerances"
        return InputError("camera", reason, remedy)

    def _image(self, since: float) -> Any:
        """The newest view that the camera took while it stood still, with its transform; or an error."""
        first: InputError | None = None
        try:
            for depth, info, others in self.inbox.views(since, self._settings.slop):
                found = self._still(depth.header)
                if not isinstance(found, InputError):
                    self._frame = depth.header.frame_id
                    return depth, info, others, found
                first = first or found
        except InputError as error:
            first = first or error
        return first

    def _still(self, header: Any) -> Any:
        """The transform of a camera that stood still before an image, or an error."""
        s, stamp = self._settings, Time.from_msg(header.stamp)
        before = Time(nanoseconds=max(1, stamp.nanoseconds - int(1e9 * STILL)), clock_type=stamp.clock_type)
        now, then = self._transform(header.frame_id, stamp), self._transform(header.frame_id, before)
        for found in (now, then):
            if isinstance(found, InputError):
                return found
        distance, angle = _between(now.translation, now.rotation, then.translation, then.rotation)
        if distance <= STILL * s.max_speed and angle <= STILL * s.max_turn:
            return now
        moves = (
            f"moves by {1e3 * distance / STILL:.0f} mm/s and {angle / STILL:.3f} rad/s while images arrive"
        )
        return InputError("camera", moves, "hold it still, or raise max_speed and max_turn")

    def _transform(self, frame: str, when: Any) -> Any:
        """The geometry_msgs/Transform world ← frame, or an error."""
        world = self._settings.world_frame
        try:
            found = self._buffer.lookup_transform(world, frame, when, Duration()).transform
            q, error = found.rotation, "its quaternion is zero or NaN"
            if math.hypot(q.x, q.y, q.z, q.w) > 1e-6:
                return found
        except TransformException as raised:
            error = str(raised)
        at = f" at {1e-9 * when.nanoseconds:.3f} s" if when.nanoseconds else ""
        remedy = "publish it in tf, or set world_frame"
        return InputError(f"transform {world} ← {frame}", f"is unknown{at} ({error})", remedy)

    def _age(self, frame: str) -> float:
        """Age of the newest transform world ← frame [s]; 0 if it is static."""
        newest = self._buffer.lookup_transform(self._settings.world_frame, frame, Time(), Duration()).header
        return self._now() - seconds_of(newest.stamp) if seconds_of(newest.stamp) > 0.0 else 0.0

    def _now(self) -> float:
        return float(1e-9 * self._node.get_clock().now().nanoseconds)

    def _do(self, stage: str, work: Callable[..., Any], *given: Any) -> Any:
        """Result of work that the node's thread for the scene does."""
        return self._result(stage, self._node.scene_thread.submit(work, *given))

    def _result(self, stage: str, job: Future[Any]) -> Any:
        self._node.tell_stage(stage)
        try:
            self._check()
            while not wait([job], timeout=POLL).done:
                self._check()
        except EndedError:
            job.cancel()
            raise
        return job.result()

    def _until(self, seconds: float, ready: Callable[[], Any]) -> Any:
        """Wait for a result other than None or an error, until a time [s] is over.

        The ROS clock measures it, or a steady clock while that stands still.
        """
        waited, before, moved = 0.0, self._now(), time.monotonic()
        while True:
            self._check()
            found, now = ready(), self._now()
            if found is not None and not isinstance(found, InputError):
                return found
            if now != before:
                passed = min(max(now - before, 0.0), STALE)  # a clock that was set tells nothing
                waited, before, moved = waited + passed, now, time.monotonic()
            if time.monotonic() - moved > seconds:
                remedy = "publish /clock, or set use_sim_time to false"
                raise InputError("ROS time", f"stands still at {now:.3f} s", remedy)
            if waited > seconds and found is not None:
                raise found
            time.sleep(POLL)

    def _check(self) -> None:
        """Raise EndedError if the goal must end: it was cancelled, its client is gone, or the node stops."""
        self._end = self._end or (CANCELLED if self._handle.is_cancel_requested else "")
        self._end = self._end or ("" if rclpy.ok() else "the node was stopped")
        self._end = self._end or ("" if self._is_client_there() else "the client of the goal is gone")
        if self._end:
            raise EndedError(self._end)

    def _is_client_there(self) -> bool:
        """Whether the client receives messages of the goal's status, which are repeated for this purpose.

        DDS notices only after 20 s that a process was killed, and until then, none of the messages counts as
        acknowledged. So silence counts only after an acknowledgement during this goal. It may be that of
        another client, which nobody can tell: a robot that stops without need does less harm.
        """
        now, watched = time.monotonic(), self._watched
        if now - self._beat < BEAT:
            return True
        self._beat, self._watched = now, self._node.count_subscribers("explore/_action/feedback") > 0
        if self._status.wait_for_all_acked(Duration(seconds=0.01)):
            self._acknowledged, info = now if self._told else None, GoalInfo(goal_id=self._handle.goal_id)
            status = GoalStatus(goal_info=info, status=self._handle.status)
            self._status.publish(GoalStatusArray(status_list=[status]))
            self._told = True
        is_silent = self._acknowledged is not None and now - self._acknowledged >= SILENT
        return not is_silent and (self._watched or not watched)


def _between(p: Any, q: Any, p2: Any, q2: Any) -> tuple[float, float]:
    """Distance [m] of two positions, and angle [rad] of two quaternions."""
    dot = abs(q.x * q2.x + q.y * q2.y + q.z * q2.z + q.w * q2.w)
    size = math.hypot(q.x, q.y, q.z, q.w) * math.hypot(q2.x, q2.y, q2.z, q2.w)
    return math.dist((p.x, p.y, p.z), (p2.x, p2.y, p2.z)), 2.0 * math.acos(min(1.0, dot / size))
