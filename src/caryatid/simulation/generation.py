"""Random scenes by size and seed: piles, dense heaps between screens and walls, and packed objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.transforms import Array
from caryatid.simulation.world import (
    TABLE_HEIGHT,
    TABLE_SIZE,
    Side,
    SimulatedScene,
    Solid,
    bounds,
    build_spec,
    displacement,
    scene_from_spec,
    state_of,
    true_shapes,
)

PILE_SIZES = (1, 25)
"""Fewest and most objects of a pile."""

DENSE_SIZES = (10, 25)
"""Fewest and most objects of a dense scene, the screens among them."""

BOX_EDGE = (0.045, 0.14)
"""Shortest and longest edge of a box [m]; what a hand takes from a table."""
RADIUS = (0.022, 0.045)
"""Radius of cylinders and balls [m]."""
CYLINDER_HEIGHT = (0.05, 0.13)
"""Height of cylinders [m]."""
MIXTURE = (0.6, 0.25, 0.15)
"""Shares of boxes, cylinders and balls [1]."""
STACKED = 0.7
"""Share of a pile's objects that are set down on another one [1]."""
JITTER = 0.3
"""How far off the middle of the one below an object is set down, as a share of its half extent [1]."""
DROP_GAP = 0.002
"""Height over what is below from which an object is let go [m]."""
TABLE_MARGIN = 0.06
"""Objects are set down at least this far from the table's edge [m]."""
TRIES = 10
"""Times an object is set down anew while it falls off, rolls away or upsets others; then the one before
it is taken up again as well."""
PATIENCE = 40
"""Objects set down, for each that is wanted, before a scene is given up."""
REST_TIME = 2.0
"""An object that has not come to rest after this long is set down anew [s]."""
LYING = 0.3
"""Share of upright objects that are laid on their side, for cylinders [1]."""
SETTLING = 0.3
"""Time an object is given before rest is asked for [s]."""
BRINK = 0.01
"""An object whose middle is nearer to the table's edge than this has as good as fallen [m]."""
MAX_HEIGHT = 0.36
"""Nothing is set down so that it reaches higher over the table top [m]."""
UPSET = 0.04
"""Setting an object down may shift a pile's others, or a heap's screens, by this much [m]."""
PACKED_STACKED = 0.3
"""Share of a packed scene's objects that are set down on another one [1]."""
PACKED_ALIGNED = 0.5
"""Share of a packed scene's objects that are parallel to one another, so that faces touch [1]."""
PACKED_GAP = 0.0005
"""Gap between objects of a packed scene before they settle [m]; far below what a camera can see."""
HEAP_RADIUS = 0.12
"""Radius of the heap of a dense scene of 16 [m]; it grows with the root of the number beyond that."""
HEAP_TILTED = 0.3
"""Share of a heap's objects that are dropped in any attitude and not upright [1]."""
SCREENS = (2, 4)
"""Least and largest number of screens around the heap."""
SCREEN_DISTANCE = (0.2, 0.27)
"""Distance of the screens from the heap's middle [m]."""
SCREEN_WIDTH = (0.12, 0.18)
"""Width of a screen [m]."""
SCREEN_HEIGHT = (0.23, 0.32)
"""Height of a screen [m]; taller than most of the heap."""
SCREEN_THICKNESS = 0.05
"""Thickness of a screen [m]; stands firm, hides well."""
WALLS = (1, 2)
"""Least and largest number of walls beside the table."""

