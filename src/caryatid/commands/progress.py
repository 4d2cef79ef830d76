"""What a command says while it works: on stderr, and only to a person."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

from caryatid.exploration import Step
from caryatid.graph import SupportGraph


class Progress:
    """Says what goes on, or nothing.

    Args:
        quiet: Say nothing.
    """

    def __init__(self, quiet: bool) -> None:
        self._console = Console(stderr=True, quiet=quiet, highlight=False, soft_wrap=True)

    @contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Show a spinner while something takes its time, on a terminal."""
        with self._console.status(what):
            yield

    def say(self, text: str) -> None:
        """Write a line."""
        self._console.print(text, markup=False)

    def step(self, step: Step, f1: float | None) -> None:
        """Say what a view brought."""
        seconds = sum(v for k, v in step.timings.items() if k != "capture")
        score = "" if f1 is None else f", F1 {f1:.3f}"
        self.say(f"view {step.index + 1}: {summary(step.graph)}{score} ({seconds:.2f} s)")
        if step.decision is not None:
            self.say(f"  next: {step.decision.why}")
        if step.stop is not None:
            self.say(f"  stop: {step.stop}")


def summary(graph: SupportGraph) -> str:
    """Objects and supports of a graph in a few words."""
    objects = sum(o.role == "object" for o in graph.objects)
    uncertain = sum(not s.certain for s in graph.supports)
    doubt = f" ({uncertain} uncertain)" if uncertain else ""
    return f"{objects} objects, {len(graph.supports)} supports{doubt}"
