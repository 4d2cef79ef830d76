"""Train the network of automatic segmentation on simulated tables.

python tools/train_affinities.py scenes FOLDER [--count N] [--seed S]    render N scenes, 8 views each
python tools/train_affinities.py train FOLDER [--minutes M] [--out FILE] [--start FILE]   needs torch, onnx

Scenes hold random objects of one to a dozen convex parts: tools, bottles, mugs, bowls, toys, boxes. They fall
onto a table, onto or into a larger object, or stand in rows. They are plain, printed or painted part by part.
Images are noise-free; each training crop gets its own noise, gaps, mixed pixels and colours. 1,800 scenes and
two hours of training on two cores are enough.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tyro
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from caryatid.config import SensorConfig
from caryatid.geometry import transforms
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.segmentation.affinities import MODEL, OFFSETS, features
from caryatid.sensing.view_sphere import direction
from caryatid.simulation import generation
from caryatid.simulation.camera import depth_edges, intrinsics, pixel_rays
from caryatid.simulation.world import quaternion

Rng = np.random.Generator
Part = dict[str, Any]
Maker = Callable[[Rng], list[Part]]
GEOM = mujoco.mjtGeom
BOX, CYLINDER, CAPSULE, ELLIPSOID = (
    GEOM.mjGEOM_BOX, GEOM.mjGEOM_CYLINDER, GEOM.mjGEOM_CAPSULE, GEOM.mjGEOM_ELLIPSOID,
)  # fmt: skip
WIDTH, HEIGHT, VIEWS = 320, 240, 8
CROP, BATCH, CHANNELS = 192, 16, 11
UNTURNED = np.eye(3)
ALONG_X = Rotation.from_euler("y", 90.0, degrees=True).as_matrix()


# Objects, made of parts around the origin [m]


def solid(kind: Any, size: Any, at: Any = (0.0, 0.0, 0.0), R: Array = UNTURNED) -> Part:
    return {"type": kind, "size": np.array(size), "pos": np.array(at), "quat": quaternion(R)}


def hull(points: Any) -> Part:
    return {"points": np.asarray(points, dtype=float)}


def block(size: Any, at: Any = (0.0, 0.0, 0.0), R: Array = UNTURNED) -> Part:
    return solid(BOX, size, at, R)


def ring(radius: float, height: float, corners: int) -> Array:
    angle = 2.0 * np.pi * np.arange(corners) / corners
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(corners, height)], axis=-1)


def turned(rings: Sequence[tuple[float, float]], corners: int = 14) -> list[Part]:
    """Make a body of revolution through rings, given as pairs of radius and height."""
    return [hull(np.concatenate([ring(*a, corners), ring(*b, corners)])) for a, b in pairwise(rings)]


def chain(points: Array, radii: Any) -> list[Part]:
    """Connect consecutive points by capsules."""
    parts = []
    for (p, q), radius in zip(pairwise(points), radii, strict=True):
        R = Rotation.align_vectors([q - p], [[0.0, 0.0, 1.0]])[0].as_matrix()
        parts.append(solid(CAPSULE, (radius, np.linalg.norm(q - p) / 2.0, 0.0), (p + q) / 2.0, R))
    return parts


def stretched(make: Callable[[Rng], Solid]) -> Maker:
    """Make objects as the simulated scenes have them, in more proportions."""

    def made(rng: Rng) -> list[Part]:
        stretch = rng.uniform(0.6, 1.2, 3)
        return [hull(stretch * part.vertices) for part in make(rng).polytopes]

    return made


bottle, bowl, mug, tray = map(
    stretched, (generation.bottle, generation.bowl, generation.mug, generation.tray)
)


def box(rng: Rng) -> list[Part]:
    return [block(rng.uniform(0.015, 0.09, 3) * rng.uniform(0.6, 1.1))]


def can(rng: Rng) -> list[Part]:
    return [solid(CYLINDER, (rng.uniform(0.012, 0.06), rng.uniform(0.01, 0.1), 0.0))]


def ball(rng: Rng) -> list[Part]:
    return [solid(ELLIPSOID, rng.uniform(0.02, 0.055) * rng.uniform(0.6, 1.0, 3))]


def book(rng: Rng) -> list[Part]:
    return [block(rng.uniform((0.04, 0.06, 0.006), (0.09, 0.13, 0.025)))]


def carton(rng: Rng) -> list[Part]:
    return [block(rng.uniform((0.02, 0.04, 0.05), (0.05, 0.09, 0.13)))]


def jar(rng: Rng) -> list[Part]:
    radius, height = rng.uniform(0.02, 0.05), rng.uniform(0.05, 0.15)
    lid = rng.uniform(0.7, 1.15) * radius
    return turned([(radius, 0.0), (radius, height)]) + turned(
        [(lid, height), (lid, height + rng.uniform(0.01, 0.04))]
    )


def banana(rng: Rng) -> list[Part]:
    length, bend = rng.uniform(0.1, 0.2), rng.uniform(0.3, 1.6)
    angle = np.linspace(-bend / 2.0, bend / 2.0, 6)
    points = length / bend * np.stack([np.sin(angle), np.cos(angle), 0.0 * angle], axis=-1)
    return chain(
        points - points.mean(axis=0), rng.uniform(0.012, 0.02) * np.array([0.7, 1.0, 1.05, 1.0, 0.7])
    )


def drill(rng: Rng) -> list[Part]:
    length, radius = rng.uniform(0.05, 0.1), rng.uniform(0.018, 0.032)
    parts = [solid(CYLINDER, (radius, length, 0.0), R=ALONG_X)]
    chuck = radius * rng.uniform(0.3, 0.7), rng.uniform(0.01, 0.03), 0.0
    parts.append(solid(CYLINDER, chuck, (length + 0.015, 0.0, 0.0), ALONG_X))
    if rng.random() < 0.5:
        parts.append(solid(CYLINDER, (0.2 * radius, 0.02, 0.0), (length + 0.05, 0.0, 0.0), ALONG_X))
    grip = rng.uniform(0.03, 0.06)
    tilt = Rotation.from_euler("y", rng.uniform(-20.0, 20.0), degrees=True).as_matrix()
    at = -length * rng.uniform(0.1, 0.7), 0.0, -radius - 0.8 * grip
    parts.append(block((rng.uniform(0.012, 0.02), rng.uniform(0.011, 0.016), grip), at, tilt))
    if rng.random() < 0.8:
        battery = rng.uniform((0.025, 0.02, 0.01), (0.045, 0.03, 0.02))
        parts.append(block(battery, (-0.4 * length, 0.0, -radius - 1.8 * grip)))
    return parts


def tool(rng: Rng) -> list[Part]:
    """Make a handle with heads: hammers, brushes, clamps."""
    length, width = rng.uniform(0.05, 0.13), rng.uniform(0.006, 0.016)
    parts = [block((length, width, rng.uniform(0.005, 0.014)))]
    if rng.random() < 0.5:
        parts = [solid(CAPSULE, (max(width, 0.007), length, 0.0), R=ALONG_X)]
    for _ in range(int(rng.integers(1, 4))):
        at = (
            rng.choice([-1.0, 1.0]) * length * rng.uniform(0.3, 1.0),
            *rng.uniform((-0.02, -0.005), (0.02, 0.005)),
        )
        kind = BOX if rng.random() < 0.6 else ELLIPSOID
        parts.append(solid(kind, rng.uniform(0.008, 0.035, 3), at))
    return parts


def toy(rng: Rng) -> list[Part]:
    """Make ellipsoids, boxes and cylinders that grow out of each other."""
    parts, centres, radii = [], [np.zeros(3)], [rng.uniform(0.02, 0.045)]
    for k in range(int(rng.integers(2, 6))):
        if k:
            onto, way = int(rng.integers(k)), rng.normal(size=3)
            radius = radii[onto] * rng.uniform(0.4, 0.95)
            reach = 0.75 * radii[onto] + 0.5 * radius
            centres.append(centres[onto] + way / np.linalg.norm(way) * reach)
            radii.append(radius)
        kind = [ELLIPSOID, BOX, CYLINDER][int(rng.choice(3, p=(0.6, 0.25, 0.15)))]
        size = radii[-1] * rng.uniform(0.6, 1.1, 3)
        parts.append(solid(kind, size, centres[-1], Rotation.random(random_state=rng).as_matrix()))
    return parts


def stone(rng: Rng) -> list[Part]:
    points = rng.normal(size=(int(rng.integers(8, 24)), 3))
    return [hull(points / np.linalg.norm(points, axis=1)[:, None] * rng.uniform(0.02, 0.06, 3))]


def profile(rng: Rng) -> list[Part]:
    """Make L, T and U profiles, and stairs."""
    parts, at, width = [], 0.0, rng.uniform(0.015, 0.04)
    for _ in range(int(rng.integers(2, 4))):
        half, height = rng.uniform((0.012, 0.01), (0.04, 0.06))
        parts.append(block((half, width, height), (at + half, 0.0, height)))
        at += 2.0 * half
    return parts


def plate(rng: Rng) -> list[Part]:
    radius = rng.uniform(0.06, 0.12)
    return turned([(0.6 * radius, 0.0), (radius, rng.uniform(0.008, 0.025))], 20)


OBJECTS: dict[Maker, float] = {
    box: 4.0, can: 3.0, ball: 1.5, bottle: 2.5, jar: 1.5, bowl: 1.2, mug: 1.8, banana: 0.8, drill: 3.0,
    tool: 1.5, toy: 2.0, stone: 1.5, profile: 1.0, tray: 0.5, plate: 0.6, book: 1.2, carton: 2.0,
}  # fmt: skip
PRIMITIVES: dict[Maker, float] = {box: 6.0, can: 2.5, ball: 1.0, book: 1.0, carton: 1.5}


# Scenes


def drawn(rng: Rng, makers: dict[Maker, float]) -> list[Part]:
    share = np.array(list(makers.values()))
    return list(makers)[int(rng.choice(len(makers), p=share / share.sum()))](rng)


def bodies(rng: Rng) -> Iterator[tuple[list[Part], float, Array, Rotation]]:
    """Yield the parts, scale, position and orientation of each object before it falls."""
    kind, count = rng.random(), int(rng.integers(1, 17))
    makers, level = OBJECTS, rng.random() < 0.25
    spread = rng.uniform(0.06, 0.16) * np.sqrt(count) / 2.0
    same = box(rng) if kind < 0.12 else can(rng) if kind < 0.2 else None
    if 0.2 <= kind < 0.5:
        makers, count = PRIMITIVES, int(rng.integers(6, 23))
        spread = rng.uniform(0.06, 0.14) * np.sqrt(count) / 2.0
    elif 0.5 <= kind < 0.65:
        count, spread = int(rng.integers(2, 9)), rng.uniform(0.02, 0.08)
        under = [bowl, bowl, tray, tray, plate, book, box][int(rng.integers(7))](rng)
        yield under, 1.0, np.array([0.0, 0.0, 0.02]), Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    elif 0.65 <= kind < 0.73:
        count, half = int(rng.integers(2, 11)), rng.uniform((0.02, 0.02, 0.02), (0.05, 0.06, 0.06))
        row, gap = [count, (count + 1) // 2, 4][int(rng.integers(3))], rng.uniform(0.0005, 0.015)
        flat = rng.random() < 0.4  # one layer, as on a pallet
        for k in range(count):
            layer, column = divmod(k, row)
            x = (column - row / 2.0 + 0.5 * (layer % 2)) * (2.0 * half[0] + gap)
            y, z = (layer * (2.0 * half[1] + gap), 0.0) if flat else (0.0, layer * (2.0 * half[2] + 0.001))
            yield [block(half)], 1.0, np.array([x, y, half[2] + z]), Rotation.identity()
        return
    for k in range(count):
        parts = same if same and rng.random() < 0.9 else drawn(rng, makers)
        scale = 1.0 if same else rng.uniform(0.75, 1.2)
        if 0.5 <= kind < 0.65:
            scale *= rng.uniform(0.5, 1.0)
        yaw = rng.integers(4) * np.pi / 2.0 + 0.03 * rng.normal() if level else rng.uniform(-np.pi, np.pi)
        R, fate = Rotation.from_euler("z", yaw), rng.random()
        if fate < 0.3:
            axis, angle = [("x", 90.0), ("y", 90.0), ("x", 180.0)][int(rng.integers(3))]
            R = R * Rotation.from_euler(axis, angle, degrees=True)
        elif fate < 0.5:
            R = Rotation.random(random_state=rng)
        xy = 0.4 * spread * rng.normal(size=2)
        yield parts, scale, np.array([*(np.round(xy / 0.08) * 0.08 if level else xy), 0.12 + 0.13 * k]), R


def surroundings(rng: Rng) -> Iterator[Part]:
    """Yield what is no object: floor, table or none, walls, legs, shelf, bin, furniture, cables, an arm."""
    table, kind = rng.uniform(0.45, 0.9, 2), rng.random()
    floor = 0.0 if kind < 0.15 else rng.uniform(-0.4, -0.05) if kind < 0.3 else rng.uniform(-0.9, -0.4)
    yield solid(GEOM.mjGEOM_PLANE, (5.0, 5.0, 0.1), (0.0, 0.0, floor))
    if floor < 0.0:
        yield block((*table, 0.02), (0.0, 0.0, -0.02))
        if rng.random() < 0.4:
            thick, inset = rng.uniform(0.015, 0.04), rng.uniform(0.03, 0.1)
            for x, y in (table - inset) * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]):
                yield block((thick, thick, -floor / 2.0 - 0.02), (x, y, floor / 2.0 - 0.02))

    def beyond(away: float, z: float, size: Any) -> Part:
        """Place a box beyond the middle in any direction, its first axis away from it."""
        R = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
        return block(size, R @ (away, 0.0, z), R)

    if rng.random() < 0.4:
        yield beyond(table.max() + rng.uniform(0.05, 1.0), 0.0, (0.05, 3.0, 2.0))
    for _ in range(int(rng.integers(0, 4))):  # monitors, cupboards, chairs
        size = rng.uniform((0.02, 0.26, 0.1), (0.3, 0.5, 0.35))
        near = rng.random() < 0.5
        away = size[0] + (rng.uniform(0.3, 0.6) if near else table.max() + rng.uniform(0.05, 0.8))
        yield beyond(away, size[2] if near else floor + size[2], size)
    if rng.random() < 0.15:  # a bin
        half, height, thick = rng.uniform(0.18, 0.35, 2), rng.uniform(0.05, 0.25), rng.uniform(0.002, 0.01)
        for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
            size, at = np.array([*half, height / 2.0]), np.array([0.0, 0.0, height / 2.0])
            size[axis], at[axis] = thick, sign * half[axis]
            yield block(size, at)
    elif rng.random() < 0.15:  # a shelf
        depth, width, height = rng.uniform((0.12, 0.3, 0.25), (0.25, 0.5, 0.55))
        R = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
        yield block((depth, width, 0.012), R @ (0.1, 0.0, height), R)
        for side in (-width, width):
            yield block((depth, 0.012, 0.3), R @ (0.1, side, 0.3), R)
    for _ in range(int(rng.integers(1, 3)) if rng.random() < 0.2 else 0):  # cables
        along = np.cumsum(0.04 * rng.normal(size=(14, 2)) + 0.05 * rng.normal(size=2), axis=0)
        radius = rng.uniform(0.002, 0.005)
        points = np.column_stack([rng.uniform(-0.4, 0.4, 2) + along, np.full(14, radius)])
        yield from chain(points, np.full(13, radius))
    if rng.random() < 0.12:  # an arm and a hand
        towards = direction(rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(5.0, 60.0)))
        hand = np.array([*0.1 * rng.normal(size=2), rng.uniform(0.05, 0.25)])
        reach, radii = np.array([0.0, 0.1, 0.5]), rng.uniform((0.025, 0.03), (0.045, 0.06))
        yield from chain(hand + reach[:, None] * towards, radii)


def settled(rng: Rng) -> tuple[Any, Any, NDArray[np.int32]]:
    """Drop objects onto a table; return the model, its state, and the label of each geom."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.004
    for part in surroundings(rng):
        spec.worldbody.add_geom(**part)
    matter = {"density": 400.0, "friction": [0.9, 0.02, 0.002], "condim": 4}
    for number, (parts, scale, at, R) in enumerate(bodies(rng)):
        body = spec.worldbody.add_body(name=f"object{number}", pos=at, quat=R.as_quat()[[3, 0, 1, 2]])
        body.add_freejoint()
        for k, part in enumerate(parts):
            if "points" in part:
                name = f"mesh{number}_{k}"
                spec.add_mesh(name=name, uservert=(scale * part["points"]).ravel())
                body.add_geom(type=GEOM.mjGEOM_MESH, meshname=name, **matter)
            else:
                sized = {"size": scale * part["size"], "pos": scale * part["pos"]}
                body.add_geom(type=part["type"], quat=part["quat"], **sized, **matter)
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(400):
        mujoco.mj_step(model, data)
        data.qvel *= 0.995
    mujoco.mj_forward(model, data)
    # Static geoms belong to body 0; objects that fell off the table are background.
    labels = model.geom_bodyid * (data.xpos[model.geom_bodyid, 2] > -0.03)
    return model, data, labels.astype(np.int32)


