"""What a command says while it works: on stderr, and only to a person."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext

from caryatid.cli.consoles import news_console
from caryatid.evaluation.scores import Score
from caryatid.exploration import Step
from caryatid.graph import SUPPORT_SURFACE_ID, SceneObject, SupportGraph


class Progress:
    """Says what goes on, or nothing.

    Args:
        quiet: Say nothing.
    """

    def __init__(self, quiet: bool) -> None:
        self._console = news_console(quiet)

    @contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Show a spinner while something takes its time, on a terminal."""
        with self._console.status(what) if self._console.is_interactive else nullcontext():
            yield

    def say(self, text: str) -> None:
        """Write a line."""
        self._console.print(text, markup=False)

    def step(self, step: Step, before: SupportGraph | None, scores: Sequence[Score]) -> None:
        """Say what a view brought, how good that is where the truth is known, and what comes next."""
        seconds = sum(v for k, v in step.timings.items() if k != "capture")
        score = f", F1 {scores[-1].f1:.3f}" if scores else ""
        self.say(f"view {step.index:02d}: {summary(step.graph)}{score} ({seconds:.1f} s)")
        for line in news(before or SupportGraph(), step.graph):
            self.say(f"  {line}")
        if step.decision is not None:
            self.say(f"  next view: {step.decision.why}")
        if step.stop is not None:
            self.say(f"  done: {step.stop}")


def summary(graph: SupportGraph) -> str:
    """Objects and supports of a graph in a few words."""
    objects = sum(o.role == "object" for o in graph.objects)
    uncertain = sum(not s.certain for s in graph.supports)
    doubt = f" ({uncertain} uncertain)" if uncertain else ""
    return f"{_counted(objects, 'object')}, {_counted(len(graph.supports), 'support')}{doubt}"


def news(before: SupportGraph, after: SupportGraph) -> list[str]:
    """What a view changed, a line for each kind of news: found, gone, carried otherwise."""
    known = {o.id for o in before.objects}
    present = {o.id for o in after.objects}
    objects = [o for o in after.objects if o.role == "object"]
    found = [f"{_named(o)} {_carried(o, after)}" for o in objects if o.id not in known]
    otherwise = [
        f"{o.id} {_carried(o, after)}"
        for o in objects
        if o.id in known and _supporters(o, before) != _supporters(o, after)
    ]
    gone = [o.id for o in before.objects if o.id not in present]
    told = (("found", found), ("now", otherwise), ("gone", gone))
    return [f"{kind}: {', '.join(items)}" for kind, items in told if items]


def _named(o: SceneObject) -> str:
    return f"{o.id} ({o.shape.kind})"


def _supporters(o: SceneObject, graph: SupportGraph) -> list[str]:
    return sorted(s.supporter for s in graph.supports if s.supported == o.id)


def _carried(o: SceneObject, graph: SupportGraph) -> str:
    names = ["the table" if i == SUPPORT_SURFACE_ID else i for i in _supporters(o, graph)]
    return f"held by {' and '.join(names)}" if names else "held by nothing seen yet"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
