from __future__ import annotations

import pytest

from caryatid.runtime import stopwatch
from caryatid.runtime.stopwatch import StageTime, Stopwatch, by_stage


def test_each_stage_gets_the_time_since_the_one_before(monkeypatch):
    clock = iter([10.0, 11.0, 13.5, 14.0])
    monkeypatch.setattr(stopwatch, "perf_counter", lambda: next(clock))
    watch = Stopwatch()
    watch.lap("look")
    watch.lap("think")
    watch.lap("look")
    assert watch.laps == pytest.approx({"look": 1.5, "think": 2.5})


def test_times_by_stage_are_over_the_turns_that_have_them():
    turns = [{"wait": 9.0, "look": 1.0, "think": 3.0}, {"wait": 1.0, "look": 2.0}, {"look": 6.0}]
    wait, look, think = by_stage(turns, beside=("wait",))
    assert wait == StageTime("wait", median=5.0, highest=9.0, share=None)
    assert look == StageTime("look", median=2.0, highest=6.0, share=pytest.approx(9.0 / 12.0))
    assert think == StageTime("think", median=3.0, highest=3.0, share=pytest.approx(3.0 / 12.0))
    assert by_stage([]) == []
    assert by_stage([{"look": 0.0}]) == [StageTime("look", 0.0, 0.0, None)]
