"""A view as automatic segmentation samples it: oriented points of what stands on the support surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from caryatid.config import CloudConfig, SegmentationConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.views import View

Grid = tuple[slice, slice]
Labels = NDArray[np.int32]
Image = NDArray[np.float32]

NORMAL_SIZE = 0.013
"""Side of the narrow window of a sample's tangent plane, at the objects' median distance [m]."""
NORMAL_RADIUS = (2, 6)
"""Least and greatest radius of that window [px]: fewer leave the noise, more cost time."""
WIDE = (5.0, 0.004, 0.0)
"""The wide window the plane is refined over: radius [px], tolerance [1/m; 3σ of the sensor at 2 m], slope."""
LEAST_SHARE = 0.25
"""Share of a narrow window whose readings a first plane must have [1]; fewer are a corner, or flying."""
LEAST_TAPS = 9.0
"""Readings a plane is refined from at the least [1]; three determine it, three times as many even it out."""
LEAST_SPREAD = 12.0
"""Least determinant of their spread per reading [px⁴]; readings on a line determine no plane."""
ON_A_LINE = 0.01
"""The same below which readings lie on one line, from which no first plane is taken [px⁴]."""
ROUNDS = 2
"""How often a plane is refined over the wide window [1]; the readings that are its own then hardly change."""
MARGIN = 16
"""Pixels beyond the foreground that gaps may look at [px]."""


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
) -> NDArray[np.bool_]:
    """Which pixels (H, W) of a view show what stands on the support surface.

    Args:
        view: The view; without a pose, the surface is in the camera frame.
        surface: The support surface.
        config: Heights, and the margin around the surface's outline.
        clouds: Working range.
    """
    T = np.eye(4) if view.T_world_camera is None else transforms.invert(view.T_world_camera)
    surface = surface.moved(T)
    up, corners = surface.normal_world, surface.outline_world
    outward = np.cross(transforms.unit(np.roll(corners, -1, axis=0) - corners), up)
    sides = np.column_stack([outward, -np.einsum("ij,ij->i", outward, corners)])
    planes = np.concatenate([np.append(up, -up @ surface.point_world)[None], sides])
    height, width = view.depth.shape
    x, y = (np.arange(width) - view.K[0, 2]) / view.K[0, 0], (np.arange(height) - view.K[1, 2]) / view.K[1, 1]
    limits = clouds.min_depth, clouds.max_depth, config.clearance, config.max_height, config.margin
    foreground = np.zeros(view.depth.shape, dtype=np.bool_)
    _find_over(view.depth, x, y, planes, np.array(limits), foreground)
    return foreground


@njit(cache=True)
def _find_over(depth, x, y, planes, limits, over):  # type: ignore[no-untyped-def]
    """Mark pixels (H, W) over the first plane and not outside the other ones, n·p + d = 0 (M, 4).

    Limits (5,) are least and greatest depth and height and the greatest distance outside; a pixel's ray has
    the slopes x (W,) and y (H,).
    """
    low, high = np.float32(limits[0]), np.float32(limits[1])
    for row in range(len(y)):
        for col in range(len(x)):
            z = depth[row, col]
            if not low <= z <= high:
                continue
            height = z * (planes[0, 0] * x[col] + planes[0, 1] * y[row] + planes[0, 2]) + planes[0, 3]
            if not limits[2] < height < limits[3]:
                continue
            inside = True
            for k in range(1, len(planes)):
                slope = planes[k, 0] * x[col] + planes[k, 1] * y[row] + planes[k, 2]
                inside = inside and z * slope + planes[k, 3] <= limits[4]
            over[row, col] = inside


def take_samples(
    view: View,
    foreground: NDArray[np.bool_],
    surface: SupportSurface,
    config: SegmentationConfig,
    clouds: CloudConfig,
) -> Samples:
    """Take oriented points of the foreground, which is not empty, on a grid of pixels.

    Where the view has no normals of its own, point and normal are those of a plane through the readings
    around the pixel that ends at creases. The smooth planes of `sensing` will not do: they round creases.

    Args:
        view: The view; without a pose, the surface is in the camera frame.
        foreground: Its pixels (H, W) above the surface.
        surface: The support surface.
        config: The grid.
        clouds: How far readings count.
    """
    grid = _around(foreground, config.stride)
    places, depth = foreground[grid].copy(), view.depth[grid]
    corner = np.array([side.start for side in grid])
    row, column = np.argwhere(places).T * config.stride + corner[:, None]
    rays = _rays(view.K, row, column)
    if view.normals_camera is None:
        scale = view.K[0, 0] / float(np.median(depth[places]))
        planes = _tangent_planes(view, row, column, scale, clouds)
        known = planes[:, 0] > 0.0
        slopes = planes[:, 1:] * view.K[[0, 1], [0, 1]]
        normals = -np.column_stack([slopes, planes[:, 0] - np.einsum("ij,ij->i", slopes, rays[:, :2])])
        points = rays[known] / planes[known, :1]
        normals = transforms.unit(normals[known])
    else:
        normals = view.normals_camera[row, column].astype(np.float64)
        known = (normals != 0.0).any(axis=-1)
        points = (rays * view.depth[row, column].astype(np.float64)[:, None])[known]
        normals = normals[known]
    places[places] = known
    K = view.K.copy()
    K[:2, 2] -= corner[::-1]
    K[:2] /= config.stride
    T = np.eye(4) if view.T_world_camera is None else view.T_world_camera
    height = surface.height(transforms.transform(T, points))
    rgb = None if view.rgb is None else view.rgb[grid]
    return Samples(grid, places, points, normals, height, depth, rgb, K)


def _rays(K: Array, row: NDArray[np.intp], column: NDArray[np.intp]) -> Array:
    """Directions (N, 3) of pixels, at z = 1."""
    return np.column_stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], np.ones(len(row))])


def _tangent_planes(
    view: View, row: NDArray[np.intp], column: NDArray[np.intp], scale: float, clouds: CloudConfig
) -> Array:
    """Fit a plane to the surface around each pixel that ends at its creases.

    Each plane is 1/z = c + a·du + b·dv about its pixel, by least squares: first to the readings of a narrow
    window that lie near the pixel's own, then in two rounds to those of a wide one that lie near the plane.
    Where a wide window determines none, the plane stays as it was.

    Args:
        view: Its readings.
        row: Of each pixel (N,); all hold a reading.
        column: Of each pixel (N,).
        scale: That of the usual object [px/m].
        clouds: Working range, and which readings are near the pixel's own.

    Returns:
        c, a, b (N, 3) [1/m, 1/m per px]; zero where readings are too few for a first plane.
    """
    radius = int(np.clip(np.floor(NORMAL_SIZE * scale / 2.0), *NORMAL_RADIUS))
    radius = min(radius, max(1, round((clouds.normal_size * scale - 1.0) / 2.0)))
    windows = np.array([(radius, clouds.edge_jump, clouds.max_slope), WIDE])
    counts = (view.depth >= clouds.min_depth) & (view.depth <= clouds.max_depth)
    inverse_depth = np.zeros(view.depth.shape, dtype=np.float32)
    np.divide(np.float32(1.0), view.depth, out=inverse_depth, where=counts)
    planes = np.zeros((len(row), 3))
    _fit_planes(inverse_depth, np.column_stack([row, column]), windows, planes)
    return planes


def _around(mask: NDArray[np.bool_], stride: int) -> Grid:
    """Rows and columns of a mask with a margin, every so many."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, left = (max(0, int(i[0]) - MARGIN) // stride * stride for i in (rows, columns))
    return slice(top, int(rows[-1]) + MARGIN + 1, stride), slice(left, int(columns[-1]) + MARGIN + 1, stride)


