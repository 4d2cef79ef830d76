"""Output: progress on stderr for a person, results on stdout."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from caryatid.evaluation.scores import Score
    from caryatid.exploration import Step


TOLD = "caryatid.progress"
"""Logger of what the commands print themselves, view by view."""


class Output(logging.Handler):
    """Print progress, results, and log messages of the package; `warnings` are those so far.

    Spinners and bars appear only if stderr is a terminal, even with FORCE_COLOR.
    """

    def __init__(self, *, json: bool, quiet: bool) -> None:
        super().__init__(logging.INFO)
        self.json = json
        self.warnings: list[str] = []
        self.progress = Console(
            stderr=True,
            quiet=quiet or json,
            highlight=False,
            emoji=False,
            soft_wrap=True,
            force_interactive=None if sys.stderr.isatty() else False,
        )
        logger = logging.getLogger("caryatid")
        logger.handlers = [self]
        logger.setLevel(logging.INFO)

    def emit(self, record: logging.LogRecord) -> None:
        """Print a log message, and keep it if it is a warning."""
        if record.levelno >= logging.WARNING:
            self.warnings.append(record.getMessage())
        elif record.name == TOLD:
            return
        self.say(record.getMessage())

    def say(self, text: str) -> None:
        """Print a line of progress."""
        self.progress.print(text, markup=False)

    def working(self, what: str) -> AbstractContextManager[Any]:
        """Show a spinner on a terminal."""
        return self.progress.status(what) if self.progress.is_interactive else nullcontext()

    def result(self, document: Mapping[str, Any], *shown: RenderableType) -> None:
        """Print the result: one JSON document, or text and tables."""
        if self.json or not shown:
            from caryatid.io.json_files import json_text

            shown = (json_text(document),)
        for item in filter(None, shown):
            if isinstance(item, str):
                sys.stdout.write(item)
            else:
                Console(highlight=False).print(item)
        sys.stdout.flush()

    def step(self, step: Step, before: Step | None, score: Score | None) -> None:
        """Print what a view changed, its score if the ground truth is known, and the next view."""
        from caryatid.viz.tables import census, changes, noticed

        lift, f1 = step.lift, "" if score is None else f", F1 {score.f1:.3f}"
        # The last graph is that after the lift.
        lifted = lift is not None and all(o.id != lift.object_id for o in step.graph.objects)
        when = ", after its lift" if lifted else ""
        compiled = step.timings.get("compile", 0.0)
        once = f"; compiling kernels, once, took {compiled:.0f} s" * (compiled >= 1.0)
        self.say(f"view {step.index + 1}{when}: {census(step.graph)}{f1} ({turn(step.timings):.1f} s{once})")
        for change in noticed(before, step):
            self.say(f"  {change}")
        for kind, items in changes(before, step).items():
            self.say(f"  {kind}: " + ("\n" + " " * (len(kind) + 4)).join(items))
        if step.removal is not None:
            self.say(f"  without {step.removal.object_id}: {step.removal}")
        if lift is not None:
            self.say(f"  removed {lift.object_id}: {lift.why}")
        if step.decision is not None:
            self.say(f"  next view: {step.decision.why}")
        if step.stop is not None:
            self.say(f"  done: {step.stop}")


@contextmanager
def kept(what: str) -> Iterator[None]:
    """Make Ctrl-C report what is kept."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(what) from None


def table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], *, figures: bool = False
) -> Table:
    """A table of text, or of right-aligned numbers."""
    made = Table(title=Text(title), title_justify="left")
    if figures:
        made.box, made.padding, made.pad_edge = box.SIMPLE_HEAD, (0, 0, 0, 0), False
    for name in columns:
        made.add_column(name, justify="right" if figures else "left", no_wrap=figures)
    for row in rows:
        made.add_row(*map(Text, row))
    return made


def turn(timings: Mapping[str, float]) -> float:
    """Time of one turn of the loop [s]: all stages except waiting for the camera, and compiling kernels."""
    return sum(seconds for stage, seconds in timings.items() if stage not in ("capture", "compile"))
