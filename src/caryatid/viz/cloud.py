"""The fused cloud with the fitted shapes, drawn by parallel projection from two opposite sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ReportConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.sensing.views import SUPPORT_LABEL, Cloud
from caryatid.viz import colours, svg
from caryatid.viz.wireframes import Projection, draw_shapes

ELEVATION = np.deg2rad(28.0)
"""How far above the horizon the eye stands."""
DISTANCE = 10.0
"""Distance of the eye from the scene [m]; any beyond the scene does."""
MARGIN = 0.04
"""Free border in shares of the picture's width."""
ASPECT = (0.5, 0.8)
"""Lowest and highest ratio of the picture's height to its width."""
LAMP = np.array([0.0, 0.0, 0.8])
"""What is added to the direction to the eye to get the direction to the lamp."""
AMBIENT = 0.5
"""Share of a colour that is left where light only grazes."""
PALE = 0.7
"""Share of white in the colour of points seen from behind."""
STRIPE = 15.0
"""From stripe to stripe of objects whose colour alone does not tell them from others [px]."""
TAG_SIZE = 15.0
"""Height of letters [px]."""


def draw_cloud(cloud: Cloud, graph: SupportGraph, azimuth: float, config: ReportConfig) -> str:
    """Draw the labelled cloud and the shapes fitted to it as SVG.

    Points are little squares lit from above the eye, pale where one sees a surface from behind.

    Args:
        cloud: The fused points, labelled.
        graph: The shapes.
        azimuth: Direction about the vertical the eye looks from [rad].
        config: Sizes.
    """
    towards_eye = np.array(
        [np.cos(azimuth) * np.cos(ELEVATION), np.sin(azimuth) * np.cos(ELEVATION), np.sin(ELEVATION)]
    )
    frame = _framed(cloud, graph, towards_eye, config)
    height, width = frame.depth.shape
    labels = np.zeros(len(cloud)) if cloud.labels is None else cloud.labels
    surface = labels == SUPPORT_LABEL
    pixels, depth = _splat(cloud.select(~surface), frame, towards_eye, config.point_size, config)
    below, depth_below = _splat(cloud.select(surface), frame, towards_eye, 2.0 * config.point_size, config)
    nearer = (depth_below > 0.0) & ((depth == 0.0) | (depth_below < depth))
    pixels, depth = np.where(nearer[..., None], below, pixels), np.where(nearer, depth_below, depth)
    projection = replace(frame, depth=depth)
    names = []
    for item in graph.objects:
        if item.role != "support_surface":
            (pixel,), _ = projection.project(item.centre_world[None, :])
            colour = colours.object_colour(item.label)
            names.append(svg.Tag(float(pixel[0]), float(pixel[1]), item.id, colour))
    return svg.picture(
        width,
        height,
        svg.raster(pixels, 0, 0, width, height),
        draw_shapes(graph.objects, projection, config.hidden),
        svg.tags(names, (0, 0, width, height), TAG_SIZE),
        name="the fused cloud with the fitted shapes",
    )


def _framed(cloud: Cloud, graph: SupportGraph, towards_eye: Array, config: ReportConfig) -> Projection:
    """Place the eye so that all shapes (without any: the middle 96 % of the points) fill the picture."""
    outlines = [o.shape.outline() for o in graph.objects]
    subject = np.concatenate(outlines) if outlines else cloud.points_world
    if len(subject) == 0:
        subject = np.zeros((1, 3))
    centre = subject.mean(axis=0)
    T_world_camera = transforms.look_at(centre + DISTANCE * towards_eye, centre)
    seen = transforms.transform(transforms.invert(T_world_camera), subject)[:, :2]
    low, high = (seen.min(axis=0), seen.max(axis=0)) if outlines else np.percentile(seen, (2.0, 98.0), axis=0)
    extent = np.maximum(high - low, 0.05) * (1.0 + 2.0 * MARGIN)
    width = config.cloud_width
    height = round(width * float(np.clip(extent[1] / extent[0], *ASPECT)))
    scale = min(width / extent[0], height / extent[1])
    middle = (low + high) / 2.0
    K = np.array(
        [
            [scale, 0.0, width / 2.0 - scale * middle[0]],
            [0.0, scale, height / 2.0 - scale * middle[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    return Projection(T_world_camera, K, np.zeros((height, width), dtype=np.float32), parallel=True)


def _splat(
    cloud: Cloud, projection: Projection, towards_eye: Array, size: float, config: ReportConfig
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Paint the points far to near, `size` [m] wide; return pixels (H, W, 4) and distances (H, W) [m]."""
    stride = max(1, -(-len(cloud) // config.cloud_points))
    points_world, normals_world = cloud.points_world[::stride], cloud.normals_world[::stride]
    count = len(points_world)
    labels = np.zeros(count, dtype=np.int32) if cloud.labels is None else cloud.labels[::stride]
    facing = np.nan_to_num(normals_world @ towards_eye)
    light = np.nan_to_num(normals_world @ transforms.unit(towards_eye + LAMP))
    shade = AMBIENT + (1.0 - AMBIENT) * np.abs(light)
    at, z = projection.project(points_world)
    colour = colours.striped_colours(labels, at[:, 0], at[:, 1], STRIPE) * shade[:, None]
    colour = np.where(facing[:, None] < 0.0, PALE * 255.0 + (1.0 - PALE) * colour, colour)
    order = np.argsort(-z)
    height, width = projection.depth.shape
    half = max(1, round(size * projection.K[0, 0] / 2.0))
    offset = np.arange(-half, half)
    u = np.rint(at[order, 0]).astype(int)[:, None, None] + offset[None, None, :]
    v = np.rint(at[order, 1]).astype(int)[:, None, None] + offset[None, :, None]
    u, v = np.broadcast_arrays(u, v)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    target = (v * width + u)[inside]
    source = np.broadcast_to(order[:, None, None], u.shape)[inside]
    pixels = np.zeros((height * width, 4), dtype=np.uint8)
    pixels[target, :3] = colour[source].round()
    pixels[target, 3] = 255
    depth = np.zeros(height * width, dtype=np.float32)
    depth[target] = z[source]
    return pixels.reshape(height, width, 4), depth.reshape(height, width)