# Colours


def palette(rng: Rng, count: int) -> Array:
    """Draw random colours (N, 3) from 0 to 1, many of them pale or dark."""
    colours = rng.random((count, 3)) ** rng.uniform(0.5, 2.0)
    grey = colours.mean(axis=1, keepdims=True)
    return grey + (colours - grey) * rng.uniform(0.0, 1.0, (count, 1))


def painted(rng: Rng, geoms: Sequence[int], model: Any) -> Callable[[Array, Array], Array]:
    """Draw an object's look: a function from points (N, 3) in its frame, on geoms (N,), to colours (N, 3)."""
    kind, reach = rng.random(), rng.uniform(0.02, 0.12)
    colours = palette(rng, 5)
    colours[1] *= 0.15 if rng.random() < 0.4 else 1.0  # black rubber
    part = np.zeros(model.ngeom, dtype=np.intp)
    if kind > 0.6:  # part by part
        part[list(geoms)] = np.minimum(rng.integers(0, 4, len(geoms)), int(rng.integers(1, 4)))
    prints = []
    for _ in range(int(rng.integers(1, 7)) if 0.25 < kind < 0.85 else 0):
        low = rng.uniform(-1.0, 0.6, 3) * reach
        size = np.where(rng.random(3) < 0.5, 9.0, rng.uniform(0.1, 1.0, 3) * reach)
        across, finest = rng.normal(size=3), rng.uniform(0.0, 1.0)
        lines = across / np.linalg.norm(across) / rng.uniform(0.003, 0.02) if finest < 0.4 else None
        prints.append((low, low + size, lines, int(rng.integers(1, 5))))
    edge = rng.uniform(0.001, 0.003) if rng.random() < 0.5 else 0.0

    def colour(points: Array, on: Array) -> Array:
        shown = colours[part[on]]
        for low, high, lines, number in prints:
            inside = ((points > low) & (points < high)).all(axis=1)
            if lines is not None:
                inside &= np.sin(2.0 * np.pi * (points @ lines)) > 0.2
            shown[inside] = colours[number]
        for g in geoms if edge else ():
            if model.geom_type[g] == BOX:  # darken its edges
                own = on == g
                R = Rotation.from_quat(model.geom_quat[g], scalar_first=True).as_matrix()
                at = (points[own] - model.geom_pos[g]) @ R
                shown[own] *= np.where((np.abs(at) > model.geom_size[g] - edge).sum(axis=1) > 1, 0.5, 1.0)[
                    :, None
                ]
        return shown

    return colour


