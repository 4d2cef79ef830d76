"""Compiled loops over depth images, each beside the plain reference it is held to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.frames import Array

Image = NDArray[np.float32]


CHANCE = 3.0
"""Standard deviations of a window's variance beyond which its readings scatter more than by chance."""
TRUSTED = 3.5
"""Standard deviations of a reading within which another window's plane may speak for it."""


@dataclass(frozen=True, eq=False, slots=True)
class LocalSurface:
    """What an inverse-depth image says of the surface at each pixel.

    Attributes:
        inverse_depth: 1/z (H, W) [1/m] of the local plane, 0 where too few readings agree.
        normals: Unit normals (H, W, 3) in the camera frame, towards the camera, zero there.
        noise: Standard deviation of one reading [1/m]: the median over all windows.
    """

    inverse_depth: Image
    normals: Image
    noise: float


def local_surface(
    inverse_depth: Image, K: Array, radius: int, edge_jump: float, max_slope: float, *, sharp: bool = True
) -> LocalSurface:
    """Fit a plane to the surface around each pixel, up to its creases but not across them.

    A plane is linear in inverse depth: 1/z = a·du + b·dv + c, by least squares over the window around each
    pixel. Where the readings of that window scatter more than by chance, the pixel takes the plane of the
    steadiest of the eight windows that end at it, if this holds for its own reading too (the filter of
    Kuwahara et al. 1976, with planes in place of means).

    Args:
        inverse_depth: 1/z (H, W) [1/m], 0 = no reading.
        K: Pinhole matrix (3, 3) [px].
        radius: The window is 2·radius + 1 pixels wide [px].
        edge_jump: Readings further than this from the pixel's own lie beyond a depth edge [1/m].
        max_slope: Added to it a pixel of distance, so that steep surfaces hold together [1/m per px].
        sharp: Whether pixels may take another window's plane; otherwise creases come out rounded.
    """
    image = np.ascontiguousarray(inverse_depth, dtype=np.float32)
    planes = _window_planes(image, radius, np.float32(edge_jump), np.float32(max_slope))
    noise = _noise(planes)
    if not sharp:
        return LocalSurface(planes[2], _plane_normals(planes, K), noise)
    limit = np.float32(_limit(noise, radius))
    chosen = _steadiest(image, planes, radius, limit, np.float32(TRUSTED * noise))
    return LocalSurface(chosen[2], _plane_normals(chosen, K), noise)


def local_surface_reference(
    inverse_depth: Image, K: Array, radius: int, edge_jump: float, max_slope: float
) -> LocalSurface:
    """Do as `local_surface` does, by NumPy over all the windows at once in double precision."""
    own = inverse_depth.astype(np.float64)
    planes = _window_planes_reference(own, radius, edge_jump, max_slope)
    noise = _noise(planes)
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
    return LocalSurface(best[2].astype(np.float32), _plane_normals(best.astype(np.float32), K), noise)


def _window_planes_reference(own: Array, radius: int, edge_jump: float, max_slope: float) -> Array:
    """Do as `_window_planes` does."""
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


def _noise(planes: NDArray[np.floating]) -> float:
    """Usual standard deviation [1/m] of readings about their window's plane."""
    known = planes[2] > 0.0
    return float(np.sqrt(np.median(planes[3][known]))) if known.any() else 0.0


def _limit(noise: float, radius: int) -> float:
    """Variance [1/m²] of a full window's readings that chance may reach."""
    return noise**2 * (1.0 + CHANCE * np.sqrt(2.0 / (2 * radius + 1) ** 2))


def _plane_normals(planes: Image, K: Array) -> Image:
    """Turn planes (≥ 3, H, W) into unit normals: n ∝ −(a·fx, b·fy, c − a·(u−cx) − b·(v−cy))."""
    a, b, c = planes[0], planes[1], planes[2]
    height, width = c.shape
    u = (np.arange(width) - K[0, 2]).astype(np.float32)[None, :]
    v = (np.arange(height) - K[1, 2]).astype(np.float32)[:, None]
    normals = np.empty((height, width, 3), dtype=np.float32)
    normals[..., 0] = a * np.float32(-K[0, 0])
    normals[..., 1] = b * np.float32(-K[1, 1])
    normals[..., 2] = a * u + b * v - c
    length = np.sqrt(np.einsum("hwi,hwi->hw", normals, normals))
    length[c <= 0.0] = np.inf
    normals /= length[..., None]
    return normals


