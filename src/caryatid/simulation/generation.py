"""Random scenes: piles, heaps, packed and household objects, blocks, boards, overhangs, and storeys."""

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
from caryatid.simulation.world import FRAME, TABLE_HEIGHT, TABLE_SIZE, Body, Part, Side, SimulatedScene

GeneratedKind = Literal["pile", "dense", "packed", "house", "blocks", "boards", "overhang", "storeys"]
SIZES: dict[GeneratedKind, tuple[int, int]] = {
    "pile": (1, 25), "dense": (10, 25), "packed": (2, 25), "house": (1, 14), "blocks": (2, 10),
    "boards": (4, 12), "overhang": (4, 12), "storeys": (4, 8),
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
    """Setup of a scene: function that draws each object, what stands first, size of the table [m], walls.

    With other furniture instead of the table, objects stay where they are put.
    """

    draw: Callable[[SimulatedScene | None], _Drop]
    screens: tuple[Body, ...] = ()
    table: tuple[float, float] = TABLE_SIZE
    walls: tuple[Side, ...] = ()
    furniture: Sequence[Part] | None = None


def generate(
    kind: GeneratedKind, size: int, seed: int, physics: PhysicsConfig | None = None
) -> SimulatedScene:
    """Set down random objects one by one, each once all others are at rest.

    A `pile` has most of them on earlier ones. `dense` heaps them between tall free screens, with walls that
    block part of the robot's way around. `packed` pushes them together until they touch. All these use
    primitives. `house` has trays, bowls, mugs, plates, books and the like on and in each other. `blocks` are
    equal boxes in a row, a wall or a pyramid, with gaps of 0 to 15 mm. `boards` has a board, plank or tray on
    two pillars, with loads on it and lower objects under it. `overhang` has boards over the edge of the table
    or of a block, each held down by a weight, and other objects around them. `storeys` has primitives, some
    stacked, on the levels of one of eight kinds of furniture: a low table and the floor, a side table, the
    bare floor, a table with a step, a shelf, a cart, a bin on a table, or two tables.

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
        "storeys": _storeys,
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


Rectangle = tuple[float, float, float, float]
"""Middle and size of a level rectangle, each along x and y [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class _Level:
    """A level of furniture: height of its top, its outline, height of what is above it [m]."""

    height: float
    outline: Rectangle
    ceiling: float = np.inf

    @property
    def middle(self) -> Array:
        """Middle (2,) [m]."""
        return np.array(self.outline[:2])

    def carries(self, shape: Shape) -> bool:
        """Whether the middle of a shape is over the level."""
        x, y, z = shape.T_world_object[:3, 3]
        inside = (np.abs(self.middle - (x, y)) < np.array(self.outline[2:]) / 2.0).all()
        return bool(inside) and self.height < z < self.ceiling


def _storeys(rng: np.random.Generator, size: int) -> _Plan:
    """An object on each level first; three in ten of the others on another one."""
    kinds = (_low_table, _side_table, _ground, _step, _shelf, _cart, _bin, _two_tables)
    furniture, levels = kinds[int(rng.integers(len(kinds)))](rng)

    def draw(scene: SimulatedScene | None) -> _Drop:
        others = [] if scene is None else list(world.true_shapes(scene).values())
        for _ in range(TRIES + 1):
            level = levels[len(others) if len(others) < len(levels) else int(rng.integers(len(levels)))]
            shape, below = _upright(rng), [other for other in others if level.carries(other)]
            if below and rng.random() < 0.3:
                xy = _over_one(rng, below)
            else:
                half = np.array(level.outline[2:]) / 2.0 - 0.06
                xy = level.middle + rng.uniform(-half, half)
            solid = _let_go(shape, xy, scene, level.height, level.ceiling)
            if not any(_meets(solid.shape, part) for part in furniture):
                break
        return solid, False

    return _Plan(draw, furniture=furniture)


def _meets(shape: Shape, part: Part) -> bool:
    """Whether the level box around a shape, a centimetre wider and higher, overlaps a part."""
    apart = shape.T_world_object[:3, 3] + (0.0, 0.0, 0.005) - part.centre
    return bool((np.abs(apart) < shape.support(np.eye(3)) + (0.01, 0.01, 0.005) + part.half).all())


def _board(body: str, outline: Rectangle, top: float, thick: float = 0.02) -> Part:
    """A level board by the height of its top [m]."""
    x, y, depth, width = outline
    return Part(body, np.array([x, y, top - thick / 2.0]), np.array([depth, width, thick]) / 2.0)


def _upright_board(body: str, outline: Rectangle, bottom: float, top: float) -> Part:
    """A post or an upright board from one height to another [m]."""
    x, y, depth, width = outline
    return Part(
        body, np.array([x, y, (bottom + top) / 2.0]), np.array([depth, width, top - bottom]) / 2.0, FRAME
    )


_Furniture = tuple[list[Part], list[_Level]]


def _low_table(rng: np.random.Generator) -> _Furniture:
    """A low table, and objects on the floor along one side of it."""
    depth, width, height = rng.uniform((0.5, 0.7, 0.32), (0.65, 1.0, 0.48))
    side, (away, other) = rng.integers(4), rng.uniform((0.25, -0.2), (0.35, 0.2))
    x, y = [(depth / 2.0 + away, other), (other, width / 2.0 + away)][side % 2]
    x, y = (x, y) if side < 2 else (-x, -y)
    floor = _Level(0.0, (x, y, 0.4, 0.4))
    return world.make_table((depth, width), height=height), [_Level(height, (0.0, 0.0, depth, width)), floor]


def _side_table(rng: np.random.Generator) -> _Furniture:
    """A small table."""
    side, height = rng.uniform((0.38, 0.45), (0.48, 0.6))
    return world.make_table((side, side), height=height), [_Level(height, (0.0, 0.0, side, side))]


def _ground(rng: np.random.Generator) -> _Furniture:
    """The bare floor."""
    return [], [_Level(0.0, (0.0, 0.0, *rng.uniform(0.5, 0.8, size=2)))]


def _step(rng: np.random.Generator) -> _Furniture:
    """A board on two uprights, on the far half of a table."""
    depth, width, up = rng.uniform((0.26, 0.4, 0.16), (0.3, 0.44, 0.25))
    x, y = TABLE_SIZE[0] / 2.0 - depth / 2.0 - 0.01, rng.choice([-1.0, 1.0]) * rng.uniform(0.0, 0.2)
    top, under = TABLE_HEIGHT + up, TABLE_HEIGHT + up - 0.02
    ends = [(x, y + sign * (width / 2.0 - 0.02), depth, 0.016) for sign in (-1, 1)]
    uprights = [_upright_board("uprights", end, TABLE_HEIGHT, under) for end in ends]
    parts = [*world.make_table(), _board("step", (x, y, depth, width), top), *uprights]
    return parts, [_Level(TABLE_HEIGHT, (0.0, 0.0, *TABLE_SIZE)), _Level(top, (x, y, depth, width))]


def _shelf(rng: np.random.Generator) -> _Furniture:
    """Two or three boards in a case that is open to the robot."""
    depth, width, lowest, apart = rng.uniform((0.28, 0.7, 0.45, 0.32), (0.36, 0.9, 0.65, 0.42))
    tops = lowest + apart * np.arange(rng.integers(2, 4))
    outline, back, side = (0.1, 0.0, depth, width), 0.11 + depth / 2.0, 0.01 + width / 2.0
    walls = [(back, 0.0, 0.02, width + 0.04), *((0.1, y, depth, 0.02) for y in (-side, side))]
    case = [_upright_board("case", wall, 0.0, tops[-1] + 0.05) for wall in walls]
    boards = [_board(f"board{k}", outline, top) for k, top in enumerate(tops)]
    ceilings = [*(tops[1:] - 0.02), np.inf]
    return boards + case, [_Level(a, outline, b) for a, b in zip(tops, ceilings, strict=True)]


def _cart(rng: np.random.Generator) -> _Furniture:
    """Two boards between four posts."""
    depth, width, low, high = rng.uniform((0.4, 0.6, 0.25, 0.75), (0.5, 0.75, 0.35, 0.85))
    outline = (0.0, 0.0, depth, width)
    corners = [(a * (depth / 2 - 0.015), b * (width / 2 - 0.015)) for a in (-1, 1) for b in (-1, 1)]
    posts = [_upright_board("posts", (x, y, 0.024, 0.024), 0.0, high - 0.02) for x, y in corners]
    boards = [_board("cart_low", outline, low), _board("cart_high", outline, high)]
    return boards + posts, [_Level(high, outline), _Level(low, outline, high - 0.02)]


def _bin(rng: np.random.Generator) -> _Furniture:
    """An open bin on one half of a table, and objects on the other half too."""
    depth, width, wall = rng.uniform((0.28, 0.36, 0.08), (0.36, 0.42, 0.12))
    y = rng.choice([-1.0, 1.0]) * (TABLE_SIZE[1] / 4.0 - 0.01)
    outline, top, rim = (0.0, y, depth, width), TABLE_HEIGHT + 0.015, TABLE_HEIGHT + wall
    x_wall, y_wall = depth / 2.0 + 0.006, width / 2.0 + 0.006
    walls = [(s * x_wall, y, 0.012, width + 0.024) for s in (-1, 1)]
    walls += [(0.0, y + s * y_wall, depth, 0.012) for s in (-1, 1)]
    parts = [*world.make_table(), _board("bin", outline, top, 0.015)]
    parts += [_upright_board("bin_walls", side, TABLE_HEIGHT, rim) for side in walls]
    free = (0.0, -y, TABLE_SIZE[0], TABLE_SIZE[1] / 2.0 - 0.02)
    return parts, [_Level(TABLE_HEIGHT, free), _Level(top, outline)]


def _two_tables(rng: np.random.Generator) -> _Furniture:
    """A table of the usual height, and a lower one beside it."""
    parts, levels = list[Part](), []
    for name, side, height in ((world.TABLE, -1, TABLE_HEIGHT), ("table2", 1, rng.uniform(0.45, 0.62))):
        depth, width, gap = rng.uniform((0.45, 0.45, 0.02), (0.6, 0.55, 0.05))
        at = 0.0, side * (width / 2.0 + gap)
        parts += world.make_table((depth, width), height=height, at=at, name=name)
        levels.append(_Level(height, (*at, depth, width)))
    return parts, levels


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

    Screens must not be upset; without screens, no earlier object; on other furniture than a table, none. If
    nothing can be set down, the last solid is removed again too; after 40 drops per object the scene fails.
    """

    def build(solids: Sequence[Body], config: PhysicsConfig = physics, least: float = 0.0) -> SimulatedScene:
        table = world.make_table(plan.table, plan.walls)
        spec = world.build_spec(solids, name, table if plan.furniture is None else plan.furniture)
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
        firm = [*solids, solid] if plan.furniture is not None else solids[:fixed] or solids
        if not slipped and _stands(tried, firm, plan, physics):
            shapes = world.true_shapes(tried).values()
            solids = [replace(s, shape=shape) for s, shape in zip([*solids, solid], shapes, strict=True)]
            below, failures = tried, 0
            continue
        failures += 1
        if failures == TRIES and len(solids) > fixed:
            solids, failures = solids[:-1], 0
            below = build(solids) if solids else None
    raise InputError(name, f"object{len(solids)} would not stay where it was put", "choose another seed")


def _stands(scene: SimulatedScene, firm: Sequence[Body], plan: _Plan, physics: PhysicsConfig) -> bool:
    """Whether all objects rest on the table or each other, with the firm ones, the first, about in place.

    An object whose middle is within a centimetre of the table's edge counts as fallen, unless it stood there
    first; none may reach higher than 36 cm above the table. Setting down another one may shift the firm ones
    by up to 4 cm. On other furniture than a table, the latter suffices.
    """
    shapes = world.true_shapes(scene)
    half = np.array(plan.table) / 2.0 - 0.01
    for label, shape in shapes.items() if plan.furniture is None else ():
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


def _let_go(
    shape: Shape,
    xy: Array,
    scene: SimulatedScene | None,
    height: float = TABLE_HEIGHT,
    ceiling: float = np.inf,
) -> Body:
    """Put a shape from the origin just above the boxes around the objects at a place (2,) [m].

    Only objects between two heights [m] count, the lower of which is the support's.
    """
    over = shape.moved(transforms.rigid(np.eye(3), (*xy, 0.0)))
    tops = [height]
    if scene is not None:
        others = world.true_shapes(scene).items()
        below = [k for k, s in others if height < s.T_world_object[2, 3] < ceiling and _overlap(over, s)]
        tops += [float(world.bounds(scene, label)[1][2]) for label in below]
    z = max(tops) + float(shape.support(np.array([[0.0, 0.0, -1.0]]))[0]) + GAP
    return Body(over.moved(transforms.rigid(np.eye(3), (0.0, 0.0, z))))


def _on_another(rng: np.random.Generator, shape: Shape, scene: SimulatedScene) -> Body:
    """Put a shape from the origin over a random object."""
    return _let_go(shape, _over_one(rng, list(world.true_shapes(scene).values())), scene)


def _over_one(rng: np.random.Generator, shapes: Sequence[Shape]) -> Array:
    """A place (2,) [m] over one of several shapes, up to 0.3 of its half extents off its middle."""
    below = shapes[int(rng.integers(len(shapes)))]
    reach = 0.3 * below.support(np.eye(3))[:2]
    return below.T_world_object[:2, 3] + reach * rng.uniform(-1.0, 1.0, size=2)


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
