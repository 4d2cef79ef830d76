"""What the page says beside its scene, as HTML: of a view, of an object, and the support graph drawn."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from html import escape
from importlib import resources

from caryatid.graph import SupportGraph
from caryatid.support.relations import Effect
from caryatid.viewer.moments import Moment
from caryatid.viz.colours import SALIENCY_STOPS
from caryatid.viz.graphs import draw_graph
from caryatid.viz.layout import arrange
from caryatid.viz.rows import ObjectRow, object_rows, support_rows

NOTHING_CHOSEN = "Click an object in the scene to see what is known of it."
"""What stands where an object's figures will."""


def in_page(content: str) -> str:
    """Put content into a block that the page's style applies to."""
    return f'<style>{_style()}</style><div class="caryatid">{content}</div>'


@cache
def _style() -> str:
    return resources.files("caryatid.viewer").joinpath("page.css").read_text(encoding="utf-8")


def tell_view(moment: Moment, views: int) -> str:
    """Say what a view brought, and where to look next."""
    graph = moment.graph
    objects = sum(o.role == "object" for o in graph.objects)
    uncertain = sum(not s.certain for s in graph.supports)
    doubt = f' <span class="doubt">({uncertain} uncertain)</span>' if uncertain else ""
    parts = [
        f"<p><b>View {moment.index}</b> of {views - 1} · {escape(moment.name)}</p>",
        f"<p>{objects} objects, {len(graph.supports)} supports{doubt}</p>",
    ]
    if moment.dots is not None:
        parts.append(f'<p class="soft">{len(moment.dots):,} points</p>')
    if moment.score is not None:
        parts.append(f"<p>F1 <b>{moment.score:.3f}</b></p>")
    decision = moment.decision
    if decision is not None:
        who = "chosen by hand" if moment.by_hand else escape(decision.why)
        parts.append(f"<p><b>Next:</b> {who}</p>")
        figures = f"saliency {decision.saliency:.2f} − cost {decision.cost:.2f} = {decision.score:.2f}"
        parts.append(f'<p class="soft">{figures}</p>')
    if moment.stop is not None:
        parts.append(f'<p class="good">Done: {escape(moment.stop)}.</p>')
    return in_page("".join(parts))


def tell_graph(graph: SupportGraph) -> str:
    """Draw the support graph as the report does."""
    caption = "Arrows run from supporter to supported, with how often each was found; dashed: uncertain."
    return in_page(f'{draw_graph(graph, arrange(graph))}<p class="soft">{caption}</p>')


def tell_key() -> str:
    """Say what the signs in the scene mean."""
    stops = ", ".join(f"{colour} {50.0 * (at + 1.0):.0f}%" for at, colour in SALIENCY_STOPS)
    scale = f'<div class="scale" style="background:linear-gradient(90deg, {stops})"></div>'
    signs = (
        ("Arrow", "supporter → supported; dashed where uncertain"),
        ("Ball, cube on an arrow", "it leans; weight from above. Neither: carried from below"),
        ("Dots on the sphere", "where the robot can bring its camera, coloured by saliency"),
        ("Fine grey dots", "where it cannot"),
        ("Balls with rays", "points of interest, and from where they are seen best"),
        ("Grey cameras", "views so far, with what they saw; the newest is black and larger"),
        ("Filled camera", "the next view: blue the planner's choice, pink one by hand"),
    )
    rows = "".join(f"<tr><td>{sign}</td><td>{meaning}</td></tr>" for sign, meaning in signs)
    ends = '<p class="soft ends"><span>seen before</span><span>nothing</span><span>look here</span></p>'
    return in_page(f"<p><b>Saliency</b>, the highest of each view red</p>{scale}{ends}<table>{rows}</table>")


def tell_object(moment: Moment, object_id: str, effects: Sequence[Effect] | None) -> str:
    """Say of an object what it is, how it is known, its edges, and what falls without it.

    Args:
        moment: What is known.
        object_id: Which.
        effects: What would move were it taken away; None for the support surface.
    """
    rows = {row.id: row for row in object_rows(moment.graph)}
    if object_id not in rows:
        return in_page(f"<p>{escape(object_id)} is not known after this view.</p>")
    row = rows[object_id]
    chip = f'<span class="chip" style="background:{row.colour}"></span>'
    head = f"<p>{chip}<b>{escape(row.id)}</b> · {row.shape}</p>"
    return in_page(head + _facts(row) + _falls(object_id, effects) + _edges(moment.graph, object_id))


def _facts(row: ObjectRow) -> str:
    facts = [
        ("size [mm]", row.size),
        ("found in", f"{row.seen} views"),
        ("unseen sides", row.unseen),
        ("residual [mm]", row.residual + (" · poor fit" if row.poor_fit else "")),
        ("stability", row.stability),
        ("because", row.why),
    ]
    lines = "".join(f"<tr><td>{name}</td><td>{escape(said)}</td></tr>" for name, said in facts if said)
    return f"<table>{lines}</table>"


def _edges(graph: SupportGraph, object_id: str) -> str:
    rows = [row for row in support_rows(graph) if object_id in (row.supporter, row.supported)]
    if not rows:
        return '<p class="doubt">Nothing is known to support it, and it supports nothing.</p>'
    items = []
    for row in rows:
        doubt = "" if row.certain else ' <span class="doubt">uncertain</span>'
        pair = escape(f"{row.supporter} → {row.supported}")
        said = f"{pair}, {row.kind}{doubt}, {row.evidence}"
        items.append(f'<li>{said}<br><span class="soft">{escape(row.why)}</span></li>')
    return f"<p><b>Supports</b></p><ul>{''.join(items)}</ul>"


def _falls(object_id: str, effects: Sequence[Effect] | None) -> str:
    if effects is None:
        return ""
    head = f"<b>Without {escape(object_id)}</b>"
    if not effects:
        return f'<p>{head} <span class="good">nothing falls.</span></p>'
    items = "".join(
        f"<li><b>{escape(e.object_id)}</b> {'falls' if e.certain else 'may fall'}: "
        f'<span class="soft">{escape(e.why)}</span></li>'
        for e in effects
    )
    return f"<p>{head}</p><ul>{items}</ul>"
