"""How far a benchmark is: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import time
from datetime import timedelta
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

EVERY = 60.0
"""Where there is no terminal, a line at most this often [s]."""


class EpisodeBar:
    """Says how many episodes are done, how fast they are and how long it will take.

    Args:
        console: Where to.
        name: Of the suite.
        total: Episodes it has.
        before: Episodes that were done by earlier runs; they do not count for the rate.
        every: Where there is no terminal, a line at most this often [s].
    """

    def __init__(
        self, console: Console, name: str, total: int, before: int = 0, *, every: float = EVERY
    ) -> None:
        self._console, self._every = console, every
        self._name, self._total, self._before, self._done = name, total, before, before
        self._start = self._told = time.monotonic()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Pace(before))
        shown = console.is_interactive and not console.quiet
        self._bar = Progress(*columns, console=console, disable=not shown)
        self._task = self._bar.add_task(name, total=total, completed=before)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def advance(self) -> None:
        """Count one more."""
        self._done += 1
        self._bar.advance(self._task)
        now = time.monotonic()
        if self._bar.disable and now - self._told >= self._every:
            self._told = now
            told = pace(self._done - self._before, self._total - self._done, now - self._start)
            self.say(f"{self._name}: {self._done} of {self._total} episodes, {told}")

    def say(self, text: str) -> None:
        """Write a line."""
        self._console.print(text, markup=False)


def pace(done: int, missing: int, seconds: float) -> str:
    """Rate and time left in words; nothing where nothing is done yet.

    Args:
        done: Episodes of this run.
        missing: Episodes still to do.
        seconds: Since this run began [s].
    """
    if done == 0 or seconds <= 0.0:
        return ""
    a_minute = 60.0 * done / seconds
    rate = f"{a_minute:.0f} a minute" if a_minute >= 10.0 else f"{60.0 * a_minute:.0f} an hour"
    left = timedelta(seconds=round(missing * seconds / done))
    return f"{rate}, {left} left" if missing else rate


class _Pace(ProgressColumn):
    """Rate and time left of this run."""

    def __init__(self, before: int) -> None:
        super().__init__()
        self._before = before

    def render(self, task: Task) -> Text:
        done = int(task.completed) - self._before
        return Text(pace(done, int(task.remaining or 0), task.elapsed or 0.0))
