"""MoveIt's planning scene, which follows the graph."""

from __future__ import annotations

from threading import Event
from typing import Any

from moveit_msgs.msg import PlanningScene, PlanningSceneComponents
from moveit_msgs.srv import GetPlanningScene
from rclpy.callback_groups import ReentrantCallbackGroup

from caryatid.exports import planning_scene
from caryatid.exports.motion import REMOVE, collision_object
from caryatid.graph import SceneObject, SupportGraph
from caryatid.sensing.voxel_map import VoxelMap
from caryatid_ros.messages import Make, message_of
from caryatid_ros.parameters import Settings

PATIENCE = 1.0
"""Maximum wait for MoveIt's answer [s]: the graph must not wait for a planner that is busy."""


class PlanningSceneTopic:
    """Publishes a diff of MoveIt's planning scene for each graph; call it outside the thread that spins.

    Args:
        node: The rclpy node.
        settings: Its parameters.
        qos: How the topic is published.
        make: Makes a message.
    """

    def __init__(self, node: Any, settings: Settings, qos: Any, make: Make) -> None:
        self._make, self._frame, self._links = make, settings.world_frame, settings.gripper_links.split()
        self._unseen = settings.unseen_space
        self._topic = node.create_publisher(PlanningScene, settings.planning_scene, qos)
        group = ReentrantCallbackGroup()
        self._service = node.create_client(GetPlanningScene, "get_planning_scene", callback_group=group)
        self._known: set[str] = set()
        self._held, self._released = "", False

    def show(self, graph: SupportGraph, voxels: VoxelMap | None, lifted: SceneObject | None = None) -> None:
        """Publish the objects, which of them may touch, what is gone, and what the gripper lifted."""
        voxels = voxels if self._unseen else None
        message = planning_scene(graph, self._frame, self._allowed(), voxels)
        now = {item["id"] for item in message["world"]["collision_objects"]}
        gone, attached = self._known - now, list[dict[str, Any]]()
        lifts = lifted is not None and bool(self._links)
        if self._held and (lifts or self._released):  # MoveIt puts back into the world what it detaches
            attached.append({"object": {"id": self._held, "operation": REMOVE}})
            gone |= {self._held} - now
            self._held = ""
        self._released = False
        if lifted is not None and lifts:
            gone.discard(lifted.id)
            self._held, body = lifted.id, collision_object(lifted, self._frame)
            attached.append({"object": body, "link_name": self._links[0], "touch_links": self._links})
        message["robot_state"]["attached_collision_objects"] = attached
        removed = [{"id": name, "operation": REMOVE} for name in sorted(gone)]
        message["world"]["collision_objects"] += removed
        self._known = now
        self._topic.publish(message_of(self._make, "moveit_msgs/msg/PlanningScene", message))

    def release(self) -> None:
        """Detach with the next graph what the gripper holds: another scene begins, whose ids begin anew."""
        self._released = True

    def _allowed(self) -> dict[str, Any] | None:
        """The present matrix of allowed collisions, or None if MoveIt does not answer."""
        if not self._service.service_is_ready():
            return None
        wanted, answered = GetPlanningScene.Request(), Event()
        wanted.components.components = PlanningSceneComponents.ALLOWED_COLLISION_MATRIX
        answer = self._service.call_async(wanted)
        answer.add_done_callback(lambda _: answered.set())
        if not answered.wait(PATIENCE) or answer.result() is None:
            return None
        matrix = answer.result().scene.allowed_collision_matrix
        return {
            "entry_names": list(matrix.entry_names),
            "entry_values": [{"enabled": list(row.enabled)} for row in matrix.entry_values],
            "default_entry_names": list(matrix.default_entry_names),
            "default_entry_values": list(matrix.default_entry_values),
        }