def ground(rng: Rng) -> Callable[[Array, Array], Array]:
    """Draw a table's look: plain, planked, checkered or mottled."""
    colours, kind = palette(rng, 2), int(rng.integers(4))
    colours, mixed = 0.6 * colours + 0.4 * colours.mean(), rng.uniform(0.1, 1.0)
    turn, size = Rotation.from_euler("z", rng.uniform(0.0, np.pi)).as_matrix(), rng.uniform(0.02, 0.2)
    phase = rng.uniform(0.0, 6.0, (6, 3))
    waves = rng.normal(size=(6, 3)) / size * rng.uniform(0.3, 3.0, (6, 1))

    def colour(points: Array, on: Array) -> Array:
        at = points @ turn / size
        share = np.zeros(len(points))
        if kind == 1:
            share = 0.5 + 0.5 * np.sin(at[:, 0] * 9.0 + 2.0 * np.sin(at[:, 1]))
        elif kind == 2:
            share = np.floor(at[:, :2]).sum(axis=1) % 2.0
        elif kind == 3:
            share = 0.5 + 0.2 * np.sin(points @ waves.T + phase[:, 0]).sum(axis=1)
        return colours[0] + (colours[1] - colours[0]) * (mixed * np.clip(share, 0.0, 1.0))[:, None]

    return colour


