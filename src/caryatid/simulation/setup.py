"""A simulated robot with body and camera in front of a scene, ready to explore."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from caryatid.config import Config, NoiseModel, RobotConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array
from caryatid.planning.candidates import Posture
from caryatid.robots import HUMANOID, Robot, RobotMaker, Surroundings, find_robot, go_home
from caryatid.robots.floor import STEP, FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.world import SimulatedScene, bounds, static_boxes, table_centre

PLATFORM, MAST, NECK = 0.3, 0.04, 0.15
"""Maximum height of the platform, radius of its mast, and distance from the mast's end to the camera [m]."""

BODY = "caryatid-robot"
"""Name of the robot's body, which no scene has."""


class HumanoidBody:
    """A platform and a mast that the torso lift extends, in a copy of a scene.

    It collides with nothing. The head is left out, because it is behind the camera. The robot finds its
    posture for a camera pose.

    Attributes:
        scene: The copy, with the body where it was last placed.
    """

    def __init__(self, scene: SimulatedScene, robot: HumanoidRobot, config: RobotConfig) -> None:
        self._robot = robot
        low, high = config.camera_height
        self._platform_height = min(PLATFORM, low / 2.0)
        spec = scene.spec.copy()
        body = spec.worldbody.add_body(name=BODY, mocap=True)
        # The mast has its maximum length, because MuJoCo bounds a geom only once.
        for radius, height in ((config.footprint, self._platform_height), (MAST, high)):
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=[0.0, 0.0, height / 2.0],
                size=[radius, height / 2.0, 0.0], contype=0, conaffinity=0, rgba=(0.47, 0.51, 0.56, 1.0),
            )  # fmt: skip
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[:] = scene.data.qpos
        labels = np.append(scene.geom_labels, np.zeros(2, dtype=np.int32))
        self.scene = replace(scene, model=model, data=data, spec=spec, geom_labels=labels)
        self._geoms = np.flatnonzero(model.geom_bodyid == model.body(BODY).id)

    def place(self, posture: Posture) -> None:
        """Move it to a posture."""
        model, data, mast = self.scene.model, self.scene.data, self._geoms[1]
        top = max(posture.camera_height - NECK, self._platform_height)
        model.geom_pos[mast, 2] = model.geom_size[mast, 1] = top / 2.0
        data.mocap_pos[-1] = (*posture.platform_world[:2], 0.0)
        mujoco.mj_kinematics(model, data)

    def around(self, scene: SimulatedScene, T_world_camera: Array) -> SimulatedScene | None:
        """The scene with the body that holds a camera at a pose (4, 4), or None if it cannot stand there."""
        posture = self._robot.solve(T_world_camera)
        if not isinstance(posture, Posture):
            return None
        self.scene.data.qpos[:] = scene.data.qpos
        self.place(posture)
        return self.scene


@dataclass(frozen=True, eq=False, slots=True)
class Simulation:
    """Camera and robot of a simulation, for `explore`.

    Attributes:
        camera: Takes views of the scene.
        robot: Stands where the first view is taken.
    """

    camera: SimulatedCamera
    robot: Robot


def make_simulation(
    scene: SimulatedScene, config: Config, *, noise: NoiseModel, seed: int, robot: RobotMaker | str = HUMANOID
) -> Simulation:
    """Put a robot at its home view in front of the main surface.

    Its floor map has the furniture, which also blocks views, and the objects on the ground. The robot is a
    maker, or a name for `find_robot`; the seed is that of the camera's noise.

    Raises:
        InputError: There is no robot of this name.
        PlanningError: No view of the surface can be reached.
    """
    centre, furniture = table_centre(scene), static_boxes(scene)
    around = [bounds(scene, label) for label in scene.object_bodies]
    lying = [
        Box(transforms.rigid(np.eye(3), (low + high) / 2.0), high - low)
        for low, high in around
        if low[2] <= STEP
    ]
    floor = FloorGrid.from_boxes([*furniture, *lying], config.robot, centre[:2])
    floor = replace(floor, furniture=furniture)
    make = find_robot(robot) if isinstance(robot, str) else robot
    made = make(Surroundings(centre, floor, config))
    go_home(made, ViewSphere.around(centre, config.active), config.robot)
    body = HumanoidBody(scene, made, config.robot).around if isinstance(made, HumanoidRobot) else None
    camera = SimulatedCamera(scene, noise, config.noise, np.random.default_rng(seed), config.sensor, body)
    return Simulation(camera, made)
