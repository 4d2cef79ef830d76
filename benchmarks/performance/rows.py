"""A row: a figure of ours beside the peer's and the machine's limit, and whether it is what is asked for."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from measures import Measure

LEAST_RUNS = 7
"""Runs a median is taken of at the least [1]."""
TOLERANCE = 0.3
"""How much worse a ratio may become before the gate fails, as a share of itself [1]; they differ by a tenth
between runs."""
EXPONENT_TOLERANCE = 0.15
"""The same of an exponent of growth [1]."""
Figure = Literal["value", "to_peer", "to_limit"]


@dataclass(frozen=True, slots=True)
class Target:
    """What is asked of a row.

    Attributes:
        at_most: The figure may not be larger.
        figure: Which of the row's figures.
        aim: What is aimed at beyond it.
    """

    at_most: float
    figure: Figure = "to_peer"
    aim: float | None = None


@dataclass(frozen=True, slots=True)
class Median:
    """What some runs come to.

    Attributes:
        value: The middle one.
        spread: Between the quartiles.
        runs: How many.
    """

    value: float
    spread: float
    runs: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Median:
        """Sum up runs, one at least."""
        low, middle, high = np.percentile(np.asarray(values, dtype=np.float64), (25.0, 50.0, 75.0))
        return cls(float(middle), float(high - low), len(values))


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table.

    Attributes:
        name: Of the row, its group before the first dot.
        what: In words.
        value: Ours, a median; None where it could not be measured.
        unit: Of the value, the peer's and the limit's: `ms`, `s`, `deg`, `mm`, `MB`, or `1` for exponents.
        spread: Between the quartiles of the runs, in the unit.
        runs: How many the value is the median of.
        peer: What it is compared with; empty where there is nothing.
        peer_value: The peer's figure, or None where it could not be measured.
        limit: What bounds it from below: a pass over the data, or arithmetic.
        limit_value: How little it could be.
        target: What is asked of it.
        note: Why something is missing, or what else was found.
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
    target: Target | None = None
    note: str = ""

    @property
    def group(self) -> str:
        """What stands before the first dot of the name."""
        return self.name.split(".")[0]

    @property
    def to_peer(self) -> float | None:
        """Ours in peers: 0.5 is half of it."""
        return _ratio(self.value, self.peer_value)

    @property
    def to_limit(self) -> float | None:
        """Ours in limits: 1 is the limit."""
        return _ratio(self.value, self.limit_value)

    @property
    def met(self) -> bool | None:
        """Whether the row is what is asked for; None where nothing is, or it could not be measured."""
        figure = None if self.target is None else getattr(self, self.target.figure)
        return None if self.target is None or figure is None else bool(figure <= self.target.at_most)


def timed_row(
    name: str,
    what: str,
    ours: Median,
    *,
    peer: str = "",
    theirs: Median | None = None,
    limit: tuple[str, float] | None = None,
    target: Target | None = None,
    note: str = "",
) -> Row:
    """Make a row of durations, in milliseconds.

    Args:
        name: Of the row.
        what: In words.
        ours: Our runs.
        peer: What it is compared with.
        theirs: The peer's runs, or None where it could not be measured.
        limit: What bounds it from below and how little that is [s].
        target: What is asked of it.
        note: What else there is to say.
    """
    return Row(
        name,
        what,
        1e3 * ours.value,
        "ms",
        1e3 * ours.spread,
        ours.runs,
        peer,
        None if theirs is None else 1e3 * theirs.value,
        "" if limit is None else limit[0],
        None if limit is None else 1e3 * limit[1],
        target,
        note,
    )


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Exponent of the power of the size that the values grow with: least squares on both logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def missed(rows: Iterable[Row]) -> list[Row]:
    """Rows that are not what is asked for."""
    return [row for row in rows if row.met is False]


def measures(rows: Iterable[Row]) -> list[Measure]:
    """What the gate compares: ratios of durations and exponents, which are much the same on another machine.

    Errors of fits have a gate of their own (`fits.py`); peers' vary from run to run.
    """
    found = []
    for row in rows:
        for figure in ("to_peer", "to_limit") if row.unit == "ms" else ():
            ratio = getattr(row, figure)
            if ratio is not None:
                found.append(Measure(f"{row.name}.{figure}", ratio, "1", "lower", TOLERANCE * ratio))
        if row.unit == "1" and row.value is not None:
            found.append(Measure(row.name, row.value, "1", "lower", EXPONENT_TOLERANCE))
    return found


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference
