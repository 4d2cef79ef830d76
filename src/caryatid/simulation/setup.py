"""A simulated robot with its camera before a scene, ready to explore."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caryatid.config import Config, NoiseModel
from caryatid.robots import HUMANOID, Robot, RobotMaker, Surroundings, find_robot, home_view
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.simulation.body import HumanoidBody
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.world import SimulatedScene, static_boxes, table_centre


@dataclass(frozen=True, eq=False, slots=True)
class Simulation:
    """What `explore` needs of a simulation.

    Attributes:
        camera: Gives views of the scene.
        robot: Stands where the first view is taken.
    """

    camera: SimulatedCamera
    robot: Robot


def make_simulation(
    scene: SimulatedScene,
    config: Config,
    *,
    noise: NoiseModel,
    seed: int,
    robot: RobotMaker | str = HUMANOID,
) -> Simulation:
    """Put a robot before the table, at its home view, with the furniture on its floor map.

    Args:
        scene: The scene in physics.
        config: Robot, sensor, noise and view sphere.
        noise: Noise of the camera.
        seed: Seed of the noise.
        robot: Makes the robot, or the name of one as `find_robot` knows it.

    Raises:
        InputError: There is no robot of this name.
        PlanningError: No view of the table can be reached.
    """
    centre = table_centre(scene)
    floor = FloorGrid.from_boxes(static_boxes(scene), config.robot, centre[:2])
    make = find_robot(robot) if isinstance(robot, str) else robot
    made = make(Surroundings(centre, floor, config))
    made.move_to(home_view(made, ViewSphere.around(centre, config.active), config.robot))
    body = HumanoidBody(scene, made, config.robot) if isinstance(made, HumanoidRobot) else None
    camera = SimulatedCamera(scene, noise, config.noise, np.random.default_rng(seed), config.sensor, body)
    return Simulation(camera, made)
