"""The camera's picture with the parts found in it and the fitted shapes drawn over it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.config import ReportConfig
from caryatid.graph import SceneObject, SupportGraph
from caryatid.sensing.views import SUPPORT_LABEL, View
from caryatid.viz import colours, svg
from caryatid.viz.wireframes import Projection, draw_shapes

TAG_SIZE = 15.0
"""Height of letters on a picture 640 px wide [px]."""
THUMBNAIL_TAG_SIZE = 28.0
"""Height of letters on a small picture, were it 640 px wide [px]."""
STRIPE = 18.0
"""From stripe to stripe of objects whose colour alone does not tell them from others, likewise [px]."""
TINT = 0.62
"""Share of its object's colour in the colour of a part; the rest is the image's grey."""
GREY = np.array([0.299, 0.587, 0.114])
"""Shares of red, green and blue in the grey of an image."""
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
    found = [o for o in graph.objects if o.role != "support_surface"]
    window = _window(found, view)
    left, top, width, height = window
    base = _base(view)
    layers = [
        _cut(base, window, config.image_width, config),
        svg.element(
            "g", _cut(tinted(base, labels, width), window, config.image_width, config), class_="tinted"
        ),
    ]
    if view.T_world_camera is not None:
        projection = Projection(view.T_world_camera, view.K, view.depth)
        size = TAG_SIZE * width / 640.0
        names = [tag for o in found if (tag := name_on(o, labels, projection)) is not None]
        layers.append(draw_shapes(graph.objects, projection, config.hidden))
        layers.append(svg.tags(names, (left, top, left + width, top + height), size))
    name = f"{view.name} with the fitted shapes drawn over it"
    return svg.picture(width, height, *layers, name=name, corner=(left, top))


def draw_thumbnail(view: View, labels: NDArray[np.int32], graph: SupportGraph, config: ReportConfig) -> str:
    """Draw one view small, as SVG: its image, its parts and their names, as large as can be read.

    Args:
        view: The view.
        labels: Object number of each pixel (H, W), 0 = nothing.
        graph: The objects the labels are of.
        config: Sizes and qualities.
    """
    found = [o for o in graph.objects if o.role != "support_surface"]
    window = _window(found, view)
    left, top, width, height = window
    size = THUMBNAIL_TAG_SIZE * width / 640.0
    names = [tag for o in found if (tag := name_on(o, labels)) is not None]
    return svg.picture(
        width,
        height,
        _cut(tinted(_base(view), labels, width), window, config.thumbnail_width, config),
        svg.tags(names, (left, top, left + width, top + height), size),
        name=f"{view.name} with the parts found in it",
        corner=(left, top),
    )


def _window(objects: Sequence[SceneObject], view: View) -> tuple[float, float, float, float]:
    """Part of the image that is shown (x, y, width, height) [px]: the objects with room around them."""
    height, width = view.depth.shape
    if view.T_world_camera is None:
        return 0.0, 0.0, float(width), float(height)
    projection = Projection(view.T_world_camera, view.K, view.depth)
    pixels = [at[z > 0.0] for at, z in (projection.project(o.shape.outline()) for o in objects)]
    inside = np.clip(np.concatenate([*pixels, np.empty((0, 2))]), 0.0, (width, height))
    if len(inside) == 0:
        return 0.0, 0.0, float(width), float(height)
    low, high = inside.min(axis=0), inside.max(axis=0)
    share = float(np.clip(((high - low) / (width, height)).max() * ROOM, LEAST_SHARE, 1.0))
    size = share * np.array([width, height], dtype=np.float64)
    corner = np.clip((low + high - size) / 2.0, 0.0, (width, height) - size)
    return float(corner[0]), float(corner[1]), float(size[0]), float(size[1])


def name_on(
    item: SceneObject, labels: NDArray[np.int32], projection: Projection | None = None
) -> svg.Tag | None:
    """Put an object's id on its pixels, or faint on its projected centre where it has none.

    Args:
        item: The object.
        labels: Object number of each pixel (H, W).
        projection: Of the picture; without one an object without pixels has no name there.
    """
    height, width = labels.shape
    v, u = np.nonzero(labels == item.label)
    colour = colours.object_colour(item.label)
    if len(u):
        return svg.Tag(float(np.median(u)), float(np.median(v)), item.id, colour)
    if projection is None:
        return None
    (pixel,), (z,) = projection.project(item.centre_world[None, :])
    if z <= 0.0 or not (0.0 <= pixel[0] < width and 0.0 <= pixel[1] < height):
        return None
    return svg.Tag(float(pixel[0]), float(pixel[1]), item.id, colour, faint=True)


def _base(view: View) -> NDArray[np.uint8]:
    """The image (H, W, 3) under parts and shapes."""
    return view.rgb if view.rgb is not None else _depth_colours(view.depth)


def _cut(
    image: NDArray[np.uint8], window: tuple[float, float, float, float], most: int, config: ReportConfig
) -> str:
    """Put the part of an image (H, W, 3) that a window shows into a picture, about `most` pixels wide."""
    left, top = int(window[0]), int(window[1])
    right, bottom = int(np.ceil(window[0] + window[2])), int(np.ceil(window[1] + window[3]))
    part = Image.fromarray(image).crop((left, top, right, bottom))
    shrunk = np.asarray(part.reduce(max(1, round(part.width / most))))
    return svg.raster(shrunk, left, top, right - left, bottom - top, jpeg=config.jpeg_quality)


def tinted(image: NDArray[np.uint8], labels: NDArray[np.int32], width: float) -> NDArray[np.uint8]:
    """An image (H, W, 3) whose parts have their objects' colours, lit as they are in the image.

    Args:
        image: The image (H, W, 3).
        labels: Object number of each pixel (H, W), 0 = nothing.
        width: Of what is shown of it [px]; stripes keep their size in what is shown.
    """
    part = (labels != 0) & (labels != SUPPORT_LABEL)
    v, u = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in labels.shape), indexing="ij")
    colour = colours.striped_colours(labels, u, v, STRIPE * width / 640.0)
    grey = image @ GREY
    tint = TINT * colour + (1.0 - TINT) * grey[..., None]
    return np.where(part[..., None], tint.round(), image).astype(np.uint8)


def _depth_colours(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours (H, W, 3) of a depth image [m], black where there is no reading."""
    valid = depth > 0.0
    if not valid.any():
        return np.zeros((*depth.shape, 3), dtype=np.uint8)
    near, far = np.percentile(depth[valid], DEPTH_SHARE)
    share = (depth.astype(np.float64) - near) / max(far - near, 1e-6)
    return np.where(valid[..., None], colours.scale(share, colours.DEPTH_STOPS), np.uint8(0))
