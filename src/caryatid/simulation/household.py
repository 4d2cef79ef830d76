"""Things of a household at the origin, upright: trays, bowls, mugs, boxes, plates, books, bottles, fruit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, fibonacci_sphere
from caryatid.geometry.solids import Polytope, Solid, hollowed
from caryatid.geometry.transforms import Array

WALL = 0.006
"""How thick walls are [m]."""
CORNERS = 12
"""Corners of a ring of a round thing [1]."""

Ring = tuple[float, float]
"""Radius and height [m]."""


def thing(rng: np.random.Generator) -> Shape:
    """Draw a thing; four in ten are hollow."""
    makers: dict[Callable[[np.random.Generator], Shape], float] = {
        _tray: 0.1, _bowl: 0.12, _mug: 0.12, _open_box: 0.06, _plate: 0.14,
        _book: 0.14, _carton: 0.08, _can: 0.08, _bottle: 0.06, _fruit: 0.1,
    }  # fmt: skip
    shape = list(makers)[int(rng.choice(len(makers), p=list(makers.values())))](rng)
    yaw = transforms.rotation_from_vector((0.0, 0.0, rng.uniform(-np.pi, np.pi)))
    return shape.moved(transforms.rigid(yaw, np.zeros(3)))


def _tray(rng: np.random.Generator) -> Shape:
    x, y, z = rng.uniform((0.2, 0.26, 0.03), (0.27, 0.36, 0.06))
    return _hollow_box(x, y, z)


def _open_box(rng: np.random.Generator) -> Shape:
    x, y, z = rng.uniform((0.11, 0.13, 0.07), (0.15, 0.2, 0.11))
    return _hollow_box(x, y, z)


def _hollow_box(x: float, y: float, z: float) -> Shape:
    """Four walls and a floor."""
    block = _hull([[a * x / 2.0, b * y / 2.0, c * z] for a in (-1, 1) for b in (-1, 1) for c in (0, 1)])
    axes = np.eye(3)
    planes = [(axes[2], WALL)]
    for axis, length in ((0, x), (1, y)):
        planes += [(sign * axes[axis], WALL - length / 2.0) for sign in (-1.0, 1.0)]
    return Solid.of(hollowed(block, planes))


def _bowl(rng: np.random.Generator) -> Shape:
    """Two rings of a wall that opens up, on a smaller floor."""
    foot, waist, rim = np.array([0.5, 0.85, 1.0]) * rng.uniform(0.07, 0.1)
    height = float(rng.uniform(0.05, 0.075))
    rings = [(foot, 0.0), (waist, 0.45 * height), (rim, height)]
    return Solid.of([part for low, high in pairwise(rings) for part in _wall(low, high)] + [_disc(foot)])


def _mug(rng: np.random.Generator) -> Shape:
    """A straight wall, a floor, and a handle of three bars."""
    radius, height = float(rng.uniform(0.036, 0.046)), float(rng.uniform(0.075, 0.1))
    bars = [
        _bar((radius + 0.01, 0.0, 0.25 * height), (0.024, 0.01, 0.01)),
        _bar((radius + 0.01, 0.0, 0.75 * height), (0.024, 0.01, 0.01)),
        _bar((radius + 0.025, 0.0, 0.5 * height), (0.01, 0.01, 0.5 * height + 0.01)),
    ]
    return Solid.of([*_wall((radius, 0.0), (radius, height)), _disc(radius), *bars])


def _bottle(rng: np.random.Generator) -> Shape:
    """A body, a shoulder and a neck; nothing gets into it."""
    radius, height = float(rng.uniform(0.03, 0.04)), float(rng.uniform(0.17, 0.24))
    rings = [(radius, 0.0), (radius, 0.6 * height), (0.013, 0.78 * height), (0.013, height)]
    return Solid.of([_hull([*_ring(a), *_ring(b)]) for a, b in pairwise(rings)])


def _fruit(rng: np.random.Generator) -> Shape:
    half = rng.uniform(0.028, 0.042) * np.array([1.0, 0.95, 0.88])
    return Solid.of([_hull(fibonacci_sphere(120) * half)])


def _plate(rng: np.random.Generator) -> Shape:
    return Cylinder(np.eye(4), float(rng.uniform(0.085, 0.12)), 0.018)


def _can(rng: np.random.Generator) -> Shape:
    return Cylinder(np.eye(4), float(rng.uniform(0.03, 0.04)), float(rng.uniform(0.09, 0.125)))


def _book(rng: np.random.Generator) -> Shape:
    return Box(np.eye(4), rng.uniform((0.13, 0.18, 0.018), (0.17, 0.24, 0.045)))


def _carton(rng: np.random.Generator) -> Shape:
    return Box(np.eye(4), rng.uniform((0.06, 0.11, 0.16), (0.08, 0.14, 0.2)))


def _wall(low: Ring, high: Ring) -> list[Polytope]:
    """A ring of a wall, in as many parts as it has corners."""
    rings = [_ring((radius - inset, height)) for radius, height in (low, high) for inset in (0.0, WALL)]
    turned = [np.roll(ring, -1, axis=0) for ring in rings]
    return [_hull([ring[k] for ring in [*rings, *turned]]) for k in range(CORNERS)]


def _disc(radius: float) -> Polytope:
    """The floor of a round thing."""
    return _hull([*_ring((radius - WALL / 2.0, 0.0)), *_ring((radius - WALL / 2.0, WALL))])


def _bar(centre: Sequence[float], size: Sequence[float]) -> Polytope:
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / 2.0
    return _hull(centre + corners * size)


def _ring(ring: Ring) -> Array:
    """Corners (CORNERS, 3) [m] of a level ring around the z axis."""
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    radius, height = ring
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(CORNERS, height)], axis=-1)


def _hull(points: Sequence[Sequence[float]] | Array) -> Polytope:
    part = Polytope.around(np.array(points, dtype=np.float64))
    assert part is not None
    return part
