"""What the page says beside its scene, as HTML: of a view, of an object, and the support graph drawn."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from caryatid.graph import SupportGraph
from caryatid.support.relations import Effect
from caryatid.viewer.drawing import Moment
from caryatid.viz.colours import SALIENCY_STOPS, object_colour
from caryatid.viz.drawings import picture_svg
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.tables import census, object_table, support_table

NOTHING_CHOSEN = "Click an object in the scene to see what is known of it."
"""What stands where an object's figures will."""
STYLE = """<style>
.caryatid { --ink: #1d2126; --soft: #5d666f; --line: #dcdfe2; --panel: #fff; --doubt: #b4480b;
  color: var(--ink); font: 13.5px/1.45 system-ui, "DejaVu Sans", sans-serif; padding: 4px 12px 8px; }
.caryatid p { margin: 3px 0; } .caryatid .soft { color: var(--soft); }
.caryatid .doubt { color: var(--doubt); }
.caryatid .good { color: #1d6b45; } .caryatid ul { margin: 2px 0 6px; padding-left: 18px; }
.caryatid td { padding: 1px 8px 1px 0; vertical-align: top; } .caryatid td:first-child { color: var(--soft); }
.caryatid svg { width: 100%; height: auto; max-height: 40vh; display: block; }
.caryatid .chip { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin-right: 6px; }
.caryatid .scale { height: 10px; border-radius: 3px; margin: 4px 0; }
.caryatid .ends { display: flex; justify-content: space-between; }
</style>"""


def in_page(content: str) -> str:
    """Put content into a block that the page's style applies to."""
    return f'{STYLE}<div class="caryatid">{content}</div>'


def describe_view(moment: Moment, views: int) -> str:
    """Say what a view brought, and where to look next."""
    step, decision = moment.step, moment.step.decision
    parts = [
        f"<p><b>View {step.index}</b> of {views - 1} · {escape(step.name)}</p>",
        f"<p>{census(step.graph)}</p>",
        f'<p class="soft">{len(step.cloud):,} points</p>',
    ]
    if moment.score is not None:
        parts.append(f"<p>F1 <b>{moment.score:.3f}</b></p>")
    if decision is not None:
        parts.append(f"<p><b>Next:</b> {escape(decision.why)}</p>")
        figures = f"saliency {decision.saliency:.2f} − cost {decision.cost:.2f} = {decision.score:.2f}"
        parts.append(f'<p class="soft">{figures}</p>')
    if step.stop is not None:
        parts.append(f'<p class="good">Done: {escape(step.stop)}.</p>')
    return in_page("".join(parts))


def describe_graph(graph: SupportGraph) -> str:
    """Draw the support graph as the report does."""
    caption = "Arrows run from supporter to supported, with how often each was found; dashed: uncertain."
    return in_page(f'{picture_svg(draw_graph(graph))}<p class="soft">{caption}</p>')


def describe_signs() -> str:
    """Say what the signs in the scene mean."""
    stops = ", ".join(f"{colour} {50.0 * (at + 1.0):.0f}%" for at, colour in SALIENCY_STOPS)
    bar = f'<div class="scale" style="background:linear-gradient(90deg, {stops})"></div>'
    signs = (
        ("Arrow", "supporter → supported; dashed where uncertain"),
        ("Ball, cube on an arrow", "it leans; weight from above. Neither: supported from below"),
        ("Dots on the sphere", "where the robot can bring its camera, coloured by saliency"),
        ("Fine grey dots", "where it cannot"),
        ("Balls with rays", "points of interest, and from where they are seen best"),
        ("Grey cameras", "views so far, with what they saw; the newest is black and larger"),
        ("Filled camera", "the next view: blue the planner's choice, pink one by hand"),
    )
    rows = "".join(f"<tr><td>{sign}</td><td>{meaning}</td></tr>" for sign, meaning in signs)
    ends = '<p class="soft ends"><span>seen before</span><span>nothing</span><span>look here</span></p>'
    return in_page(f"<p><b>Saliency</b>, the highest of each view red</p>{bar}{ends}<table>{rows}</table>")


def describe_object(graph: SupportGraph, object_id: str, effects: Sequence[Effect] | None) -> str:
    """Say of an object what it is, how it is known, its edges, and what falls without it.

    Args:
        graph: What is known.
        object_id: Which.
        effects: What would move if it were taken away; None for the support surface.
    """
    item = next((o for o in graph.objects if o.id == object_id), None)
    if item is None:
        return in_page(f"<p>{escape(object_id)} is not known after this view.</p>")
    chip = f'<span class="chip" style="background:{object_colour(item.label)}"></span>'
    parts = [f"<p>{chip}<b>{escape(item.id)}</b> · {item.shape.kind}</p>"]
    table = object_table(graph)
    (row,) = (row for row in table.rows if row[0].text == object_id)
    facts = list(zip(table.columns, row, strict=True))[2:]
    lines = (f"<tr><td>{escape(name)}</td><td>{escape(entry.text)}</td></tr>" for name, entry in facts)
    parts.append(f"<table>{''.join(lines)}</table>")
    if effects is not None:
        parts.append(f"<p><b>Without {escape(object_id)}</b>")
        parts.append("</p><ul>" if effects else ' <span class="good">nothing falls.</span></p>')
        for effect in effects:
            verb = "falls" if effect.certain else "may fall"
            why = f'<span class="soft">{escape(effect.why)}</span>'
            parts.append(f"<li><b>{escape(effect.object_id)}</b> {verb}: {why}</li>")
        parts += ["</ul>"] if effects else []
    edges = [row for row in support_table(graph).rows if object_id in (row[0].text, row[1].text)]
    if not edges:
        parts.append('<p class="doubt">No support of it is known, and it supports nothing.</p>')
        return in_page("".join(parts))
    parts.append("<p><b>Supports</b></p><ul>")
    for supporter, supported, how, certain, found, reason in edges:
        doubt = ' <span class="doubt">uncertain</span>' if certain.doubt else ""
        pair = escape(f"{supporter.text} → {supported.text}")
        parts.append(f"<li>{pair}, {how.text}{doubt}, {found.text}")
        parts.append(f'<br><span class="soft">{escape(reason.text)}</span></li>')
    return in_page("".join([*parts, "</ul>"]))
