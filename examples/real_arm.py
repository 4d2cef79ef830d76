"""Your own arm: a real model with a wrist camera explores a simulated table and says how to grasp.

    python examples/real_arm.py examples/arms/ur5e.json examples/arms/ur5e.toml

The JSON file has the model (a robot of MuJoCo Menagerie, or your MJCF or URDF file), the body that carries
camera and gripper, your hand-eye calibration `T_hand_camera`, and `T_hand_gripper` with z along the approach
and x along the closing direction. The TOML file has settings: where the arm stands, its camera and gripper.
"""

import json
import sys
from pathlib import Path
from typing import Any

import mink
import mujoco
import mujoco_menagerie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import caryatid as ct
from caryatid.config.settings import read_settings
from caryatid.evaluation import score, true_scene_from_simulation
from caryatid.geometry.transforms import Array, as_rigid, invert
from caryatid.manipulation.order import plan_order
from caryatid.robots import Surroundings
from caryatid.robots.arm import ArmRobot
from caryatid.robots.reachability import sample_reachability, write_reachability
from caryatid.simulation import load_scene
from caryatid.simulation.setup import make_simulation

SAMPLES = 200_000  # postures in the map
STARTS = 4  # sampled postures from which inverse kinematics starts
TURN = 0.2  # error of position [m] that is as bad as one of 1 rad


class Arm:
    """What an arm reaches with its camera and its gripper, and with which joints."""

    def __init__(self, known: dict[str, Any], place: Surroundings) -> None:
        self.T_world_base = place.T_world_base
        T_hand_camera, T_hand_gripper = (as_rigid(known[k], k) for k in ("T_hand_camera", "T_hand_gripper"))
        self.T_gripper_camera = invert(T_hand_gripper) @ T_hand_camera
        spec = mujoco.MjSpec.from_file(str(find_model(known["model"])))
        spec.body(known["hand"]).add_site(name="camera", **placed(T_hand_camera))
        for box in place.floor.furniture:  # the arm must not touch the table
            T_base_box, kind = invert(self.T_world_base) @ box.T_world_object, mujoco.mjtGeom.mjGEOM_BOX
            spec.worldbody.add_geom(type=kind, size=box.extents / 2.0, **placed(T_base_box))
        self.model = spec.compile()
        self.state = mink.Configuration(self.model)
        body, links = self.model.body(known["hand"]).id, list[int]()
        while body:
            links.append(body)
            body = self.model.body_parentid[body]
        joints = np.flatnonzero(np.isin(self.model.jnt_bodyid, links))
        self.address = self.model.jnt_qposadr[joints]
        turns = np.clip(self.model.jnt_range[joints], -np.pi, np.pi)
        limits = np.where(self.model.jnt_limited[joints, None], turns, (-np.pi, np.pi))
        drawn, poses = list[Array](), list[Array]()

        def forward(joints: Array) -> Array:
            drawn.append(joints)
            poses.append(np.array([self.pose(each) for each in joints]))
            return poses[-1]

        rng = np.random.default_rng(0)
        self.reach = sample_reachability(forward, limits, SAMPLES, rng, place.config.arm)
        free = np.isfinite(np.concatenate(poses)).all(axis=(1, 2))
        self.drawn, self.tree = np.concatenate(drawn)[free], KDTree(told(np.concatenate(poses)[free]))

    def pose(self, joints: Array) -> Array:
        """Forward kinematics: `T_base_camera` (4, 4), NaN in a collision."""
        data, T = self.state.data, np.eye(4)
        data.qpos[self.address] = joints
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_collision(self.model, data)
        T[:3, :3], T[:3, 3] = data.site("camera").xmat.reshape(3, 3), data.site("camera").xpos
        return T if data.ncon == 0 else np.full((4, 4), np.nan)

    def solve(self, T_base_camera: Array, exact: bool = False) -> Array | None:
        """Inverse kinematics: joints that hold the camera at a pose (4, 4) to 1 mm, or None.

        An arm of five joints chooses where its camera is and looks, but not the roll, unless `exact`.
        """
        roll = TURN if exact or len(self.address) > 5 else 0.0
        task = mink.FrameTask("camera", "site", 1.0, [TURN, TURN, roll])
        task.set_target(mink.SE3.from_matrix(T_base_camera))
        for start in self.drawn[self.tree.query(told(T_base_camera[None])[0], STARTS)[1]]:
            q = self.state.q.copy()
            q[self.address] = start
            self.state.update(q)
            for _ in range(20):
                self.state.integrate_inplace(mink.solve_ik(self.state, [task], 1.0, "daqp", 1e-6), 1.0)
                if np.linalg.norm(task.cost * task.compute_error(self.state)) < 0.001:
                    joints: Array = self.state.q[self.address].copy()
                    if np.isfinite(self.pose(joints)).all():
                        return joints
                    break
        return None

    def grasp(self, T_world_gripper: Array) -> Array | None:
        """Joints that hold the gripper at a pose (4, 4), or None."""
        return self.solve(invert(self.T_world_base) @ T_world_gripper @ self.T_gripper_camera, exact=True)

    def grasps(self, T_world_gripper: Array) -> NDArray[np.bool_]:
        """Which poses (N, 4, 4) the gripper reaches."""
        return np.array([self.grasp(T) is not None for T in T_world_gripper])


