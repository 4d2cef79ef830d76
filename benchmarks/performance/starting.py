"""Start-up: importing, the command's help, and the first views when nothing is compiled yet."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from performance.effort import FULL, Effort
from performance.rows import Median, Row, Target

SCRIPT = Path(__file__).with_name("first_view.py")
IMPORT = "import time; t = time.perf_counter(); import caryatid; print(time.perf_counter() - t)"
WARM = 3
"""Runs of the first views with everything compiled."""


def measure_start(effort: Effort = FULL) -> list[Row]:
    """Rows of start-up."""
    importing = [float(_run("-c", IMPORT)) for _ in range(effort.runs + 1)][1:]
    helping = []
    for _ in range(effort.runs + 1):
        started = time.perf_counter()
        _run("-m", "caryatid", "--help")
        helping.append(time.perf_counter() - started)
    with tempfile.TemporaryDirectory() as cache:
        cold, *warm = (
            float(_run(str(SCRIPT), NUMBA_CACHE_DIR=cache)) for _ in range(1 + min(WARM, effort.runs))
        )
    views = "two views with automatic parts, two with labels"
    again = Median.of(warm)
    return [
        _seconds("start.import", "import caryatid", Median.of(importing), 0.5),
        _seconds("start.help", "caryatid --help", Median.of(helping[1:]), 0.4),
        _seconds("start.first", f"first use, nothing compiled: {views}", Median.of([cold]), 20.0),
        _seconds("start.compile", "of it, compiling", Median.of([cold - again.value]), 20.0),
        _seconds("start.again", "the same in a new process, compiled", again, None),
    ]


def _seconds(name: str, what: str, took: Median, at_most: float | None) -> Row:
    target = None if at_most is None else Target(at_most, "value")
    return Row(name, what, took.value, "s", took.spread, took.runs, target=target)


def _run(*arguments: str, **environment: str) -> str:
    """Run Python and return what it printed.

    Raises:
        subprocess.CalledProcessError: It failed.
    """
    done = subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout
