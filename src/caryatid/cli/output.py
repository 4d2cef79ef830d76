"""Output: progress on stderr for a person, results on stdout."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from caryatid.runtime.stopwatch import by_stage

if TYPE_CHECKING:
    from caryatid.cli.options import General
    from caryatid.evaluation.scores import Score
    from caryatid.exploration import Step
    from caryatid.graph import SceneObject, SupportGraph

WAITING = ("capture",)
"""Stages that wait for the camera and are not part of a turn."""


class Output:
    """What a command prints.

    Nothing moves on stderr unless it is a terminal, not even with FORCE_COLOR.

    Args:
        general: Whether progress is printed, and results as JSON.
    """

    def __init__(self, general: General) -> None:
        self._json = general.json
        self.progress = Console(
            stderr=True,
            quiet=general.quiet or general.json,
            highlight=False,
            emoji=False,
            soft_wrap=True,
            force_interactive=None if sys.stderr.isatty() else False,
        )

    def say(self, text: str) -> None:
        """Print a line of progress."""
        self.progress.print(text, markup=False)

    def working(self, what: str) -> AbstractContextManager[Any]:
        """Show a spinner on a terminal."""
        return self.progress.status(what) if self.progress.is_interactive else nullcontext()

    def result(self, document: Mapping[str, Any], *shown: RenderableType) -> None:
        """Print the result: as one JSON document, or else text as it is and tables."""
        if self._json:
            from caryatid.io.json_files import json_text

            shown = (json_text(document),)
        for item in shown:
            if isinstance(item, str):
                sys.stdout.write(item)
            else:
                Console(highlight=False).print(item)
        sys.stdout.flush()

    def compile(self) -> None:
        """Compile the kernels that are not compiled yet."""
        from caryatid.runtime.compiling import compile_kernels

        with self.working("compiling"):
            compile_kernels(self.say)

    def step(self, step: Step, before: SupportGraph | None, score: Score | None) -> None:
        """Print what a view changed, its score where the ground truth is known, and what comes next."""
        f1 = "" if score is None else f", F1 {score.f1:.3f}"
        self.say(f"view {step.index:02d}: {summary(step.graph)}{f1} ({_turn(step.timings):.1f} s)")
        for line in changes(before, step.graph):
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


def changes(before: SupportGraph | None, after: SupportGraph) -> list[str]:
    """What a view changed: a line each for objects found, supported differently, and gone."""
    known = {} if before is None else {o.id: _held(o, before) for o in before.objects}
    held = {o.id: _held(o, after) for o in after.objects}
    objects = [o for o in after.objects if o.role == "object"]
    lines = {
        "found": [f"{o.id} ({o.shape.kind}) {held[o.id]}" for o in objects if o.id not in known],
        "now": [f"{o.id} {held[o.id]}" for o in objects if known.get(o.id, held[o.id]) != held[o.id]],
        "gone": [i for i in known if i not in held],
    }
    return [f"{kind}: {', '.join(items)}" for kind, items in lines.items() if items]


def _held(o: SceneObject, graph: SupportGraph) -> str:
    supporters = sorted(s.supporter for s in graph.supports if s.supported == o.id)
    names = [i if graph[i].role == "object" else "the table" for i in supporters]
    return f"held by {' and '.join(names)}" if names else "held by nothing seen yet"


def numbered_table(title: str, *columns: str) -> Table:
    """A table of numbered rows."""
    table = Table(title=Text(title), title_justify="left")
    table.add_column("", justify="right")
    for column in columns:
        table.add_column(column)
    return table


def figures_table(title: str, *columns: str) -> Table:
    """A table of figures, aligned to the right."""
    table = Table(title=Text(title), title_justify="left")
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def profile(steps: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], list[Table]]:
    """What `--profile` adds to the JSON document, in seconds, and two tables, by stage and by view [ms].

    Args:
        steps: Number and timings [s] of each view, as in run.json.
    """
    stages = by_stage([step["timings"] for step in steps], beside=WAITING)
    (turn,) = by_stage([{"turn": _turn(step["timings"])} for step in steps])
    views = [{"view": step["view"]} | step["timings"] for step in steps]
    record = {"stages": [asdict(s) for s in stages], "turn": asdict(turn), "views": views}
    by_name = figures_table("time by stage [ms]", "stage", "median", "highest", "share")
    by_name.columns[0].justify = "left"
    for s in (*stages, turn):
        share = "" if s is turn or s.share is None else f"{100.0 * s.share:.0f} %"
        by_name.add_row(s.stage, _milliseconds(s.median), _milliseconds(s.highest), share)
    by_view = figures_table("time by view [ms]", "view", *(s.stage for s in stages), turn.stage)
    for step in steps:
        times = [*(step["timings"].get(s.stage) for s in stages), _turn(step["timings"])]
        by_view.add_row(f"{step['view']:02d}", *map(_milliseconds, times))
    for table in (by_name, by_view):
        table.box, table.padding, table.pad_edge = box.SIMPLE_HEAD, (0, 0, 0, 0), False
    return {"profile": record}, [by_name, by_view]


def _turn(laps: Mapping[str, float]) -> float:
    """Time of a turn [s]."""
    return sum(seconds for stage, seconds in laps.items() if stage not in WAITING)


def _milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1000.0 * seconds:.1f}"
