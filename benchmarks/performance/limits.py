"""What bounds the stages from below: one pass over their data, or the arithmetic that cannot be avoided."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numba
import numpy as np
from numba import njit, prange

from caryatid.geometry.transforms import Array
from performance.clock import in_turns

TRIAD = 16_000_000
"""Numbers in each array of the triad [1]: 128 MB, four times a large cache."""
PRODUCT = 1500
"""Rows of the matrices whose product is timed [1]."""
RUNS = 9
"""Runs of each; the best counts: a limit is what the machine can do."""


@dataclass(frozen=True, slots=True)
class Machine:
    """What the machine can do, with all its cores.

    Attributes:
        bandwidth: Of its memory [B/s], both ways.
        arithmetic: Multiplications and additions of float64 [1/s].
        threads: Numba's.
    """

    bandwidth: float
    arithmetic: float
    threads: int

    def limit(self, size: float, operations: float = 0.0) -> tuple[str, float]:
        """Which of the two takes longer, and how long.

        Args:
            size: Bytes read and written.
            operations: Multiplications and additions.

        Returns:
            What it is the time of, and that time [s].
        """
        passing, computing = size / self.bandwidth, operations / self.arithmetic
        if computing > passing:
            return f"{_amount(operations)}flop", computing
        return f"{_amount(size)}B", passing


@cache
def machine() -> Machine:
    """Measure the machine: the triad a = b + s·c in memory, and a product of matrices."""
    a, b, c = (np.full(TRIAD, v) for v in (0.0, 1.0, 2.0))
    M = np.random.default_rng(0).normal(size=(PRODUCT, PRODUCT))
    found = in_turns({"triad": lambda: triad(a, b, c, 3.0), "product": lambda: M @ M}, RUNS)
    return Machine(
        3 * a.nbytes / min(found["triad"]), 2 * PRODUCT**3 / min(found["product"]), numba.get_num_threads()
    )


@njit(parallel=True)
def triad(a: Array, b: Array, c: Array, s: float) -> None:
    """Set a to b + s·c."""
    for i in prange(len(a)):
        a[i] = b[i] + s * c[i]


def points_limit(pixels: int, points: int) -> tuple[float, float]:
    """Bytes and operations of oriented points: depth in; place, normal and pixel of each point out.

    A plane through each pixel's window takes six running sums over rows and columns, and a solution of three
    unknowns.
    """
    return 4.0 * pixels + 56.0 * points, (6 * 4 + 40.0) * pixels


def fit_limit(points: int, parameters: int = 9, shapes: int = 3) -> tuple[float, float]:
    """Bytes and operations of a fit: each shape judged once, and one step of least squares of the best.

    A judgement is a distance and an agreement of normals, 20 operations a point; a step is a distance, its
    derivatives and their products.
    """
    step = 20.0 + 2.0 * parameters + parameters * (parameters + 1.0)
    return 48.0 * points, points * (20.0 * shapes + step)


def map_limit(pixels: int, voxels: int) -> tuple[float, float]:
    """Bytes of a voxel map's update: depth in, two counts of each voxel in and out."""
    return 4.0 * pixels + 4.0 * voxels, 0.0


def plan_limit(voxels: int, candidates: int, samples: int, looks: int) -> tuple[float, float]:
    """Bytes and operations of a decision: the map's states and the candidates' poses once.

    Each of the samples is turned to each of the looks, 20 operations.
    """
    return voxels + 152.0 * candidates, 20.0 * samples * looks


def _amount(count: float) -> str:
    """A number with the prefix of its unit."""
    for prefix in ("", "k", "M"):
        if count < 1000.0:
            return f"{count:.3g} {prefix}"
        count /= 1000.0
    return f"{count:.3g} G"
