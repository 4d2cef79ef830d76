"""Random scenes: piles, heaps, packed and household objects, blocks, boards and overhanging boards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import mujoco
import numpy as np

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere, fibonacci_sphere
from caryatid.geometry.solids import Polytope, Solid, hollowed
from caryatid.geometry.transforms import UP, Array
from caryatid.simulation import world
from caryatid.simulation.world import TABLE_HEIGHT, TABLE_SIZE, Body, Side, SimulatedScene

GeneratedKind = Literal["pile", "dense", "packed", "house", "blocks", "boards", "overhang"]
SIZES: dict[GeneratedKind, tuple[int, int]] = {
    "pile": (1, 25), "dense": (10, 25), "packed": (2, 25), "house": (1, 14), "blocks": (2, 10),
    "boards": (4, 12), "overhang": (4, 12),
}  # fmt: skip
"""Kind of a scene → minimum and maximum number of objects, including the screens of a dense one."""
GAP = 0.002
"""Height above the support from which an object is dropped [m]."""
CLOSE = 0.0005
"""Distance of touching objects before they settle [m]; far below a camera's resolution."""
TRIES = 10
"""Failed attempts to set down an object after which the one before it is removed too."""

_Drop = tuple[Body, bool]
"""A body where it is dropped, and whether it must stay on another one."""


@dataclass(frozen=True, eq=False, slots=True)
class _Plan:
    """Setup of a scene: function that draws each object, what stands first, size of the table [m], walls."""

    draw: Callable[[SimulatedScene | None], _Drop]
    screens: tuple[Body, ...] = ()
    table: tuple[float, float] = TABLE_SIZE
    walls: tuple[Side, ...] = ()


def generate(
    kind: GeneratedKind, size: int, seed: int, physics: PhysicsConfig | None = None
) -> SimulatedScene:
    """Set down random objects one by one, each once all others are at rest.

    A `pile` has most of them on earlier ones. `dense` heaps them between tall free screens, with walls that
    block part of the robot's way around. `packed` pushes them together until they touch. All these use
    primitives. `house` has trays, bowls, mugs, plates, books and the like on and in each other. `blocks` are
    equal boxes in a row, a wall or a pyramid, with gaps of 0 to 15 mm. `boards` has a board, plank or tray on
    two pillars, with loads on it and lower objects under it. `overhang` has boards over the edge of the table
    or of a block, each held down by a weight, and other objects around them.

    Args:
        kind: Kind of scene.
        size: Number of objects, including screens.
        seed: Seed; the same kind, size and seed give the same scene.
        physics: When an object counts as at rest.

    Raises:
        InputError: The size or seed is out of range, or an object does not stay in place.
    """
    name = f"{kind}-{size}-{seed}"
    least, most = SIZES[kind]
    if not least <= size <= most:
        raise InputError(name, f"{size} objects are out of range", f"give {least} to {most}")
    if seed < 0:
        raise InputError(name, f"seed {seed} is negative", "give 0 or more")
    rng = np.random.default_rng([list(SIZES).index(kind), size, seed])
    plans: dict[GeneratedKind, Callable[[np.random.Generator, int], _Plan]] = {
        "pile": partial(_stacked, make=_upright, margin=0.06),
        "dense": _dense,
        "packed": _packed,
        "house": partial(_stacked, make=thing, margin=0.12),
        "blocks": _blocks,
        "boards": _boards,
        "overhang": _overhang,
    }
    return _set_down(name, size, plans[kind](rng, size), physics or PhysicsConfig())


