"""What the page says beside its scene: of a view, of an object, and the support graph drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.graph import SupportGraph
from caryatid.support.relations import Effect
from caryatid.viewer.drawing import Moment
from caryatid.viz.colours import SALIENCY_STOPS, object_colour, scale
from caryatid.viz.drawings import draw_layers
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.notebook import cell_html
from caryatid.viz.report import Figure, Section
from caryatid.viz.tables import census, object_table

SIGNS = (
    ("Arrow", "supporter → supported; dashed where uncertain"),
    ("Ball, cube on an arrow", "it leans; weight from above. Neither: supported from below"),
    ("Dots on the sphere", "where the robot can bring its camera, coloured by saliency"),
    ("Fine grey dots", "where it cannot"),
    ("Balls with rays", "points of interest, and from where they are seen best"),
    ("Grey cameras", "views so far, with what they saw; the newest is black and larger"),
    ("Filled camera", "the next view: blue the planner's choice, pink one by hand"),
)
"""Signs in the scene and what they mean."""


def describe_view(moment: Moment, views: int) -> str:
    """Say what a view brought, and where to look next."""
    step, decision = moment.step, moment.step.decision
    facts = [("known", census(step.graph)), ("points", f"{len(step.cloud):,}")]
    if moment.score is not None:
        facts.append(("F1", f"{moment.score:.3f}"))
    if decision is not None:
        figures = f"saliency {decision.saliency:.2f} − cost {decision.cost:.2f} = {decision.score:.2f}"
        facts += [("next", decision.why), ("score", figures)]
    if step.stop is not None:
        facts.append(("done", step.stop))
    return cell_html(Section(f"View {step.index}", f"of {views - 1} · {step.name}", facts=tuple(facts)))


def describe_graph(graph: SupportGraph) -> str:
    """Draw the support graph as the report does."""
    caption = "Arrows run from supporter to supported, with how often each was found; dashed: uncertain."
    return cell_html(Section("Supports", figures=(Figure("", draw_graph(graph), caption),)))


def describe_signs() -> str:
    """Say what the signs in the scene mean."""
    picture = draw_layers("saliency", [scale(np.tile(np.linspace(-1.0, 1.0, 340), (10, 1)), SALIENCY_STOPS)])
    caption = "Saliency: seen before, nothing, look here; the highest of each view is red."
    return cell_html(Section("Key", facts=SIGNS, figures=(Figure("", picture, caption),)))


def describe_object(graph: SupportGraph, object_id: str, effects: Sequence[Effect] | None) -> str:
    """Say of an object what it is, how it is known, its edges, and what falls without it.

    Args:
        graph: What is known.
        object_id: Which.
        effects: What would move if it were taken away; None for the support surface.
    """
    item = next((o for o in graph.objects if o.id == object_id), None)
    if item is None:
        return cell_html(Section(object_id, "is not known after this view"))
    table = object_table(graph)
    (row,) = (row for row in table.rows if row[0].text == object_id)
    facts = [(name, entry.text) for name, entry in zip(table.columns, row, strict=True)][2:]
    if effects is not None:
        falls = [f"{e.object_id} {'falls' if e.certain else 'may fall'}: {e.why}" for e in effects]
        facts += [(f"Without {object_id}", text) for text in falls or ["nothing falls"]]
    edges = []
    for s in graph.supports:
        if object_id in s.pair:
            evidence = f"{s.kind}{', uncertain' * (not s.certain)}, {s.occurrences} of {s.opportunities}"
            edges.append((f"{s.supporter} → {s.supported}", f"{evidence}; {s.why}"))
    facts += edges or [("supports", "none of it is known, and it supports nothing")]
    return cell_html(Section(item.id, item.shape.kind, facts=facts, colour=object_colour(item.label)))
