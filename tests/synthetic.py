"""Oriented points, objects and simulated views for tests, and distances between what comes out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from caryatid.config import (
    ActiveVisionConfig,
    Config,
    FusionMethod,
    SensorConfig,
    SupportConfig,
    VoxelConfig,
)
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere, Uncertainty, fibonacci_sphere
from caryatid.geometry.transforms import Array
from caryatid.graph import SUPPORT_SURFACE_ID, SceneObject, SupportGraph, object_id
from caryatid.scene import Scene
from caryatid.segmentation.support_plane import Region, SupportSurface
from caryatid.sensing.clouds import oriented_points
from caryatid.sensing.view_sphere import direction
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.scenes import load_scene
from caryatid.support.relations import infer

SENSOR = SensorConfig(width=240, height=180, focal=197.0)
"""The Carmine's field of view with a seventh of its pixels: 8 mm between points at 1.5 m."""

FEW_VIEWS = Config(
    sensor=SENSOR, active=ActiveVisionConfig(sphere_points=4000, look_directions=200, max_views=3)
)

TABLE_TOP = 0.75
"""Height of the table in the designed scenes [m]."""

AROUND = (180.0, 60.0, 300.0)
"""Azimuths of three views from around the table [deg]."""

DIRECTIONS = fibonacci_sphere(400)


def box(centre, extents, turn_deg: float = 0.0) -> Box:
    """A box turned about the vertical."""
    R = transforms.rotation_from_vector((0.0, 0.0, np.radians(turn_deg)))
    return Box(transforms.rigid(R, centre), np.array(extents, dtype=np.float64))


def cylinder(centre, radius: float, height: float) -> Cylinder:
    """An upright cylinder."""
    return Cylinder(transforms.rigid(np.eye(3), centre), radius, height)


def sphere(centre, radius: float) -> Sphere:
    return Sphere(transforms.rigid(np.eye(3), centre), radius)


def thing(label: int, shape: Shape, **fields) -> SceneObject:
    """A vertex of the support graph."""
    return SceneObject(id=f"o{label}", label=label, shape=shape, **fields)


def table_object(top: float = TABLE_TOP) -> SceneObject:
    shape = box((0.0, 0.0, top - 0.02), (0.7, 1.0, 0.04))
    return SceneObject(SUPPORT_SURFACE_ID, SUPPORT_LABEL, shape, "support_surface")


def surface_object(number: int, middle, size, turn_deg: float = 0.0) -> SceneObject:
    """A support surface of a size (x, y) [m] around the middle of its top: `o0` with 0, else `s1`, …."""
    label, centre = SUPPORT_LABEL - number, np.array(middle) - (0.0, 0.0, 0.02)
    return SceneObject(object_id(label), label, box(centre, (*size, 0.04), turn_deg), "support_surface")


def shelf_objects() -> list[SceneObject]:
    """A low table, the floor and a shelf board, with two objects on each of the lower ones and a ball.

    On the table o0 there are o1 with o2 on it, and o5 under the board s2, which bears the ball o4. On the
    floor s1, o3 stands beside the table and o6 under it.
    """
    firm = Uncertainty(np.full(3, 0.001), np.full(3, 0.005), np.full(3, 0.001), np.full(6, 0.001))
    shapes = (
        box((0.0, -0.3, 0.5), (0.12, 0.12, 0.1)),
        cylinder((0.0, -0.3, 0.6), 0.04, 0.1),
        box((0.6, 0.0, 0.1), (0.15, 0.2, 0.2), 30.0),
        sphere((0.0, 0.3, 0.89), 0.04),
        box((0.0, 0.3, 0.55), (0.1, 0.1, 0.2)),
        box((0.1, -0.2, 0.06), (0.2, 0.3, 0.12)),
    )
    return [
        surface_object(0, (0.0, 0.0, 0.45), (0.7, 1.0)),
        surface_object(1, (0.3, 0.0, 0.0), (1.6, 1.8)),
        surface_object(2, (0.0, 0.3, 0.85), (0.5, 0.35), 10.0),
        *(thing(k, shape, uncertainty=firm) for k, shape in enumerate(shapes, start=1)),
    ]


@cache
def shelf_graph() -> SupportGraph:
    """The graph of `shelf_objects`."""
    return infer(shelf_objects(), SupportConfig())