def _dense(rng: np.random.Generator, size: int) -> _Plan:
    """Three in ten objects of the heap are dropped in a random orientation, the others upright."""
    radius = 0.12 * max(1.0, np.sqrt(size / 16))
    # Two to four thin boxes, taller than most of the heap, with broad sides facing the middle.
    around = int(rng.integers(2, 5))
    step = 2.0 * np.pi / around
    azimuths = rng.uniform(-np.pi, np.pi) + step * (np.arange(around) + rng.uniform(-0.2, 0.2, size=around))
    screens = []
    for azimuth in azimuths:
        distance = rng.uniform(0.2, 0.27)
        width, height = rng.uniform(0.12, 0.18), rng.uniform(0.23, 0.32)
        at = (distance * np.cos(azimuth), distance * np.sin(azimuth), TABLE_HEIGHT + height / 2.0)
        T = transforms.rigid(transforms.rotation_from_vector((0.0, 0.0, azimuth)), at)
        screens.append(Body(Box(T, np.array([0.05, width, height])), density=1200.0))
    sides: tuple[Side, ...] = ("+x", "+y", "-y")
    count = int(rng.integers(1, 3))
    walls = tuple(sides[i] for i in sorted(rng.choice(3, size=count, replace=False)))

    def draw(scene: SimulatedScene | None) -> _Drop:
        shape = _shape(rng, transforms.random_rotation(rng)) if rng.random() < 0.3 else _upright(rng)
        for _ in range(TRIES + 1):
            r, azimuth = radius * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
            solid = _let_go(shape, np.array([r * np.cos(azimuth), r * np.sin(azimuth)]), scene)
            if not any(_overlap(solid.shape, screen.shape) for screen in screens):
                break
        return solid, False

    return _Plan(draw, tuple(screens), (0.7, 1.0), walls)


def _packed(rng: np.random.Generator, size: int) -> _Plan:
    """Half of the objects are parallel, so that faces touch; three in ten are set down on another one."""
    turn = _yaw(rng)

    def draw(scene: SimulatedScene | None) -> _Drop:
        shape = _upright(rng)
        if rng.random() < 0.5:  # turn its level axes to those of the pack
            R = shape.T_world_object[:3, :3]
            level = int(np.argmin(np.abs(R[2])))
            back = transforms.rotation_from_vector((0.0, 0.0, -np.arctan2(R[1, level], R[0, level])))
            shape = shape.moved(transforms.rigid(turn @ back, np.zeros(3)))
        if scene is None:
            return _let_go(shape, np.zeros(2), scene), False
        if rng.random() < 0.3:
            return _on_another(rng, shape, scene), True
        azimuth = rng.uniform(-np.pi, np.pi)
        outward_world = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        return Body(_pushed(shape, outward_world, list(world.true_shapes(scene).values()))), False

    return _Plan(draw)