_DENSE_TABLE = (0.7, 1.0)
_HEAP_OF = 16
_SCREEN_DENSITY = 1200.0
_SIDES: tuple[Side, ...] = ("+x", "+y", "-y")
DOWN = np.array([[0.0, 0.0, -1.0]])
AXES = np.eye(3)
"""Straight down (1, 3), and the world's axes (3, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Drop:
    """A solid where it is let go.

    Attributes:
        solid: The solid.
        stacked: It is meant to stay on another one.
    """

    solid: Solid
    stacked: bool = False


Draw = Callable[[np.random.Generator, SimulatedScene | None], Drop]


def generate_pile(size: int, seed: int, physics: PhysicsConfig | None = None) -> SimulatedScene:
    """Set primitives down one by one, most of them on what is there already.

    Args:
        size: Number of objects.
        seed: Seed; the same size and seed give the same scene.
        physics: When an object is at rest.

    Raises:
        InputError: The size or the seed is out of range, or an object would not stay where it is put.
    """
    name = f"pile-{size}-{seed}"
    check_request(name, size, seed, PILE_SIZES)

    def draw(rng: np.random.Generator, scene: SimulatedScene | None) -> Drop:
        shape = upright(rng)
        if scene is None or rng.random() >= STACKED:
            half = np.array(TABLE_SIZE) / 2.0 - TABLE_MARGIN
            return Drop(let_go(shape, rng.uniform(-half, half), scene))
        below = true_shapes(scene)[int(rng.integers(1, len(scene.object_bodies) + 1))]
        reach = below.support(AXES)[:2]
        xy = below.T_world_object[:2, 3] + JITTER * reach * rng.uniform(-1.0, 1.0, size=2)
        return Drop(let_go(shape, xy, scene), stacked=True)

    rng = np.random.default_rng([0, size, seed])
    return set_down(name, [], [draw] * size, rng, Place(TABLE_SIZE, ()), physics)


def generate_dense(size: int, seed: int, physics: PhysicsConfig | None = None) -> SimulatedScene:
    """Heap primitives between tall free screens, with walls that close part of the circle for a robot.

    Args:
        size: Number of objects, the screens among them.
        seed: Seed; the same size and seed give the same scene.
        physics: When an object is at rest.

    Raises:
        InputError: The size or the seed is out of range, or an object would not stay where it is put.
    """
    name = f"dense-{size}-{seed}"
    check_request(name, size, seed, DENSE_SIZES)
    rng = np.random.default_rng([1, size, seed])
    radius = HEAP_RADIUS * max(1.0, np.sqrt(size / _HEAP_OF))
    screens = _screens(rng)
    count = int(rng.integers(WALLS[0], WALLS[1] + 1))
    walls = tuple(_SIDES[i] for i in sorted(rng.choice(len(_SIDES), size=count, replace=False)))

    def draw(rng: np.random.Generator, scene: SimulatedScene | None) -> Drop:
        shape = _tilted(rng) if rng.random() < HEAP_TILTED else upright(rng)
        solid = let_go(shape, _in_disc(rng, radius), scene)
        for _ in range(TRIES):
            if not _over(solid.shape, [screen.shape for screen in screens]):
                break
            solid = let_go(shape, _in_disc(rng, radius), scene)
        return Drop(solid)

    place = Place(_DENSE_TABLE, walls)
    return set_down(name, screens, [draw] * (size - len(screens)), rng, place, physics)


@dataclass(frozen=True, slots=True)
class Place:
    """What stays put.

    Attributes:
        table: Size of the table's top along x and y [m].
        walls: At which of its sides walls stand.
    """

    table: tuple[float, float]
    walls: tuple[Side, ...]


def set_down(
    name: str,
    solids: list[Solid],
    draws: Sequence[Draw],
    rng: np.random.Generator,
    place: Place,
    physics: PhysicsConfig | None,
) -> SimulatedScene:
    """Let solids go one after the other, each when all are at rest; what goes wrong is tried again.

    Solids that were there from the start must not be upset; where there were none, no earlier one must be.
    Where nothing can be set down any more, the last solid is taken up again too.

    Args:
        name: Of the scene.
        solids: What is there from the start.
        draws: Each draws a solid, given what is there already.
        rng: For every random choice.
        place: Table and walls.
        physics: Settings of the simulation, or None for those that come with it.

    Raises:
        InputError: The solids cannot be set down within the tries there are.
    """
    physics = physics or PhysicsConfig()
    impatient = replace(physics, settle_time=REST_TIME)

    def spec_of(solids: list[Solid]) -> Any:
        return build_spec(solids, name, place.table, place.walls)

    fixed, wanted, failures = len(solids), len(solids) + len(draws), 0
    below = scene_from_spec(spec_of(solids), name, name, physics) if solids else None
    for _ in range(PATIENCE * wanted):
        if len(solids) == wanted:
            return scene_from_spec(spec_of(solids), name, name, physics)
        drop = draws[len(solids) - fixed](rng, below)
        tried = scene_from_spec(spec_of([*solids, drop.solid]), name, name, impatient, least=SETTLING)
        insist = drop.stacked and failures < TRIES // 2
        if _stands(tried, solids[:fixed] or solids, place, physics) and (not insist or _is_raised(tried)):
            shapes = true_shapes(tried)
            solids = [
                replace(solid, shape=shapes[label])
                for label, solid in enumerate([*solids, drop.solid], start=1)
            ]
            below, failures = tried, 0
            continue
        failures += 1
        if failures == TRIES and len(solids) > fixed:
            solids, failures = solids[:-1], 0
            below = scene_from_spec(spec_of(solids), name, name, physics) if solids else None
    raise InputError(name, f"object{len(solids)} would not stay on the table", "choose another seed")


def _stands(
    scene: SimulatedScene,
    firm: list[Solid],
    place: Place,
    physics: PhysicsConfig,
) -> bool:
    """All objects are at rest on or over the table, and the firm ones, the first, about where they were."""
    shapes = true_shapes(scene)
    half = np.array(place.table) / 2.0 - BRINK
    for label, shape in shapes.items():
        low, high = bounds(scene, label)
        if low[2] < TABLE_HEIGHT - DROP_GAP or high[2] > TABLE_HEIGHT + MAX_HEIGHT:
            return False
        if (np.abs(shape.T_world_object[:2, 3]) > half).any():
            return False
    shifts = [
        float(np.linalg.norm(shapes[label].T_world_object[:3, 3] - solid.shape.T_world_object[:3, 3]))
        for label, solid in enumerate(firm, start=1)
    ]
    return scene.at_rest and max(shifts, default=0.0) <= UPSET and _keeps_still(scene, physics)


def _keeps_still(scene: SimulatedScene, physics: PhysicsConfig) -> bool:
    """Nothing moves by itself, not even slowly, while one would watch what taking an object away does."""
    data = state_of(scene)
    mujoco.mj_step(scene.model, data, nstep=round(physics.removal_time / scene.model.opt.timestep))
    distance, angle = displacement(scene.data.xpos, scene.data.xmat, data.xpos, data.xmat)
    return bool(distance.max() < physics.moved / 2.0 and angle.max() < np.deg2rad(physics.turned) / 2.0)


def _is_raised(scene: SimulatedScene) -> bool:
    """The last object does not reach the table."""
    return bool(bounds(scene, len(scene.object_bodies))[0][2] > TABLE_HEIGHT + DROP_GAP)


def let_go(shape: Shape, xy: Array, scene: SimulatedScene | None) -> Solid:
    """Put a shape a little over whatever the boxes around objects say is below it.

    Args:
        shape: At the origin, turned as it is to be.
        xy: Where (2,) [m].
        scene: What is there already, or None.
    """
    over = shape.moved(transforms.rigid(np.eye(3), (*xy, 0.0)))
    tops = [TABLE_HEIGHT]
    if scene is not None:
        shapes = true_shapes(scene)
        tops += [float(bounds(scene, label)[1][2]) for label in shapes if _over(over, [shapes[label]])]
    z = max(tops) + float(shape.support(DOWN)[0]) + DROP_GAP
    return Solid(over.moved(transforms.rigid(np.eye(3), (0.0, 0.0, z))))


def _over(shape: Shape, others: Sequence[Shape]) -> bool:
    """Whether the level boxes around two shapes overlap seen from above."""
    return any(
        (
            np.abs(shape.T_world_object[:2, 3] - other.T_world_object[:2, 3])
            < (shape.support(AXES) + other.support(AXES))[:2]
        ).all()
        for other in others
    )


def upright(rng: np.random.Generator) -> Shape:
    """Draw a shape at the origin with one axis vertical: a box on any face, a cylinder on an end or lying.

    Args:
        rng: For every random choice.
    """
    yaw = transforms.rotation_from_vector((0.0, 0.0, rng.uniform(-np.pi, np.pi)))
    R = yaw @ _ON_ITS_SIDE if rng.random() < LYING else yaw
    return _shape(rng, R)


def _tilted(rng: np.random.Generator) -> Shape:
    return _shape(rng, transforms.random_rotation(rng))


def _shape(rng: np.random.Generator, R: Array) -> Shape:
    T = transforms.rigid(R, np.zeros(3))
    kind = rng.choice(3, p=MIXTURE)
    radius = float(rng.uniform(*RADIUS))
    if kind == 0:
        return Box(T, rng.uniform(*BOX_EDGE, size=3))
    if kind == 1:
        return Cylinder(T, radius, float(rng.uniform(*CYLINDER_HEIGHT)))
    return Sphere(T, radius)


def _screens(rng: np.random.Generator) -> list[Solid]:
    """Tall thin boxes all around the middle, their broad sides to it."""
    count = int(rng.integers(SCREENS[0], SCREENS[1] + 1))
    step = 2.0 * np.pi / count
    azimuths = rng.uniform(-np.pi, np.pi) + step * (np.arange(count) + rng.uniform(-0.2, 0.2, size=count))
    screens = []
    for azimuth in azimuths:
        distance = rng.uniform(*SCREEN_DISTANCE)
        width, height = rng.uniform(*SCREEN_WIDTH), rng.uniform(*SCREEN_HEIGHT)
        at = (distance * np.cos(azimuth), distance * np.sin(azimuth), TABLE_HEIGHT + height / 2.0)
        T = transforms.rigid(transforms.rotation_from_vector((0.0, 0.0, azimuth)), at)
        screens.append(Solid(Box(T, np.array([SCREEN_THICKNESS, width, height])), _SCREEN_DENSITY))
    return screens


def _in_disc(rng: np.random.Generator, radius: float) -> Array:
    r, azimuth = radius * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
    return np.array([r * np.cos(azimuth), r * np.sin(azimuth)])


def check_request(name: str, size: int, seed: int, sizes: tuple[int, int]) -> None:
    """Raise InputError where a scene of this size or seed cannot be set up.

    Args:
        name: Of the scene.
        size: How many objects are asked for.
        seed: Its seed.
        sizes: Fewest and most objects there may be.

    Raises:
        InputError: The size is none of these, or the seed is negative.
    """
    if not sizes[0] <= size <= sizes[1]:
        raise InputError(name, f"{size} objects cannot be set up", f"ask for {sizes[0]} to {sizes[1]}")
    if seed < 0:
        raise InputError(name, f"seed {seed} is negative", "give 0 or more")


_ON_ITS_SIDE = transforms.rotation_from_vector((np.pi / 2.0, 0.0, 0.0))


PACKED_SIZES = (2, 25)
"""Fewest and most objects of a packed scene."""

_STEPS = 60
_SPACING = 0.004


def generate_packed(size: int, seed: int, physics: PhysicsConfig | None = None) -> SimulatedScene:
    """Push primitives together on the table until they touch, and stack some of them.

    Args:
        size: Number of objects.
        seed: Seed; the same size and seed give the same scene.
        physics: When an object is at rest.

    Raises:
        InputError: The size or the seed is out of range, or an object would not stay where it is put.
    """
    name = f"packed-{size}-{seed}"
    check_request(name, size, seed, PACKED_SIZES)
    rng = np.random.default_rng([2, size, seed])
    turn = transforms.rotation_from_vector((0.0, 0.0, rng.uniform(-np.pi, np.pi)))

    def draw(rng: np.random.Generator, scene: SimulatedScene | None) -> Drop:
        shape = upright(rng)
        if rng.random() < PACKED_ALIGNED:
            shape = _turned(shape, turn)
        if scene is None:
            return Drop(let_go(shape, np.zeros(2), scene))
        others = list(true_shapes(scene).values())
        if rng.random() < PACKED_STACKED:
            below = others[int(rng.integers(len(others)))]
            reach = JITTER * below.support(AXES)[:2]
            xy = below.T_world_object[:2, 3] + reach * rng.uniform(-1.0, 1.0, size=2)
            return Drop(let_go(shape, xy, scene), stacked=True)
        azimuth = rng.uniform(-np.pi, np.pi)
        return Drop(Solid(_pushed(shape, np.array([np.cos(azimuth), np.sin(azimuth), 0.0]), others)))

    return set_down(name, [], [draw] * size, rng, Place(TABLE_SIZE, ()), physics)


def _turned(shape: Shape, turn: Array) -> Shape:
    """Turn a shape at the origin so that its level axes are those of the pack."""
    R = shape.T_world_object[:3, :3]
    level = int(np.argmin(np.abs(R[2])))
    yaw = np.arctan2(R[1, level], R[0, level])
    back = transforms.rotation_from_vector((0.0, 0.0, -yaw))
    return shape.moved(transforms.rigid(turn @ back, np.zeros(3)))


def _pushed(
    shape: Shape,
    outward_world: Array,
    others: Sequence[Shape],
) -> Shape:
    """Push a shape over the table from outside towards the middle until it touches another."""
    z = TABLE_HEIGHT + float(shape.support(DOWN)[0]) + PACKED_GAP
    distance = float(np.hypot(*TABLE_SIZE))
    for _ in range(_STEPS):
        at = shape.moved(transforms.rigid(np.eye(3), distance * outward_world + (0.0, 0.0, z)))
        gap = min(_gap(at, other) for other in others)
        if gap < PACKED_GAP or distance <= 0.0:
            break
        distance = max(distance - gap + PACKED_GAP / 2.0, 0.0)
    return at


def _gap(a: Shape, b: Shape) -> float:
    """Distance [m] between two shapes, from samples on both surfaces."""
    return min(
        float(a.signed_distance(b.surface(_SPACING)[0]).min()),
        float(b.signed_distance(a.surface(_SPACING)[0]).min()),
    )
