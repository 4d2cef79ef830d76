"""Output: progress on stderr for a person, results on stdout."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from caryatid.evaluation.scores import Score
from caryatid.exploration import Step
from caryatid.graph import SUPPORT_SURFACE_ID, SceneObject, SupportGraph
from caryatid.io.json_files import json_text
from caryatid.runtime.stopwatch import StageTime, by_stage

WAITING = ("capture",)
"""Stages that wait for the camera and are not part of a turn."""


def result_console() -> Console:
    """Stdout, for results."""
    return Console(highlight=False)


def progress_console(silent: bool) -> Console:
    """Stderr, for progress; nothing moves there unless it is a terminal, not even with FORCE_COLOR.

    Args:
        silent: Print nothing.
    """
    moving = None if sys.stderr.isatty() else False
    return Console(
        stderr=True, quiet=silent, highlight=False, emoji=False, soft_wrap=True, force_interactive=moving
    )


def write_json(document: Mapping[str, Any]) -> None:
    """Print the result as one JSON document."""
    sys.stdout.write(json_text(document))


class Progress:
    """Prints what goes on.

    Args:
        silent: Print nothing.
    """

    def __init__(self, silent: bool) -> None:
        self._console = progress_console(silent)

    @contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Show a spinner on a terminal."""
        with self._console.status(what) if self._console.is_interactive else nullcontext():
            yield

    def say(self, text: str) -> None:
        """Print a line."""
        self._console.print(text, markup=False)

    def step(self, step: Step, before: SupportGraph | None, score: Score | None) -> None:
        """Print what a view changed, its score where the ground truth is known, and what comes next."""
        seconds = sum(v for k, v in step.timings.items() if k not in WAITING)
        f1 = "" if score is None else f", F1 {score.f1:.3f}"
        self.say(f"view {step.index:02d}: {summary(step.graph)}{f1} ({seconds:.1f} s)")
        for line in changes(before or SupportGraph(), step.graph):
            self.say(f"  {line}")
        if step.decision is not None:
            self.say(f"  next view: {step.decision.why}")
        if step.stop is not None:
            self.say(f"  done: {step.stop}")


def counted(number: int, what: str) -> str:
    """A number of things in words."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def summary(graph: SupportGraph) -> str:
    """Objects and supports of a graph in a few words."""
    objects = sum(o.role == "object" for o in graph.objects)
    uncertain = sum(not s.certain for s in graph.supports)
    doubt = f" ({uncertain} uncertain)" if uncertain else ""
    return f"{counted(objects, 'object')}, {counted(len(graph.supports), 'support')}{doubt}"


def changes(before: SupportGraph, after: SupportGraph) -> list[str]:
    """What a view changed: a line each for objects found, supported differently, and gone."""
    known = {o.id for o in before.objects}
    present = {o.id for o in after.objects}
    objects = [o for o in after.objects if o.role == "object"]
    found = [f"{o.id} ({o.shape.kind}) {_held(o, after)}" for o in objects if o.id not in known]
    moved = [
        f"{o.id} {_held(o, after)}"
        for o in objects
        if o.id in known and _supporters(o, before) != _supporters(o, after)
    ]
    gone = [o.id for o in before.objects if o.id not in present]
    lines = (("found", found), ("now", moved), ("gone", gone))
    return [f"{kind}: {', '.join(items)}" for kind, items in lines if items]


def _supporters(o: SceneObject, graph: SupportGraph) -> list[str]:
    return sorted(s.supporter for s in graph.supports if s.supported == o.id)


def _held(o: SceneObject, graph: SupportGraph) -> str:
    names = ["the table" if i == SUPPORT_SURFACE_ID else i for i in _supporters(o, graph)]
    return f"held by {' and '.join(names)}" if names else "held by nothing seen yet"


def left_table(title: str, *columns: str) -> Table:
    """A table of numbered rows."""
    table = Table(title=Text(title), title_justify="left")
    table.add_column("", justify="right")
    for column in columns:
        table.add_column(column)
    return table


def profile_record(steps: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What `--profile` adds to the JSON document: times in seconds and shares of a turn.

    Args:
        steps: Number and timings [s] of each view, as in run.json.
    """
    stages, turn = _profile(steps)
    views = [{"view": step["view"]} | step["timings"] for step in steps]
    return {"profile": {"stages": [asdict(s) for s in stages], "turn": asdict(turn), "views": views}}


def print_profile(steps: Sequence[Mapping[str, Any]]) -> None:
    """Print two tables: time by stage over the views, and by view [ms].

    Args:
        steps: Number and timings [s] of each view, as in run.json.
    """
    stages, turn = _profile(steps)
    table = _figures("time by stage [ms]", ["stage", "median", "highest", "share"])
    table.columns[0].justify = "left"
    for s in stages:
        share = "" if s.share is None else f"{100.0 * s.share:.0f} %"
        table.add_row(s.stage, _milliseconds(s.median), _milliseconds(s.highest), share)
    table.add_section()
    table.add_row(turn.stage, _milliseconds(turn.median), _milliseconds(turn.highest))
    views = _figures("time by view [ms]", ["view", *(s.stage for s in stages), turn.stage])
    for step in steps:
        times = [step["timings"].get(s.stage) for s in stages]
        views.add_row(f"{step['view']:02d}", *map(_milliseconds, [*times, _turn(step["timings"])]))
    console = result_console()
    console.print(table)
    console.print(views)


def _profile(steps: Sequence[Mapping[str, Any]]) -> tuple[list[StageTime], StageTime]:
    """Stages in their order, and the whole turn."""
    laps = [step["timings"] for step in steps]
    return by_stage(laps, beside=WAITING), by_stage([{"turn": _turn(lap)} for lap in laps])[0]


def _turn(laps: Mapping[str, float]) -> float:
    return sum(seconds for stage, seconds in laps.items() if stage not in WAITING)


def _figures(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1000.0 * seconds:.1f}"
