"""Robots that carry the camera, found by name with `find_robot`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np

from caryatid.config import Config, RobotConfig
from caryatid.errors import InputError, PlanningError
from caryatid.geometry.transforms import Array, rigid, rotation_from_vector
from caryatid.planning.candidates import Posture
from caryatid.robots.arm import ArmRobot
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.robots.protocol import OwnViews, Robot, Unreachable, refusal_of, view_sphere_of, way_to
from caryatid.robots.reachability import read_reachability
from caryatid.sensing.view_sphere import ViewSphere, direction

__all__ = [
    "OwnViews", "Posture", "Robot", "RobotMaker", "Surroundings", "Unreachable", "find_robot", "go_home",
    "located", "view_sphere_of", "way_to",
]  # fmt: skip

HUMANOID = "humanoid"
"""The robot of the paper, and the default."""

ARM = "arm:"
"""Prefix of a name that ends with the file of a reachability map."""


@dataclass(frozen=True, eq=False, slots=True)
class Surroundings:
    """Where a robot is put in simulation.

    Attributes:
        centre_world: Middle of the table top (3,) [m].
        floor: Free space on the floor, and the furniture.
        config: All settings.
    """

    centre_world: Array
    floor: FloorGrid
    config: Config

    @property
    def T_world_base(self) -> Array:
        """Pose (4, 4) of an arm's base by the settings."""
        arm = self.config.arm
        turn = rotation_from_vector((0.0, 0.0, math.radians(arm.base_yaw)))
        return rigid(turn, self.centre_world + arm.base)


RobotMaker = Callable[[Surroundings], Robot]
"""Makes a robot that stands in such surroundings."""


def find_robot(name: str) -> RobotMaker:
    """Return the maker of a robot: `humanoid`, or `module:callable`.

    `arm:FILE.npz` is an arm by its file of `write_reachability`.

    Raises:
        InputError: There is no such robot, its file is broken, or its module cannot be imported.
    """
    if name == HUMANOID:
        return lambda around: HumanoidRobot(around.floor, around.config.robot)
    if name.startswith(ARM):
        file = name.removeprefix(ARM)
        reachability = read_reachability(file)
        reachability.check_use(file, "camera", "base")
        return lambda around: ArmRobot(
            reachability, around.T_world_base, around.config.arm, furniture=around.floor
        )
    if ":" not in name:
        remedy = f"choose one of {HUMANOID}, {ARM}FILE.npz, module:callable"
        raise InputError("robot", f"unknown robot '{name}'", remedy)
    try:
        return EntryPoint(name, name, "").load()
    except (ImportError, AttributeError, ValueError) as error:
        remedy = "give a module:callable that Python can import"
        raise InputError("robot", f"'{name}' cannot be imported ({error})", remedy) from None


def located(name: str) -> str:
    """Return a robot's name with the file in it as an absolute path, for use from other folders."""
    return f"{ARM}{Path(name.removeprefix(ARM)).absolute()}" if name.startswith(ARM) else name


def go_home(robot: Robot, sphere: ViewSphere, config: RobotConfig) -> None:
    """Move to the first view: the reachable candidate nearest to `config.home` on its view sphere.

    Raises:
        PlanningError: No view of the sphere can be reached.
    """
    candidates = robot.candidates(view_sphere_of(robot, sphere))
    rejected = dict(candidates.rejected)
    nearness = candidates.directions @ direction(*np.deg2rad(config.home))
    for T_world_camera in candidates.T_world_camera[np.argsort(-nearness, kind="stable")]:
        refused = refusal_of(robot, T_world_camera)
        try:
            if refused is None:
                robot.move_to(T_world_camera)
                return
        except PlanningError as error:
            refused = Unreachable(str(error))
        rejected[refused.reason] = rejected.get(refused.reason, 0) + 1
    reasons = ", ".join(f"{reason} ({count})" for reason, count in rejected.items())
    height = f"the table top is {sphere.centre_world[2]:.2f} m above the floor, z = 0"
    remedy = "move the scene, or change robot.camera_height (for an arm, arm.base)"
    raise PlanningError(f"no view of the view sphere is reachable: {reasons}; {height}: {remedy}")
