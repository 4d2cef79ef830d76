"""A depth camera without GL: rays through the scene, and the noise of a Carmine 1.09."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from caryatid.config import NoiseConfig, NoiseModel, SensorConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import View
from caryatid.simulation.world import SimulatedScene


def axial_sigma(depth: Array, config: NoiseConfig) -> Array:
    """Standard deviation (...) [m] of readings at depths (...) [m]: σ(z) = a + b·(z − z0)²."""
    a, b, z0 = config.axial
    return a + b * (depth - z0) ** 2


def add_depth_noise(depth: Array, incidence: Array, config: NoiseConfig, rng: np.random.Generator) -> Array:
    """Add the sensor's noise to true depth (H, W) [m], 0 = nothing; one random draw per pixel.

    There is no return outside the range, from surfaces at a grazing angle, by the incidence (H, W) [rad]
    between ray and normal, and beside depth edges. Gaussian noise is added along the optical axis, and the
    result is rounded to equal steps of 1/z.
    """
    near, far = config.range
    seen = (depth > 0.0) & (incidence <= np.deg2rad(config.grazing)) & ~depth_edges(depth, config.edge_jump)
    noisy = depth + axial_sigma(depth, config) * rng.standard_normal(depth.shape)
    noisy = np.maximum(noisy, near / 2.0)
    steps = np.maximum(np.round(1.0 / (noisy * config.disparity_step)), 1.0)
    quantised = 1.0 / (steps * config.disparity_step)
    return np.where(seen & (quantised >= near) & (quantised <= far), quantised, 0.0)


def depth_edges(depth: Array, jump: float) -> NDArray[np.bool_]:
    """Pixels (H, W) on either side of a step of more than `jump` [m] to a direct neighbour."""
    edges = np.zeros(depth.shape, dtype=bool)
    for pixels, values in ((edges, depth), (edges.T, depth.T)):
        step = np.abs(np.diff(values, axis=0)) > jump
        pixels[:-1] |= step
        pixels[1:] |= step
    return edges


def misregister(T_world_camera: Array, config: NoiseConfig, rng: np.random.Generator) -> Array:
    """Return the reported pose (4, 4): the true one, shifted and turned about the camera's centre.

    The shift is Gaussian with σ = `config.translation` along each axis; the turn is about an axis drawn
    uniformly, by a Gaussian angle with σ = `config.rotation`.
    """
    angle = np.deg2rad(config.rotation) * rng.standard_normal()
    axis = transforms.unit(rng.standard_normal(3))
    shift = config.translation * rng.standard_normal(3)
    R_world_camera = transforms.rotation_from_vector(angle * axis) @ T_world_camera[:3, :3]
    return transforms.rigid(R_world_camera, T_world_camera[:3, 3] + shift)


@dataclass(frozen=True, eq=False, slots=True)
class Rendering:
    """The image of a perfect camera.

    Attributes:
        depth: Along the optical axis (H, W) [m], 0 = nothing.
        normals_world: Unit normals (H, W, 3) that face the camera, zero where there is nothing.
        incidence: Angle (H, W) [rad] between ray and normal; π/2 where there is nothing.
        labels: Label of the object (H, W), 0 = anything else.
        robots: Where a robot of the scene is seen (H, W).
        rgb: Colour (H, W, 3) uint8.
    """

    depth: Array
    normals_world: Array
    incidence: Array
    labels: NDArray[np.int32]
    robots: NDArray[np.bool_]
    rgb: NDArray[np.uint8]


class SimulatedCamera:
    """A depth camera anywhere in a simulated scene.

    The first capture is the reference for registration, so its pose is exact: the error is between views.
    Each capture draws its noise from its own stream, given by the seed and its number, so a run is
    reproducible whatever else draws random numbers.

    Args:
        scene: The scene.
        noise: `none`, or `carmine` for sensor noise and registration error.
        noise_config: Parameters of the noise.
        rng: Source of the seed of all captures.
        sensor: Image size, focal length and light.
        around: Returns the scene with the body of the robot that holds the camera at a pose (4, 4), or None
            if no robot can stand there. None = the camera floats.

    Attributes:
        scene: The scene; another state of the same scene may replace it.
        captures: Number of views so far, which determines the noise of the next one.

    Raises:
        InputError: The noise model is not one of the two.
    """

    def __init__(
        self,
        scene: SimulatedScene,
        noise: NoiseModel = "none",
        noise_config: NoiseConfig | None = None,
        rng: np.random.Generator | None = None,
        sensor: SensorConfig | None = None,
        around: Callable[[SimulatedScene, Array], SimulatedScene | None] | None = None,
    ) -> None:
        if noise not in ("none", "carmine"):
            raise InputError("noise", f"'{noise}' is not a noise model", "choose none or carmine")
        self.scene = scene
        self.noise = noise
        self.noise_config = noise_config or NoiseConfig()
        self.sensor = sensor or SensorConfig()
        self.K = intrinsics(self.sensor)
        self._seed = int((rng or np.random.default_rng(0)).integers(2**63))
        self.captures = 0
        self._around = around

    def fork(self) -> SimulatedCamera:
        """Return an independent copy whose next captures have the same noise."""
        return copy.copy(self)

    def capture(self, T_world_camera: Array) -> View:
        """Take one view from a pose.

        Args:
            T_world_camera: True camera pose (4, 4), OpenCV camera frame.

        Returns:
            The view. With noise, its depth is noisy, it has no normals, and its pose is the reported one;
            labels stay even where depth is missing. Robots of the scene are ignored.

        Raises:
            InputError: The pose is not a rigid transform.
        """
        T = transforms.as_rigid(T_world_camera, "T_world_camera")
        scene = None if self._around is None else self._around(self.scene, T)
        image = render(scene or self.scene, T, self.K, self.sensor)
        number = self.captures
        rng = np.random.default_rng([self._seed, number])
        name = f"{self.scene.name} view {number + 1}"
        self.captures += 1
        if self.noise == "none":
            depth, T_reported = image.depth, T
            normals = (image.normals_world @ T[:3, :3]).astype(np.float32)
        else:
            depth = add_depth_noise(image.depth, image.incidence, self.noise_config, rng)
            T_reported, normals = misregister(T, self.noise_config, rng) if number else T, None
        ignored = image.robots if image.robots.any() else None
        return View(
            depth.astype(np.float32), self.K, T_reported, image.rgb, image.labels, normals, name,
            ignored=ignored,
        )  # fmt: skip


def intrinsics(sensor: SensorConfig) -> Array:
    """Pinhole matrix (3, 3) [px] with the principal point in the middle of the image."""
    u, v = (sensor.width - 1) / 2.0, (sensor.height - 1) / 2.0
    return np.array([[sensor.focal, 0.0, u], [0.0, sensor.focal, v], [0.0, 0.0, 1.0]])


def render(scene: SimulatedScene, T_world_camera: Array, K: Array, sensor: SensorConfig) -> Rendering:
    """Cast a ray through the middle of each pixel of a camera at a pose (4, 4), with pinhole matrix K (3, 3).

    Geoms of group 3 are invisible.
    """
    shape = (sensor.height, sensor.width)
    rays_world, lengths = pixel_rays(K, T_world_camera[:3, :3], sensor.width, sensor.height)
    geoms = np.empty(lengths.size, dtype=np.int32)
    depth = np.empty(lengths.size)
    normals_world = np.empty((lengths.size, 3))
    # The fourth of MuJoCo's six groups is for collisions only.
    visible = np.array([1, 1, 1, 0, 1, 1], dtype=np.uint8)
    mujoco.mj_multiRay(
        scene.model, scene.data, T_world_camera[:3, 3], rays_world.ravel(), visible, 1, -1, geoms, depth,
        normals_world.reshape(-1), lengths.size, sensor.far * float(lengths.max()),
    )  # fmt: skip
    missed = (geoms < 0) | (depth > sensor.far)
    geoms[missed], depth[missed], normals_world[missed] = -1, 0.0, 0.0
    cosine = -np.einsum("ij,ij->i", normals_world, rays_world) / lengths
    normals_world[cosine < 0.0] *= -1.0
    incidence = np.arccos(np.minimum(np.abs(cosine), 1.0)).reshape(shape)
    labels = np.append(scene.geom_labels, np.int32(0))[geoms].reshape(shape)
    rgb = _shade(scene, geoms, normals_world, sensor).reshape(*shape, 3)
    objects, robots = np.maximum(labels, 0), labels < 0
    return Rendering(depth.reshape(shape), normals_world.reshape(*shape, 3), incidence, objects, robots, rgb)


def pixel_rays(K: Array, R_world_camera: Array, width: int, height: int) -> tuple[Array, Array]:
    """Rays (H·W, 3) in the world frame through the pixels, row by row, and their lengths (H·W,) [m].

    Each ray is one metre long along the optical axis, so distances in rays are depths. The camera has a
    pinhole matrix K (3, 3) [px] and a rotation (3, 3).
    """
    u = ((np.arange(width) - K[0, 2]) / K[0, 0])[None, :, None]
    v = ((np.arange(height) - K[1, 2]) / K[1, 1])[:, None, None]
    x, y, z = R_world_camera.T
    rays_world = u * x + (v * y + z)
    return rays_world.reshape(-1, 3), np.sqrt(u**2 + v**2 + 1.0).reshape(-1)


def _shade(
    scene: SimulatedScene, geoms: NDArray[np.int32], normals_world: Array, sensor: SensorConfig
) -> NDArray[np.uint8]:
    """Lambert's law with one lamp and ambient light: colours (N, 3)."""
    model = scene.model
    colours = model.geom_rgba[:, :3].astype(np.float32)
    # A geom without a colour is grey: then that of its material counts.
    plain = (model.geom_matid >= 0) & (colours == 0.5).all(axis=1)
    colours[plain] = model.mat_rgba[model.geom_matid[plain], :3]
    colours = np.concatenate([colours, np.array([(0.55, 0.62, 0.70)], dtype=np.float32)])
    lit = np.einsum("ij,j->i", normals_world, transforms.unit(sensor.light))
    brightness = sensor.ambient + (1.0 - sensor.ambient) * np.maximum(lit, 0.0)
    brightness[geoms < 0] = 1.0
    shaded = colours[geoms] * (255.0 * brightness.astype(np.float32))[:, None] + np.float32(0.5)
    return np.minimum(shaded, 255.0).astype(np.uint8)
