"""A stand-in for MoveIt: its planning scene, and an arm whose link goes wherever it is sent."""

from __future__ import annotations

import numpy as np
from control_msgs.action import GripperCommand, ParallelGripperCommand
from geometry_msgs.msg import TransformStamped
from moveit_msgs.action import ExecuteTrajectory, MoveGroup
from moveit_msgs.msg import (
    AllowedCollisionEntry,
    AllowedCollisionMatrix,
    CollisionObject,
    MoveItErrorCodes,
    PlanningScene,
)  # fmt: skip
from moveit_msgs.srv import ApplyPlanningScene, GetCartesianPath, GetPlanningScene
from rclpy.action import ActionServer
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectoryPoint

from caryatid_ros.messages import make_message, matrix_of, pose_message

BASE, HAND = "panda_link0", "panda_hand"


class Planner:
    """A planner that keeps its planning scene as MoveIt does.

    Attributes:
        world: Objects by id.
        held: Objects that are attached to a link, by id.
        matrix: Allowed collisions.
        scenes: Number of diffs it applied.
    """

    def __init__(self, node) -> None:
        rows = [AllowedCollisionEntry(enabled=row) for row in ([False, True], [True, False])]
        self.world, self.held, self.scenes = {}, {}, 0
        self.matrix = AllowedCollisionMatrix(entry_names=["hand", "finger"], entry_values=rows)
        self._node = node
        self._service = node.create_service(GetPlanningScene, "/get_planning_scene", self._answer)
        self._topic = node.create_subscription(PlanningScene, "/planning_scene", self.apply, 10)

    def destroy(self) -> None:
        """Stop."""
        self._node.destroy_service(self._service)
        self._node.destroy_subscription(self._topic)

    @property
    def touching(self) -> set[frozenset[str]]:
        """The pairs that may touch."""
        names, rows = self.matrix.entry_names, self.matrix.entry_values
        pairs = zip(names, rows, strict=True)
        return {frozenset((a, b)) for a, row in pairs for b, on in zip(names, row.enabled, strict=True) if on}

    def _answer(self, request, response):
        response.scene.allowed_collision_matrix = self.matrix
        return response

    def apply(self, scene) -> None:
        """Apply a diff."""
        assert scene.is_diff
        assert scene.robot_state.is_diff
        for body in scene.robot_state.attached_collision_objects:
            if body.object.operation == CollisionObject.REMOVE:
                self.world[body.object.id] = self.held.pop(body.object.id).object
            else:
                self.world.pop(body.object.id, None)
                self.held[body.object.id] = body
        if scene.allowed_collision_matrix.entry_names:
            self.matrix = scene.allowed_collision_matrix
        for item in scene.world.collision_objects:
            if item.operation == CollisionObject.REMOVE:
                del self.world[item.id]
            else:
                self.world[item.id] = item
        self.scenes += 1


