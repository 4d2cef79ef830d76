"""The support graph for programs that work with graphs, or draw them: GraphML and DOT."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import networkx as nx

from caryatid.graph import SupportGraph
from caryatid.viz.colours import ink_on, object_colour


def to_graphml(graph: SupportGraph) -> str:
    """Write the support graph as GraphML; edges run from supporter to supported.

    Vertices have role, label, shape, size [m], centre x, y, z [m] and in how many views they were found;
    edges have kind, certain, and in how many views they were found.

    Args:
        graph: The graph.
    """
    plain = nx.DiGraph()
    for item in graph.objects:
        x, y, z = (float(value) for value in item.centre_world)
        size = item.shape.size
        lengths = size.values() if isinstance(size, Mapping) else size
        plain.add_node(
            item.id,
            role=item.role,
            label=item.label,
            shape=item.shape.kind,
            size=" ".join(f"{length:.6g}" for length in lengths),
            x=x,
            y=y,
            z=z,
            colour=object_colour(item.label),
            occurrences=item.occurrences,
            opportunities=item.opportunities,
        )
    for support in graph.supports:
        plain.add_edge(
            *support.pair,
            kind=support.kind,
            certain=support.certain,
            occurrences=support.occurrences,
            opportunities=support.opportunities,
        )
    return "\n".join(nx.generate_graphml(plain)) + "\n"


def to_dot(graph: SupportGraph) -> str:
    """Write the support graph as DOT, to be drawn as the report draws it: the table below, doubt in dashes.

    Args:
        graph: The graph.
    """
    lines = ["digraph supports {", "  rankdir=BT;", '  node [style=filled, fontname="sans-serif"];']
    for item in graph.objects:
        colour = object_colour(item.label)
        attributes: dict[str, Any] = {
            "label": item.id if item.role == "object" else f"{item.id} · support surface",
            "shape": {"cylinder": "cylinder", "sphere": "circle"}.get(item.shape.kind, "box"),
            "fillcolor": colour,
            "fontcolor": ink_on(colour),
            "tooltip": f"{item.shape.kind}, found in {item.occurrences} of {item.opportunities} views",
        }
        lines.append(f"  {_quoted(item.id)} [{_listed(attributes)}];")
    for support in graph.supports:
        attributes = {
            "style": "solid" if support.certain else "dashed",
            "tooltip": f"{support.kind}, found in {support.occurrences} of {support.opportunities} views",
        }
        if support.kind != "bottom-up":
            attributes["label"] = support.kind
        ends = " -> ".join(_quoted(name) for name in support.pair)
        lines.append(f"  {ends} [{_listed(attributes)}];")
    return "\n".join([*lines, "}"]) + "\n"


def _listed(attributes: Mapping[str, str]) -> str:
    return ", ".join(f"{name}={_quoted(value)}" for name, value in attributes.items())


def _quoted(text: str) -> str:
    """A quoted string of DOT: backslashes begin escapes in what is shown, quotes end it."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + " ".join(escaped.splitlines()) + '"'
