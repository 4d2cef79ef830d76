"""The camera's picture with the parts found in it and the fitted shapes drawn over it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.config import ReportConfig
from caryatid.graph import SceneObject, SupportGraph
from caryatid.report import colours, svg
from caryatid.report.wireframes import Projection, draw_shapes
from caryatid.views import SUPPORT_LABEL, View

TAG_SIZE = 15.0
"""Height of letters on a picture 640 px wide [px]."""
ROOM, LEAST_SHARE = 1.35, 0.5
"""The part shown is this much larger than the objects in it, and this share of the image at the least."""
DEPTH_SHARE = (2.0, 98.0)
"""Percentiles of the depth that get the ends of the colour scale."""


def draw_image(view: View, labels: NDArray[np.int32], graph: SupportGraph, config: ReportConfig) -> str:
    """Draw one view as SVG: its image (depth where it has no colour), its parts, and the shapes over it.

    Args:
        view: The view; without a pose the shapes are left out.
        labels: Object number of each pixel (H, W), 0 = nothing.
        graph: The shapes, in the world frame.
        config: Sizes and qualities.
    """
    height, width = view.depth.shape
    left, top, shown_width, shown_height = 0.0, 0.0, float(width), float(height)
    step = max(1, round(width / config.image_width))
    base = view.rgb if view.rgb is not None else _depth_colours(view.depth)
    reduced = np.asarray(Image.fromarray(base).reduce(step))
    layers = [
        svg.raster(reduced, 0, 0, width, height, jpeg=config.jpeg_quality),
        svg.element(
            "g", svg.raster(_mask_colours(labels[::step, ::step]), 0, 0, width, height), class_="parts"
        ),
    ]
    if view.T_world_camera is not None:
        projection = Projection(view.T_world_camera, view.K, view.depth)
        found = [o for o in graph.objects if o.role != "support_surface"]
        left, top, shown_width, shown_height = _window(found, projection)
        size = TAG_SIZE * shown_width / 640.0
        names = [tag for o in found if (tag := _name(o, labels, projection)) is not None]
        layers.append(draw_shapes(graph.objects, projection, config.hidden))
        layers.append(svg.tags(names, (left, top, left + shown_width, top + shown_height), size))
    name = f"{view.name} with the fitted shapes drawn over it"
    return svg.picture(shown_width, shown_height, *layers, name=name, corner=(left, top))


def _window(objects: Sequence[SceneObject], projection: Projection) -> tuple[float, float, float, float]:
    """Part of the image that is shown (x, y, width, height) [px]: the objects with room around them."""
    height, width = projection.depth.shape
    pixels = [at[z > 0.0] for at, z in (projection.project(o.shape.outline()) for o in objects)]
    inside = np.clip(np.concatenate([*pixels, np.empty((0, 2))]), 0.0, (width, height))
    if len(inside) == 0:
        return 0.0, 0.0, float(width), float(height)
    low, high = inside.min(axis=0), inside.max(axis=0)
    share = float(np.clip(((high - low) / (width, height)).max() * ROOM, LEAST_SHARE, 1.0))
    size = share * np.array([width, height], dtype=np.float64)
    corner = np.clip((low + high - size) / 2.0, 0.0, (width, height) - size)
    return float(corner[0]), float(corner[1]), float(size[0]), float(size[1])


def _name(item: SceneObject, labels: NDArray[np.int32], projection: Projection) -> svg.Tag | None:
    """Put an object's id on its pixels, or faint on its projected centre where it has none."""
    height, width = labels.shape
    v, u = np.nonzero(labels == item.label)
    colour = colours.object_colour(item.label)
    if len(u):
        return svg.Tag(float(np.median(u)), float(np.median(v)), item.id, colour)
    (pixel,), (z,) = projection.project(item.centre_world[None, :])
    if z <= 0.0 or not (0.0 <= pixel[0] < width and 0.0 <= pixel[1] < height):
        return None
    return svg.Tag(float(pixel[0]), float(pixel[1]), item.id, colour, faint=True)


def _mask_colours(labels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Colours (H, W, 4) of the parts, transparent where there is none."""
    part = (labels != 0) & (labels != SUPPORT_LABEL)
    opaque = np.where(part, np.uint8(255), np.uint8(0))
    return np.concatenate(
        [np.where(part[..., None], colours.label_colours(labels), 0), opaque[..., None]], -1
    )


def _depth_colours(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours (H, W, 3) of a depth image [m], black where there is no reading."""
    valid = depth > 0.0
    if not valid.any():
        return np.zeros((*depth.shape, 3), dtype=np.uint8)
    near, far = np.percentile(depth[valid], DEPTH_SHARE)
    share = (depth.astype(np.float64) - near) / max(far - near, 1e-6)
    return np.where(valid[..., None], colours.scale(share, colours.DEPTH_STOPS), np.uint8(0))
