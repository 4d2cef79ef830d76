"""Solid pictures for film.py: fitted shapes, furniture, a robot and the view sphere, met by rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

import caryatid as ct
from caryatid.config import SensorConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.simulation.camera import intrinsics, pixel_rays, render
from caryatid.simulation.setup import Simulation
from caryatid.simulation.world import SimulatedScene, quaternion, static_boxes, table_top
from caryatid.viz import colours
from caryatid.viz.drawings import Projection

FINE = 2
"""Rays a pixel along each side."""
PANEL = (247, 247, 245)
FLOOR, WOOD, WALL, ROBOT, DARK = "#e8e8e3", "#b8a894", "#c9c9c4", "#6b7887", "#29303b"


Solids = list[tuple[Any, Array, str]]
"""Shapes with their poses and colours; the pose a shape has itself does not count."""


@dataclass(frozen=True, eq=False, slots=True)
class Eye:
    """Where a picture is taken from."""

    T_world_camera: Array
    sensor: SensorConfig

    @property
    def projection(self) -> Projection:
        """From the world to pixels of the finished picture."""
        K = intrinsics(self.sensor) / FINE
        K[2, 2] = 1.0
        return Projection(self.T_world_camera, K, np.zeros((1, 1), np.float32))


def eye(
    target: Array, azimuth: float, elevation: float, distance: float, size: tuple[int, int], f: float
) -> Eye:
    """An eye [deg, m] that looks at a target, with a focal length of `f` widths."""
    a, e = np.deg2rad([azimuth, elevation])
    towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    width, height = FINE * size[0], FINE * size[1]
    sensor = SensorConfig(width=width, height=height, focal=f * width, far=30.0, ambient=0.55)
    return Eye(transforms.look_at(target + distance * towards, target), sensor)


def geoms_of(graph: SupportGraph) -> Solids:
    """The model's shapes as solids: shape, pose and colour."""
    return [
        (o.shape, o.shape.T_world_object, colours.object_colour(o.label))
        for o in graph.objects
        if o.role != "support_surface"
    ]


def robot_geoms(T_world_camera: Array) -> Solids:
    """A humanoid whose head bears the camera: platform, torso, shoulders, arms, head."""
    position, forward = T_world_camera[:3, 3], T_world_camera[:3, 2]
    heading = np.arctan2(forward[1], forward[0])
    R = np.array(
        [[np.cos(heading), -np.sin(heading), 0.0], [np.sin(heading), np.cos(heading), 0.0], [0, 0, 1.0]]
    )
    foot = np.append(position[:2], 0.0) - R @ np.array([0.16, 0.0, 0.0])
    z = position[2]

    def at(x: float, y: float, height: float) -> Array:
        return transforms.rigid(R, foot + R @ np.array([x, y, 0.0]) + (0.0, 0.0, height))

    head = transforms.rigid(T_world_camera[:3, :3], position - 0.09 * forward)
    solids = [
        (Cylinder(np.eye(4), 0.3, 0.22), at(0.0, 0.0, 0.12), DARK),
        (Box(np.eye(4), np.array([0.16, 0.2, z - 0.45])), at(0.0, 0.0, 0.2 + (z - 0.45) / 2.0), ROBOT),
        (Box(np.eye(4), np.array([0.18, 0.52, 0.16])), at(0.0, 0.0, z - 0.26), ROBOT),
        (Box(np.eye(4), np.array([0.2, 0.2, 0.18])), head, ROBOT),
        (Box(np.eye(4), np.array([0.16, 0.06, 0.03])), transforms.rigid(head[:3, :3], position), DARK),
    ]
    for side in (-1.0, 1.0):
        solids.append((Box(np.eye(4), np.array([0.1, 0.09, 0.5])), at(0.02, 0.3 * side, z - 0.45), DARK))
    return solids


def world_of(solids: Solids) -> SimulatedScene:
    """Solids as a scene that rays can be cast in."""
    spec = mujoco.MjSpec()
    kinds = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}
    for shape, T, colour in solids:
        match shape.kind:
            case "box":
                size = shape.extents / 2.0
            case "cylinder":
                size = np.array([shape.radius, shape.height / 2.0, 0.0])
            case _:
                size = np.array([shape.radius, 0.0, 0.0])
        kind = kinds.get(shape.kind, mujoco.mjtGeom.mjGEOM_SPHERE)
        rgba = [*(c / 255.0 for c in colours.rgb(colour)), 1.0]
        spec.worldbody.add_geom(type=kind, size=size, pos=T[:3, 3], quat=quaternion(T[:3, :3]), rgba=rgba)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    labels = np.zeros(model.ngeom, np.int32)
    return SimulatedScene(model, data, spec, "picture", "picture", {}, "world", labels, True)


