"""Look at a table with a wrist camera through MoveIt 2, and lift the first object: a client of the ROS node.

    python examples/franka_moveit.py --ros-args --params-file examples/franka_moveit.yaml

docs/franka.md says what has to run. The node chooses views, and MoveIt moves the camera there; where MoveIt
refuses one, the node chooses another. Then the node plans a lift, which is printed; with parameter `lift`,
MoveIt and the gripper carry it out.
"""

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from math import atan2, pi
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import moveit_msgs.msg as moveit
import numpy as np
import rclpy
from action_msgs.msg import GoalStatus
from caryatid_msgs.action import Explore
from caryatid_msgs.msg import SupportGraph
from caryatid_msgs.srv import Order, Refused, Removed
from control_msgs.action import GripperCommand, ParallelGripperCommand
from geometry_msgs.msg import Transform, Vector3
from moveit_msgs.action import ExecuteTrajectory, MoveGroup
from moveit_msgs.srv import ApplyPlanningScene, GetCartesianPath, GetPlanningScene
from rclpy.action import ActionClient, get_action_names_and_types
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from shape_msgs.msg import SolidPrimitive
from tf2_ros import Buffer, TransformException, TransformListener

from caryatid.geometry.shapes import KINDS
from caryatid.geometry.transforms import Array, invert, rigid, transform
from caryatid.robots import Surroundings
from caryatid.robots.arm import ArmRobot
from caryatid.robots.reachability import read_reachability
from caryatid_ros.messages import make_message, matrix_of, pose_message

GIVEN = {
    "world_frame": "panda_link0",  # that of the caryatid node: the arm's base, which must be level
    "camera_frame": "camera_color_optical_frame",  # its transform from `link` is the hand-eye calibration
    "group": "panda_arm",  # planning group of MoveIt
    "link": "panda_hand",  # link that MoveIt places; the camera and the gripper are fixed to it
    "tcp": [0.0, 0.0, 0.1034, 0.0],  # grasp frame in `link`: x, y, z [m] and turn about z [rad]
    "touch_links": ["panda_hand", "panda_leftfinger", "panda_rightfinger"],  # touch what is held
    "base_links": ["panda_link0"],  # may touch the table, `o0`, on which the arm may stand
    "gripper": "franka",  # name of the gripper for caryatid
    "gripper_action": "panda_hand_controller/gripper_cmd",  # GripperCommand or ParallelGripperCommand
    "open": 0.039,  # its position when open: of one finger of two, a little less than it could [m]
    "closed": 0.0,  # its position when closed
    "share": 0.5,  # change of the position for each metre of width
    "squeeze": 0.003,  # how far it closes beyond the width of the object, which holds it [m]
    "force": 20.0,  # of the grip [N]
    "speed": 0.1,  # share of the maximum joint speeds and accelerations [1]
    "drop": [0.4, -0.35, 0.003],  # free place on `o0`: x, y, just above its height, in `world_frame` [m]
    "goal": "",  # object to reach; empty = the first of any
    "max_views": 6,
    "lift": False,  # whether to carry out the lift that is planned
    "confirm": True,  # whether to ask on the terminal before its first motion
}
REACH = Path("fr3.npz")  # reachability map of the camera, which examples/real_arm.py writes
PATIENCE = 10.0  # maximum wait for a server or a transform [s]


class MotionError(Exception):
    """MoveIt, the gripper or the node refuses."""


def make_arm(place: Surroundings) -> ArmRobot:
    """Make the arm for the node's parameter `robot`: its base is the world frame."""
    return ArmRobot(read_reachability(REACH), np.eye(4), place.config.arm, furniture=place.floor)


