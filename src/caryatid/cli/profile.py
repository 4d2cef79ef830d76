"""`--profile`: where the time of a run went, by stage and by view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich import box
from rich.table import Table

from caryatid.cli.consoles import result_console
from caryatid.runtime.stopwatch import StageTime, by_stage

WAITING = ("capture",)
"""Stages that wait for the camera: no part of the turn."""


def profile_record(steps: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the JSON document gets: times in seconds, shares of the turn.

    Args:
        steps: Of each view its number and its timings [s], as run.json has them.
    """
    stages, turn = _profile(steps)
    views = [{"view": step["view"]} | _laps(step) for step in steps]
    return {"profile": {"stages": [asdict(s) for s in stages], "turn": asdict(turn), "views": views}}


def print_profile(steps: Sequence[Mapping[str, Any]]) -> None:
    """Print two tables to stdout: time by stage over the views, and of every view [ms].

    Args:
        steps: Of each view its number and its timings [s], as run.json has them.
    """
    stages, turn = _profile(steps)
    table = _table("time by stage [ms]", ["stage", "median", "highest", "share"])
    table.columns[0].justify = "left"
    for s in stages:
        table.add_row(s.stage, _milliseconds(s.median), _milliseconds(s.highest), _percent(s.share))
    table.add_section()
    table.add_row(turn.stage, _milliseconds(turn.median), _milliseconds(turn.highest))
    views = _table("time by view [ms]", ["view", *(s.stage for s in stages), turn.stage])
    for step in steps:
        laps = _laps(step)
        times = [laps.get(s.stage) for s in stages]
        views.add_row(f"{step['view']:02d}", *map(_milliseconds, [*times, _turn(laps)]))
    console = result_console()
    console.print(table)
    console.print(views)


def _profile(steps: Sequence[Mapping[str, Any]]) -> tuple[list[StageTime], StageTime]:
    """Stages in their order, and the whole turn."""
    laps = [_laps(step) for step in steps]
    return by_stage(laps, beside=WAITING), by_stage([{"turn": _turn(lap)} for lap in laps])[0]


def _laps(step: Mapping[str, Any]) -> dict[str, float]:
    """Stages of a view [s]; where the loop stops nothing is planned."""
    return {k: v for k, v in step["timings"].items() if k != "plan" or not step.get("stop")}


def _turn(laps: Mapping[str, float]) -> float:
    return sum(seconds for stage, seconds in laps.items() if stage not in WAITING)


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1000.0 * seconds:.1f}"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100.0 * share:.0f} %"
