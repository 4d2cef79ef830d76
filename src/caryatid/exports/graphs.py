"""The support graph for other programs: GraphML, DOT and spark_dsg."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from caryatid.errors import InputError, needs_extra
from caryatid.geometry.solids import Solid
from caryatid.graph import SupportGraph
from caryatid.viz.colours import ink_on, object_colour, rgb


def to_graphml(graph: SupportGraph) -> str:
    """Edges run from supporter to supported; sizes and centres x, y, z of vertices are in metres."""
    import networkx as nx

    plain = nx.DiGraph()
    for item in graph.objects:
        x, y, z = item.centre_world.tolist()
        size = list(item.shape.extents) if isinstance(item.shape, Solid) else item.shape.size
        lengths = size.values() if isinstance(size, Mapping) else size
        attributes: dict[str, Any] = {"role": item.role, "label": item.label, "shape": item.shape.kind}
        attributes |= {"size": " ".join(f"{length:.6g}" for length in lengths), "x": x, "y": y, "z": z}
        attributes["colour"] = object_colour(item.label)
        attributes |= {} if item.name is None else {"name": item.name}
        attributes |= {"occurrences": item.occurrences, "opportunities": item.opportunities}
        plain.add_node(item.id, **attributes)
    for support in graph.supports:
        names = ("kind", "certain", "occurrences", "opportunities")
        known = {} if support.probability is None else {"probability": support.probability}
        plain.add_edge(*support.pair, **known, **{name: getattr(support, name) for name in names})
    return "\n".join(nx.generate_graphml(plain)) + "\n"


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


def to_dsg(graph: SupportGraph) -> bytes:
    """A scene graph of spark_dsg: a node `O3` with a box for `o3`, an edge from supporter to supported.

    It has one edge for two objects: of those that hold each other, the one from below.

    Raises:
        InputError: spark-dsg (extra `dsg`) is not installed, or two objects have the same label.
    """
    with needs_extra("dsg", "the format dsg"):
        import spark_dsg as dsg

    made, nodes = dsg.DynamicSceneGraph(), {o.id: dsg.NodeSymbol("O", o.label) for o in graph.objects}
    for item in graph.objects:
        known, T, shape = dsg.ObjectNodeAttributes(), item.shape.T_world_object, item.shape
        known.name, known.position = item.title, T[:3, 3]
        known.bounding_box = dsg.BoundingBox(dsg.BoundingBoxType.RAABB, shape.extents, T[:3, 3], T[:3, :3])
        known.color = np.array(rgb(object_colour(item.label)), dtype=np.uint8)
        known.metadata.set({"id": item.id, "role": item.role, "shape": shape.kind})
        if not made.add_node(dsg.DsgLayers.OBJECTS, nodes[item.id], known):
            reason = f"two objects have the label {item.label}"
            raise InputError("the scene model", reason, "give each object its own in graph.json")
    for s in sorted(graph.supports, key=lambda s: s.kind == "top-down"):
        edge = dsg.EdgeAttributes()
        edge.weighted, edge.weight = True, s.belief
        edge.metadata.set({"kind": s.kind})
        made.insert_edge(nodes[s.supporter], nodes[s.supported], edge)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "graph.sparkdsg"
        made.save(path)
        return path.read_bytes()


def _listed(attributes: Mapping[str, str]) -> str:
    return ", ".join(f"{name}={_quoted(value)}" for name, value in attributes.items())


def _quoted(text: str) -> str:
    """A quoted string of DOT: backslashes begin escapes in what is shown, quotes end it."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + " ".join(escaped.splitlines()) + '"'
