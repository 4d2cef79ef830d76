"""A view sampled for automatic segmentation: oriented points above the support surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import CloudConfig, SegmentationConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import SHARES, inner, kernel, on_threads
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.clouds import GRAZING, slope_limit
from caryatid.sensing.views import View

Labels = NDArray[np.int32]


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """The foreground of a view on a grid of pixels (H, W), and the N samples on it.

    Attributes:
        grid: Rows and columns of the view that are the grid's.
        places: Which places of the grid hold a sample (H, W).
        points_camera: (N, 3) [m].
        normals_camera: Unit normals (N, 3).
        height: Over the support surface (N,) [m].
        depth: Readings (H, W) [m], 0 = none; of the whole view, not only of the foreground.
        rgb: Colours (H, W, 3), or None.
        K: Pinhole matrix (3, 3) of the grid [px].
    """

    grid: tuple[slice, slice]
    places: NDArray[np.bool_]
    points_camera: Array
    normals_camera: Array
    height: Array
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None
    K: Array

    @property
    def spacing(self) -> float:
        """Median distance of neighbours on a surface that faces the camera [m]."""
        return float(np.median(self.points_camera[:, 2])) / float(self.K[0, 0])

    def image(self, part: Labels) -> Labels:
        """Put the parts (N,) of the samples on the grid (H, W), 0 elsewhere."""
        image = np.zeros(self.places.shape, dtype=np.int32)
        image[self.places] = part
        return image


def take_samples(
    view: View,
    foreground: NDArray[np.bool_],
    surface: SupportSurface,
    config: SegmentationConfig,
    clouds: CloudConfig,
) -> Samples:
    """Take oriented points of the foreground, which is not empty, on a grid of pixels.

    If the view has no normals of its own, point and normal are those of a plane through the readings around
    the pixel that ends at creases. The smooth planes of `sensing` are unsuitable: they round creases. Planes
    along the ray are ramps from one surface to another behind it, and are left out.

    Args:
        view: The view, which has a pose.
        foreground: Its pixels (H, W) above the surface.
        surface: The support surface.
        config: The grid.
        clouds: How far readings count.
    """
    # Gaps may look 16 pixels beyond the foreground.
    seen = [np.flatnonzero(foreground.any(axis=axis)) for axis in (1, 0)]
    corner = [max(0, int(index[0]) - 16) // config.stride * config.stride for index in seen]
    ends = [int(index[-1]) + 17 for index in seen]
    grid = slice(corner[0], ends[0], config.stride), slice(corner[1], ends[1], config.stride)
    places, depth = foreground[grid].copy(), view.depth[grid]
    row, column = np.argwhere(places).T * config.stride + np.array(corner)[:, None]
    x, y = (column - view.K[0, 2]) / view.K[0, 0], (row - view.K[1, 2]) / view.K[1, 1]
    rays = np.column_stack([x, y, np.ones(len(row))])
    if view.normals_camera is None:
        scale = view.K[0, 0] / float(np.median(depth[places]))  # For the usual object [px/m].
        # 13 mm at the objects' median distance; fewer than 5 px leave the noise, more than 13 px cost time.
        radius = int(np.clip(np.floor(0.013 * scale / 2.0), 2, 6))
        radius = min(radius, max(1, round((clouds.normal_size * scale - 1.0) / 2.0)))
        counts = (view.depth >= clouds.min_depth) & (view.depth <= clouds.max_depth)
        image = np.zeros(view.depth.shape, dtype=np.float32)
        np.divide(np.float32(1.0), view.depth, out=image, where=counts)
        shares = np.array_split(np.column_stack([row, column]), SHARES)
        windows = radius, clouds.edge_jump, slope_limit(view.K[0, 0], clouds)
        planes = np.concatenate(on_threads(lambda k: _fit_planes(image, shares[k], *windows), SHARES))
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
    seen = -np.einsum("ij,ij->i", normals, transforms.unit(rays[known])) > GRAZING
    points, normals, known[known] = points[seen], normals[seen], seen
    places[places] = known
    K = view.K.copy()
    K[:2, 2] -= corner[::-1]
    K[:2] /= config.stride
    height = surface.height(transforms.transform(view.pose, points))
    rgb = None if view.rgb is None else view.rgb[grid]
    return Samples(grid, places, points, normals, height, depth, rgb, K)


@kernel
def _fit_planes(image, pixels, radius, jump, slope):  # type: ignore[no-untyped-def]
    """Planes 1/z = c + a·du + b·dv (N, 3) [1/m, 1/m per px] of the surface around pixels, up to its creases.

    By least squares: first over the readings of a narrow window that lie near the pixel's own, then in two
    rounds over those of a wide one that lie near the plane. If a wide window determines none, the plane
    stays as it was; if readings are too few for a first plane, it is zero.
    """
    planes = np.zeros((len(pixels), 3))
    side = 2.0 * radius + 1.0
    for n in range(len(pixels)):
        row, column, plane = pixels[n, 0], pixels[n, 1], planes[n]
        own = float(image[row, column])
        plane[0] = own
        # A quarter of the window is needed, because less is a corner or flying pixels; and more than
        # readings on a line.
        known = _refit(image, row, column, radius, jump, slope, 0.25 * side * side, 0.01, plane)
        if not known or plane[0] <= 0.0:
            plane[0] = plane[1] = plane[2] = 0.0
            continue
        plane[1] *= own / plane[0]
        plane[2] *= own / plane[0]
        plane[0] = own
        for _ in range(2):
            # Three times the readings that determine a plane average out their noise, if not on a line. They
            # lie as near to it as 3σ of the sensor at 2 m.
            if not _refit(image, row, column, 5, 0.004, 0.0, 9.0, 12.0, plane):
                break
    return planes


@inner
def _refit(image, row, column, radius, tolerance, slope, least, spread, plane):  # type: ignore[no-untyped-def]
    """Fit a plane (3,) to the readings of a window that lie near it, and say if they determine one.

    They do if their number, and the determinant of their spread per reading [px⁴], are large enough.
    """
    height, width = image.shape
    c, a, b = plane[0], plane[1], plane[2]
    n = su = sv = suu = suv = svv = sw = suw = svw = 0.0
    left, right = max(-radius, -column), min(radius, width - 1 - column)
    for down in range(max(-radius, -row), min(radius, height - 1 - row) + 1):
        dv = float(down)
        line_n = line_u = line_uu = line_w = line_uw = 0.0
        for across in range(left, right + 1):
            du = float(across)
            reading = image[row + down, column + across]
            off = reading - (c + a * du + b * dv)
            near = abs(off) <= tolerance + slope * (abs(du) if abs(du) > abs(dv) else abs(dv))
            weight = 1.0 if (reading > 0.0) & near else 0.0
            line_n += weight
            line_u += weight * du
            line_uu += weight * (du * du)
            line_w += weight * off
            line_uw += weight * (du * off)
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
