"""How far off a fitted shape may be: standard deviations of its pose, its sizes and each of its sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.geometry import BOX, SPHERE
from caryatid.geometry.transforms import Array

_SIZE_COLUMNS = np.array([(6, 6, 6), (6, 6, 8), (6, 7, 8)])
"""Column of the normal equations that holds the half extent along x, y, z, by the code of the kind."""
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
    kinds: NDArray[np.intp],
    seen: NDArray[np.bool_],
    unseen: Array,
    normal_matrices: Array,
    sigma: Array,
    config: FitConfig,
) -> list[Uncertainty]:
    """Standard deviations of several shapes from the normal equations of their last fits.

    Args:
        kinds: Code (P,) of each shape's kind.
        seen: Which sides (P, 6) points bear out.
        unseen: Standard deviation (P, 6) [m] of the sides that no point bears out.
        normal_matrices: Sum over the points of the products of their derivatives (P, 9, 9), unseen sides out
            of the way; rows and columns as of `least_squares.normal_equations`.
        sigma: Robust standard deviation (P,) [m] of the points' distances to the shape.
        config: How many points share an error, and the error of registration.
    """
    information = normal_matrices / (config.correlated * sigma[:, None, None] ** 2)
    prior = np.array([config.max_extent] * 3 + [_TURN] * 3 + [config.max_extent] * 3)
    covariance = np.linalg.inv(information + np.diag(prior**-2.0))
    # Rounding may leave a variance a little below zero.
    variance = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0)
    rows, axes, columns = np.arange(len(kinds))[:, None], np.arange(3), _SIZE_COLUMNS[kinds]
    centre, half, both = variance[:, :3], variance[rows, columns], covariance[rows, axes, columns]
    borne_out = _borne_out(kinds, seen)
    low = np.where(borne_out[:, 0::2], np.maximum(centre + half - 2.0 * both, 0.0), unseen[:, 0::2] ** 2)
    high = np.where(borne_out[:, 1::2], np.maximum(centre + half + 2.0 * both, 0.0), unseen[:, 1::2] ** 2)
    determined = borne_out[:, 0::2] & borne_out[:, 1::2]
    floor = config.registration**2
    position = np.sqrt(np.where(determined, centre, (low + high) / 4.0) + floor)
    sizes = np.sqrt(np.where(determined, 4.0 * half, low + high) + floor)
    sides = np.sqrt(np.stack([low, high], axis=2).reshape(-1, 6) + floor)
    rotation = np.sqrt(variance[:, 3:6])
    return [Uncertainty(*found) for found in zip(position, rotation, sizes, sides, strict=True)]


def _borne_out(kinds: NDArray[np.intp], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Sides (P, 6) that points tell of: any part of a round surface tells where all of it is."""
    borne_out = seen.copy()
    borne_out[:, :4] |= (kinds != BOX)[:, None] & seen[:, :4].any(axis=1, keepdims=True)
    borne_out[kinds == SPHERE] = True
    return borne_out
