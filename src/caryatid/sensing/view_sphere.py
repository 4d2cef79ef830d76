"""The view sphere: possible camera positions around the scene, all looking at its centre (section IV)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from caryatid.config import ActiveVisionConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import fibonacci_sphere
from caryatid.geometry.transforms import Array


@dataclass(frozen=True, eq=False, slots=True)
class ViewSphere:
    """Evenly spread view points around a centre.

    Attributes:
        centre_world: Centre (3,) [m]: the centroid of the table-top segment of the first view.
        radius: Distance of the views from the centre [m].
        directions: Unit vectors (N, 3) from the centre to the views.
    """

    centre_world: Array
    radius: float
    directions: Array

    @classmethod
    def around(cls, centre_world: ArrayLike, config: ActiveVisionConfig) -> ViewSphere:
        """Build the sphere of `config.sphere_points` views around a point (3,) [m]."""
        centre = np.array(centre_world, dtype=np.float64)
        return cls(centre, config.sphere_radius, fibonacci_sphere(config.sphere_points))

    @property
    def positions_world(self) -> Array:
        """Camera positions (N, 3) [m]."""
        return self.centre_world + self.radius * self.directions

    def poses(self, directions: Array) -> Array:
        """Camera poses (M, 4, 4) in unit directions (M, 3) from the centre, looking at it without roll.

        Straight above and below, where the roll is open, the image's top points along world +x.
        """
        return transforms.look_at(self.centre_world + self.radius * directions, self.centre_world)

    def direction_of(self, T_world_camera: Array) -> Array:
        """Unit vectors (..., 3) from the centre to cameras (..., 4, 4), wherever they are."""
        return transforms.unit(T_world_camera[..., :3, 3] - self.centre_world)


def spread(direction_from: Array, directions: Array, sigma: float) -> Array:
    """Gaussians on the sphere, exp(−angle² / 2σ²): values (M, K) in unit directions (M, 3).

    Their centres, where the value is 1, are unit vectors (K, 3); σ is an angle [rad].
    """
    angle = np.arccos(np.clip(directions @ direction_from.T, -1.0, 1.0))
    return np.exp(-0.5 * (angle / sigma) ** 2)


def direction(azimuth: float, elevation: float) -> Array:
    """Unit vector (3,) with an azimuth, from +x towards +y, and an elevation over the horizontal [rad]."""
    return np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
