"""How much is measured: all that the page is made of, or enough to see that nothing is broken."""

from __future__ import annotations

from dataclasses import dataclass

from performance.rows import LEAST_RUNS


@dataclass(frozen=True, slots=True)
class Effort:
    """How many runs, and up to which sizes.

    Attributes:
        runs: Of each figure at the least [1].
        repeats: Times all views of the turn are gone through after the warm-up [1].
        points: Numbers of points that fits are measured with.
        widths: Of images [px] for growth with points: 77 thousand to 1.2 million pixels.
        objects: On the table.
        voxels: Their edges [m]: 40 thousand to 20 million of them.
        views: Seen one after the other [1].
    """

    runs: int = LEAST_RUNS
    repeats: int = 3
    points: tuple[int, ...] = (1000, 5000, 20_000)
    widths: tuple[int, ...] = (320, 452, 640, 904, 1280)
    objects: tuple[int, ...] = (5, 10, 20, 40, 70, 100)
    voxels: tuple[float, ...] = (0.04, 0.02, 0.01, 0.005)
    views: int = 200


FULL = Effort()
"""What the targets speak of."""
QUICK = Effort(2, 1, (5000,), (320, 640), (5, 10, 20), (0.02, 0.01), 30)
"""A look while something is worked on; its figures are no medians to compare."""
