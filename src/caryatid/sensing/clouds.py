"""From views and raw clouds to oriented points: local planes, normals, valid readings, thinning."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import CloudConfig
from caryatid.geometry import transforms
from caryatid.geometry.points import most_central
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import SHARES, for_each, inner, kernel
from caryatid.sensing.views import View

Image = NDArray[np.float32]

ZERO = np.float32(0.0)
"""Keeps sums and comparisons in single precision."""

GRAZING = float(np.cos(np.radians(80.0)))
"""Cosine of the angle of incidence beyond which a sensor reads no surface [1]: such a reading mixes two."""


def oriented_points(view: View, config: CloudConfig) -> tuple[Array, Array, NDArray[np.intp]]:
    """Oriented points of a view: the readings in working range that have a normal, smoothed by local planes.

    A view with normals of its own (`view.normals_camera`) is taken as exact.

    Args:
        view: The view; without a pose, "world" below is the camera frame.
        config: Working range and normal estimation.

    Returns:
        Points (N, 3) [m] and unit normals (N, 3) in the world frame, and the flat pixel index (N,) of each.
    """
    T = np.ascontiguousarray(np.eye(4) if view.T_world_camera is None else view.T_world_camera)
    taken = view.valid & (view.depth >= config.min_depth) & (view.depth <= config.max_depth)
    given = view.normals_camera
    if given is not None:
        taken &= np.einsum("hwi,hwi->hw", given, given) > 0.5
        pixels = np.flatnonzero(taken)
        points = transforms.transform(T, view.points_camera.reshape(-1, 3)[pixels])
        return points, transforms.rotate(T, given.reshape(-1, 3)[pixels].astype(float)), pixels
    inverse_depth = np.divide(np.float32(1.0), view.depth, out=np.zeros_like(view.depth), where=taken)
    radius = config.normal_window // 2
    if distance := working_distance(view, config):
        width = config.normal_size * view.K[0, 0] / distance
        radius = min(radius, max(1, round((width - 1.0) / 2.0)))
    planes = local_planes(inverse_depth, radius, config.edge_jump, slope_limit(view.K[0, 0], config))
    pixels = np.flatnonzero(planes[2] > 0.0)
    points, normals = np.empty((len(pixels), 3)), np.empty((len(pixels), 3))
    for_each(_orient, SHARES, (pixels, planes, np.ascontiguousarray(view.K), T, points, normals))
    return points, normals, pixels


def working_distance(view: View, config: CloudConfig) -> float:
    """Median depth [m] of the readings in range, in every fourth row and column; 0 if there are none."""
    readings = view.depth[::4, ::4]
    readings = readings[(readings >= max(config.min_depth, 1e-9)) & (readings <= config.max_depth)]
    return float(np.median(readings)) if len(readings) > 0 else 0.0


def average_pixels(view: View, step: int, config: CloudConfig) -> View:
    """Return a view whose pixels are means over blocks of `step` × `step` pixels.

    Readings beyond a depth edge of the block's median do not count. Where half of the block has no reading,
    the pixel has none. Labels and normals are those of the median reading.
    """
    if step == 1:
        return view
    height, width = (-(-n // step) for n in view.depth.shape)
    K = view.K / np.array([[step], [step], [1.0]])
    K[:2, 2] -= (step - 1) / (2.0 * step)
    inverse_depth = np.divide(np.float32(1.0), view.depth, out=np.zeros_like(view.depth), where=view.valid)
    depth, pixels = np.zeros((height, width), np.float32), np.zeros((height, width), np.int64)
    jump = np.float32(config.edge_jump + slope_limit(view.K[0, 0], config) * (step - 1))
    for_each(_average_blocks, SHARES, (inverse_depth, step, jump, depth, pixels))
    images = dict[str, Any]()
    for name in ("labels", "normals_camera", "ignored"):
        if (image := getattr(view, name)) is not None:
            images[name] = image.reshape(-1, *image.shape[2:])[pixels]
    if view.rgb is not None:
        beyond = [(0, -n % step) for n in view.depth.shape]
        blocks = np.pad(view.rgb, (*beyond, (0, 0)), mode="edge").reshape(height, step, width, step, 3)
        images["rgb"] = blocks.mean(axis=(1, 3)).astype(np.uint8)
    return replace(view, depth=depth, K=K, **images)


@kernel
def _average_blocks(share, data):  # type: ignore[no-untyped-def]
    """Write the mean depth of every 16th row of blocks, and the pixel with the median reading of each."""
    inverse_depth, step, jump, depth, pixels = data
    height, width = inverse_depth.shape
    values, places = np.empty(step * step, np.float32), np.empty(step * step, np.int64)
    for row in range(share, depth.shape[0], SHARES):
        for column in range(depth.shape[1]):
            count = 0
            for v in range(row * step, min((row + 1) * step, height)):
                for u in range(column * step, min((column + 1) * step, width)):
                    if inverse_depth[v, u] > ZERO:
                        values[count], places[count] = inverse_depth[v, u], v * width + u
                        count += 1
            pixels[row, column] = row * step * width + column * step
            if 2 * count < step * step:
                continue
            middle = np.argsort(values[:count])[count // 2]
            total, near = ZERO, ZERO
            for k in range(count):
                if abs(values[k] - values[middle]) <= jump:
                    total, near = total + values[k], near + np.float32(1.0)
            depth[row, column], pixels[row, column] = near / total, places[middle]


def slope_limit(focal: float, config: CloudConfig) -> float:
    """Largest change of 1/z within one surface [1/m per px] for a focal length [px]."""
    return config.max_slope * max(1.0, 525.0 / focal)


def local_planes(inverse_depth: Image, radius: int, edge_jump: float, max_slope: float) -> Image:
    """Fit a plane to the surface around each pixel, up to its creases and depth edges but not across them.

    A plane is linear in inverse depth, 1/z = a·du + b·dv + c, and the noise of a structured-light sensor is
    nearly even in it: least squares over 7 × 7 readings reduce it to a quarter or less. If the readings of a
    window scatter more than by chance, the pixel gets the plane of the steadiest of the eight windows that
    end at it, if that plane also fits its own reading (the filter of Kuwahara et al. 1976, with planes
    instead of means).

    Args:
        inverse_depth: 1/z (H, W) [1/m], 0 = no reading.
        radius: The window is 2·radius + 1 pixels wide [px].
        edge_jump: Readings further than this from the pixel's own lie beyond a depth edge [1/m].
        max_slope: Added to it per pixel of distance, so that steep surfaces hold together [1/m per px].

    Returns:
        a, b, c (3, H, W) [1/m per px, 1/m]; c is 0 where too few readings agree.
    """
    image = np.ascontiguousarray(inverse_depth, dtype=np.float32)
    planes = np.zeros((4, *image.shape), dtype=np.float32)
    sums = np.empty((SHARES, 10, image.shape[1]), dtype=np.float32)
    padded, jump, slope = np.pad(image, radius), np.float32(edge_jump), np.float32(max_slope)
    for_each(_find_planes, SHARES, (padded, radius, jump, slope, sums, planes))
    c, variance = planes[2], planes[3]
    # The usual standard deviation [1/m] of readings about their window's plane, over windows half apart.
    apart = (slice(None, None, radius), slice(None, None, radius))
    noise = float(np.sqrt(np.median(variance[apart][c[apart] > 0.0]))) if (c[apart] > 0.0).any() else 0.0
    # Variance of a full window's readings within chance: three standard deviations of it.
    limit = np.float32(noise**2 * (1.0 + 3.0 * np.sqrt(2.0 / (2 * radius + 1) ** 2)))
    unsteady = np.flatnonzero((image > 0.0) & ((c == 0.0) | (variance > limit)))
    # Another window's plane fits a reading within 3.5 standard deviations of it.
    planes.reshape(4, -1)[:3, unsteady] = _steadier(
        unsteady, image, planes, radius, limit, np.float32(3.5 * noise)
    )
    return planes[:3]


@kernel
def _find_planes(share, data):  # type: ignore[no-untyped-def]
    """Write a, b, c and the variance about them of every 16th row; zeros stay where readings are few."""
    padded, radius, edge_jump, max_slope, sums, planes = data
    sums = sums[share]
    for row in range(share, planes.shape[1], SHARES):
        here, left, right = row + radius, radius, radius + planes.shape[2]
        while left < right and padded[here, left] <= ZERO:
            left += 1
        while right > left and padded[here, right - 1] <= ZERO:
            right -= 1
        count = right - left
        for k in range(10):
            for i in range(count):
                sums[k, i] = ZERO
        own = _part(padded, here, left, count)
        for dv in range(radius + 1):
            for du in range(radius + 1):
                weight = np.float32((0.5 if dv == 0 else 1.0) * (0.5 if du == 0 else 1.0))
                allowed = edge_jump + max_slope * np.float32(max(dv, du))
                a, b = _part(padded, here - dv, left - du, count), _part(padded, here - dv, left + du, count)
                c, d = _part(padded, here + dv, left - du, count), _part(padded, here + dv, left + du, count)
                _add_corners(own, a, b, c, d, np.float32(du), np.float32(dv), weight, allowed, sums)
        enough = np.float32((2 * radius + 1) ** 2 / 4.0)
        a, b = _part(planes[0], row, left - radius, count), _part(planes[1], row, left - radius, count)
        c, d = _part(planes[2], row, left - radius, count), _part(planes[3], row, left - radius, count)
        _solve(own, sums, enough, a, b, c, d)


@inner
def _part(image, row, first, count):  # type: ignore[no-untyped-def]
    return image[row, first : first + count]


@inner
def _add_corners(own, a, b, c, d, du, dv, share, allowed, sums):  # type: ignore[no-untyped-def]
    """Add the readings at (∓dv, ∓du) of each pixel to n, Σdu, Σdv, Σdu², Σdu·dv, Σdv², Σw, Σw·du, Σw·dv, Σw².

    They are above and before (a), above and after (b), below and before (c), below and after (d) the pixel.
    """
    for i in range(len(own)):
        wa, wb, wc, wd = a[i] - own[i], b[i] - own[i], c[i] - own[i], d[i] - own[i]
        na = share if abs(wa) <= allowed and a[i] > ZERO else ZERO
        nb = share if abs(wb) <= allowed and b[i] > ZERO else ZERO
        nc = share if abs(wc) <= allowed and c[i] > ZERO else ZERO
        nd = share if abs(wd) <= allowed and d[i] > ZERO else ZERO
        n = (na + nb) + (nc + nd)
        sums[0, i] += n
        sums[1, i] += du * ((nb - na) + (nd - nc))
        sums[2, i] += dv * ((nc + nd) - (na + nb))
        sums[3, i] += du * du * n
        sums[4, i] += du * dv * ((na - nb) + (nd - nc))
        sums[5, i] += dv * dv * n
        sums[9, i] += (na * wa * wa + nb * wb * wb) + (nc * wc * wc + nd * wd * wd)
        wa, wb, wc, wd = na * wa, nb * wb, nc * wc, nd * wd
        sums[6, i] += (wa + wb) + (wc + wd)
        sums[7, i] += du * ((wb - wa) + (wd - wc))
        sums[8, i] += dv * ((wc + wd) - (wa + wb))


@inner
def _solve(own, sums, enough, a, b, c, variance):  # type: ignore[no-untyped-def]
    """The least-squares planes of windows with enough readings that do not lie on a line."""
    for i in range(len(own)):
        n = sums[0, i]
        mean_u, mean_v, mean_w = sums[1, i] / n, sums[2, i] / n, sums[6, i] / n
        uu = sums[3, i] - n * mean_u * mean_u
        uv = sums[4, i] - n * mean_u * mean_v
        vv = sums[5, i] - n * mean_v * mean_v
        uw = sums[7, i] - n * mean_u * mean_w
        vw = sums[8, i] - n * mean_v * mean_w
        determinant = uu * vv - uv * uv
        slope_u = (uw * vv - vw * uv) / determinant
        slope_v = (vw * uu - uw * uv) / determinant
        squares = sums[9, i] - n * mean_w * mean_w - slope_u * uw - slope_v * vw
        level = own[i] + mean_w - slope_u * mean_u - slope_v * mean_v
        known = own[i] > ZERO and n >= enough and n * determinant > np.float32(0.5)
        a[i] = slope_u if known else ZERO
        b[i] = slope_v if known else ZERO
        c[i] = level if known else ZERO
        variance[i] = max(squares, ZERO) / max(n - np.float32(3.0), np.float32(1.0)) if known else ZERO


@kernel
def _steadier(pixels, image, planes, radius, limit, trusted):  # type: ignore[no-untyped-def]
    """The planes (3, N) of unsteady pixels: that of the steadiest window beside each, or its own."""
    height, width = image.shape
    found = np.empty((3, len(pixels)), np.float32)
    for i in range(len(pixels)):
        row = pixels[i] // width
        col = pixels[i] - row * width
        own = image[row, col]
        least = planes[3, row, col] if planes[2, row, col] > ZERO else limit
        a, b, c = planes[0, row, col], planes[1, row, col], planes[2, row, col]
        for dv in (-radius, 0, radius):
            for du in (-radius, 0, radius):
                y, x = row + dv, col + du
                if not (0 <= y < height and 0 <= x < width):
                    continue
                if planes[2, y, x] <= ZERO or planes[3, y, x] >= least:
                    continue
                slope_u, slope_v = planes[0, y, x], planes[1, y, x]
                here = planes[2, y, x] - slope_u * np.float32(du) - slope_v * np.float32(dv)
                if here > ZERO and abs(here - own) <= trusted:
                    a, b, c, least = slope_u, slope_v, here, planes[3, y, x]
        found[0, i], found[1, i], found[2, i] = a, b, c
    return found


@kernel
def _orient(share, data):  # type: ignore[no-untyped-def]
    """Write the points (N, 3) [m] and normals (N, 3) of a share of these pixels, in the world."""
    pixels, planes, K, T, points, normals = data
    width = planes.shape[2]
    for i in range(share * len(pixels) // SHARES, (share + 1) * len(pixels) // SHARES):
        row = pixels[i] // width
        col = pixels[i] - row * width
        a, b, c = planes[0, row, col], planes[1, row, col], planes[2, row, col]
        u, v = col - K[0, 2], row - K[1, 2]
        nx, ny, nz = -a * K[0, 0], -b * K[1, 1], a * u + b * v - c
        length, z = np.sqrt(nx * nx + ny * ny + nz * nz), 1.0 / c
        x, y = u / K[0, 0] * z, v / K[1, 1] * z
        for k in range(3):
            points[i, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
            normals[i, k] = (T[k, 0] * nx + T[k, 1] * ny + T[k, 2] * nz) / length


def estimate_normals(points: Array, viewpoint: Array, neighbours: int) -> Array:
    """Normals of an unorganised cloud: the direction of least spread among each point's neighbours.

    If the neighbours lie on one line or in one spot, the normal points straight at the viewpoint.

    Args:
        points: (N, 3) [m].
        viewpoint: Where the sensor was (3,) [m], in the points' frame; normals point to its side.
        neighbours: How many nearest points, the point itself included, a normal is estimated from.

    Returns:
        Unit normals (N, 3).
    """
    normals, tree, count = np.zeros_like(points), cKDTree(points), min(neighbours, len(points))
    # Neighbourhoods of some points at a time limit the memory.
    for start in range(0, len(points), 100_000):
        part = slice(start, start + 100_000)
        _, index = tree.query(points[part], k=count)
        offsets = points[index.reshape(-1, count)] - points[part, None, :]
        offsets -= offsets.mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
        unique = values[:, 1] > 1e-6 * np.maximum(values[:, 2], 1e-18)
        normals[part] = np.where(unique[:, None], vectors[:, :, 0], 0.0)
    towards = transforms.unit(np.asarray(viewpoint, dtype=np.float64) - points)
    degenerate = np.einsum("ij,ij->i", normals, normals) < 0.5
    normals[degenerate] = towards[degenerate]
    away = np.einsum("ij,ij->i", normals, towards) < 0.0
    normals[away] *= -1.0
    return normals


def thin(points: Array, voxel: float) -> NDArray[np.intp]:
    """Pick one of the points (N, 3) [m] in each occupied voxel: the one nearest to the mean of its voxel.

    Voxels have an edge length [m]; the grid starts at the world's origin. The indices (M,) are ascending.
    """
    return most_central(points, np.zeros(len(points), dtype=np.int32), np.array([voxel]))
