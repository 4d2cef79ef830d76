"""Compiled refinement of tangent planes on a depth image, beside the plain reference it is held to."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.frames import Array

Image = NDArray[np.float32]

LEAST_TAPS = 9
"""Readings a plane is refined from at the least [1]; three determine it, three times as many even it out."""
LEAST_SPREAD = 12.0
"""Least determinant of their spread per reading [px⁴]; readings on a line determine no plane."""


def refine_planes(
    inverse_depth: Image,
    pixels: NDArray[np.intp],
    planes: Array,
    radius: int,
    tolerance: float,
    rounds: int,
) -> Array:
    """Refit planes to the readings of a wide window that lie on them, so that they end at creases.

    Each plane is 1/z = c + a·du + b·dv about its pixel. In each round it is fitted afresh to those readings
    of the window that lie within the tolerance of it; where these determine none it stays as it was.

    Args:
        inverse_depth: 1/z (H, W) [1/m], 0 = no reading.
        pixels: Row and column (N, 2) of each plane.
        planes: c, a, b (N, 3) [1/m, 1/m per px].
        radius: The window is 2·radius + 1 pixels wide [px].
        tolerance: Distance within which a reading is the plane's [1/m].
        rounds: How many times.

    Returns:
        The refined planes (N, 3).
    """
    image = np.ascontiguousarray(inverse_depth, dtype=np.float32)
    refined = np.array(planes, dtype=np.float64)
    _refine(image, np.asarray(pixels, dtype=np.intp), refined, radius, tolerance, rounds)
    return refined


def refine_planes_reference(
    inverse_depth: Image,
    pixels: NDArray[np.intp],
    planes: Array,
    radius: int,
    tolerance: float,
    rounds: int,
) -> Array:
    """Do as `refine_planes` does, one plane after the other by `numpy.linalg`."""
    refined = np.array(planes, dtype=np.float64)
    padded = np.pad(inverse_depth.astype(np.float64), radius)
    dv, du = (g.ravel() for g in np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(np.float64))
    terms = np.stack([np.ones_like(du), du, dv], axis=-1)
    for number, (row, column) in enumerate(pixels):
        readings = padded[row : row + 2 * radius + 1, column : column + 2 * radius + 1].ravel()
        for _ in range(rounds):
            near = (readings > 0.0) & (np.abs(readings - terms @ refined[number]) <= tolerance)
            count = int(near.sum())
            if count < LEAST_TAPS or np.linalg.det(np.cov(terms[near, 1:].T, ddof=0)) < LEAST_SPREAD / count:
                break
            refined[number] = np.linalg.lstsq(terms[near], readings[near], rcond=None)[0]
    return refined


@njit(cache=True)
def _refine(image, pixels, planes, radius, tolerance, rounds):  # type: ignore[no-untyped-def]
    height, width = image.shape
    for number in range(len(pixels)):
        row, column = pixels[number]
        for _ in range(rounds):
            c, a, b = planes[number, 0], planes[number, 1], planes[number, 2]
            n = su = sv = suu = suv = svv = sw = suw = svw = 0.0
            for v in range(max(row - radius, 0), min(row + radius + 1, height)):
                dv = float(v - row)
                for u in range(max(column - radius, 0), min(column + radius + 1, width)):
                    du = float(u - column)
                    off = image[v, u] - (c + a * du + b * dv)
                    if image[v, u] > 0.0 and abs(off) <= tolerance:
                        n += 1.0
                        su += du
                        sv += dv
                        suu += du * du
                        suv += du * dv
                        svv += dv * dv
                        sw += off
                        suw += du * off
                        svw += dv * off
            if n < LEAST_TAPS:
                break
            mean_u, mean_v, mean_w = su / n, sv / n, sw / n
            uu, uv, vv = suu / n - mean_u * mean_u, suv / n - mean_u * mean_v, svv / n - mean_v * mean_v
            uw, vw = suw / n - mean_u * mean_w, svw / n - mean_v * mean_w
            determinant = uu * vv - uv * uv
            if determinant < LEAST_SPREAD / n:
                break
            slope_u = (uw * vv - vw * uv) / determinant
            slope_v = (vw * uu - uw * uv) / determinant
            planes[number, 0] = c + mean_w - slope_u * mean_u - slope_v * mean_v
            planes[number, 1] = a + slope_u
            planes[number, 2] = b + slope_v