def backdrop(rng: Rng) -> Callable[[Array, Array], Array]:
    """Draw the look of what is no object: its geoms share a few grounds."""
    grounds = [ground(rng) for _ in range(4)]

    def colour(points: Array, on: Array) -> Array:
        shown = np.zeros_like(points)
        for k, look in enumerate(grounds):
            own = on % len(grounds) == k
            shown[own] = look(points[own], on[own])
        return shown

    return colour


def coloured(model: Any, data: Any, points: Array, normals: Array, on: Any, paint: Any, rng: Rng) -> Any:
    """Compute colours (N, 3) uint8 of points on geoms (N,), lit by one lamp that casts shadows."""
    albedo = np.full((len(points), 3), 0.5)
    body = np.where(on >= 0, model.geom_bodyid[on], -1)
    for number, look in paint.items():
        own = body == number
        if own.any():
            albedo[own] = look((points[own] - data.xpos[number]) @ data.xmat[number].reshape(3, 3), on[own])
    lamp = np.array([*rng.normal(size=2), rng.uniform(0.8, 3.0)])
    to_lamp = lamp - points
    away = np.maximum(np.linalg.norm(to_lamp, axis=1), 1e-6)
    light = np.clip(np.einsum("ij,ij->i", normals, to_lamp) / away, 0.0, 1.0)
    hit, gap = np.empty(len(points), dtype=np.int32), np.empty(len(points))
    everything = hit, gap, None
    mujoco.mj_multiRay(model, data, lamp, (-to_lamp).ravel(), None, 1, -1, *everything, len(points), 20.0)
    light *= np.where(gap < 0.99, rng.uniform(0.0, 0.8), 1.0)
    ambient = rng.uniform(0.25, 0.7) * (0.85 + 0.15 * normals[:, 2])
    shine = rng.uniform(0.0, 0.4) * light ** rng.uniform(10.0, 60.0)
    shown = albedo * (ambient + rng.uniform(0.3, 0.8) * light)[:, None] + shine[:, None]
    return (255.0 * np.clip(shown, 0.0, 1.0)).astype(np.uint8)