@njit(cache=True)
def _window_planes(image, radius, edge_jump, max_slope):  # type: ignore[no-untyped-def]
    """1/z = a·du + b·dv + c over each pixel's window: a, b, c and the variance about it (4, H, W).

    All zero where readings are too few.
    """
    height, width = image.shape
    planes = np.zeros((4, height, width), np.float32)
    zero, one = np.float32(0.0), np.float32(1.0)
    side = 2 * radius + 1
    enough = np.float32(side * side / 4.0)
    padded = np.zeros(width + 2 * radius, np.float32)
    sums = np.zeros((10, width), np.float32)
    for row in range(height):
        sums[:] = zero
        own = image[row]
        for dv in range(-radius, radius + 1):
            if row + dv < 0 or row + dv >= height:
                continue
            padded[radius : radius + width] = image[row + dv]
            fv = np.float32(dv)
            for du in range(-radius, radius + 1):
                fu = np.float32(du)
                allowed = edge_jump + max_slope * np.float32(max(abs(du), abs(dv)))
                for col in range(width):
                    other = padded[col + radius + du]
                    difference = other - own[col]
                    near = abs(difference) <= allowed and other > zero
                    weight = one if near else zero
                    weighted = weight * difference
                    sums[0, col] += weight
                    sums[1, col] += weight * fu
                    sums[2, col] += weight * fv
                    sums[3, col] += weight * (fu * fu)
                    sums[4, col] += weight * (fu * fv)
                    sums[5, col] += weight * (fv * fv)
                    sums[6, col] += weighted
                    sums[7, col] += weighted * fu
                    sums[8, col] += weighted * fv
                    sums[9, col] += weighted * difference
        for col in range(width):
            n = sums[0, col]
            if own[col] <= zero or n < enough:
                continue
            mean_u, mean_v, mean_w = sums[1, col] / n, sums[2, col] / n, sums[6, col] / n
            uu = sums[3, col] - n * mean_u * mean_u
            uv = sums[4, col] - n * mean_u * mean_v
            vv = sums[5, col] - n * mean_v * mean_v
            uw = sums[7, col] - n * mean_u * mean_w
            vw = sums[8, col] - n * mean_v * mean_w
            determinant = uu * vv - uv * uv
            if n * determinant <= np.float32(0.5):
                continue
            slope_u = (uw * vv - vw * uv) / determinant
            slope_v = (vw * uu - uw * uv) / determinant
            squares = sums[9, col] - n * mean_w * mean_w - slope_u * uw - slope_v * vw
            planes[0, row, col] = slope_u
            planes[1, row, col] = slope_v
            planes[2, row, col] = own[col] + mean_w - slope_u * mean_u - slope_v * mean_v
            planes[3, row, col] = max(squares, zero) / max(n - np.float32(3.0), one)
    return planes


@njit(cache=True)
def _steadiest(image, planes, radius, limit, trusted):  # type: ignore[no-untyped-def]
    """For each pixel whose window varies beyond the limit, the plane of the steadiest one next to it."""
    height, width = image.shape
    chosen = planes[:3].copy()
    zero = np.float32(0.0)
    for row in range(height):
        for col in range(width):
            own = image[row, col]
            known = planes[2, row, col] > zero
            if own <= zero or (known and planes[3, row, col] <= limit):
                continue
            least = planes[3, row, col] if known else limit
            for dv in (-radius, 0, radius):
                for du in (-radius, 0, radius):
                    y, x = row + dv, col + du
                    if not (0 <= y < height and 0 <= x < width):
                        continue
                    if planes[2, y, x] <= zero or planes[3, y, x] >= least:
                        continue
                    slope_u, slope_v = planes[0, y, x], planes[1, y, x]
                    here = planes[2, y, x] - slope_u * np.float32(du) - slope_v * np.float32(dv)
                    if here > zero and abs(here - own) <= trusted:
                        least = planes[3, y, x]
                        chosen[0, row, col] = slope_u
                        chosen[1, row, col] = slope_v
                        chosen[2, row, col] = here
    return chosen