def surface_at(height: float = TABLE_TOP) -> SupportSurface:
    """A table top of 0.7 m × 1 m."""
    corners = np.array(
        [[-0.35, -0.5, height], [0.35, -0.5, height], [0.35, 0.5, height], [-0.35, 0.5, height]]
    )
    top = box((0.0, 0.0, height - 0.02), (0.7, 1.0, 0.04))
    middle = np.array([0.0, 0.0, height])
    region = Region(np.array([-18, -25]), np.ones((36, 50), dtype=np.bool_), 0.02)
    return SupportSurface(np.array([0.0, 0.0, 1.0]), middle, corners, top, region, region)


def random_motion(rng: np.random.Generator, reach: float = 1.0) -> Array:
    """Any rotation, and a translation of up to `reach` [m] along each axis."""
    return transforms.rigid(transforms.random_rotation(rng), rng.uniform(-reach, reach, 3))


def motion_about_vertical(rng: np.random.Generator) -> Array:
    """A rotation about the vertical, and a translation of up to 1 m along each axis."""
    R = transforms.rotation_from_vector((0.0, 0.0, rng.uniform(-np.pi, np.pi)))
    return transforms.rigid(R, rng.uniform(-1.0, 1.0, 3))


def surface_points(
    shape: Shape, rng: np.random.Generator, *, eye=None, spacing: float = 0.005, sigma: float = 1e-6
) -> tuple[Array, Array]:
    """Points on a shape with noise along the normals [m], and the normals.

    With an eye only what faces it within 80°: all that is seen of a convex shape that stands alone.
    """
    points, normals = shape.surface(spacing)
    if eye is not None:
        towards = transforms.unit(np.asarray(eye) - points)
        facing = np.sum(towards * normals, axis=1) > np.cos(np.radians(80.0))
        points, normals = points[facing], normals[facing]
    return points + sigma * rng.normal(size=(len(points), 1)) * normals, normals


def hausdorff(a: Shape, b: Shape, directions: Array = DIRECTIONS) -> float:
    """Hausdorff distance [m] of two convex shapes, in these directions: blind to axes' names and symmetry."""
    reach = [directions @ s.T_world_object[:3, 3] + s.support(directions) for s in (a, b)]
    return float(np.abs(reach[0] - reach[1]).max())


def seen_free(where, centre_world=(0.0, 0.0, 0.0)) -> VoxelMap:
    """A map that knows nothing but the free voxels, whose centres (N, 3) [m] satisfy a predicate."""
    nothing = VoxelMap.around(centre_world, VoxelConfig())
    centres = nothing.centres_world(np.indices(nothing.hits.shape).reshape(3, -1).T)
    return replace(nothing, passes=where(centres).reshape(nothing.hits.shape).astype(np.uint8))


def vertices(graph: SupportGraph) -> set[str]:
    return {o.id for o in graph.objects}


def edges(graph: SupportGraph) -> set[tuple[str, str]]:
    return {s.pair for s in graph.supports}


def config_for(method: FusionMethod, **sections) -> Config:
    config = Config(**sections)
    return replace(config, fusion=replace(config.fusion, method=method))


def look_from(azimuth_deg: float, elevation_deg: float = 38.0, distance: float = 1.5) -> Array:
    """`T_world_camera` of a camera that looks at the middle of the table top."""
    centre = np.array([0.0, 0.0, TABLE_TOP])
    offset = distance * direction(np.radians(azimuth_deg), np.radians(elevation_deg))
    return transforms.look_at(centre + offset, centre)


@cache
def simulated_scene(name: str):
    return load_scene(name)


@cache
def simulated_views(
    name: str, azimuths: tuple[float, ...] = AROUND, noise: str = "none", *, vga: bool = False
) -> tuple[View, ...]:
    """Views of a built-in scene from around the table."""
    sensor = SensorConfig() if vga else SENSOR
    camera = SimulatedCamera(simulated_scene(name), noise, rng=np.random.default_rng(0), sensor=sensor)
    return tuple(camera.capture(look_from(a)) for a in azimuths)


@cache
def simulated_cloud(name: str) -> Cloud:
    """All points of three views of a built-in scene, with labels."""
    parts = [(oriented_points(v, Config().cloud), v) for v in simulated_views(name)]
    return Cloud(
        np.concatenate([p for (p, _, _), _ in parts]),
        np.concatenate([n for (_, n, _), _ in parts]),
        np.concatenate([v.labels.ravel()[pixels] for (_, _, pixels), v in parts]),
        name=name,
    )


def model_of(sources, config: Config | None = None, *, segmentation="labels") -> Scene:
    """The scene model of some views or clouds."""
    scene = Scene(config, segmentation=segmentation)
    for source in sources:
        scene.update(source)
    return scene