def rendered(
    model: Any, data: Any, labels: NDArray[np.int32], paint: dict[int, Any], rng: Rng
) -> dict[str, Any]:
    """Render a view: 1/z, labels, cosine of incidence and colours (H, W); focal length, up, and height."""
    focal = rng.uniform(0.8, 1.3) * (1.0 if rng.random() < 0.6 else 1.6) * WIDTH
    on_table = data.xpos[1:][data.xpos[1:, 2] > -0.03]
    target = np.array([*0.05 * rng.normal(size=2), rng.uniform(0.0, 0.1)])
    target[:2] += on_table[:, :2].mean(axis=0) if len(on_table) else 0.0
    rise = np.radians(rng.uniform(18.0, 65.0) if rng.random() < 0.8 else rng.uniform(65.0, 89.0))
    azimuth, roll = rng.uniform(-np.pi, np.pi), 0.08 * rng.normal()
    eye = target + rng.uniform(0.3, 1.5) * direction(azimuth, rise)
    R = transforms.look_at(eye, target)[:3, :3] @ transforms.rotation_from_vector((0.0, 0.0, roll))
    K = intrinsics(SensorConfig(width=WIDTH, height=HEIGHT, focal=focal))
    rays, lengths = pixel_rays(K, R, WIDTH, HEIGHT)
    geoms, depth, normals = np.empty(len(rays), dtype=np.int32), np.empty(len(rays)), np.empty((len(rays), 3))
    everything = geoms, depth, normals.reshape(-1)
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), None, 1, -1, *everything, len(rays), 6.0)
    inverse = np.where(geoms >= 0, 1.0 / np.maximum(depth, 0.05), 0.0)
    towards = np.einsum("ij,ij->i", normals, rays)
    points, normals = eye + rays * np.maximum(depth, 0.0)[:, None], normals * -np.sign(towards)[:, None]
    images = {
        "inverse": np.minimum(20000.0 * inverse, 65535.0).astype(np.uint16),
        "cosine": (255.0 * np.abs(towards) / lengths).astype(np.uint8),
        "labels": np.append(labels, 0)[geoms].astype(np.uint8),
        "rgb": coloured(model, data, points, normals, geoms, paint, rng),
    }
    known = {name: image.reshape(HEIGHT, WIDTH, *image.shape[1:]) for name, image in images.items()}
    return known | {"focal": focal, "up": R[2], "height": eye[2]}