def _blocks(rng: np.random.Generator, size: int) -> _Plan:
    """Equal boxes side by side and in layers, with one orientation."""
    extents = rng.uniform((0.04, 0.04, 0.04), (0.07, 0.1, 0.08))
    gap = rng.uniform(CLOSE, 0.015)
    pyramid = int(np.ceil(np.sqrt(2.0 * size + 0.25) - 0.5))
    # Number of boxes in the lowest layer, and how many fewer each layer has than the one below.
    base, fewer = [(size, 0), ((size + 1) // 2, 0), (pyramid, 1)][int(rng.integers(3))]
    layers = [(layer, base - fewer * layer) for layer in range(base if fewer else 2)]
    cells = [(k - (count - 1) / 2.0, layer) for layer, count in layers for k in range(count)][:size]
    turn = transforms.rigid(_yaw(rng), np.zeros(3))

    def draw(scene: SimulatedScene | None) -> _Drop:
        along, layer = cells[0 if scene is None else len(scene.object_bodies)]
        z = TABLE_HEIGHT + (layer + 0.5) * extents[2] + (layer + 1) * CLOSE
        box = Box(transforms.rigid(np.eye(3), (along * (extents[0] + gap), 0.0, z)), extents)
        return Body(box.moved(turn)), layer > 0

    return _Plan(draw)


def _boards(rng: np.random.Generator, size: int) -> _Plan:
    """A board hides the upper ends of its pillars, and of lower objects between them, from above."""
    turn = transforms.rigid(_yaw(rng), np.zeros(3))
    height, length = float(rng.uniform(0.08, 0.16)), float(rng.uniform(0.3, 0.45))
    apart = length * float(rng.uniform(0.6, 0.8))
    thickness = float(rng.uniform(0.012, 0.03))
    board: Shape = Box(np.eye(4), np.array([float(rng.uniform(0.1, 0.2)), length, thickness]))
    if rng.random() < 0.3:
        board = _hollow_box(float(rng.uniform(0.14, 0.22)), length, float(rng.uniform(0.025, 0.05)))
    under = 2 + max(1, (size - 3) // 2)

    def draw(scene: SimulatedScene | None) -> _Drop:
        number = 0 if scene is None else len(scene.object_bodies)
        for _ in range(TRIES + 1):
            if number < 2:
                shape, at = _pillar(rng, height), np.array([0.0, (number - 0.5) * apart])
            elif number < under:
                shape = _pillar(rng, height * float(rng.uniform(0.4, 0.9)))
                if rng.random() < 0.3:
                    shape = Sphere(np.eye(4), float(rng.uniform(0.022, 0.45 * height)))
                at = rng.uniform((-0.05, -0.3 * apart), (0.05, 0.3 * apart))
            elif number == under:
                shape, at = board, np.array([0.0, rng.uniform(-0.02, 0.02)])
            else:
                shape, at = _upright(rng), rng.uniform((-0.03, -0.4 * length), (0.03, 0.4 * length))
            solid = _let_go(shape.moved(turn), turn[:2, :2] @ at, scene)
            top = solid.shape.T_world_object[2, 3] + solid.shape.support(UP[None])[0] - TABLE_HEIGHT
            if not 2 <= number < under or top < 0.95 * height:
                break
        return solid, number > under

    return _Plan(draw)


def _pillar(rng: np.random.Generator, height: float) -> Shape:
    """A can or a carton of this height [m], at the origin."""
    if rng.random() < 0.5:
        return Cylinder(np.eye(4), float(rng.uniform(0.025, 0.04)), height)
    return Box(np.eye(4), np.array([*rng.uniform(0.045, 0.08, size=2), height]))


def _overhang(rng: np.random.Generator, size: int) -> _Plan:
    """Boards with the middle 3 to 6 cm over an edge, of the table or of a block; from seven objects on, both.

    The weight on a board's other end has 1.3 to 4 times the moment that holds it.
    """
    bodies: list[Body] = []
    azimuth = rng.integers(4) * np.pi / 2.0
    for on_block in rng.permutation([False, True])[: 1 + (size >= 7)]:
        length, width, thick = rng.uniform((0.3, 0.06, 0.015), (0.42, 0.1, 0.025))
        out, depth, *extents = rng.uniform((0.03, 0.09, 0.05, 0.05, 0.05), (0.06, 0.13, 0.07, 0.07, 0.09))
        behind = (length / 2.0 - out - extents[0] / 2.0) * rng.uniform(0.7, 1.0)
        behind = min(behind, 0.6 * depth) if on_block else behind
        # The edge is the y axis of a frame whose x points outwards.
        turn = azimuth + np.pi + rng.uniform(-1.0, 1.0) if on_block else azimuth
        side, along = np.array(TABLE_SIZE if azimuth % np.pi == 0.0 else TABLE_SIZE[::-1]) / 2.0
        height = rng.uniform(0.08, 0.13) if on_block else 0.0
        edge = (-0.1, 0.0) if on_block else (side, rng.uniform(-0.5, 0.5) * along)
        R = transforms.rotation_from_vector((0.0, 0.0, azimuth))
        at = R @ (*edge, TABLE_HEIGHT + height + CLOSE)
        T = transforms.rigid(transforms.rotation_from_vector((0.0, 0.0, turn)), at)

        def put(x: float, z: float, shape: Sequence[float], density: float, T: Array = T) -> None:
            T_edge_box = transforms.rigid(np.eye(3), (x, 0.0, z + shape[2] / 2.0))
            bodies.append(Body(Box(T @ T_edge_box, np.array(shape)), density))

        if on_block:
            put(-depth / 2.0, -height, (depth, depth, height - CLOSE), 800.0)
        put(out, 0.0, (length, width, thick), 600.0)
        holds = 600.0 * length * width * thick * out / (behind * float(np.prod(extents)))
        put(-behind, thick + CLOSE, extents, max(300.0, holds * rng.uniform(1.3, 4.0)))

    def draw(scene: SimulatedScene | None) -> _Drop:
        assert scene is not None
        if rng.random() < 0.3:
            return _on_another(rng, _upright(rng), scene), True
        return _let_go(_upright(rng), rng.uniform(-0.5, 0.5, size=2) * TABLE_SIZE * 0.8, scene), False

    return _Plan(draw, tuple(bodies))


def _stacked(
    rng: np.random.Generator, size: int, make: Callable[[np.random.Generator], Shape], margin: float
) -> _Plan:
    """Seven in ten shapes are set down on another one, the others on the table, a margin [m] off its edge."""

    def draw(scene: SimulatedScene | None) -> _Drop:
        shape = make(rng)
        if scene is None or rng.random() >= 0.7:
            half = np.array(TABLE_SIZE) / 2.0 - margin
            return _let_go(shape, rng.uniform(-half, half), scene), False
        return _on_another(rng, shape, scene), True

    return _Plan(draw)


def _set_down(name: str, size: int, plan: _Plan, physics: PhysicsConfig) -> SimulatedScene:
    """Drop solids one after the other, each when all are at rest; failures are tried again.

    Screens must not be upset; without screens, no earlier object. If nothing can be set down, the last solid
    is removed again too; after 40 drops per object the scene fails.
    """

    def build(solids: Sequence[Body], config: PhysicsConfig = physics, least: float = 0.0) -> SimulatedScene:
        spec = world.build_spec(solids, name, plan.table, plan.walls)
        return world.scene_from_spec(spec, name, name, config, least=least)

    # An object that has not come to rest after two seconds is set down again.
    impatient = replace(physics, settle_time=2.0)
    solids, failures = list(plan.screens), 0
    fixed = len(solids)
    below = build(solids) if solids else None
    for _ in range(40 * size):
        if len(solids) == size:
            return build(solids)
        solid, stacked = plan.draw(below)
        tried = build([*solids, solid], impatient, least=0.3)
        on_the_table = world.bounds(tried, len(solids) + 1)[0][2] <= TABLE_HEIGHT + GAP
        slipped = stacked and failures < TRIES // 2 and on_the_table
        if not slipped and _stands(tried, solids[:fixed] or solids, plan, physics):
            shapes = world.true_shapes(tried).values()
            solids = [replace(s, shape=shape) for s, shape in zip([*solids, solid], shapes, strict=True)]
            below, failures = tried, 0
            continue
        failures += 1
        if failures == TRIES and len(solids) > fixed:
            solids, failures = solids[:-1], 0
            below = build(solids) if solids else None
    raise InputError(name, f"object{len(solids)} would not stay on the table", "choose another seed")


def _stands(scene: SimulatedScene, firm: Sequence[Body], plan: _Plan, physics: PhysicsConfig) -> bool:
    """Whether all objects rest on the table or each other, with the firm ones, the first, about in place.

    An object whose middle is within a centimetre of the table's edge counts as fallen, unless it stood there
    first; none may reach higher than 36 cm above the table. Setting down another one may shift the firm ones
    by up to 4 cm.
    """
    shapes = world.true_shapes(scene)
    half = np.array(plan.table) / 2.0 - 0.01
    for label, shape in shapes.items():
        low, high = world.bounds(scene, label)
        if low[2] < TABLE_HEIGHT - GAP or high[2] > TABLE_HEIGHT + 0.36:
            return False
        if label > len(plan.screens) and (np.abs(shape.T_world_object[:2, 3]) > half).any():
            return False
    for label, solid in enumerate(firm, start=1):
        shift = shapes[label].T_world_object[:3, 3] - solid.shape.T_world_object[:3, 3]
        if np.linalg.norm(shift) > 0.04:
            return False
    if not scene.at_rest:
        return False
    # Nothing moves by itself, not even slowly, while the effect of a removal is observed.
    data = world.state_of(scene)
    mujoco.mj_step(scene.model, data, nstep=round(physics.removal_time / scene.model.opt.timestep))
    limits = physics.moved / 2.0, physics.turned / 2.0
    return not world.strayed(world.body_poses(scene.data), world.body_poses(data), *limits).any()


def _let_go(shape: Shape, xy: Array, scene: SimulatedScene | None) -> Body:
    """Put a shape from the origin just above the boxes around the objects at a place (2,) [m]."""
    over = shape.moved(transforms.rigid(np.eye(3), (*xy, 0.0)))
    tops = [TABLE_HEIGHT]
    if scene is not None:
        others = world.true_shapes(scene).items()
        tops += [float(world.bounds(scene, label)[1][2]) for label, other in others if _overlap(over, other)]
    z = max(tops) + float(shape.support(np.array([[0.0, 0.0, -1.0]]))[0]) + GAP
    return Body(over.moved(transforms.rigid(np.eye(3), (0.0, 0.0, z))))


def _on_another(rng: np.random.Generator, shape: Shape, scene: SimulatedScene) -> Body:
    """Put a shape from the origin over a random object, up to 0.3 of its half extents off its middle."""
    below = list(world.true_shapes(scene).values())[int(rng.integers(len(scene.object_bodies)))]
    reach = 0.3 * below.support(np.eye(3))[:2]
    xy = below.T_world_object[:2, 3] + reach * rng.uniform(-1.0, 1.0, size=2)
    return _let_go(shape, xy, scene)


def _overlap(shape: Shape, other: Shape) -> bool:
    """Whether the level boxes around two shapes overlap, seen from above."""
    apart = np.abs(shape.T_world_object[:2, 3] - other.T_world_object[:2, 3])
    return bool((apart < (shape.support(np.eye(3)) + other.support(np.eye(3)))[:2]).all())


def _yaw(rng: np.random.Generator) -> Array:
    """A random rotation (3, 3) about the vertical."""
    return transforms.rotation_from_vector((0.0, 0.0, rng.uniform(-np.pi, np.pi)))


def _upright(rng: np.random.Generator) -> Shape:
    """A shape at the origin with one axis vertical; three in ten lie on their side."""
    yaw = _yaw(rng)
    on_its_side = transforms.rotation_from_vector((np.pi / 2.0, 0.0, 0.0))
    return _shape(rng, yaw @ on_its_side if rng.random() < 0.3 else yaw)


def _shape(rng: np.random.Generator, R: Array) -> Shape:
    """A shape at the origin, of a graspable size; most are boxes."""
    T = transforms.rigid(R, np.zeros(3))
    kind = rng.choice(3, p=(0.6, 0.25, 0.15))
    radius = float(rng.uniform(0.022, 0.045))
    if kind == 0:
        return Box(T, rng.uniform(0.045, 0.14, size=3))
    if kind == 1:
        return Cylinder(T, radius, float(rng.uniform(0.05, 0.13)))
    return Sphere(T, radius)


def _pushed(shape: Shape, outward_world: Array, others: Sequence[Shape]) -> Shape:
    """Push a shape over the table from outside towards the middle, until it is `CLOSE` to another one."""
    z = TABLE_HEIGHT + float(shape.support(np.array([[0.0, 0.0, -1.0]]))[0]) + CLOSE
    distance = float(np.hypot(*TABLE_SIZE))
    for _ in range(60):
        at = shape.moved(transforms.rigid(np.eye(3), distance * outward_world + (0.0, 0.0, z)))
        # From samples on both surfaces, 4 mm apart.
        pairs = [pair for other in others for pair in ((at, other), (other, at))]
        gap = min(float(a.signed_distance(b.surface(0.004)[0]).min()) for a, b in pairs)
        if gap < CLOSE or distance <= 0.0:
            break
        distance = max(distance - gap + CLOSE / 2.0, 0.0)
    return at


# Household objects, upright at the origin

WALL = 0.006
"""Thickness of walls [m]."""
CORNERS = 12
"""Corners of a ring of a round object [1]."""

Ring = tuple[float, float]
"""Radius and height [m]."""


def thing(rng: np.random.Generator) -> Shape:
    """Draw a tray, a bowl, a mug or the like; four in ten are hollow."""
    kinds = {
        "tray": 0.1, "bowl": 0.12, "mug": 0.12, "open box": 0.06, "plate": 0.14,
        "book": 0.14, "carton": 0.08, "can": 0.08, "bottle": 0.06, "fruit": 0.1,
    }  # fmt: skip
    made = {"tray": tray, "bowl": bowl, "mug": mug, "bottle": bottle}
    shape: Shape
    match list(kinds)[int(rng.choice(len(kinds), p=list(kinds.values())))]:
        case "open box":
            shape = _hollow_box(*rng.uniform((0.11, 0.13, 0.07), (0.15, 0.2, 0.11)))
        case "plate":
            shape = Cylinder(np.eye(4), float(rng.uniform(0.085, 0.12)), 0.018)
        case "book":
            shape = Box(np.eye(4), rng.uniform((0.13, 0.18, 0.018), (0.17, 0.24, 0.045)))
        case "carton":
            shape = Box(np.eye(4), rng.uniform((0.06, 0.11, 0.16), (0.08, 0.14, 0.2)))
        case "can":
            shape = Cylinder(np.eye(4), float(rng.uniform(0.03, 0.04)), float(rng.uniform(0.09, 0.125)))
        case "fruit":
            half = rng.uniform(0.028, 0.042) * np.array([1.0, 0.95, 0.88])
            shape = Solid.of([_hull(fibonacci_sphere(120) * half)])
        case kind:
            shape = made[kind](rng)
    return shape.moved(transforms.rigid(_yaw(rng), np.zeros(3)))


def tray(rng: np.random.Generator) -> Solid:
    """Draw a tray with a low rim."""
    return _hollow_box(*rng.uniform((0.2, 0.26, 0.03), (0.27, 0.36, 0.06)))


def _hollow_box(x: float, y: float, z: float) -> Solid:
    """Four walls and a floor."""
    block = _hull([[a * x / 2.0, b * y / 2.0, c * z] for a in (-1, 1) for b in (-1, 1) for c in (0, 1)])
    along_x, along_y, up = np.eye(3)
    walls = [(s * axis, WALL - size / 2.0) for axis, size in ((along_x, x), (along_y, y)) for s in (-1, 1)]
    return Solid.of(hollowed(block, [(up, WALL), *walls]))


def bowl(rng: np.random.Generator) -> Solid:
    """Draw two rings of a wall that opens up, on a smaller floor."""
    foot, waist, rim = np.array([0.5, 0.85, 1.0]) * rng.uniform(0.07, 0.1)
    height = float(rng.uniform(0.05, 0.075))
    rings = [(foot, 0.0), (waist, 0.45 * height), (rim, height)]
    return Solid.of([part for low, high in pairwise(rings) for part in _wall(low, high)] + [_disc(foot)])


def mug(rng: np.random.Generator) -> Solid:
    """Draw a straight wall, a floor, and a handle of three bars."""
    radius, height = float(rng.uniform(0.036, 0.046)), float(rng.uniform(0.075, 0.1))
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / 2.0
    bars = (
        ((radius + 0.01, 0.0, 0.25 * height), (0.024, 0.01, 0.01)),
        ((radius + 0.01, 0.0, 0.75 * height), (0.024, 0.01, 0.01)),
        ((radius + 0.025, 0.0, 0.5 * height), (0.01, 0.01, 0.5 * height + 0.01)),
    )
    handle = [_hull(centre + corners * extents) for centre, extents in bars]
    return Solid.of([*_wall((radius, 0.0), (radius, height)), _disc(radius), *handle])


def bottle(rng: np.random.Generator) -> Solid:
    """Draw a body, a shoulder and a neck; nothing fits into it."""
    radius, height = float(rng.uniform(0.03, 0.04)), float(rng.uniform(0.17, 0.24))
    rings = [(radius, 0.0), (radius, 0.6 * height), (0.013, 0.78 * height), (0.013, height)]
    return Solid.of([_hull([*_ring(a), *_ring(b)]) for a, b in pairwise(rings)])


def _wall(low: Ring, high: Ring) -> list[Polytope]:
    """A ring of a wall, in one part per corner."""
    rings = [_ring((radius - inset, height)) for radius, height in (low, high) for inset in (0.0, WALL)]
    turned = [np.roll(ring, -1, axis=0) for ring in rings]
    return [_hull([ring[k] for ring in [*rings, *turned]]) for k in range(CORNERS)]


def _disc(radius: float) -> Polytope:
    """The floor of a round object."""
    return _hull([*_ring((radius - WALL / 2.0, 0.0)), *_ring((radius - WALL / 2.0, WALL))])


def _ring(ring: Ring) -> Array:
    """Corners (CORNERS, 3) [m] of a level ring around the z axis."""
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    radius, height = ring
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(CORNERS, height)], axis=-1)


def _hull(points: Sequence[Sequence[float]] | Array) -> Polytope:
    part = Polytope.around(np.array(points, dtype=np.float64))
    assert part is not None
    return part
