"""A view as automatic segmentation samples it: oriented points of what stands on the support surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import CloudConfig, SegmentationConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.segmentation.foreground import standing_pixels
from caryatid.segmentation.plane_fits import Window, tangent_planes
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.views import View

Grid = tuple[slice, slice]
Labels = NDArray[np.int32]

MARGIN = 16
"""Pixels beyond the foreground that gaps may look at [px]."""

NORMAL_RADIUS = (2, 6)
"""Least and greatest radius of the window for normals [px]: fewer leave the noise, more cost time."""


@dataclass(frozen=True, eq=False, slots=True)
class Foreground:
    """What stands on the support surface.

    Attributes:
        pixels: Which pixels show it (H, W).
        inverse_depth: 1/z (H, W) [1/m] of all readings in working range, 0 = none.
        height: Normal and offset (4,) of the support surface in the camera frame: height is n·p + d [m].
    """

    pixels: NDArray[np.bool_]
    inverse_depth: NDArray[np.float32]
    height: Array


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """The foreground of a view on a grid of pixels (H, W), and what holds for the N samples on it.

    Attributes:
        grid: Rows and columns of the view that are the grid's.
        places: Which places of the grid hold a sample (H, W).
        points_camera: (N, 3) [m].
        normals_camera: Unit normals (N, 3).
        height: Over the support surface (N,) [m].
        depth: Readings (H, W) [m], 0 = none; of all that is seen, not of the foreground only.
        rgb: Colours (H, W, 3), or None.
        K: Pinhole matrix (3, 3) of the grid [px].
    """

    grid: Grid
    places: NDArray[np.bool_]
    points_camera: Array
    normals_camera: Array
    height: Array
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None
    K: Array

    def patch(self, own: NDArray[np.bool_] | NDArray[np.intp]) -> Array:
        """Points [m] and unit normals (K, 6) of some of the samples."""
        return np.concatenate([self.points_camera[own], self.normals_camera[own]], axis=1)

    def image(self, part: Labels) -> Labels:
        """Lay out the parts (N,) of the samples on the grid (H, W), 0 elsewhere."""
        image = np.zeros(self.places.shape, dtype=np.int32)
        image[self.places] = part
        return image


def find_foreground(
    view: View, surface: SupportSurface, config: SegmentationConfig, clouds: CloudConfig
) -> Foreground:
    """Find the pixels of a view that show what stands on the support surface.

    Args:
        view: The view; without a pose, the surface is in the camera frame.
        surface: The support surface.
        config: Heights, and the margin around the surface's outline.
        clouds: Working range.
    """
    T = np.eye(4) if view.T_world_camera is None else transforms.invert(view.T_world_camera)
    normal, corners = (
        transforms.rotate(T, surface.normal_world),
        transforms.transform(T, surface.outline_world),
    )
    outward = np.cross(transforms.unit(np.roll(corners, -1, axis=0) - corners), normal)
    sides = np.column_stack([outward, -np.einsum("ij,ij->i", outward, corners)])
    height = np.append(normal, -normal @ transforms.transform(T, surface.point_world))
    pixels, inverse_depth = standing_pixels(
        view.depth,
        view.K,
        (clouds.min_depth, clouds.max_depth),
        height,
        (config.clearance, config.max_height),
        sides,
        config.margin,
    )
    return Foreground(pixels, inverse_depth, height)


def take_samples(
    view: View, foreground: Foreground, config: SegmentationConfig, clouds: CloudConfig
) -> Samples:
    """Take oriented points of the foreground, which is not empty, on a grid of pixels.

    Where the view has no normals of its own, point and normal are those of a plane through the readings
    around the pixel that ends at creases.

    Args:
        view: The view.
        foreground: Its pixels above the surface.
        config: The grid, and what is a crease.
        clouds: How far readings count.
    """
    grid = _around(foreground.pixels, config.stride)
    chosen, depth = foreground.pixels[grid], view.depth[grid]
    corner = np.array([side.start for side in grid])
    pixels = np.argwhere(chosen) * config.stride + corner
    row, column = pixels.T
    centre, focal = view.K[[0, 1], 2], view.K[[0, 1], [0, 1]]
    rays = np.ones((len(pixels), 3))
    rays[:, :2] = (pixels[:, ::-1] - centre) / focal
    if view.normals_camera is None:
        windows = _windows(view.K[0, 0] / float(np.median(depth[chosen])), config, clouds)
        planes = tangent_planes(foreground.inverse_depth, pixels, *windows)
        known = planes[:, 0] > 0.0
        points = rays / np.where(known, planes[:, 0], 1.0)[:, None]
        slopes = planes[:, 1:] * focal
        ahead = planes[:, 0] - np.einsum("ij,ij->i", slopes, rays[:, :2])
        normals = transforms.unit(-np.column_stack([slopes, ahead]))
    else:
        points = rays * view.depth[row, column].astype(np.float64)[:, None]
        normals = view.normals_camera[row, column].astype(np.float64)
        known = (normals != 0.0).any(axis=-1)
    places = chosen.copy()
    places[chosen] = known
    points, normals = points[known], normals[known]
    K = view.K.copy()
    K[:2, 2] -= corner[::-1]
    K[:2] /= config.stride
    rgb = None if view.rgb is None else view.rgb[grid]
    heights = points @ foreground.height[:3] + foreground.height[3]
    return Samples(grid, places, points, normals, heights, depth, rgb, K)


def _around(mask: NDArray[np.bool_], stride: int) -> Grid:
    """Rows and columns of a mask with a margin, every so many."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, left = (max(0, int(i[0]) - MARGIN) // stride * stride for i in (rows, columns))
    return slice(top, int(rows[-1]) + MARGIN + 1, stride), slice(left, int(columns[-1]) + MARGIN + 1, stride)


def _windows(scale: float, config: SegmentationConfig, clouds: CloudConfig) -> tuple[Window, Window]:
    """Narrow and wide window of the samples' planes; `scale` is that of the usual object [px/m]."""
    radius = int(np.clip(np.floor(config.normal_size * scale / 2.0), *NORMAL_RADIUS))
    radius = min(radius, max(1, round((clouds.normal_size * scale - 1.0) / 2.0)))
    narrow = Window(radius, clouds.edge_jump, clouds.max_slope)
    return narrow, Window(config.plane_radius, config.plane_tolerance, 0.0)
