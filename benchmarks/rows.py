"""Rows of the performance table: our time beside the peer's and the machine's limit, and the target."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar

import numba
import numpy as np
import pandas as pd
from measures import Measure
from numba import njit, prange

from caryatid.geometry.transforms import Array

T = TypeVar("T")
PAUSE = 0.02
"""Pause before each timed run [s]: after it, the threads of the previous run no longer wait for work."""
TOLERANCE, EXPONENT_TOLERANCE = 0.3, 0.15
"""By how much a ratio (as a share of itself) or an exponent of growth may get worse [1]."""
NOTHING, MISSED = "–", "missed"
Limit = tuple[float, float]
"""Minimum bytes that a stage reads and writes, and its minimum number of multiplications and additions."""


@dataclass(frozen=True, slots=True)
class Effort:
    """Number of runs; sizes of fits [points], images [px], tables [objects], voxels [m]; views; recordings.

    `crowd` is the number of objects on a large table.
    """

    runs: int = 7
    points: tuple[int, ...] = (1000, 5000, 20_000)
    widths: tuple[int, ...] = (320, 452, 640, 904, 1280)
    objects: tuple[int, ...] = (5, 10, 20, 40, 70, 100)
    voxels: tuple[float, ...] = (0.04, 0.02, 0.01, 0.005)
    views: int = 500
    crowd: int = 300
    real: Path = Path(__file__).parents[2] / "shared/data/real"


FULL = Effort()
QUICK = Effort(2, (5000,), (320, 640), (5, 10, 20), (0.02, 0.01), 30, 40)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table.

    Attributes:
        name: Name; its group precedes the first dot.
        what: Description.
        value: Our figure, a median; None if it could not be measured.
        unit: Unit of all values: `ms`, `s`, `deg`, `mm`, `%`, `MB`, or `1` for exponents.
        spread: Range between the quartiles of the runs, in the unit.
        runs: Number of runs behind the median.
        peer: What ours is compared with.
        peer_value: The peer's figure; None if it could not be measured.
        limit: What bounds the value from below: a pass over the data, or arithmetic.
        limit_value: Lower bound of the value.
        target: Maximum of the value or, if there is a peer, of the ratio to the peer's.
        note: Why something is missing, or other findings.
    """

    name: str
    what: str
    value: float | None
    unit: str = "ms"
    spread: float = 0.0
    runs: int = 1
    peer: str = ""
    peer_value: float | None = None
    limit: str = ""
    limit_value: float | None = None
    target: float | None = None
    note: str = ""

    @property
    def to_peer(self) -> float | None:
        """Our value divided by the peer's."""
        return None if self.value is None or not self.peer_value else self.value / self.peer_value

    @property
    def to_limit(self) -> float | None:
        """Our value divided by the limit."""
        return None if self.value is None or not self.limit_value else self.value / self.limit_value

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None without a target or a figure."""
        figure = self.to_peer if self.peer else self.value
        return None if self.target is None or figure is None else figure <= self.target

    def cells(self) -> dict[str, str]:
        """Return the columns of the table."""
        verdict = {True: "met", False: MISSED, None: "not measured"}[self.met]
        asked = NOTHING
        if self.target is not None:
            asked = f"≤ {_ratio(self.target) if self.peer else _figure(self.target, self.unit)} {verdict}"
        return {
            "row": self.name,
            "what": self.what,
            "ours": _figure(self.value, self.unit),
            "spread": _figure(self.spread, self.unit) if self.runs > 1 and self.unit != "1" else NOTHING,
            "runs": str(self.runs),
            "peer": self.peer or NOTHING,
            "theirs": _figure(self.peer_value, self.unit),
            "to peer": _ratio(self.to_peer),
            "pass of": self.limit or NOTHING,
            "to limit": _ratio(self.to_limit),
            "target": asked,
            "note": self.note or NOTHING,
        }


def table_of_rows(rows: Iterable[Row]) -> pd.DataFrame:
    """Return the table, one line per row."""
    return pd.DataFrame([row.cells() for row in rows])


def timed_row(
    name: str,
    what: str,
    ours: Sequence[float],
    *,
    peer: str = "",
    theirs: Sequence[float] = (),
    limit: Limit | None = None,
    target: float | None = None,
    note: str = "",
) -> Row:
    """Make a row, in milliseconds, from the durations [s] of our runs and of a peer's."""
    value, spread = median([1e3 * t for t in ours])
    peer_value = median([1e3 * t for t in theirs])[0] if theirs else None
    bound, least = ("", None) if limit is None else limit_of(*limit)
    return Row(name, what, value, "ms", spread, len(ours), peer, peer_value, bound, least, target, note)


