"""A few solids seen by a pinhole camera, by formula: exact depth, labels and normals for tests."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import View

K = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
TABLE = 0.75


def table_scene(
    T_world_camera: Array,
    boxes: list[tuple[Array, Array]] = (),
    spheres: list[tuple[Array, float]] = (),
    sigma: float = 0.0,
    seed: int = 0,
    half_table: tuple[float, float] = (0.3, 0.45),
    floor: float = 0.0,
) -> View:
    """Show a floor, a table top at 0.75 m, and boxes and spheres on it labelled 1, 2, … in order.

    Boxes are (centre, extents) along the axes, spheres (centre, radius), all in metres;
    `sigma` is the noise of inverse depth [1/m].
    """
    v, u = np.mgrid[0:480, 0:640].astype(np.float64)
    rays_camera = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    rays = transforms.rotate(T_world_camera, rays_camera)
    eye = T_world_camera[:3, 3]
    depth, labels = np.full(u.shape, np.inf), np.zeros(u.shape, dtype=np.int32)
    with np.errstate(divide="ignore", invalid="ignore"):
        solids = [np.where(rays[..., 2] < 0, (floor - eye[2]) / rays[..., 2], np.inf)]
        top = (np.array([0.0, 0.0, TABLE - 0.02]), np.array([2 * half_table[0], 2 * half_table[1], 0.04]))
        for centre, extents in [top, *boxes]:
            a = (np.asarray(centre) - np.asarray(extents) / 2.0 - eye) / rays
            b = (np.asarray(centre) + np.asarray(extents) / 2.0 - eye) / rays
            near, far = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
            solids.append(np.where((near < far) & (near > 0), near, np.inf))
        for centre, radius in spheres:
            towards = eye - np.asarray(centre)
            square, half = np.sum(rays**2, axis=-1), rays @ towards
            root = half**2 - square * (towards @ towards - radius**2)
            solids.append(np.where(root > 0, (-half - np.sqrt(root)) / square, np.inf))
    for number, hit in enumerate(solids):
        nearer = hit < depth
        depth[nearer], labels[nearer] = hit[nearer], max(number - 1, 0)
    seen = np.isfinite(depth)
    inverse = np.where(seen, 1.0 / depth, 0.0)
    inverse += sigma * np.random.default_rng(seed).normal(size=inverse.shape) * seen
    depth = np.where(seen, 1.0 / np.where(seen, inverse, 1.0), 0.0)
    return View(depth=depth.astype(np.float32), K=K, T_world_camera=T_world_camera, labels=labels)


def from_the_side(azimuth: float = 20.0, elevation: float = 40.0, distance: float = 1.3) -> Array:
    """`T_world_camera` of a camera that looks at the middle of the table; angles in degrees."""
    a, e = np.radians([azimuth, elevation])
    centre = np.array([0.0, 0.0, TABLE])
    offset = distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return transforms.look_at(centre + offset, centre)
