"""Points of a single shape, seen from one side or all around, for fitters to be compared on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import fits
import numpy as np
from scipy.spatial import cKDTree

from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from performance.peers import NEIGHBOURS

Kind = Literal["cylinder", "box", "sphere"]
Side = Literal["one side", "all around"]
SIGMA = 0.001
"""Noise of the points along each axis [m]."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What fitters are compared on.

    Attributes:
        kind: Of the shape.
        count: Points.
        side: From where they are seen.
    """

    kind: Kind
    count: int
    side: Side

    @property
    def name(self) -> str:
        """As part of a row's name."""
        return f"{self.kind}.{self.count // 1000}k-{self.side.replace(' ', '-')}"

    @property
    def words(self) -> str:
        """For a person to read."""
        return f"{self.kind}, {self.count // 1000}k points, {self.side}"


@dataclass(frozen=True, eq=False, slots=True)
class Sample:
    """Points of a shape.

    Attributes:
        shape: The true one.
        points: (N, 3) [m].
        normals: Unit normals (N, 3), of planes through each point's neighbours.
        eye: A point (3,) [m] that normals can be turned to.
    """

    shape: Shape
    points: Array
    normals: Array
    eye: Array


def draw(setting: Setting, seed: int) -> Sample:
    """Draw a shape of table-top size and points on it, as dense in every part of the image or of the surface.

    What is measured can be seen from the one side: two faces of a box, the mantle of a cylinder.
    """
    rng = np.random.default_rng([fits.KINDS.index(setting.kind), setting.count, seed])
    shape = fits.random_shape(setting.kind, rng)
    centre = shape.T_world_object[:3, 3]
    if setting.side == "all around":
        points, outward = fits.dense_surface(shape, setting.count, rng)
        points = points + SIGMA * rng.normal(size=points.shape)
        return Sample(shape, points, _normals(points, outward), centre)
    while True:
        points, normals, view = fits.half_view(shape, setting.count, SIGMA, rng)
        facing = np.abs(view @ shape.T_world_object[:3, :3]) > np.cos(fits.STEEPEST)
        seen = {"sphere": True, "box": facing.sum() > 1, "cylinder": facing[:2].any()}
        if seen[setting.kind]:
            return Sample(shape, points, normals, centre + view)


def _normals(points: Array, outward: Array) -> Array:
    """Normals (N, 3) of planes through each point's neighbours, on the side of the outward ones (N, 3)."""
    _, near = cKDTree(points).query(points, NEIGHBOURS)
    spread = points[near] - points[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    inward = np.sum(normals * outward, axis=1) < 0.0
    return np.where(inward[:, None], -normals, normals)