@njit(cache=True, parallel=True)
def _fit_planes(image: Image, pixels: NDArray[np.intp], windows: Array, planes: Array) -> None:
    """Do for each pixel as `_tangent_planes` says."""
    for number in prange(len(pixels)):
        _fit_plane(image, pixels[number, 0], pixels[number, 1], windows, planes[number])


@njit(cache=True, error_model="numpy")
def _fit_plane(image: Image, row: int, column: int, windows: Array, plane: Array) -> None:
    """Fit one plane (3,); the windows (2, 3) are the narrow and the wide one."""
    own, side = float(image[row, column]), 2.0 * windows[0, 0] + 1.0
    plane[0], plane[1], plane[2] = own, 0.0, 0.0
    known = _refit(image, row, column, windows[0], LEAST_SHARE * side * side, ON_A_LINE, plane)
    if not known or plane[0] <= 0.0:
        plane[0], plane[1], plane[2] = 0.0, 0.0, 0.0
        return
    plane[1] *= own / plane[0]
    plane[2] *= own / plane[0]
    plane[0] = own
    for _ in range(ROUNDS):
        if not _refit(image, row, column, windows[1], LEAST_TAPS, LEAST_SPREAD, plane):
            return


@njit(cache=True, error_model="numpy")
def _refit(
    image: Image,
    row: int,
    column: int,
    window: Array,
    least: float,
    spread: float,
    plane: Array,
) -> bool:
    """Fit a plane (3,) to the readings of a window (3,) that are its own, and say if they determine one."""
    height, width = image.shape
    c, a, b = plane[0], plane[1], plane[2]
    radius, tolerance, slope = int(window[0]), window[1], window[2]
    n = su = sv = suu = suv = svv = sw = suw = svw = 0.0
    for down in range(-radius, radius + 1):
        if row + down < 0 or row + down >= height:
            continue
        dv = float(down)
        line_n = line_u = line_uu = line_w = line_uw = 0.0
        for right in range(-radius, radius + 1):
            if column + right < 0 or column + right >= width:
                continue
            du = float(right)
            reading = image[row + down, column + right]
            off = reading - (c + a * du + b * dv)
            distance = abs(du) if abs(du) > abs(dv) else abs(dv)
            if reading > 0.0 and abs(off) <= tolerance + slope * distance:
                line_n += 1.0
                line_u += du
                line_uu += du * du
                line_w += off
                line_uw += du * off
        n, su, sv = n + line_n, su + line_u, sv + dv * line_n
        suu, suv, svv = suu + line_uu, suv + dv * line_u, svv + dv * dv * line_n
        sw, suw, svw = sw + line_w, suw + line_uw, svw + dv * line_w
    if n < least:
        return False
    mean_u, mean_v, mean_w = su / n, sv / n, sw / n
    uu, uv, vv = suu / n - mean_u * mean_u, suv / n - mean_u * mean_v, svv / n - mean_v * mean_v
    uw, vw = suw / n - mean_u * mean_w, svw / n - mean_v * mean_w
    determinant = uu * vv - uv * uv
    if determinant < spread / n:
        return False
    slope_u = (uw * vv - vw * uv) / determinant
    slope_v = (vw * uu - uw * uv) / determinant
    plane[0] = c + mean_w - slope_u * mean_u - slope_v * mean_v
    plane[1], plane[2] = a + slope_u, b + slope_v
    return True
