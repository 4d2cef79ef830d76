"""Random scenes in which every object touches another: pushed together on the table, some stacked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.config import GenerationConfig, PhysicsConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.transforms import Array
from caryatid.simulation.generate import (
    AXES,
    DOWN,
    Drop,
    Place,
    check_request,
    let_go,
    set_down,
    upright,
)
from caryatid.simulation.mjcf import TABLE_HEIGHT, TABLE_SIZE, Solid
from caryatid.simulation.solids import true_shapes
from caryatid.simulation.world import SimulatedScene

PACKED_SIZES = (2, 25)
"""Fewest and most objects of a packed scene."""

_STEPS = 60
_SPACING = 0.004


def generate_packed(
    size: int, seed: int, config: GenerationConfig | None = None, physics: PhysicsConfig | None = None
) -> SimulatedScene:
    """Push primitives together on the table until they touch, and stack some of them.

    Args:
        size: Number of objects.
        seed: Seed; the same size and seed give the same scene.
        config: Sizes and habits.
        physics: When an object is at rest.

    Raises:
        InputError: The size or the seed is out of range, or an object would not stay where it is put.
    """
    name = f"packed-{size}-{seed}"
    check_request(name, size, seed, PACKED_SIZES)
    habits = config or GenerationConfig()
    rng = np.random.default_rng([2, size, seed])
    turn = transforms.rotation_from_vector((0.0, 0.0, rng.uniform(-np.pi, np.pi)))

    def draw(rng: np.random.Generator, scene: SimulatedScene | None) -> Drop:
        shape = upright(rng, habits)
        if rng.random() < habits.packed_aligned:
            shape = _turned(shape, turn)
        if scene is None:
            return Drop(let_go(shape, np.zeros(2), scene, habits))
        others = list(true_shapes(scene).values())
        if rng.random() < habits.packed_stacked:
            below = others[int(rng.integers(len(others)))]
            reach = habits.jitter * below.support(AXES)[:2]
            xy = below.T_world_object[:2, 3] + reach * rng.uniform(-1.0, 1.0, size=2)
            return Drop(let_go(shape, xy, scene, habits), stacked=True)
        azimuth = rng.uniform(-np.pi, np.pi)
        return Drop(Solid(_pushed(shape, np.array([np.cos(azimuth), np.sin(azimuth), 0.0]), others, habits)))

    return set_down(name, [], [draw] * size, rng, Place(TABLE_SIZE, ()), habits, physics)


def _turned(shape: Box | Cylinder | Sphere, turn: Array) -> Box | Cylinder | Sphere:
    """Turn a shape at the origin so that its level axes are those of the pack."""
    R = shape.T_world_object[:3, :3]
    level = int(np.argmin(np.abs(R[2])))
    yaw = np.arctan2(R[1, level], R[0, level])
    back = transforms.rotation_from_vector((0.0, 0.0, -yaw))
    return shape.moved(transforms.rigid(turn @ back, np.zeros(3)))


def _pushed(
    shape: Box | Cylinder | Sphere,
    outward_world: Array,
    others: Sequence[Box | Cylinder | Sphere],
    habits: GenerationConfig,
) -> Box | Cylinder | Sphere:
    """Push a shape over the table from outside towards the middle until it touches another."""
    z = TABLE_HEIGHT + float(shape.support(DOWN)[0]) + habits.packed_gap
    distance = float(np.hypot(*TABLE_SIZE))
    for _ in range(_STEPS):
        at = shape.moved(transforms.rigid(np.eye(3), distance * outward_world + (0.0, 0.0, z)))
        gap = min(_gap(at, other) for other in others)
        if gap < habits.packed_gap or distance <= 0.0:
            break
        distance = max(distance - gap + habits.packed_gap / 2.0, 0.0)
    return at


def _gap(a: Box | Cylinder | Sphere, b: Box | Cylinder | Sphere) -> float:
    """Distance [m] between two shapes, from samples on both surfaces."""
    return min(
        float(a.signed_distance(b.surface(_SPACING)[0]).min()),
        float(b.signed_distance(a.surface(_SPACING)[0]).min()),
    )
