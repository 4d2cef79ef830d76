"""Robots for a simulated scene, by name: the humanoid, an arm with a map, or one of another package."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from caryatid.errors import InputError

if TYPE_CHECKING:
    from caryatid.config import Config
    from caryatid.geometry.transforms import Array
    from caryatid.robots.floor import FloorGrid
    from caryatid.robots.humanoid import Robot

HUMANOID = "humanoid"
"""The robot of the paper, and the default."""

ARM = "arm:"
"""What a name begins with that goes on with the file of a map."""

ENTRY_POINTS = "caryatid.robots.registry"
"""Group under which other packages offer robots: callables that make one for `Surroundings`."""


@dataclass(frozen=True, eq=False, slots=True)
class Surroundings:
    """Where a robot is put in simulation.

    Attributes:
        centre_world: Middle of the table top (3,) [m].
        floor: Where there is room on the floor, and the furniture.
        config: All settings.
    """

    centre_world: Array
    floor: FloorGrid
    config: Config

    @property
    def T_world_base(self) -> Array:
        """Where the settings put the base of an arm (4, 4)."""
        from caryatid.geometry.transforms import rigid, rotation_from_vector

        arm = self.config.arm
        turn = rotation_from_vector((0.0, 0.0, math.radians(arm.base_yaw)))
        return rigid(turn, self.centre_world + arm.base)


RobotMaker = Callable[[Surroundings], "Robot"]
"""Makes a robot that stands in such surroundings."""


def offered() -> dict[str, EntryPoint]:
    """Robots of other packages by name; a name of ours stays ours."""
    return {r.name: r for r in entry_points(group=ENTRY_POINTS) if r.name != HUMANOID}


def find_robot(name: str) -> RobotMaker:
    """Return what makes a robot.

    Args:
        name: `humanoid`; `arm:FILE.npz`, the file as `write_reachability` writes it; `module:callable`; or a
            name another package offers.

    Raises:
        InputError: There is none of this name, its file is bad, or its module cannot be imported.
    """
    if name == HUMANOID:
        return _humanoid
    if name.startswith(ARM):
        return _arm(name.removeprefix(ARM))
    others = offered()
    if name not in others and ":" not in name:
        names = ", ".join([HUMANOID, *sorted(others), f"{ARM}FILE.npz", "module:callable"])
        raise InputError("robot", f"there is no robot '{name}'", f"choose one of {names}")
    point = others.get(name) or EntryPoint(name, name, ENTRY_POINTS)
    try:
        maker: RobotMaker = point.load()
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            "robot", f"'{point.value}' cannot be imported ({error})", "give module:callable of Python's path"
        ) from None
    return maker


def located(name: str) -> str:
    """Return a robot's name with the file in it as an absolute path, for use from other folders."""
    return f"{ARM}{Path(name.removeprefix(ARM)).resolve()}" if name.startswith(ARM) else name


def _humanoid(around: Surroundings) -> Robot:
    from caryatid.robots.humanoid import HumanoidRobot

    return HumanoidRobot(around.floor, around.config.robot)


def _arm(file: str) -> RobotMaker:
    """An arm that reaches what its map says, on the base of the settings."""
    from caryatid.robots.arm import ArmRobot
    from caryatid.robots.reachability_files import read_reachability

    reachability = read_reachability(file)

    def make(around: Surroundings) -> Robot:
        return ArmRobot(reachability, around.T_world_base, around.config.arm, furniture=around.floor)

    return make
