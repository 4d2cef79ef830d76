from __future__ import annotations

import pytest

from caryatid.runtime import stopwatch
from caryatid.runtime.stopwatch import Stopwatch


def test_each_stage_gets_the_time_since_the_one_before(monkeypatch):
    clock = iter([10.0, 11.0, 13.5, 14.0])
    monkeypatch.setattr(stopwatch, "perf_counter", lambda: next(clock))
    watch = Stopwatch()
    watch.lap("look")
    watch.lap("think")
    watch.lap("look")
    assert watch.laps == pytest.approx({"look": 1.5, "think": 2.5})
