"""Where the time of one turn of the loop goes."""

from __future__ import annotations

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