def median(values: Sequence[float]) -> tuple[float, float]:
    """Return the median of the values, and the range between their quartiles."""
    low, middle, high = np.percentile(values, (25.0, 50.0, 75.0))
    return float(middle), float(high - low)


def measures(rows: Iterable[Row]) -> list[Measure]:
    """Return what the gate compares: ratios of durations, and exponents; machines differ little in them."""
    found = []
    for row in rows:
        for figure, ratio in (("to_peer", row.to_peer), ("to_limit", row.to_limit)):
            if row.unit == "ms" and ratio is not None:
                found.append(Measure(f"{row.name}.{figure}", ratio, "1", "lower", TOLERANCE * ratio))
        if row.unit == "1" and row.value is not None:
            found.append(Measure(row.name, row.value, "1", "lower", EXPONENT_TOLERANCE))
    return found


def timed(call: Callable[[], T], *, warm: bool = True) -> tuple[float, T]:
    """Time one call [s] after a pause, and return its result too; a warm call follows an untimed one."""
    time.sleep(PAUSE)
    if warm:
        call()
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def in_turns(calls: Mapping[str, Callable[[], object]], runs: int) -> dict[str, list[float]]:
    """Time warm calls [s] by name, in rounds of all of them."""
    found: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(runs):
        for name, call in calls.items():
            found[name].append(timed(call)[0])
    return found


@cache
def machine() -> dict[str, float]:
    """Measure memory bandwidth [B/s] (triad a = b + s·c), arithmetic [1/s] (matrix product), and threads.

    Both are medians, as our times are: on a virtual machine a single run can be twice as fast.
    """
    a, b, c = (np.full(16_000_000, v) for v in (0.0, 1.0, 2.0))
    M = np.random.default_rng(0).normal(size=(1500, 1500))
    found = in_turns({"triad": lambda: _triad(a, b, c, 3.0), "product": lambda: M @ M}, 25)
    triad, product = (median(found[name])[0] for name in ("triad", "product"))
    bandwidth, arithmetic = 3 * a.nbytes / triad, 2 * 1500**3 / product
    return {"bandwidth": bandwidth, "arithmetic": arithmetic, "threads": numba.get_num_threads()}


@njit(parallel=True)
def _triad(a: Array, b: Array, c: Array, s: float) -> None:
    for i in prange(len(a)):
        a[i] = b[i] + s * c[i]


def limit_of(size: float, operations: float) -> tuple[str, float]:
    """Return the data or the operations, whichever takes longer to process, and the time it takes [ms]."""
    passing, computing = size / machine()["bandwidth"], operations / machine()["arithmetic"]
    count, unit, seconds = (operations, "flop", computing) if computing > passing else (size, "B", passing)
    power = min(int(np.log10(max(count, 1.0)) // 3), 3)
    return f"{count / 1e3**power:.3g} {('', 'k', 'M', 'G')[power]}{unit}", 1e3 * seconds


def _figure(value: float | None, unit: str) -> str:
    return NOTHING if value is None else f"{_digits(value)} {'' if unit == '1' else unit}".rstrip()


def _ratio(value: float | None) -> str:
    """Format a ratio; below one, as a fraction."""
    if value is None:
        return NOTHING
    return f"1/{_digits(1.0 / value)}" if 0.0 < value < 1.0 else f"{_digits(value)} ×"


def _digits(value: float) -> str:
    """Format a number with three significant digits, or with all digits before the decimal point."""
    return f"{value:,.0f}" if abs(value) >= 99.95 else f"{value:.3g}"
