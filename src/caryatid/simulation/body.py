"""The body of the simulated humanoid: what its camera may see of it, and what it may meet."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from caryatid.config import RobotConfig
from caryatid.geometry.transforms import Array
from caryatid.planning.posture import Posture
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.simulation.world import SimulatedScene

PLATFORM, MAST, NECK = 0.3, 0.04, 0.15
"""Greatest height of the platform, radius of the mast on it, and how far under the camera that ends [m]."""


class HumanoidBody:
    """A platform and a mast that the torso lift makes longer, in a copy of a scene.

    Nothing is pushed by it. The head is left out: it is behind the camera, which is at its front.

    Args:
        scene: Where it stands; stays as it is.
        robot: Says how it stands for a camera pose.
        config: Its footprint and heights.

    Attributes:
        scene: The copy, with the body where it was placed last.
    """

    def __init__(self, scene: SimulatedScene, robot: HumanoidRobot, config: RobotConfig) -> None:
        self._robot = robot
        low, high = config.camera_height
        self._platform_height = min(PLATFORM, low / 2.0)
        spec = scene.spec.copy()
        body = spec.worldbody.add_body(name="robot", mocap=True)
        # The mast is made as long as it can be, since MuJoCo bounds a geom only once.
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
        self._geoms = np.flatnonzero(model.geom_bodyid == model.body("robot").id)

    def place(self, posture: Posture) -> None:
        """Put it where a posture has it."""
        model, data, mast = self.scene.model, self.scene.data, self._geoms[1]
        top = max(posture.camera_height - NECK, self._platform_height)
        model.geom_pos[mast, 2] = model.geom_size[mast, 1] = top / 2.0
        data.mocap_pos[-1] = (*posture.platform_world[:2], 0.0)
        mujoco.mj_kinematics(model, data)

    def around(self, T_world_camera: Array) -> SimulatedScene | None:
        """The scene with the body that holds the camera at a pose (4, 4), or None where it cannot stand."""
        posture = self._robot.solve(T_world_camera)
        if not isinstance(posture, Posture):
            return None
        self.place(posture)
        return self.scene

    def clearance(self) -> tuple[float, str]:
        """Return how near it is to anything but the floor [m], negative inside, and the name of that body."""
        model, data = self.scene.model, self.scene.data
        flat = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
        others = [g for g in range(model.ngeom) if g not in self._geoms and model.geom_type[g] not in flat]
        pairs = ((mine, other) for mine in self._geoms.tolist() for other in others)
        distances = ((mujoco.mj_geomDistance(model, data, *pair, 10.0, None), pair[1]) for pair in pairs)
        nearest, geom = min(distances, default=(10.0, 0))
        return nearest, str(model.body(model.geom_bodyid[geom]).name)
