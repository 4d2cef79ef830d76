"""The support graph for Graphviz."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from caryatid.graph import SupportGraph
from caryatid.viz.colours import ink_on, object_colour


def to_dot(graph: SupportGraph) -> str:
    """Write the support graph as DOT, drawn as in the report: surfaces below, doubtful supports dashed."""
    lines = ["digraph supports {", "  rankdir=BT;", '  node [style=filled, fontname="sans-serif"];']
    for item in graph.objects:
        colour = object_colour(item.label)
        attributes: dict[str, Any] = {
            "label": item.title if item.role == "object" else f"{item.id} · support surface",
            "shape": {"cylinder": "cylinder", "sphere": "circle"}.get(item.shape.kind, "box"),
            "fillcolor": colour,
            "fontcolor": ink_on(colour),
            "tooltip": f"{item.shape.kind}, found in {item.occurrences} of {item.opportunities} views",
        }
        lines.append(f"  {_quoted(item.id)} [{_listed(attributes)}];")
    for support in graph.supports:
        attributes = {
            "style": "dashed" if support.doubtful else "solid",
            "penwidth": f"{max(0.6, 2.4 * support.belief):.2f}",
            "label": f"{'' if support.kind == 'bottom-up' else f'{support.kind} '}{support.belief:.2f}",
            "tooltip": f"{support.kind}, found in {support.occurrences} of {support.opportunities} views",
        }
        ends = " -> ".join(_quoted(name) for name in support.pair)
        lines.append(f"  {ends} [{_listed(attributes)}];")
    return "\n".join([*lines, "}"]) + "\n"


def _listed(attributes: Mapping[str, str]) -> str:
    return ", ".join(f"{name}={_quoted(value)}" for name, value in attributes.items())


def _quoted(text: str) -> str:
    """A quoted string of DOT: backslashes begin escapes in what is shown, quotes end it."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + " ".join(escaped.splitlines()) + '"'