class WristCamera:
    """The simulated camera, where the joints really hold it."""

    def __init__(self, arm: Arm, camera: ct.Camera) -> None:
        self.arm, self.camera = arm, camera

    def capture(self, T_world_camera: Array) -> ct.View:
        """Take a view with the joints for a pose (4, 4) that the robot has confirmed."""
        joints = self.arm.solve(invert(self.arm.T_world_base) @ T_world_camera)
        assert joints is not None
        return self.camera.capture(self.arm.T_world_base @ self.arm.pose(joints))


def find_model(model: str) -> Path:
    """The file of a robot of MuJoCo Menagerie, which is downloaded once, or a file of your own."""
    robot = mujoco_menagerie.bundled().robots.get(model)
    return Path(model) if robot is None else robot.xml(robot.default_model)


def placed(T: Array) -> dict[str, Array]:
    """A pose (4, 4) as MuJoCo takes it."""
    return {"pos": T[:3, 3], "quat": Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)}


def told(T_base_camera: Array) -> Array:
    """Poses (N, 4, 4) as points (N, 9): their distance says how far the camera has to go."""
    return np.column_stack([T_base_camera[:, :3, 3], *(TURN * T_base_camera[:, :3, k] for k in (0, 2))])


def main(description: Path, settings: Path) -> None:
    """Put the arm beside a table, let it look, and ask how to grasp the first object."""
    known, config, arms = json.loads(description.read_text()), read_settings(settings, []), list[Arm]()

    def make_robot(place: Surroundings) -> ArmRobot:
        arms.append(arm := Arm(known, place))
        return ArmRobot(arm.reach, arm.T_world_base, config.arm, confirm=arm.solve, furniture=place.floor)

    scene = load_scene("clutter")
    truth = true_scene_from_simulation(scene)
    stage = make_simulation(scene, config, noise="carmine", seed=0, robot=make_robot)
    arm = arms[0]
    write_reachability(f"{description.stem}.npz", arm.reach)
    for step in ct.explore(WristCamera(arm, stage.camera), stage.robot, config=config):
        f1, found = score(step.graph, truth).f1, f"{len(step.graph.movable)} objects"
        rest = step.stop or f"{len(step.candidates or ())} views in reach"
        print(f"view {step.index + 1} from {step.sphere.radius:.2f} m: {found}, F1 {f1:.2f}; {rest}")
    order = plan_order(step.graph, config, steps=1, reachable=arm.grasps)
    for take in order.steps:
        print(f"take {take.object_id}: {take.why}")
        if take.grasp is not None:  # if there is a gripper
            print("T_world_gripper", np.round(take.grasp.T_world_gripper, 3).tolist())
            print("joints", arm.grasp(take.grasp.T_world_gripper))
    print(order.refusal or "the lift is safe")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
