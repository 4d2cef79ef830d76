"""Where the time of one turn of the loop goes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from time import perf_counter


class Stopwatch:
    """Measures consecutive stages.

    Attributes:
        laps: Stage → seconds it took.
    """

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._started = perf_counter()

    def lap(self, stage: str) -> None:
        """End a stage; the next one starts now."""
        now = perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + now - self._started
        self._started = now


@dataclass(frozen=True, slots=True)
class StageTime:
    """What a stage took over several turns.

    Attributes:
        stage: Its name.
        median: Of the turns that have it [s].
        highest: Of the turns that have it [s].
        share: Part of all turns' time it took [1], or None for what is no part of a turn.
    """

    stage: str
    median: float
    highest: float
    share: float | None


def by_stage(turns: Sequence[Mapping[str, float]], *, beside: Collection[str] = ()) -> list[StageTime]:
    """Times by stage, in the order the stages first come in.

    Args:
        turns: Stage → seconds it took, of every turn.
        beside: Stages that are no part of the turn, and have no share in it.
    """
    times: dict[str, list[float]] = {}
    for turn in turns:
        for stage, seconds in turn.items():
            times.setdefault(stage, []).append(seconds)
    whole = sum(sum(t) for stage, t in times.items() if stage not in beside)
    return [
        StageTime(stage, median(t), max(t), None if stage in beside or whole <= 0.0 else sum(t) / whole)
        for stage, t in times.items()
    ]
