"""Compiled fits of planes around the pixels of a depth image, beside the plain reference they are held to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each

Image = NDArray[np.float32]

SHARES = 16
"""Shares of the image's rows that threads take [1]: every 16th row, as the readings are amid the image."""
CHANCE = 3.0
"""Standard deviations of a window's variance beyond which its readings scatter more than by chance."""
TRUSTED = 3.5
"""Standard deviations of a reading within which another window's plane may speak for it."""

ZERO, ONE = np.float32(0.0), np.float32(1.0)
"""Numbers that leave sums in single precision."""


@dataclass(frozen=True, eq=False, slots=True)
class LocalSurface:
    """What an inverse-depth image says of the surface around each pixel.

    Attributes:
        planes: 1/z = a·du + b·dv + c about each pixel: a, b, c (3, H, W) [1/m per px, 1/m]; c is 0 where too
            few readings agree.
        noise: Standard deviation of one reading [1/m]: the median over windows half their width apart.
    """

    planes: Image
    noise: float

    def oriented(self, pixels: NDArray[np.intp], K: Array, T_world_camera: Array) -> tuple[Array, Array]:
        """Points (N, 3) [m] and unit normals (N, 3), towards the camera, in the world.

        Args:
            pixels: Flat indices (N,) of pixels that have a plane.
            K: Pinhole matrix (3, 3) [px].
            T_world_camera: Camera pose (4, 4).
        """
        K, T = np.ascontiguousarray(K), np.ascontiguousarray(T_world_camera)
        points, normals = np.empty((len(pixels), 3)), np.empty((len(pixels), 3))
        _orient(pixels, self.planes, K, T, points, normals)
        return points, normals


def local_surface(inverse_depth: Image, radius: int, edge_jump: float, max_slope: float) -> LocalSurface:
    """Fit a plane to the surface around each pixel, up to its creases but not across them.

    A plane is linear in inverse depth: 1/z = a·du + b·dv + c, by least squares over the window around each
    pixel. Where the readings of that window scatter more than by chance, the pixel takes the plane of the
    steadiest of the eight windows that end at it, if this holds for its own reading too (the filter of
    Kuwahara et al. 1976, with planes in place of means).

    Args:
        inverse_depth: 1/z (H, W) [1/m], 0 = no reading.
        radius: The window is 2·radius + 1 pixels wide [px].
        edge_jump: Readings further than this from the pixel's own lie beyond a depth edge [1/m].
        max_slope: Added to it a pixel of distance, so that steep surfaces hold together [1/m per px].
    """
    image = np.ascontiguousarray(inverse_depth, dtype=np.float32)
    planes = np.zeros((4, *image.shape), dtype=np.float32)
    sums = np.empty((SHARES, 10, image.shape[1]), dtype=np.float32)
    padded, jump, slope = np.pad(image, radius), np.float32(edge_jump), np.float32(max_slope)
    for_each(_find_planes, SHARES, _Windows(padded, radius, jump, slope, sums, planes))
    c, variance = planes[2], planes[3]
    noise = _noise(planes, radius)
    limit = np.float32(_limit(noise, radius))
    unsteady = np.flatnonzero((image > 0.0) & ((c == 0.0) | (variance > limit)))
    steadier = _steadier(unsteady, image, planes, radius, limit, np.float32(TRUSTED * noise))
    planes.reshape(4, -1)[:3, unsteady] = steadier
    return LocalSurface(planes[:3], noise)


def local_surface_reference(
    inverse_depth: Image, K: Array, radius: int, edge_jump: float, max_slope: float
) -> tuple[Image, Image, float]:
    """Do as `local_surface` does, by NumPy over all the windows at once in double precision.

    Returns:
        1/z (H, W) [1/m] and the normals (H, W, 3) by the planes, both 0 where there is none, and the noise.
    """
    own = inverse_depth.astype(np.float64)
    planes = _window_planes_reference(own, radius, edge_jump, max_slope)
    noise = _noise(planes, radius)
    unsteady = (own > 0.0) & ((planes[2] == 0.0) | (planes[3] > _limit(noise, radius)))
    best = planes.copy()
    best[3, planes[2] == 0.0] = _limit(noise, radius)
    padded = np.pad(planes, ((0, 0), (radius, radius), (radius, radius)))
    height, width = own.shape
    for dv in (-radius, 0, radius):
        for du in (-radius, 0, radius):
            there = padded[:, radius + dv :, radius + du :][:, :height, :width].copy()
            there[2] = np.where(there[2] > 0.0, there[2] - there[0] * du - there[1] * dv, 0.0)
            better = unsteady & (there[2] > 0.0) & (there[3] < best[3])
            better &= np.abs(there[2] - own) <= TRUSTED * noise
            best = np.where(better, there, best)
    return best[2].astype(np.float32), normals_reference(best, K), noise


def normals_reference(planes: Array, K: Array) -> Image:
    """Turn planes (≥ 3, H, W) into unit normals: n ∝ −(a·fx, b·fy, c − a·(u−cx) − b·(v−cy))."""
    a, b, c = planes[:3]
    v, u = np.indices(c.shape) - K[1::-1, 2][:, None, None]
    normals = -np.stack([a * K[0, 0], b * K[1, 1], c - a * u - b * v], axis=-1)
    length = np.linalg.norm(normals, axis=-1)
    return (normals / np.where(c > 0.0, length, np.inf)[..., None]).astype(np.float32)


def _window_planes_reference(own: Array, radius: int, edge_jump: float, max_slope: float) -> Array:
    """The planes of all windows and the variance about them (4, H, W), as `_find_planes` writes them."""
    side = 2 * radius + 1
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(own, radius), (side, side))
    dv, du = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(np.float64)
    difference = windows - own[:, :, None, None]
    allowed = edge_jump + max_slope * np.maximum(np.abs(du), np.abs(dv))
    near = (windows > 0) & (own > 0)[:, :, None, None] & (np.abs(difference) <= allowed)
    weight = near.astype(np.float64)
    terms = np.stack([np.ones_like(du), du, dv])
    moments = np.einsum("hwij,aij,bij->hwab", weight, terms, terms)
    right = np.einsum("hwij,hwij,aij->hwa", weight, difference, terms)
    count = moments[..., 0, 0].copy()
    enough = (count >= side * side / 4.0) & (np.linalg.det(moments) > 0.5)
    moments[~enough] = np.eye(3)
    solution = np.linalg.solve(moments, right[..., None])[..., 0]
    squares = np.einsum("hwij,hwij->hw", weight, difference**2) - np.einsum("hwa,hwa->hw", solution, right)
    variance = np.maximum(squares, 0.0) / np.maximum(count - 3.0, 1.0)
    c, a, b = np.moveaxis(solution, -1, 0)
    return np.where(enough, np.stack([a, b, own + c, variance]), 0.0)


def _noise(planes: NDArray[np.floating], radius: int) -> float:
    """Usual standard deviation [1/m] of readings about their window's plane, over windows half apart."""
    c, variance = planes[2:, ::radius, ::radius]
    return float(np.sqrt(np.median(variance[c > 0.0]))) if (c > 0.0).any() else 0.0


def _limit(noise: float, radius: int) -> float:
    """Variance [1/m²] of a full window's readings that chance may reach."""
    return noise**2 * (1.0 + CHANCE * np.sqrt(2.0 / (2 * radius + 1) ** 2))


class _Windows(NamedTuple):
    """What the planes of an image's windows are found from, and where they are written.

    Attributes:
        padded: 1/z [1/m] with a border of `radius` zeros (H + 2·radius, W + 2·radius), 0 = no reading.
        radius: The windows are 2·radius + 1 pixels wide [px].
        edge_jump: Readings further than this from the pixel's own lie beyond a depth edge [1/m].
        max_slope: Added to it a pixel of distance [1/m per px].
        sums: Room to work in (SHARES, 10, W).
        planes: a, b, c of 1/z = a·du + b·dv + c and the variance about it (4, H, W), at first all zero.
    """

    padded: Image
    radius: int
    edge_jump: np.float32
    max_slope: np.float32
    sums: Image
    planes: Image


@njit(cache=True)
def _find_planes(share, windows):  # type: ignore[no-untyped-def]
    """Write the planes of every 16th row's pixels; where readings are too few, the zeros stay."""
    padded, radius, planes, sums = windows.padded, windows.radius, windows.planes, windows.sums[share]
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
                allowed = windows.edge_jump + windows.max_slope * np.float32(max(dv, du))
                a, b = _part(padded, here - dv, left - du, count), _part(padded, here - dv, left + du, count)
                c, d = _part(padded, here + dv, left - du, count), _part(padded, here + dv, left + du, count)
                _add_corners(own, a, b, c, d, np.float32(du), np.float32(dv), weight, allowed, sums)
        enough = np.float32((2 * radius + 1) ** 2 / 4.0)
        a, b = _part(planes[0], row, left - radius, count), _part(planes[1], row, left - radius, count)
        c, d = _part(planes[2], row, left - radius, count), _part(planes[3], row, left - radius, count)
        _solve(own, sums, enough, a, b, c, d)


@njit(cache=True)
def _part(image, row, first, count):  # type: ignore[no-untyped-def]
    return image[row, first : first + count]


@njit(cache=True)
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


@njit(cache=True, error_model="numpy")
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
        variance[i] = max(squares, ZERO) / max(n - np.float32(3.0), ONE) if known else ZERO


@njit(cache=True)
def _steadier(pixels, image, planes, radius, limit, trusted):  # type: ignore[no-untyped-def]
    """The planes (3, N) of unsteady pixels: each of the steadiest window next to it, or its own."""
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


@njit(cache=True, error_model="numpy")
def _orient(pixels, planes, K, T, points, normals):  # type: ignore[no-untyped-def]
    """Write the points (N, 3) [m] and normals (N, 3) of these pixels, in the world."""
    width = planes.shape[2]
    for i in range(len(pixels)):
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
