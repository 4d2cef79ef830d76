"""How far off a fitted shape may be: standard deviations of its pose, its sizes and each of its sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import FitConfig
from caryatid.geometry import BOX, SPHERE
from caryatid.geometry.transforms import Array


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


def estimate(
    kind: int,
    seen: NDArray[np.bool_],
    unseen: Array,
    information: Array,
    sigma: float,
    config: FitConfig,
) -> Uncertainty:
    """Standard deviations of a shape from the normal equations of its last fit.

    Args:
        kind: Code of the shape.
        seen: Which sides (6,) points bear out.
        unseen: Standard deviation (6,) [m] of the sides that no point bears out.
        information: Sum over the points of the products of their derivatives (9, 9), unseen sides out of the
            way; rows and columns as of `least_squares.normal_equations`.
        sigma: Robust standard deviation [m] of the points' distances to the shape.
        config: How many points share an error, and the error of registration.
    """
    # A radian for a rotation that nothing determines.
    prior = np.array([config.max_extent] * 3 + [1.0] * 3 + [config.max_extent] * 3)
    information = information / (config.correlated * sigma**2)
    covariance = np.linalg.inv(information + np.diag(prior**-2.0))
    # Rounding may leave a variance a little below zero.
    variance = np.maximum(np.diagonal(covariance), 0.0)
    # The half extents along x, y, z have these columns: round ones share one.
    columns = {BOX: (6, 7, 8), SPHERE: (6, 6, 6)}.get(kind, (6, 6, 8))
    centre, half, both = variance[:3], variance[list(columns)], covariance[range(3), columns]
    borne_out = seen.copy()
    if kind != BOX:
        # Any part of a round surface tells where all of it is.
        borne_out[:4] |= seen[:4].any()
    borne_out |= kind == SPHERE
    low = np.where(borne_out[0::2], np.maximum(centre + half - 2.0 * both, 0.0), unseen[0::2] ** 2)
    high = np.where(borne_out[1::2], np.maximum(centre + half + 2.0 * both, 0.0), unseen[1::2] ** 2)
    determined = borne_out[0::2] & borne_out[1::2]
    floor = config.registration**2
    return Uncertainty(
        position=np.sqrt(np.where(determined, centre, (low + high) / 4.0) + floor),
        rotation=np.sqrt(variance[3:6]),
        sizes=np.sqrt(np.where(determined, 4.0 * half, low + high) + floor),
        sides=np.sqrt(np.stack([low, high], axis=1).ravel() + floor),
    )
