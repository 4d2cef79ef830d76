"""How far a benchmark is, said to terminals and to logs."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from caryatid.cli.episode_bar import EpisodeBar, pace


@pytest.mark.parametrize(
    ("done", "missing", "seconds", "told"),
    [
        (0, 5, 10.0, ""),
        (20, 40, 60.0, "20 a minute, 0:02:00 left"),
        (1, 2, 120.0, "30 an hour, 0:04:00 left"),
        (24, 24 * 60, 3600.0, "24 an hour, 2 days, 12:00:00 left"),
        (20, 0, 60.0, "20 a minute"),
    ],
)
def test_pace_is_told_in_words(done, missing, seconds, told):
    assert pace(done, missing, seconds) == told


def said(*, terminal, before=0, every=60.0, quiet=False, dumb=False):
    """What a bar of 1000 episodes says while three are done."""
    file = io.StringIO()
    environment = {"TERM": "dumb" if dumb else "xterm"}
    console = Console(
        file=file, force_terminal=terminal, width=120, quiet=quiet, highlight=False, _environ=environment
    )
    with EpisodeBar(console, "smoke", 1000, before, every=every) as bar:
        for _ in range(3):
            bar.advance()
        bar.say("failed: [tower]: no luck")
    return file.getvalue()


def test_earlier_runs_do_not_count_for_the_rate():
    file = io.StringIO()
    with EpisodeBar(Console(file=file), "smoke", 1000, before=900, every=0.0) as bar:
        assert file.getvalue() == ""
        bar.advance()
        (line,) = file.getvalue().splitlines()
    assert re.fullmatch(r"smoke: 901 of 1000 episodes, \d+ a minute, 0:00:0\d left", line)


def test_a_log_gets_a_line_now_and_then_and_a_terminal_a_bar():
    assert said(terminal=False, before=5) == "failed: [tower]: no luck\n"
    log = said(terminal=False, every=0.0)
    assert re.findall(r"smoke: (\d) of 1000", log) == ["1", "2", "3"]
    assert "\x1b" not in log
    assert "\r" not in log
    drawn = said(terminal=True, before=500)
    assert re.search(r"smoke.*503/1000.* a minute, .* left", drawn)
    assert "failed: [tower]: no luck" in drawn
    assert "\x1b" not in said(terminal=True, dumb=True)
    assert said(terminal=True, quiet=True) == ""
