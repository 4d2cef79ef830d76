"""How far off a fitted shape may be: standard deviations of its pose, its sizes and each of its sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.frames import Array

_SIZE_COLUMN = {"box": (6, 7, 8), "cylinder": (6, 6, 8), "sphere": (6, 6, 6)}
"""Column of the normal equations that holds the half extent along x, y, z."""
_TURN = 1.0
"""Standard deviation of a rotation that nothing determines [rad]."""


@dataclass(frozen=True, eq=False, slots=True)
class Uncertainty:
    """Standard deviations of a fitted shape, along and about the object's own axes.

    Attributes:
        position: Of the centre (3,) [m].
        rotation: (3,) [rad]; large about an axis of symmetry.
        sizes: Of the full extents (3,) [m] along x, y, z.
        sides: Of the position of the sides -x, +x, -y, +y, -z, +z (6,) [m] along their normals.
    """

    position: Array
    rotation: Array
    sizes: Array
    sides: Array

    def along(self, point: Array, direction: Array) -> float:
        """Standard deviation [m] of where the surface lies, at a point and along a direction.

        Args:
            point: On or near the surface (3,) [m], in the object's frame.
            direction: Outward unit vector (3,) there, in the object's frame.
        """
        facing = np.where(direction > 0.0, self.sides[1::2], self.sides[0::2])
        turned = np.cross(point, direction) * self.rotation
        return float(np.sqrt(np.sum((direction * facing) ** 2) + np.sum(turned**2)))


def estimate(
    kind: str,
    seen: NDArray[np.bool_],
    unseen: Array,
    normal_matrix: Array,
    sigma: float,
    config: FitConfig,
) -> Uncertainty:
    """Standard deviations from the normal equations of the last fit.

    Args:
        kind: Of the shape.
        seen: Which sides (6,) points bear out.
        unseen: Standard deviation (6,) [m] of the sides that no point bears out; passed over for the others.
        normal_matrix: Sum over the points of the products of their derivatives (9, 9), unseen sides out of
            the way; rows and columns as of `kernels.fitting.normal_equations`.
        sigma: Robust standard deviation of the points' distances to the shape [m].
        config: How many points share an error, and the error of registration.
    """
    columns = _SIZE_COLUMN[kind]
    information = normal_matrix / (config.correlated * sigma**2)
    prior = np.array([config.max_extent] * 3 + [_TURN] * 3 + [config.max_extent] * 3)
    covariance = np.linalg.inv(information + np.diag(prior**-2.0))
    borne_out = np.array(seen)
    if kind != "box":
        # What is round is one surface: any part of it tells where all of it is.
        borne_out[:4] = kind == "sphere" or seen[:4].any()
        borne_out[4:] |= kind == "sphere"
    sides = np.empty(6)
    position, sizes = np.empty(3), np.empty(3)
    floor = config.registration**2
    for axis in range(3):
        centre, half, both = (
            covariance[axis, axis],
            covariance[columns[axis], columns[axis]],
            covariance[axis, columns[axis]],
        )
        low, high = centre + half - 2.0 * both, centre + half + 2.0 * both
        low = low if borne_out[2 * axis] else unseen[2 * axis] ** 2
        high = high if borne_out[2 * axis + 1] else unseen[2 * axis + 1] ** 2
        sides[2 * axis], sides[2 * axis + 1] = np.sqrt(low + floor), np.sqrt(high + floor)
        determined = bool(borne_out[2 * axis] and borne_out[2 * axis + 1])
        position[axis] = np.sqrt((centre if determined else (low + high) / 4.0) + floor)
        sizes[axis] = np.sqrt((4.0 * half if determined else low + high) + floor)
    return Uncertainty(position, np.sqrt(np.diag(covariance)[3:6]), sizes, sides)
