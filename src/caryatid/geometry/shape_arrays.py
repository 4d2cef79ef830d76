"""Many shapes as the compiled kernels take them: codes, axes, centres and half extents in arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.shapes import Shape
from caryatid.geometry.signed_distance import BOX, CYLINDER, SPHERE
from caryatid.geometry.transforms import Array

SHAPE_CODES = {"box": BOX, "cylinder": CYLINDER, "sphere": SPHERE}
"""Code of each kind of shape."""


class ShapeArrays(NamedTuple):
    """N shapes in the world frame.

    Attributes:
        kinds: Codes (N,).
        R: Axes (N, 3, 3), columns = x, y, z of the object.
        centres: (N, 3) [m].
        half: Half extents (N, 3) [m] along the axes.
    """

    kinds: NDArray[np.int64]
    R: Array
    centres: Array
    half: Array


def shape_arrays(shapes: Sequence[Shape]) -> ShapeArrays:
    """Gather shapes into arrays."""
    T = np.array([s.T_world_object for s in shapes]).reshape(-1, 4, 4)
    return ShapeArrays(
        np.array([SHAPE_CODES[s.kind] for s in shapes], dtype=np.int64),
        np.ascontiguousarray(T[:, :3, :3]),
        np.ascontiguousarray(T[:, :3, 3]),
        np.array([s.extents for s in shapes]).reshape(-1, 3) / 2.0,
    )


def boxes_around(shapes: ShapeArrays) -> tuple[Array, Array]:
    """Lowest and highest corner (N, 3) [m] of the upright box around each shape."""
    along = np.abs(shapes.R) * shapes.half[:, None]
    reach = along.sum(axis=2)
    round_, balls = shapes.kinds == CYLINDER, shapes.kinds == SPHERE
    reach[round_] = np.hypot(along[round_, :, 0], along[round_, :, 1]) + along[round_, :, 2]
    reach[balls] = shapes.half[balls]
    return shapes.centres - reach, shapes.centres + reach