class Arm(Planner):
    """A planner for a Panda that carries the camera, with the names of its configuration for MoveIt.

    Attributes:
        T_base_hand: Pose (4, 4) of the hand.
        asked, refused: Number of poses it was asked for so far, and numbers of those that it refuses, from 0.
        done: What was done, in order: a verb, and where the hand or the gripper is then, or with what object.
    """

    def __init__(self, node, T_map_base, T_base_hand, T_hand_camera, gripper=GripperCommand) -> None:
        super().__init__(node)
        self.T_base_hand, self.asked, self.refused, self.done = T_base_hand, 0, (), []
        self.matrix.entry_names = [BASE, HAND]
        self._tf = node.create_publisher(TFMessage, "/tf", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._static = node.create_publisher(TFMessage, "/tf_static", latched)
        camera = self._transform(HAND, "camera_color_optical_frame", T_hand_camera)
        self._static.publish(TFMessage(transforms=[self._transform("map", BASE, T_map_base), camera]))
        self._timer = node.create_timer(0.02, self._tell)
        self._actions = [
            ActionServer(node, MoveGroup, "/move_action", self._move),
            ActionServer(node, ExecuteTrajectory, "/execute_trajectory", self._follow),
            ActionServer(node, gripper, "/panda_hand_controller/gripper_cmd", self._grip),
        ]
        self._services = [
            node.create_service(ApplyPlanningScene, "/apply_planning_scene", self._answer_diff),
            node.create_service(GetCartesianPath, "/compute_cartesian_path", self._plan_line),
        ]

    def destroy(self) -> None:
        """Stop."""
        super().destroy()
        self._node.destroy_timer(self._timer)
        for action in self._actions:
            action.destroy()
        for service in self._services:
            self._node.destroy_service(service)
        for topic in (self._tf, self._static):
            self._node.destroy_publisher(topic)

    def reaches(self, T_base_hand) -> bool:
        """Whether the hand can be at a pose (4, 4)."""
        self.asked += 1
        return self.asked - 1 not in self.refused

    def _transform(self, parent: str, child: str, T) -> TransformStamped:
        pose, message = pose_message(make_message, T), TransformStamped(child_frame_id=child)
        message.header.frame_id, message.header.stamp = parent, self._node.get_clock().now().to_msg()
        t, p = message.transform.translation, pose.position
        t.x, t.y, t.z, message.transform.rotation = p.x, p.y, p.z, pose.orientation
        return message

    def _tell(self) -> None:
        self._tf.publish(TFMessage(transforms=[self._transform(BASE, HAND, self.T_base_hand)]))

    def _go(self, what: str, T) -> None:
        self.T_base_hand = T
        self.done.append((what, T))

    def _move(self, handle):
        request, result = handle.request.request, MoveGroup.Result()
        (wanted,) = request.goal_constraints
        (place,), (turn,) = wanted.position_constraints, wanted.orientation_constraints
        assert request.group_name == "panda_arm"
        assert request.start_state.is_diff, "what is held would be forgotten"
        assert {(c.header.frame_id, c.link_name) for c in (place, turn)} == {(BASE, HAND)}
        middle = place.constraint_region.primitive_poses[0].position
        T = matrix_of(turn.orientation, middle, "goal")
        if not self.reaches(T):
            result.error_code.val = MoveItErrorCodes.NO_IK_SOLUTION
            handle.abort()
            return result
        self._go("move", T)
        result.error_code.val = MoveItErrorCodes.SUCCESS
        handle.succeed()
        return result

    def _plan_line(self, request, response):
        (pose,) = request.waypoints
        T = matrix_of(pose.orientation, pose.position, "waypoint")
        assert (request.group_name, request.link_name, request.header.frame_id) == ("panda_arm", HAND, BASE)
        assert np.allclose(T[:3, :3], self.T_base_hand[:3, :3], atol=1e-6), "the hand must not turn"
        assert request.avoid_collisions
        assert request.start_state.is_diff
        response.solution.joint_trajectory.points = [JointTrajectoryPoint(positions=T.ravel().tolist())]
        response.fraction, response.error_code.val = float(self.reaches(T)), MoveItErrorCodes.SUCCESS
        return response

    def _follow(self, handle):
        positions = handle.request.trajectory.joint_trajectory.points[-1].positions
        self._go("line", np.reshape(positions, (4, 4)))
        handle.succeed()
        result = ExecuteTrajectory.Result()
        result.error_code.val = MoveItErrorCodes.SUCCESS
        return result

    def _grip(self, handle):
        command = handle.request.command
        handle.succeed()
        if isinstance(handle.request, ParallelGripperCommand.Goal):
            (position,) = command.position
            self.done.append(("grip", position))
            return ParallelGripperCommand.Result(state=command, reached_goal=True)
        self.done.append(("grip", command.position))
        return GripperCommand.Result(position=command.position, reached_goal=True)

    def _answer_diff(self, request, response):
        attached = request.scene.robot_state.attached_collision_objects
        if not attached:
            response.success = True
            self.apply(request.scene)
            return response
        (body,) = attached
        name, adds = body.object.id, body.object.operation == CollisionObject.ADD
        response.success = name in (self.world if adds else self.held)
        if response.success:
            if adds:
                assert body.link_name == HAND
                assert "panda_leftfinger" in body.touch_links
            self.apply(request.scene)
            self.done.append(("attach" if adds else "detach", name))
        return response
