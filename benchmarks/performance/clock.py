"""Durations of calls that take turns, so that the machine's mood meets all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TypeVar

T = TypeVar("T")

PAUSE = 0.02
"""Before each run [s]: the threads of what ran before have stopped waiting for more work by then."""


def timed(call: Callable[[], T], *, warm: bool = True) -> tuple[float, T]:
    """Time one call, after a pause.

    Args:
        call: What to time.
        warm: Call it once right before: compiled, its threads awake, its data in the caches.

    Returns:
        Seconds, and what it returned.
    """
    time.sleep(PAUSE)
    if warm:
        call()
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def in_turns(calls: Mapping[str, Callable[[], object]], runs: int) -> dict[str, list[float]]:
    """Time some calls, warm, one after the other and all of them again.

    Args:
        calls: What to call, by name.
        runs: How often.

    Returns:
        Seconds of each run, by name.
    """
    found: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(runs):
        for name, call in calls.items():
            found[name].append(timed(call)[0])
    return found
