"""What a Carmine 1.09 does to a perfect depth image, and registration to a camera's pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid.config import NoiseConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array


def axial_sigma(depth: Array, config: NoiseConfig) -> Array:
    """Standard deviation (...) [m] of readings at depths (...) [m]: σ(z) = a + b·(z − z0)²."""
    a, b, z0 = config.axial
    return a + b * (depth - z0) ** 2


def add_depth_noise(depth: Array, incidence: Array, config: NoiseConfig, rng: np.random.Generator) -> Array:
    """Corrupt a perfect depth image as the sensor does.

    No return outside the range, from surfaces seen at a grazing angle, and beside depth edges; Gaussian noise
    along the optical axis; then rounding to equal steps of 1/z.

    Args:
        depth: True depth (H, W) [m], 0 = nothing there.
        incidence: Angle (H, W) [rad] between each ray and the surface's normal.
        config: The sensor's figures.
        rng: Source of the noise; one draw a pixel, whatever is seen.

    Returns:
        Depth (H, W) [m], 0 = no reading.
    """
    near, far = config.range
    seen = (depth > 0.0) & (incidence <= np.deg2rad(config.grazing)) & ~depth_edges(depth, config.edge_jump)
    noisy = depth + axial_sigma(depth, config) * rng.standard_normal(depth.shape)
    noisy = np.maximum(noisy, near / 2.0)
    steps = np.maximum(np.round(1.0 / (noisy * config.disparity_step)), 1.0)
    quantised = 1.0 / (steps * config.disparity_step)
    return np.where(seen & (quantised >= near) & (quantised <= far), quantised, 0.0)


def depth_edges(depth: Array, jump: float) -> NDArray[np.bool_]:
    """Pixels (H, W) on either side of a step of more than `jump` [m] to one of their four neighbours."""
    edges = np.zeros(depth.shape, dtype=bool)
    rows = np.abs(np.diff(depth, axis=0)) > jump
    columns = np.abs(np.diff(depth, axis=1)) > jump
    edges[:-1] |= rows
    edges[1:] |= rows
    edges[:, :-1] |= columns
    edges[:, 1:] |= columns
    return edges


def misregister(T_world_camera: Array, config: NoiseConfig, rng: np.random.Generator) -> Array:
    """Return the pose (4, 4) registration believes in: shifted, and turned about the camera's centre.

    The shift is Gaussian with σ = `config.translation` along each axis; the turn is about an axis drawn
    uniformly, by a Gaussian angle with σ = `config.rotation`.

    Args:
        T_world_camera: True pose (4, 4).
        config: The errors' sizes.
        rng: Source of the error.
    """
    angle = np.deg2rad(config.rotation) * rng.standard_normal()
    axis = transforms.unit(rng.standard_normal(3))
    shift = config.translation * rng.standard_normal(3)
    R_world_camera = transforms.rotation_from_vector(angle * axis) @ T_world_camera[:3, :3]
    return transforms.rigid(R_world_camera, T_world_camera[:3, 3] + shift)
