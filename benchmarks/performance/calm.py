"""How many cores other processes held while something was measured: what runs in parallel waits for them."""

from __future__ import annotations

import os
import resource
import time
from pathlib import Path

CORES = Path("/proc/stat")
"""What the machine's cores did since its start; systems without it are taken to be calm."""
WORKING = (0, 1, 2, 5, 6, 7)
"""Columns of its first line in which a core is taken: user, nice, system, irq, softirq, steal."""
CALM = 0.2
"""So many cores taken by others are a system's own business [1]."""


class Watch:
    """Watches the machine from its making on."""

    def __init__(self) -> None:
        self._started, self._others = time.perf_counter(), _others()

    def others(self) -> float:
        """Cores that other processes held since, on average [1]."""
        return max(0.0, (_others() - self._others) / (time.perf_counter() - self._started))


def _others() -> float:
    """Processor time of all but this process and those it waited for [s]."""
    if not CORES.is_file():
        return 0.0
    ticks = CORES.read_text(encoding="ascii").split("\n", 1)[0].split()[1:]
    own = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    taken = sum(int(ticks[k]) for k in WORKING) / os.sysconf("SC_CLK_TCK")
    return taken - sum(use.ru_utime + use.ru_stime for use in own)
