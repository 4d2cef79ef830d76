"""What the rays of candidate views gather in a voxel grid, beside the plain NumPy reference.

A ray gathers from where it enters the grid up to the first occupied voxel, that one included, or to where
it leaves the grid. The visibility of a voxel is the product of 1 − occupancy over the voxels before it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.rays import Triple, advance, enter, traversed_reference, within
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each
from caryatid.sensing.voxel_map import OCCUPIED, UNKNOWN

FORMULATIONS = (
    "occlusion-aware",
    "unobserved-voxel",
    "rear-side-voxel",
    "rear-side-entropy",
    "proximity-count",
)
"""Columns of what `gather` returns."""


class Views(NamedTuple):
    """Candidate views of a voxel grid.

    Attributes:
        states: State (X, Y, Z) of each voxel: 0 unknown, 1 free, 2 occupied.
        layers: Occupancy [1], its entropy [bit] and the nearness to a surface of each voxel (X, Y, Z, 3).
        T_world_camera: Candidates (C, 4, 4).
        rays_camera: Unit directions (R, 3) of the rays in the camera.
        origin: Corner (3,) [m] of voxel [0, 0, 0].
        size: Edge of a voxel [m].
        gathered: What the rays of each gather (C, 5), 0 at first; written to.
    """

    states: NDArray[np.int8]
    layers: NDArray[np.float32]
    T_world_camera: Array
    rays_camera: Array
    origin: Array
    size: float
    gathered: Array


@njit(cache=True)
def _gather_ray(
    states: NDArray[np.int8], layers: NDArray[np.float32], start: Triple, ray: Triple, gathered: Array
) -> None:
    """Add what one ray gathers, start and direction in voxel units, to `gathered` (5,)."""
    shape = states.shape
    t, end, voxel, step, ahead = enter(shape, start, ray, 0.0, np.inf)
    visible, run = 1.0, 0.0
    while t < end and within(voxel, shape):
        state = states[voxel]
        occupancy, entropy, proximity = layers[voxel]
        gathered[0] += visible * entropy
        if state == UNKNOWN:
            gathered[1] += visible * entropy
            gathered[4] += proximity
            run += entropy
        elif state == OCCUPIED:
            if run > 0.0:
                gathered[2] += 1.0
                gathered[3] += run
            return
        else:
            run = 0.0
        visible *= 1.0 - occupancy
        t = min(ahead[0], ahead[1], ahead[2])
        voxel, ahead = advance(voxel, ray, step, ahead)


def gather(
    states: NDArray[np.int8],
    layers: NDArray[np.float32],
    T_world_camera: Array,
    rays_camera: Array,
    origin: Array,
    size: float,
) -> Array:
    """Sum the information the rays of each candidate gather. Every candidate has a sum of its own.

    The arguments are as in `Views`.

    Returns:
        (C, 5), a column each of `FORMULATIONS`.
    """
    gathered = np.zeros((len(T_world_camera), len(FORMULATIONS)))
    for_each(
        gather_one,
        len(T_world_camera),
        Views(states, layers, T_world_camera, rays_camera, origin, size, gathered),
    )
    return gathered


@njit(cache=True)
def gather_one(c: int, views: Views) -> None:
    """Sum what the rays of one candidate gather."""
    T, size, origin = views.T_world_camera[c], views.size, views.origin
    start = ((T[0, 3] - origin[0]) / size, (T[1, 3] - origin[1]) / size, (T[2, 3] - origin[2]) / size)
    for r in range(len(views.rays_camera)):
        x, y, z = views.rays_camera[r, 0], views.rays_camera[r, 1], views.rays_camera[r, 2]
        ray = (
            (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z) / size,
            (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z) / size,
            (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z) / size,
        )
        _gather_ray(views.states, views.layers, start, ray, views.gathered[c])


def gather_reference(
    states: NDArray[np.int8],
    layers: NDArray[np.float32],
    T_world_camera: Array,
    rays_camera: Array,
    origin: Array,
    size: float,
) -> Array:
    """Do the same as `gather`, ray by ray from all crossings with the grid's planes."""
    result = np.zeros((len(T_world_camera), 5))
    reach = size * float(np.sum(states.shape))
    middle = origin + size * np.array(states.shape) / 2.0
    for c, T in enumerate(T_world_camera):
        eye = T[:3, 3]
        for ray_world in rays_camera @ T[:3, :3].T:
            end = eye + (np.linalg.norm(middle - eye) + reach) * ray_world
            voxels = traversed_reference(states.shape, eye, end, 0.0, 1.0, origin, size)
            found = states[tuple(voxels.T)]
            stop = np.flatnonzero(found == OCCUPIED)[:1]
            last = int(stop[0]) + 1 if len(stop) else len(found)
            unknown = found[:last] == UNKNOWN
            occupancy, entropy, proximity = layers[tuple(voxels[:last].T)].T.astype(np.float64)
            seen = np.append(1.0, np.cumprod(1.0 - occupancy))[:last] * entropy
            known = np.flatnonzero(~unknown[: last - 1])
            run = entropy[known[-1] + 1 if len(known) else 0 : last - 1] if len(stop) else entropy[:0]
            result[c] += seen.sum(), seen[unknown].sum(), len(run) > 0, run.sum(), proximity[unknown].sum()
    return result
