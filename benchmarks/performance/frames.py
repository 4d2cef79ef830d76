"""What is measured on: views of a heap in simulation, and of tables of any number of objects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caryatid.config import Config, SensorConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.transforms import Array
from caryatid.robots import Robot
from caryatid.sensing.view_sphere import ViewSphere, direction
from caryatid.sensing.views import View
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.world import (
    TABLE_HEIGHT,
    SimulatedScene,
    Solid,
    build_spec,
    scene_from_spec,
    table_top,
)

HEAP = "pile-10-1"
"""Scene of ten objects, some on others."""
VIEWS = 8
"""Views of it: the first one and the seven a median is taken of."""
ELEVATION = 38.0
"""Of the ring of views over the table [deg]; what the robot reaches all around."""
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
"""Between consecutive views [rad]: spreads any number of them all around, and neighbours far apart."""
WIDE_TABLE = (1.2, 1.2)
"""Of the tables of many objects [m]: holds a hundred, and all of it is in the image."""
PITCH = 0.11
"""Between places on it [m]: a free gap between objects of 4 to 7 cm."""


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """Views of a scene and the robot that took them.

    Attributes:
        name: Of the scene.
        config: All settings; the sensor's are those of the views.
        poses: Where the camera truly was (V, 4, 4).
        views: What it gave.
        robot: Can be where the views are.
    """

    name: str
    config: Config
    poses: Array
    views: tuple[View, ...]
    robot: Robot


def record(
    scene: SimulatedScene, count: int = VIEWS, sensor: SensorConfig | None = None, seed: int = 0
) -> Recording:
    """Take views from all around, with the noise and the registration error of the simulated camera."""
    config = replace(Config(), sensor=sensor or SensorConfig())
    stage = make_simulation(scene, config, noise="carmine", seed=seed)
    poses = ring(scene, stage.robot, config, count)
    return Recording(scene.name, config, poses, tuple(stage.camera.capture(T) for T in poses), stage.robot)


def capture(scene: SimulatedScene, count: int, seed: int = 0) -> Iterator[tuple[Array, View]]:
    """Pose and view, one after the other, of as many as `record` would take; none is kept."""
    stage = make_simulation(scene, Config(), noise="carmine", seed=seed)
    for T_world_camera in ring(scene, stage.robot, Config(), count):
        yield T_world_camera, stage.camera.capture(T_world_camera)


def ring(scene: SimulatedScene, robot: Robot, config: Config, count: int) -> Array:
    """Poses (V, 4, 4) around the table that the robot reaches, the first where it stands."""
    top = table_top(scene)
    centre = np.append(top.corners_world[:, :2].mean(axis=0), top.height)
    sphere = ViewSphere.around(centre, config.active)
    reached = robot.candidates(sphere)
    first = sphere.direction_of(robot.T_world_camera)
    azimuths = np.arctan2(first[1], first[0]) + GOLDEN_ANGLE * np.arange(1, count)
    wanted = np.stack([first, *(direction(a, np.deg2rad(ELEVATION)) for a in azimuths)])
    nearest = np.argmax(reached.directions @ wanted.T, axis=0)
    poses = reached.T_world_camera[nearest]
    poses[0] = robot.T_world_camera
    return poses


def fresh(view: View, *, labels: bool = True) -> View:
    """The view as its camera's images make it: nothing is worked out of it yet."""
    return replace(view, labels=view.labels if labels else None)


def heap() -> SimulatedScene:
    """The scene of ten objects."""
    return load_scene(HEAP)


def table_of(count: int, seed: int = 0) -> SimulatedScene:
    """A table with so many boxes, cylinders and balls in rows, every third one on top of another."""
    rng = np.random.default_rng([count, seed])
    stacked = count // 3
    side = int(np.ceil(np.sqrt(count - stacked)))
    places = (np.argwhere(np.ones((side, side))) - (side - 1) / 2.0) * PITCH
    places = places[np.argsort(np.hypot(*places.T), kind="stable")][: count - stacked]
    below = [_standing(xy, 0.0, rng, flat=k < stacked) for k, xy in enumerate(places)]
    above = [_standing(b.T_world_object[:2, 3], b.extents[2], rng) for b in below[:stacked]]
    spec = build_spec([Solid(shape) for shape in (*below, *above)], f"table-of-{count}", WIDE_TABLE)
    return scene_from_spec(spec, f"table-of-{count}", f"table-of-{count}")


def _standing(xy: Array, height: float, rng: np.random.Generator, *, flat: bool = False) -> Shape:
    """A shape that stands over the table at a height [m]; with `flat` one that others can stand on."""
    turn = transforms.rotation_from_vector((0.0, 0.0, rng.uniform(-np.pi, np.pi)))
    kind = rng.choice(["box", "cylinder"] if flat else ["box", "cylinder", "sphere"])
    size = rng.uniform(0.04, 0.07, 3)
    tall = size[0] if kind == "sphere" else size[2]
    T = transforms.rigid(turn, (*xy, TABLE_HEIGHT + height + tall / 2.0 + 1e-4))
    if kind == "box":
        return Box(T, size)
    if kind == "cylinder":
        return Cylinder(T, size[0] / 2.0, size[2])
    return Sphere(T, size[0] / 2.0)


def sensors(widths: Sequence[int]) -> list[SensorConfig]:
    """The usual camera with other numbers of pixels over the same field of view."""
    usual = SensorConfig()
    return [
        replace(usual, width=w, height=w * usual.height // usual.width, focal=usual.focal * w / usual.width)
        for w in widths
    ]
