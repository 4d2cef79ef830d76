"""Compiled tangent planes at some pixels of a depth image, beside the plain reference they are held to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array

Image = NDArray[np.float32]

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


class Window(NamedTuple):
    """Which readings around a pixel are its surface's.

    Attributes:
        radius: The window is 2·radius + 1 pixels wide [px].
        tolerance: Distance from the plane within which a reading is its own [1/m].
        slope: Added to it a pixel of distance [1/m per px].
    """

    radius: int
    tolerance: float
    slope: float


def tangent_planes(inverse_depth: Image, pixels: NDArray[np.intp], narrow: Window, wide: Window) -> Array:
    """Fit a plane to the surface around each pixel that ends at its creases.

    Each plane is 1/z = c + a·du + b·dv about its pixel, by least squares: first to the readings of a narrow
    window that lie near the pixel's own, then in two rounds to those of a wide one that lie near the plane.
    Where a wide window determines none, the plane stays as it was.

    Args:
        inverse_depth: 1/z (H, W) [1/m], 0 = no reading.
        pixels: Row and column (N, 2) of each plane; all hold a reading.
        narrow: Readings of the first plane.
        wide: Readings it is refined to.

    Returns:
        c, a, b (N, 3) [1/m, 1/m per px]; zero where readings are too few for a first plane.
    """
    image = np.ascontiguousarray(inverse_depth, dtype=np.float32)
    planes = np.zeros((len(pixels), 3))
    _fit_planes(image, np.ascontiguousarray(pixels, dtype=np.intp), np.array([narrow, wide]), planes)
    return planes


def tangent_planes_reference(
    inverse_depth: Image, pixels: NDArray[np.intp], narrow: Window, wide: Window
) -> Array:
    """Do as `tangent_planes` does, one plane after the other by `numpy.linalg`."""
    planes = np.zeros((len(pixels), 3))
    for number, (row, column) in enumerate(pixels):
        own = float(inverse_depth[row, column])
        least = LEAST_SHARE * (2 * narrow.radius + 1) ** 2
        first = _refitted_reference(
            inverse_depth, row, column, np.array([own, 0, 0]), narrow, least, ON_A_LINE
        )
        if first is None or first[0] <= 0.0:
            continue
        plane = np.array([own, *(first[1:] * own / first[0])])
        for _ in range(ROUNDS):
            refined = _refitted_reference(inverse_depth, row, column, plane, wide, LEAST_TAPS, LEAST_SPREAD)
            plane = plane if refined is None else refined
        planes[number] = plane
    return planes


def _refitted_reference(
    image: Image, row: int, column: int, plane: Array, window: Window, least: float, spread: float
) -> Array | None:
    """Do as `_refit` does; None where the readings determine no plane."""
    side = 2 * window.radius + 1
    padded = np.pad(image.astype(np.float64), window.radius)
    readings = padded[row : row + side, column : column + side].ravel()
    dv, du = (g.ravel().astype(np.float64) - window.radius for g in np.mgrid[:side, :side])
    terms = np.stack([np.ones_like(du), du, dv], axis=-1)
    allowed = window.tolerance + window.slope * np.maximum(np.abs(du), np.abs(dv))
    near = (readings > 0.0) & (np.abs(readings - terms @ plane) <= allowed)
    count = int(near.sum())
    if count < least or np.linalg.det(np.cov(terms[near, 1:].T, ddof=0)) < spread / count:
        return None
    refitted: Array = np.linalg.lstsq(terms[near], readings[near], rcond=None)[0]
    return refitted


@njit(cache=True, parallel=True)
def _fit_planes(image: Image, pixels: NDArray[np.intp], windows: Array, planes: Array) -> None:
    """Do for each pixel as `tangent_planes` says."""
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
    image: Image, row: int, column: int, window: Array, least: float, spread: float, plane: Array
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