def furniture(stage: Simulation, low: float) -> Solids:
    """The table, and walls cut off at a height [m], so that one sees over them; a floor below."""
    solids: Solids = []
    for box in static_boxes(stage.scene):
        centre, extents = box.T_world_object[:3, 3].copy(), box.extents.copy()
        wall = extents[2] > 1.0
        if wall:
            extents[2] = low
            centre[2] = low / 2.0
        colour = WALL if wall else WOOD
        solids.append((Box(np.eye(4), extents), transforms.rigid(box.T_world_object[:3, :3], centre), colour))
    middle = table_centre(stage) * (1.0, 1.0, 0.0) - (0.0, 0.0, 0.011)
    solids.append((Cylinder(np.eye(4), 2.0, 0.02), transforms.rigid(np.eye(3), middle), FLOOR))
    return solids


def table_centre(stage: Simulation) -> Array:
    """Middle of the table top (3,) [m]."""
    top = table_top(stage.scene)
    return np.append(top.corners_world[:, :2].mean(axis=0), top.height)


def picture_of(solids: Solids, at: Eye) -> tuple[Array, Array]:
    """Colours (H, W, 3) of solids before paper, and depth (H, W) [m], at `FINE` rays a pixel."""
    image = render(world_of(solids), at.T_world_camera, intrinsics(at.sensor), at.sensor)
    rgb = np.where((image.depth > 0.0)[..., None], image.rgb.astype(float), PANEL)
    return rgb, np.where(image.depth > 0.0, image.depth, np.inf)


def coarse(rgb: Array) -> Image.Image:
    """The finished picture: means of `FINE` × `FINE` rays."""
    h, w = rgb.shape[0] // FINE, rgb.shape[1] // FINE
    mean = rgb.reshape(h, FINE, w, FINE, 3).mean(axis=(1, 3))
    return Image.fromarray(mean.round().astype(np.uint8))


def dome(step: ct.Step, at: Eye) -> list[tuple[Array, Array, Array]]:
    """Saliency painted on the upper half of the view sphere, its far side and then its near one.

    Returns:
        For each side colours (H, W, 3), depth (H, W) [m], ∞ where there is none, and how opaque it is (H, W).
    """
    rays, _ = pixel_rays(intrinsics(at.sensor), at.T_world_camera[:3, :3], at.sensor.width, at.sensor.height)
    sphere, shape = step.sphere, (at.sensor.height, at.sensor.width)
    offset = at.T_world_camera[:3, 3] - sphere.centre_world
    a, b = (rays**2).sum(axis=1), rays @ offset
    inside = b**2 - a * (offset @ offset - sphere.radius**2)
    root = np.sqrt(np.where(inside > 0.0, inside, np.nan))
    tree = cKDTree(sphere.directions)
    reachable = np.zeros(len(sphere.directions), bool)
    saliency = np.zeros(len(sphere.directions))
    if step.candidates is not None and step.candidates.indices is not None:
        reachable[step.candidates.indices] = True
    if step.decision is not None and step.decision.sphere_saliency is not None:
        saliency = step.decision.sphere_saliency
    grey = np.array(colours.rgb(colours.saliency_colour(0.0)), float)
    sides = []
    for sign, full, pale in ((1.0, 0.85, 0.4), (-1.0, 0.45, 0.12)):
        t = (-b + sign * root) / a
        met = np.isfinite(t)
        directions = transforms.unit(offset + t[met, None] * rays[met])
        _, nearest = tree.query(directions)
        shown = colours.scale(saliency[nearest], colours.SALIENCY_STOPS).astype(float)
        good = reachable[nearest]
        colour, depth, opaque = np.zeros((len(t), 3)), np.full(len(t), np.inf), np.zeros(len(t))
        colour[met] = np.where(good[:, None], shown, 0.3 * shown + 0.7 * grey)
        opaque[met] = np.where(good, full, pale)
        depth[met] = np.where(directions[:, 2] > 0.0, t[met], np.inf)
        sides.append((colour.reshape(*shape, 3), depth.reshape(shape), opaque.reshape(shape)))
    return sides
