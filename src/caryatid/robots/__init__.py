"""Robots that carry the camera: the protocol, and `find_robot` for those of a simulated scene by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from caryatid.errors import InputError, PlanningError

if TYPE_CHECKING:
    from caryatid.config import Config, RobotConfig
    from caryatid.geometry.transforms import Array
    from caryatid.planning.candidates import Candidates
    from caryatid.robots.floor import FloorGrid
    from caryatid.sensing.view_sphere import ViewSphere

HUMANOID = "humanoid"
"""The robot of the paper, and the default."""

ARM = "arm:"
"""What a name begins with that goes on with the file of a map."""

ENTRY_POINTS = "caryatid.robots"
"""Group under which other packages offer robots: callables that make one for `Surroundings`."""


@dataclass(frozen=True, eq=False, slots=True)
class Posture:
    """How the robot holds its camera at a pose.

    Attributes:
        platform_world: Platform (3,): x, y, yaw [m, m, rad].
        camera_height: Height of the camera centre over the floor [m], set by the torso lift.
        head_yaw: Against the platform, to the left [rad].
        head_pitch: Upwards [rad].
    """

    platform_world: Array
    camera_height: float
    head_yaw: float
    head_pitch: float


@dataclass(frozen=True, slots=True)
class Unreachable:
    """No posture.

    Attributes:
        reason: Why, for a person to read.
    """

    reason: str


class Robot(Protocol):
    """What carries the camera; one with views of its own is an `OwnViews` too."""

    @property
    def T_world_camera(self) -> Array:
        """Where the camera is now (4, 4)."""
        ...

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Say how the robot would stand with its camera at a pose (4, 4), or why it cannot."""
        ...

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that can be reached."""
        ...

    def move_to(self, T_world_camera: Array) -> float:
        """Go to a pose (4, 4) of the camera and return the length of the way [m].

        Raises:
            PlanningError: The pose cannot be reached.
        """
        ...


class OwnViews:
    """What a robot may say beyond `Robot`: one that inherits this is asked, another is not."""

    def view_sphere(self, proposed: ViewSphere) -> ViewSphere:
        """Say on which sphere this robot's views lie: radius, centre and points.

        What is asked twice, also about its own answer, is answered with the same sphere.

        Args:
            proposed: The sphere of the settings around the middle of the table top.

        Returns:
            The proposed one, unless a robot says otherwise.
        """
        return proposed

    def confirm(self, T_world_camera: Array) -> Unreachable | None:
        """Say why a candidate (4, 4) that was chosen cannot be taken after all; then another one is chosen.

        Returns:
            None, go ahead, unless a robot says otherwise.
        """
        return None


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


RobotMaker = Callable[[Surroundings], Robot]
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
        from caryatid.robots.humanoid import HumanoidRobot

        return lambda around: HumanoidRobot(around.floor, around.config.robot)
    if name.startswith(ARM):
        from caryatid.robots.arm import ArmRobot
        from caryatid.robots.reachability import read_reachability

        reachability = read_reachability(name.removeprefix(ARM))
        return lambda around: ArmRobot(
            reachability, around.T_world_base, around.config.arm, furniture=around.floor
        )
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


def view_sphere_of(robot: Robot, proposed: ViewSphere) -> ViewSphere:
    """Return the sphere a robot's views lie on: its own where it inherits `OwnViews`, else the proposed."""
    return robot.view_sphere(proposed) if isinstance(robot, OwnViews) else proposed


def refusal_of(robot: Robot, T_world_camera: Array) -> Unreachable | None:
    """Why a robot that inherits `OwnViews` does not take a candidate (4, 4) on a closer look, or None."""
    return robot.confirm(T_world_camera) if isinstance(robot, OwnViews) else None


def home_view(robot: Robot, sphere: ViewSphere, config: RobotConfig) -> Array:
    """Pick the first view: the reachable candidate (4, 4) nearest to `config.home` on its view sphere.

    Raises:
        PlanningError: No view of the sphere can be reached.
    """
    import numpy as np

    from caryatid.sensing.view_sphere import direction

    candidates = robot.candidates(view_sphere_of(robot, sphere))
    if len(candidates) == 0:
        why = ", ".join(f"{reason} ({count})" for reason, count in candidates.rejected.items())
        raise PlanningError(f"no view of the sphere can be reached: {why}")
    nearness = candidates.directions @ direction(*np.deg2rad(config.home))
    reasons: set[str] = set()
    for index in np.argsort(-nearness, kind="stable"):
        refused = refusal_of(robot, candidates.T_world_camera[index])
        if refused is None:
            return candidates.T_world_camera[index]
        reasons.add(refused.reason)
    raise PlanningError(f"no view of the sphere can be reached: {', '.join(sorted(reasons))}")
