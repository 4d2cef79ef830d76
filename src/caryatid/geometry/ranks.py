"""Compiled kernels that find numbers by their rank, for other kernels to call.

NumPy's sort and median do the same; called in a kernel they take ten times as long to compile.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy")
def select(numbers: NDArray[np.float64], rank: int) -> float:
    """The number that comes at this rank among numbers (N,) in ascending order, counted from 0.

    The numbers are put in another order: those before the rank are not greater, those after it not less.
    Where some are not comparable, it is any of them.
    """
    left, right = 0, len(numbers) - 1
    while left < right:
        pivot = numbers[rank]
        i, j = left, right
        while i <= j:
            while numbers[i] < pivot:
                i += 1
            while pivot < numbers[j]:
                j -= 1
            if i <= j:
                numbers[i], numbers[j] = numbers[j], numbers[i]
                i += 1
                j -= 1
        if j < rank:
            left = i
        if rank < i:
            right = j
    return numbers[rank]


@njit(cache=True, error_model="numpy")
def quantile(numbers: NDArray[np.float64], share: float) -> float:
    """Quantile of numbers (N,), between two of them in proportion; they are put in another order."""
    place = share * (len(numbers) - 1)
    rank = int(place)
    below = select(numbers, rank)
    if rank + 1 >= len(numbers):
        return below
    above = np.inf
    for k in range(rank + 1, len(numbers)):
        above = min(above, numbers[k])
    return below + (place - rank) * (above - below)
