"""Compiled kernel that finds where points end: the likeliest end of an even density blurred by noise.

The tests hold a NumPy reference.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

HALVINGS = 14
"""Bisections of the search for the end: to 12 σ / 2¹⁴."""
ROUNDS = 3
"""How often density and end are found from one another; they change by a hundredth of σ in the last."""


@njit(cache=True, error_model="numpy")
def likeliest_end(
    coordinates: NDArray[np.float64], start: float, sigma: float, window: float, growing: bool, stray: float
) -> tuple[float, float]:
    """Upper end [m] of points whose density is even up to it, and its standard deviation [m].

    With Gaussian noise the density near an end e is c·Φ((e − u)/σ). Its likelihood is greatest where
    Σ φ(z)/Φ(z) = c·σ with z = (e − u)/σ; half a density c and e are found in turn, c within a window below e.

    Args:
        coordinates: (N,) [m].
        start: Where to begin [m], within a few σ of the end.
        sigma: Standard deviation of the noise along the coordinate [m].
        window: Length over which the density is measured [m].
        growing: The density grows with the coordinate, as on a disc along its radius.
        stray: Density beyond the end, as a share of that within: one stray point weighs little against a rim.

    Returns:
        The end and its standard deviation.
    """
    near, close = 0, np.empty(len(coordinates))
    for i in range(len(coordinates)):
        if coordinates[i] > start - window - 12.0 * sigma:
            close[near] = coordinates[i]
            near += 1
    end = start
    density = 0.0
    for _ in range(ROUNDS):
        top = end - 2.0 * sigma
        count = 0
        for i in range(near):
            u = close[i]
            if top - window < u <= top:
                count += 1
        density = max(count, 1) / window
        if growing:
            density *= end / max(top - window / 2.0, 1e-6)
        low, high = end - 6.0 * sigma, end + 6.0 * sigma
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            slope = -density * sigma
            for i in range(near):
                u = close[i]
                z = (middle - u) / sigma
                if -6.0 < z < 4.5:
                    within = 0.5 * math.erfc(-z * 0.7071067811865476)
                    slope += 0.3989422804014327 * math.exp(-0.5 * z * z) / (within + stray)
            if slope > 0.0:
                low = middle
            else:
                high = middle
        end = 0.5 * (low + high)
    return end, np.sqrt(sigma / (0.9 * density))
