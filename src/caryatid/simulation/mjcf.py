"""MJCF of a table with solids on it and walls around it, built through MuJoCo's spec."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.transforms import Array
from caryatid.simulation.world import TABLE

TABLE_HEIGHT = 0.75
"""Height of the table tops built here [m]."""

TABLE_SIZE = (0.6, 0.9)
"""Depth (along world x, towards the robot) and width (along y) of the usual table top [m]."""

Side = Literal["+x", "+y", "-y"]
"""Where a wall may stand; the robot comes from -x."""

_TOP_THICKNESS = 0.04
_LEG = 0.04
_WALL_THICKNESS = 0.06
_WALL_LENGTH = 3.2
_WALL_HEIGHT = 2.0
_WALL_GAP = {"+x": 0.24, "+y": 0.32, "-y": 0.32}
_WOOD, _DARK_WOOD, _PLASTER = (0.72, 0.58, 0.42, 1.0), (0.6, 0.48, 0.35, 1.0), (0.85, 0.85, 0.82, 1.0)
_GOLDEN_RATIO = 0.618034
_ROLLING = {"box": (4, 0.005, 0.001), "cylinder": (6, 0.005, 0.001), "sphere": (6, 0.01, 0.01)}


@dataclass(frozen=True, eq=False, slots=True)
class Solid:
    """A free body of one primitive.

    Attributes:
        shape: Where it is set down and how large it is, in the world.
        density: [kg/m³].
        friction: Sliding friction [1]; the larger one of two bodies in contact counts.
    """

    shape: Box | Cylinder | Sphere
    density: float = 600.0
    friction: float = 0.8


def box(
    size: tuple[float, float, float],
    at: tuple[float, float, float],
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    density: float = 600.0,
    friction: float = 0.8,
) -> Solid:
    """A cuboid.

    Args:
        size: Full edge lengths [m].
        at: Centre in x and y, and the height of the centre over the table top in z [m].
        turn: Rotation vector [deg].
        density: [kg/m³].
        friction: Sliding friction [1].
    """
    return Solid(Box(_placed(at, turn), np.array(size)), density, friction)


def cylinder(
    radius: float,
    height: float,
    at: tuple[float, float, float],
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    density: float = 600.0,
) -> Solid:
    """A cylinder [m], upright unless turned; the other arguments are as in `box`.

    Args:
        radius: Of its ends [m].
        height: Along its axis [m].
        at: As in `box`.
        turn: As in `box`.
        density: As in `box`.
    """
    return Solid(Cylinder(_placed(at, turn), radius, height), density)


def sphere(radius: float, at: tuple[float, float, float], density: float = 600.0) -> Solid:
    """A ball [m]; the other arguments are as in `box`."""
    return Solid(Sphere(_placed(at, (0.0, 0.0, 0.0)), radius), density)


def build_spec(
    solids: Sequence[Solid],
    name: str,
    table_size: tuple[float, float] = TABLE_SIZE,
    walls: Sequence[Side] = (),
) -> Any:
    """Build a floor, a table with legs, walls beside it and free bodies `object0`, `object1`, … on it.

    Args:
        solids: The free bodies, in order.
        name: Name of the model.
        table_size: Depth along x and width along y of the top [m].
        walls: Sides of the table where a wall stands.

    Returns:
        The `mujoco.MjSpec`.
    """
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.option.impratio = 10.0
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10.0, 10.0, 0.1])
    for index, side in enumerate(walls):
        centre, half = _wall(side, table_size)
        _add_box(spec.worldbody, f"wall{index}", centre, half, _PLASTER)
    _add_table(spec.worldbody.add_body(name=TABLE), table_size)
    for index, solid in enumerate(solids):
        add_solid(spec, f"object{index}", solid, palette(index))
    return spec


def palette(index: int) -> tuple[float, float, float, float]:
    """Colour of the object with this number; neighbours in number differ widely in hue."""
    hue = (0.02 + index * _GOLDEN_RATIO) % 1.0
    value = (0.88, 0.7, 0.55)[(index // 7) % 3]
    return (*colorsys.hsv_to_rgb(hue, 0.75, value), 1.0)


def quaternion(R: Array) -> Array:
    """Unit quaternion (4,), w first as MuJoCo wants it, of a rotation (3, 3)."""
    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, np.ascontiguousarray(R).reshape(-1))
    return wxyz


def _placed(at: tuple[float, float, float], turn: tuple[float, float, float]) -> Array:
    R = transforms.rotation_from_vector(np.deg2rad(turn))
    return transforms.rigid(R, (at[0], at[1], TABLE_HEIGHT + at[2]))


def _add_table(table: Any, size: tuple[float, float]) -> None:
    x, y = size[0] / 2.0, size[1] / 2.0
    under = TABLE_HEIGHT - _TOP_THICKNESS
    _add_box(
        table,
        "table_top",
        (0.0, 0.0, TABLE_HEIGHT - _TOP_THICKNESS / 2.0),
        (x, y, _TOP_THICKNESS / 2.0),
        _WOOD,
    )
    inset, half = 0.75 * _LEG, (_LEG / 2.0, _LEG / 2.0, under / 2.0)
    for index, (sign_x, sign_y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        centre = (sign_x * (x - inset), sign_y * (y - inset), under / 2.0)
        _add_box(table, f"table_leg{index}", centre, half, _DARK_WOOD)


def _wall(
    side: Side, table_size: tuple[float, float]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Centre and half sizes [m] of a wall on one side of the table."""
    thick, long, high = _WALL_THICKNESS / 2.0, _WALL_LENGTH / 2.0, _WALL_HEIGHT / 2.0
    sign = 1.0 if side[0] == "+" else -1.0
    match side[1]:
        case "x":
            return (sign * (table_size[0] / 2.0 + _WALL_GAP[side] + thick), 0.0, high), (thick, long, high)
        case _:
            return (0.0, sign * (table_size[1] / 2.0 + _WALL_GAP[side] + thick), high), (long, thick, high)


def _add_box(
    body: Any,
    name: str,
    centre: tuple[float, float, float],
    half: tuple[float, float, float],
    rgba: tuple[float, float, float, float],
) -> None:
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=list(centre), size=list(half), rgba=list(rgba)
    )


def add_solid(
    spec: Any, name: str, solid: Solid, rgba: tuple[float, float, float, float] = (0.7, 0.7, 0.7, 1.0)
) -> None:
    """Add a free body of one primitive to a MuJoCo spec.

    Args:
        spec: `mujoco.MjSpec`, changed in place.
        name: Of the body.
        solid: What it is and where.
        rgba: Its colour.
    """
    shape = solid.shape
    T_world_body = shape.T_world_object
    body = spec.worldbody.add_body(name=name, pos=T_world_body[:3, 3], quat=quaternion(T_world_body[:3, :3]))
    body.add_freejoint()
    match shape:
        case Box():
            kind, size = mujoco.mjtGeom.mjGEOM_BOX, shape.extents / 2.0
        case Cylinder():
            kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, np.array([shape.radius, shape.height / 2.0, 0.0])
        case Sphere():
            kind, size = mujoco.mjtGeom.mjGEOM_SPHERE, np.array([shape.radius, 0.0, 0.0])
    condim, torsional, rolling = _ROLLING[shape.kind]
    body.add_geom(
        type=kind,
        size=size,
        condim=condim,
        friction=[solid.friction, torsional, rolling],
        density=solid.density,
        rgba=rgba,
    )