def make_scenes(folder: tyro.conf.Positional[Path], count: int = 1800, seed: int = 0) -> None:
    """Render scenes, 8 views each."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        model, data, labels = settled(rng)
        looks: list[Any] = []
        paint: dict[int, Any] = {0: backdrop(rng)}
        same = rng.random() < 0.15
        for body in range(1, model.nbody):
            geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
            looks.append(looks[0] if same and looks else painted(rng, geoms, model))
            paint[body] = looks[-1]
        views = [rendered(model, data, labels, paint, rng) for _ in range(VIEWS)]
        stacked: Any = {key: np.stack([view[key] for view in views]) for key in views[0]}
        np.savez_compressed(folder / f"{seed}-{number}.npz", **stacked)


# Crops


def crop(views: dict[str, Any], rng: Rng) -> tuple[Any, ...] | None:
    """Return noisy depth, colours, labels, K, up and height of a crop; None if it hardly shows objects."""
    k = int(rng.integers(VIEWS))
    inverse = views["inverse"][k] / np.float32(20000.0)
    labels, cosine = views["labels"][k], views["cosine"][k]
    rows, columns = np.nonzero(labels)
    if len(rows) < 60:
        return None
    size = np.clip((max(np.ptp(rows), np.ptp(columns)) + 1) * rng.uniform(0.6, 1.6), 70.0, 320.0)
    one = int(rng.integers(len(rows)))
    middle = np.array([(rows.min() + rows.max()) / 2.0, (columns.min() + columns.max()) / 2.0])
    middle = np.array([rows[one], columns[one]]) if rng.random() < 0.3 else middle
    low, zoom = middle + 0.1 * size * rng.normal(size=2) - size / 2.0, CROP / size
    at = np.stack(np.meshgrid(*(c + (np.arange(CROP) + 0.5) / zoom - 0.5 for c in low), indexing="ij"))

    def taken(image: Any, order: int) -> Any:
        return ndimage.map_coordinates(image, at, order=order, mode="constant", cval=0)

    nearest, smooth = taken(inverse, 0), taken(inverse, 1)
    # Planes stay planes within a surface; depth steps stay sharp.
    inverse = np.where(np.abs(smooth - nearest) < 0.02 * nearest, smooth, nearest)
    labels, cosine = taken(labels, 0), taken(cosine, 0)
    rgb = np.stack([taken(views["rgb"][k][..., c], 1) for c in range(3)], axis=-1)
    focal, up, height = views["focal"][k] * zoom, views["up"][k].copy(), float(views["height"][k])
    cy, cx = (np.array([(HEIGHT - 1) / 2.0, (WIDTH - 1) / 2.0]) - low + 0.5) * zoom - 0.5
    if rng.random() < 0.5:
        inverse, labels, cosine, rgb = (image[:, ::-1] for image in (inverse, labels, cosine, rgb))
        cx, up[0] = CROP - 1 - cx, -up[0]
    scale = rng.uniform(0.75, 1.35)
    depth = noisy(np.ascontiguousarray(inverse / scale), cosine / 255.0, rng)
    if rng.random() < 0.25:  # a transparent object: readings lie behind it or are missing
        places = labels[labels > 0]
        clear = labels == (places[int(rng.integers(len(places)))] if len(places) else 0)
        depth = np.where(clear, depth + 0.06 * np.maximum(waves(rng, 8, 40), 0.0), depth)
        depth = np.where(clear & (waves(rng, 8, 40) > rng.uniform(-0.5, 1.5)), 0.0, depth)
        depth = depth.astype(np.float32)
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    seen = None if rng.random() < 0.2 else photographed(rgb, rng)
    return depth, seen, labels, K, up, height * scale + 0.002 * rng.normal()


def photographed(rgb: Any, rng: Rng) -> Any:
    """Return colours (H, W, 3) uint8 as from a camera: toned, blurred, noisy, and offset from the depth."""
    image = (rgb.astype(np.float32) + 1.0) / 256.0
    image = image ** np.float32(rng.uniform(0.5, 1.8)) * rng.uniform(0.6, 1.4, 3).astype(np.float32)
    grey = image.mean(axis=-1, keepdims=True)
    image = grey + (image - grey) * np.float32(rng.uniform(0.0, 1.3) if rng.random() < 0.7 else 1.0)
    if rng.random() < 0.5:
        image = ndimage.uniform_filter(image, (3, 3, 1))
    image = image + np.float32(rng.uniform(0.0, 0.05)) * rng.normal(size=image.shape).astype(np.float32)
    if rng.random() < 0.6:
        off = np.round((1.2 if rng.random() < 0.85 else 5.0) * rng.normal(size=2)).astype(int)
        image = np.roll(image, off, axis=(0, 1))
    return (255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)


def noisy(inverse: Any, cosine: Any, rng: Rng) -> Any:
    """Return depth (H, W) [m] as from a sensor: with frayed and mixed edges, noise, rounding, and gaps."""
    true = inverse
    if rng.random() < 0.7:  # edges fray
        spread = rng.uniform(0.2, 0.9)
        rows, columns = (
            np.clip(i + np.round(spread * rng.normal(size=i.shape)), 0, CROP - 1).astype(int)
            for i in np.indices(true.shape)
        )
        other = inverse[rows, columns]
        inverse = np.where(np.abs(other - inverse) > 0.01, other, inverse)
    if rng.random() < 0.4:  # pixels mix both sides of an edge: all of them, or some that fly
        mixed = (true > 0.0) & (rng.random(true.shape) < rng.uniform(0.2, 2.0))
        inverse = np.where(mixed, ndimage.uniform_filter(inverse, int(rng.choice([3, 3, 5, 7]))), inverse)
    depth = np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0.0)
    sigma = rng.uniform(0.1, 1.3) * (0.0008 + 0.0019 * np.maximum(depth - 0.3, 0.0) ** 2)
    depth = depth + sigma * rng.normal(size=depth.shape)
    if rng.random() < 0.7:  # errors that neighbouring pixels share
        depth = depth + rng.uniform(0.0, 0.004) * depth**2 * waves(rng, 6, 60)
    inverse = np.where(inverse > 0.0, 1.0 / np.maximum(depth, 0.01), 0.0)
    if rng.random() < 0.5:
        step = rng.uniform(0.0005, 0.004)
        inverse = np.round(inverse / step) * step
    gone = cosine < np.cos(np.radians(rng.uniform(70.0, 88.0)))
    if rng.random() < 0.7:  # no readings next to depth steps
        edge = depth_edges(true, rng.uniform(0.01, 0.05))
        edge = ndimage.binary_dilation(edge) if rng.random() < 0.4 else edge
        gone |= edge & (rng.random(edge.shape) < (rng.uniform(0.3, 1.0) if rng.random() < 0.5 else 1.0))
    if rng.random() < 0.4:  # what a projector or the second camera, to one side, does not see
        way, shift = int(rng.choice([-1, 1])), rng.uniform(5.0, 60.0)
        shifted = np.arange(true.shape[1]) + shift * true[:, ::way]
        gone |= (shifted < np.maximum.accumulate(shifted, axis=1) - 0.5)[:, ::way]
    if rng.random() < 0.5:  # black or shiny spots
        gone |= waves(rng, 8, 50) > rng.uniform(1.6, 3.0)
    return np.divide(1.0, inverse, out=np.zeros_like(inverse), where=~gone & (inverse > 0.0)).astype(
        np.float32
    )


def waves(rng: Rng, fewest: int, most: int) -> Any:
    """Draw a smooth random image of unit variance, with `fewest` to `most` bumps across."""
    count = int(rng.integers(fewest, most))
    return ndimage.zoom(
        rng.normal(size=(count, count)), CROP / count, order=3, grid_mode=True, mode="nearest"
    )


# Training


def feed(queue: Any, folder: Path, seed: int) -> None:
    """Fill the queue endlessly with features (B, 11, H, W), labels (B, H, W) and valid pixels (B, H, W)."""
    rng, scenes = np.random.default_rng(seed), dict[Path, dict[str, Any]]()
    while True:
        files, crops = sorted(folder.glob("*.npz")), list[tuple[Any, ...]]()
        while len(crops) < BATCH:
            file = files[int(rng.integers(len(files)))]
            if file not in scenes:
                scenes[file] = dict(np.load(file))
            if (found := crop(scenes[file], rng)) is not None:
                crops.append(found)
        seen = np.stack([features(depth, rgb, *pose) for depth, rgb, _, *pose in crops])
        labels = np.stack([c[2] for c in crops]).astype(np.int64)
        queue.put((seen, labels, np.stack([c[0] > 0.0 for c in crops])))


def train(
    folder: tyro.conf.Positional[Path],
    minutes: float = 120.0,
    out: Path = Path(MODEL),
    start: Path | None = None,
    rate: float = 2e-3,
) -> None:
    """Train a network on rendered scenes, anew or from the weights of another one."""
    import torch
    import torch.multiprocessing as processes
    from torch import nn
    from torch.nn import functional

    def layer(before: int, after: int, stride: int = 1) -> nn.Module:
        # In a trained network, normalization has become part of the weights.
        normal = nn.BatchNorm2d(after) if start is None else nn.Identity()
        return nn.Sequential(
            nn.Conv2d(before, after, 3, stride, 1, bias=start is not None), normal, nn.ReLU()
        )

    class Network(nn.Module):  # type: ignore[misc]
        """A U-Net at half resolution and below, with a thin path at full resolution."""

        def __init__(self, widths: tuple[int, ...] = (32, 48, 64, 96, 128)) -> None:
            super().__init__()
            self.full = layer(CHANNELS, 8)
            self.stem = nn.Sequential(layer(CHANNELS, widths[0], 2), layer(widths[0], widths[0]))
            self.down = nn.ModuleList(nn.Sequential(layer(a, b, 2), layer(b, b)) for a, b in pairwise(widths))
            self.up = nn.ModuleList(nn.Sequential(layer(a + b, a), layer(a, a)) for a, b in pairwise(widths))
            self.last = nn.Sequential(layer(widths[0] // 4 + 8, 16), nn.Conv2d(16, len(OFFSETS) + 1, 1))

        def forward(self, x: Any) -> Any:
            full, levels = self.full(x), [self.stem(x)]
            for down in self.down:
                levels.append(down(levels[-1]))
            y = levels.pop()
            for up, level in zip(reversed(self.up), reversed(levels), strict=True):
                y = up(torch.cat([level, functional.interpolate(y, scale_factor=2.0, mode="nearest")], 1))
            return self.last(torch.cat([functional.pixel_shuffle(y, 2), full], 1))

    def targets(labels: Any, valid: Any) -> tuple[Any, Any]:
        """Return the target outputs (B, 13, H, W), and the weight of each pixel (B, 13, H, W)."""
        said, counts, (_, height, width) = [], [], labels.shape
        for down, right in OFFSETS:
            here = np.s_[:, : height - down, max(0, -right) : width - max(0, right)]
            there = np.s_[:, down:, max(0, right) : width + min(0, right)]
            same, weight = torch.zeros(labels.shape), torch.zeros(labels.shape)
            a, b = labels[here], labels[there]
            objects, alike = (a > 0) & (b > 0), (a == b) & (a > 0)
            same[here] = alike.float()
            weight[here] = torch.where(objects, torch.where(alike, 1.0, 2.0), 0.3)
            weight[here] *= ((a > 0) | (b > 0)) & valid[here] & valid[there]
            said.append(same)
            counts.append(weight)
        said.append((labels > 0).float())
        counts.append(0.5 * valid)
        return torch.stack(said, 1), torch.stack(counts, 1)

    torch.manual_seed(0)
    network = Network()
    if start is not None:
        stored = iter(read_weights(start))

        def fill(layer: Any, _: Any) -> None:
            layer.weight.data, layer.bias.data = map(torch.tensor, next(stored))

        # They are stored in the order in which they run.
        hooks = [m.register_forward_pre_hook(fill) for m in network.modules() if isinstance(m, nn.Conv2d)]
        network(torch.zeros(1, CHANNELS, CROP, CROP))
        for hook in hooks:
            hook.remove()
    network = network.to(memory_format=torch.channels_last)
    steps = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-4)
    queue = processes.Queue(6)
    processes.Process(target=feed, args=(queue, folder, 1), daemon=True).start()
    begun, number, usual = time.monotonic(), 0, 0.7
    while (part := (time.monotonic() - begun) / (60.0 * minutes)) < 1.0:
        seen, labels, valid = map(torch.from_numpy, queue.get())
        said, counts = targets(labels, valid)
        for group in steps.param_groups:
            group["lr"] = rate * min(1.0, (number + 1) / 50) * (0.5 + 0.5 * np.cos(np.pi * part)) + 1e-5
        with torch.autocast("cpu", torch.bfloat16):
            odds = network(seen.contiguous(memory_format=torch.channels_last))
        losses = functional.binary_cross_entropy_with_logits(odds.float(), said, reduction="none")
        loss = (losses * counts).sum() / counts.sum()
        steps.zero_grad()
        loss.backward()
        steps.step()
        number, usual = number + 1, 0.98 * usual + 0.02 * loss.item()
        if number % 100 == 0:
            print(f"{number} steps, {time.monotonic() - begun:.0f} s, loss {usual:.4f}", flush=True)
    axes = {name: {2: "H", 3: "W"} for name in ("features", "logits")}
    names: dict[str, Any] = {"input_names": ["features"], "output_names": ["logits"], "dynamic_axes": axes}
    torch.onnx.export(
        network.eval(), (torch.zeros(1, CHANNELS, 256, 320),), out, dynamo=False, opset_version=17, **names
    )
    store_in_half(out)


def read_weights(model: Path) -> list[tuple[Any, Any]]:
    """Read weights and biases of the convolutions of a network, in the order in which they run."""
    import onnx
    from onnx import numpy_helper

    graph = onnx.load(model).graph
    known = {w.name: numpy_helper.to_array(w).astype(np.float32) for w in graph.initializer}
    known |= {n.output[0]: known[n.input[0]] for n in graph.node if n.op_type == "Cast"}
    return [(known[n.input[1]], known[n.input[2]]) for n in graph.node if n.op_type == "Conv"]


def store_in_half(model: Path) -> None:
    """Store a network's weights in 16 bits; casts in the network restore 32 bits when it is loaded."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    whole = onnx.load(model)
    graph, casts = whole.graph, []
    for weights in [w for w in graph.initializer if np.prod(w.dims) > 1000]:
        values = numpy_helper.to_array(weights).astype(np.float16)
        graph.initializer.append(numpy_helper.from_array(values, f"{weights.name}_half"))
        graph.initializer.remove(weights)
        casts.append(helper.make_node("Cast", [f"{weights.name}_half"], [weights.name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    onnx.save(whole, model)


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"scenes": make_scenes, "train": train}, description=__doc__)