class Client(Node):
    """Looks and lifts; each method returns when it is done, or raises MotionError."""

    def __init__(self) -> None:
        super().__init__("look_and_lift")
        self.given = SimpleNamespace(**{n: self.declare_parameter(n, v).value for n, v in GIVEN.items()})
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        x, y, z, turn = self.given.tcp
        self.T_link_tcp = rigid(Rotation.from_euler("z", turn).as_matrix(), (x, y, z))
        self.header = make_message("std_msgs/msg/Header", frame_id=self.given.world_frame)
        self.gripper: Any = None  # the type of its action
        self.graph: Any = None  # the newest
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(SupportGraph, "support_graph", self.keep, latched)

    def keep(self, graph: SupportGraph) -> None:
        """Keep the newest graph."""
        self.graph = graph

    def look(self) -> None:
        """Take the views that the node chooses."""
        self.gripper = self.find_gripper()
        self.allow(self.given.base_links)
        T_link_camera = self.find_transform(self.given.link, self.given.camera_frame)

        def go(feedback: Any) -> None:
            decision, pose = feedback.decision, feedback.decision.camera.pose
            try:
                self.move(matrix_of(pose.orientation, pose.position, "camera") @ invert(T_link_camera))
                self.get_logger().info(f"looks: {decision.why}")
            except MotionError as error:
                self.get_logger().warning(f"asks for another view: {error}")
                self.call(Refused, "refused", reason=str(error))

        goal = Explore.Goal(max_views=self.given.max_views, goal=self.given.goal, restart=True)
        answer = self.act(Explore, "explore", goal, go)
        self.get_logger().info(f"{answer.result.views} views: {answer.result.message}")
        if answer.status != GoalStatus.STATUS_SUCCEEDED:
            raise MotionError(answer.result.message)

    def plan(self) -> Any:
        """Plan the first lift of the order (caryatid_msgs/Lift)."""
        given = self.given
        order = self.call(Order, "order", goal=given.goal, gripper=given.gripper, hands=1, steps=1)
        if not (order.success and order.safe and order.lifts and order.lifts[0].grasp):
            raise MotionError(order.message or "no object is left")
        return order.lifts[0]

    def lift(self, lift: Any) -> None:
        """Lift an object as planned, and put it down at `drop` as it stood, turned about the vertical."""
        given, grasp = self.given, lift.grasp[0]
        bottom = self.find_bottom(lift.object)
        self.grip(given.open)
        T = self.approach(matrix_of(grasp.pose.orientation, grasp.pose.position, "grasp"), grasp.travel)
        self.reach(T)
        self.grip(given.closed + given.share * max(grasp.width - given.squeeze, 0.0))
        self.attach(lift.object)
        x, y, height = given.drop
        turn = atan2(y, x) - atan2(T[1, 3], T[0, 3])  # of the arm's first joint
        placed = rigid(np.eye(3), (x, y, height + T[2, 3] - bottom))
        placed[:3, :3] = Rotation.from_euler("z", turn).as_matrix() @ T[:3, :3]
        up, back = (rigid(np.eye(3), (0.0, 0.0, z)) for z in (grasp.travel, -grasp.travel))
        try:
            self.allow([lift.object])
            self.reach(up @ T)
            self.move(up @ placed @ invert(self.T_link_tcp))
            self.reach(placed)
        except MotionError as error:
            raise MotionError(f"{error}; the gripper holds {lift.object}") from None
        self.grip(given.open)
        self.attach(lift.object, moveit.CollisionObject.REMOVE)
        pose = pose_message(make_message, placed @ invert(T))
        way = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
        motion = Transform(translation=way, rotation=pose.orientation)
        told = self.call(Removed, "removed", object=lift.object, moved=True, motion=motion)
        if not told.success:
            raise MotionError(told.message)
        self.reach(placed @ back)

    def approach(self, T_world_tcp: Array, travel: float) -> Array:
        """Go to where a grasp (4, 4), or that turned by 180°, is approached from; return which one."""
        for turn in (0.0, pi):
            T = T_world_tcp @ rigid(Rotation.from_euler("z", turn).as_matrix(), np.zeros(3))
            try:
                self.move(T @ rigid(np.eye(3), (0.0, 0.0, -travel)) @ invert(self.T_link_tcp))
                return T
            except MotionError as error:
                refusal = error
        raise refusal

    def move(self, T_world_link: Array) -> None:
        """Have MoveIt plan to a pose (4, 4) of the link around all obstacles, and go there."""
        pose, header, link = pose_message(make_message, T_world_link), self.header, self.given.link
        ball = SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=[0.001])
        region = moveit.BoundingVolume(primitives=[ball], primitive_poses=[pose])
        tolerances = {f"absolute_{axis}_axis_tolerance": 0.01 for axis in "xyz"}
        place = moveit.PositionConstraint(header=header, link_name=link, constraint_region=region, weight=1.0)
        turn = moveit.OrientationConstraint(
            header=header, link_name=link, orientation=pose.orientation, weight=1.0, **tolerances
        )
        goal, speed = MoveGroup.Goal(), self.given.speed
        goal.request.group_name = self.given.group
        goal.request.start_state.is_diff = True  # from where the arm is, with what it holds
        wanted = moveit.Constraints(position_constraints=[place], orientation_constraints=[turn])
        goal.request.goal_constraints = [wanted]
        goal.request.num_planning_attempts, goal.request.allowed_planning_time = 5, 5.0
        goal.request.max_velocity_scaling_factor = goal.request.max_acceleration_scaling_factor = speed
        goal.planning_options.planning_scene_diff.is_diff = True
        goal.planning_options.planning_scene_diff.robot_state.is_diff = True
        self.check(self.act(MoveGroup, "move_action", goal).result.error_code)

    def reach(self, T_world_tcp: Array) -> None:
        """Go straight to a pose (4, 4) of the grasp frame."""
        pose, speed = pose_message(make_message, T_world_tcp @ invert(self.T_link_tcp)), self.given.speed
        path = self.call(
            GetCartesianPath, "compute_cartesian_path", header=self.header, group_name=self.given.group,
            link_name=self.given.link, waypoints=[pose], max_step=0.005, avoid_collisions=True,
            start_state=moveit.RobotState(is_diff=True), max_velocity_scaling_factor=speed,
            max_acceleration_scaling_factor=speed,
        )  # fmt: skip
        self.check(path.error_code)
        if path.fraction < 0.999:
            raise MotionError(f"MoveIt can follow {path.fraction:.0%} of the straight path")
        goal = ExecuteTrajectory.Goal(trajectory=path.solution)
        self.check(self.act(ExecuteTrajectory, "execute_trajectory", goal).result.error_code)

    def grip(self, position: float) -> None:
        """Open or close the gripper."""
        goal, force, old = self.gripper.Goal(), self.given.force, self.gripper is GripperCommand
        if old:
            goal.command.position, goal.command.max_effort = position, force
        else:
            goal.command = JointState(position=[position], effort=[force])
        result = self.act(self.gripper, self.given.gripper_action, goal).result
        if not (result.reached_goal or result.stalled):
            reached = result.position if old else next(iter(result.state.position), np.nan)
            raise MotionError(f"the gripper stopped at {1e3 * reached:.0f} mm")

    def find_gripper(self) -> Any:
        """Wait for the action of the gripper, and return its type."""
        name = self.resolve_topic_name(self.given.gripper_action)

        def look() -> Any:
            kinds = dict(get_action_names_and_types(self)).get(name, [])
            known = {f"control_msgs/action/{k.__name__}": k for k in (GripperCommand, ParallelGripperCommand)}
            return next((known[kind] for kind in kinds if kind in known), None)

        return self.find(look, f"there is no action {name}, GripperCommand or ParallelGripperCommand")

    def find_bottom(self, name: str) -> float:
        """Wait for the graph, and return the height [m] of the lowest point of an object."""

        def look() -> Any:
            return next((o for o in getattr(self.graph, "objects", []) if o.id == name), None)

        found = self.find(look, f"the topic support_graph has no {name}")
        T, size = matrix_of(found.pose.orientation, found.pose.position, name), found.extents
        if found.triangles:
            return float(transform(T, np.array([(p.x, p.y, p.z) for p in found.triangles]))[:, 2].min())
        shape = KINDS[found.shape].from_extents(T, np.array([size.x, size.y, size.z]))
        return float(T[2, 3] - shape.support(np.array([[0.0, 0.0, -1.0]]))[0])

    def attach(self, name: str, operation: bytes = moveit.CollisionObject.ADD) -> None:
        """Tell MoveIt that the gripper holds an object, or with REMOVE that it holds it no more."""
        body, links = moveit.CollisionObject(id=name, operation=operation), self.given.touch_links
        held = moveit.AttachedCollisionObject(object=body, link_name=self.given.link, touch_links=links)
        state = moveit.RobotState(is_diff=True, attached_collision_objects=[held])
        if not self.apply(robot_state=state):
            raise MotionError(f"MoveIt has no {name}; set the node's parameter planning_scene")

    def allow(self, bodies: list[str]) -> None:
        """Let links or objects touch the table, `o0`, in MoveIt; the node keeps what is allowed."""
        kinds = moveit.PlanningSceneComponents
        wanted = kinds(components=kinds.ALLOWED_COLLISION_MATRIX)
        scene = self.call(GetPlanningScene, "get_planning_scene", components=wanted).scene
        matrix = scene.allowed_collision_matrix
        names, known = list(dict.fromkeys([*matrix.entry_names, "o0", *bodies])), len(matrix.entry_names)
        allowed = np.zeros((len(names), len(names)), dtype=np.bool_)
        allowed[:known, :known] = [row.enabled for row in matrix.entry_values]
        table, others = names.index("o0"), [names.index(body) for body in bodies]
        allowed[table, others] = allowed[others, table] = True
        matrix.entry_names = names
        matrix.entry_values = [moveit.AllowedCollisionEntry(enabled=row.tolist()) for row in allowed]
        self.apply(allowed_collision_matrix=matrix)

    def apply(self, **fields: Any) -> bool:
        """Change MoveIt's planning scene; return whether it could."""
        fields.setdefault("robot_state", moveit.RobotState(is_diff=True))
        scene = moveit.PlanningScene(is_diff=True, **fields)
        return bool(self.call(ApplyPlanningScene, "apply_planning_scene", scene=scene).success)

    def find_transform(self, target: str, source: str) -> Array:
        """Wait for a fixed transform (4, 4), target ← source."""

        def look() -> Any:
            with suppress(TransformException):
                return self.buffer.lookup_transform(target, source, Time()).transform

        found = self.find(look, f"tf has no {target} ← {source}; publish the hand-eye calibration")
        return matrix_of(found.rotation, found.translation, source)

    def find(self, look: Callable[[], Any], missing: str) -> Any:
        """Spin until a function returns something, and return that."""
        end = time.monotonic() + PATIENCE
        while (found := look()) is None:
            rclpy.spin_once(self, timeout_sec=0.1)
            if time.monotonic() > end:
                raise MotionError(missing)
        return found

    def check(self, code: moveit.MoveItErrorCodes) -> None:
        """Raise MotionError unless MoveIt succeeded."""
        codes = moveit.MoveItErrorCodes
        if code.val != codes.SUCCESS:
            names = [name for name in dir(codes) if name.isupper() and getattr(codes, name) == code.val]
            raise MotionError(f"MoveIt answers {names[0] if names else code.val}")

    def act(self, kind: Any, name: str, goal: Any, take: Any = None) -> Any:
        """Have an action done, and return its status and result; call `take` with each feedback meanwhile."""
        client, news = ActionClient(self, kind, name), list[Any]()
        if not client.wait_for_server(PATIENCE):
            raise MotionError(f"there is no action {name}")
        handle = self.wait(client.send_goal_async(goal, news.append), name, client.server_is_ready)
        if not handle.accepted:
            raise MotionError(f"{name} rejects the goal")
        done = handle.get_result_async()
        while take is not None and not done.done():
            self.wait(done, name, client.server_is_ready, lambda: bool(news))
            if news:
                take(news.pop().feedback)
        return self.wait(done, name, client.server_is_ready)

    def call(self, kind: Any, name: str, **fields: Any) -> Any:
        """Call a service, and return its response."""
        client = self.create_client(kind, name)
        if not client.wait_for_service(PATIENCE):
            raise MotionError(f"there is no service {name}")
        return self.wait(client.call_async(kind.Request(**fields)), name, client.service_is_ready)

    def wait(self, future: Any, name: str, is_ready: Any, is_enough: Any = lambda: False) -> Any:
        """Spin until a future is done, or enough has come, and return its result."""
        while not (future.done() or is_enough()):
            rclpy.spin_once(self, timeout_sec=0.1)
            if not is_ready():
                raise MotionError(f"{name} is gone")
        return future.result()


def main() -> None:
    """Look, plan a lift, and carry it out if that is wanted."""
    rclpy.init()
    client = Client()
    try:
        client.look()
        lift = client.plan()
        print(f"plan: lift {lift.object}: {lift.why}")
        if not client.given.lift:
            return print("nothing is lifted: the parameter lift is false")
        if client.given.confirm and input(f"lift {lift.object}? [y/N] ").strip().lower() != "y":
            return print("nothing is lifted")
        client.lift(lift)
        print(f"{lift.object} is lifted and put down")
    except EOFError:
        sys.exit("error: there is no terminal to ask on; set the parameter confirm to false")
    except MotionError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
