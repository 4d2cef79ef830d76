"""graph.json: the support graph as other programs read it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from math import inf, isfinite
from pathlib import Path
from typing import Any, Final, get_args

from caryatid.errors import InputError
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.geometry.shapes import Box, Cylinder, Sphere, from_size
from caryatid.geometry.transforms import Array
from caryatid.graph import Kind, Role, SceneObject, Stability, Support, SupportGraph
from caryatid.io.json_files import field, json_text, number, numbers, plain, read_json, rigid_transform
from caryatid.sensing.views import SUPPORT_LABEL

FORMAT: Final = "caryatid/graph"
VERSION: Final = 1
"""What graph.json says it is."""


def graph_to_json(graph: SupportGraph) -> dict[str, Any]:
    """Write a graph as the document of graph.json.

    Keys come in a fixed order and floats are rounded to a nanometre, so the same graph gives the same bytes.

    Returns:
        Plain dicts, lists, texts and numbers.
    """
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "frame": "world, z up, metres",
        "objects": [_object_to_json(o) for o in graph.objects],
        "supports": [_support_to_json(s) for s in graph.supports],
    }
    if graph.stability:
        document["stability"] = {
            id_: {
                "ratio": verdict.ratio,
                "overhang": verdict.overhang if isfinite(verdict.overhang) else None,
                "small_area": verdict.small_area,
                "tips": verdict.tips,
            }
            for id_, verdict in sorted(graph.stability.items())
        }
    result: dict[str, Any] = plain(document)
    return result


def graph_text(graph: SupportGraph) -> str:
    """Text of graph.json.

    Raises:
        ValueError: A number in the graph is NaN or infinite.
    """
    return json_text(graph_to_json(graph))


def graph_from_json(document: Mapping[str, Any], source: str | Path) -> SupportGraph:
    """Read a graph from the document of graph.json; keys that are not known are passed over.

    Args:
        document: The parsed JSON object.
        source: The file, for errors.

    Raises:
        InputError: Another format or version, a missing key, an edge to an object that is not there, a
            transform that is not rigid, or sizes that are not positive.
    """
    name = str(source)
    if document.get("format") != FORMAT:
        raise InputError(
            name, f"no '{FORMAT}' file (format: {document.get('format')!r})", "give a graph.json"
        )
    version = field(document, "version", int, name)
    if version != VERSION:
        raise InputError(
            name,
            f"version {version} of the format is not known",
            f"read it with the caryatid that wrote it, or write version {VERSION}",
        )
    objects: list[SceneObject] = []
    ids: set[str] = set()
    for index, item in enumerate(field(document, "objects", list, name)):
        scene_object = _object_from_json(item, f"{name}: objects[{index}]")
        if scene_object.id in ids:
            raise InputError(name, f"two objects are called '{scene_object.id}'", "give each its own id")
        ids.add(scene_object.id)
        objects.append(scene_object)
    if sum(o.role == "support_surface" for o in objects) > 1:
        raise InputError(name, "has two support surfaces", "keep one; the others are objects")
    supports: list[Support] = []
    pairs: set[tuple[str, str]] = set()
    for index, item in enumerate(field(document, "supports", list, name)):
        support = _support_from_json(item, ids, f"{name}: supports[{index}]")
        if support.pair in pairs:
            raise InputError(
                name, f"the edge {support.supporter} → {support.supported} is there twice", "keep one of them"
            )
        pairs.add(support.pair)
        supports.append(support)
    stability = field(document, "stability", dict, name, default={})
    return SupportGraph(
        tuple(objects),
        tuple(supports),
        {id_: _stability_from_json(id_, item, ids, f"{name}: stability") for id_, item in stability.items()},
    )


def read_graph(path: str | Path) -> SupportGraph:
    """Read a graph.json.

    Args:
        path: The file.

    Raises:
        InputError: The file is missing, broken or no graph; see `graph_from_json`.
    """
    return graph_from_json(read_json(Path(path)), Path(path))


def _object_to_json(o: SceneObject) -> dict[str, Any]:
    item = {
        "id": o.id,
        "role": o.role,
        "label": o.label,
        "shape": o.shape.kind,
        "T_world_object": o.shape.T_world_object,
        "size": o.shape.size,
        "occurrences": o.occurrences,
        "opportunities": o.opportunities,
        "residual": o.residual,
        "poor_fit": o.poor_fit,
        "seen": o.seen,
        "why": o.why,
        "doubt": o.doubt,
    }
    if o.uncertainty is not None:
        item["uncertainty"] = asdict(o.uncertainty)
    return item


def _object_from_json(item: Any, source: str) -> SceneObject:
    _must_be_object(item, source)
    id_ = field(item, "id", str, source)
    source = f"{source} ('{id_}')"
    role: Role = _one_of(item, "role", get_args(Role), source)
    label = _count(item, "label", source)
    if label > SUPPORT_LABEL:
        raise InputError(source, f"label {label} leaves 16 bits", f"use 0…{SUPPORT_LABEL}")
    seen = field(item, "seen", list, source, default=[True] * 6)
    if len(seen) != 6 or not all(isinstance(side, bool) for side in seen):
        raise InputError(source, "'seen' is not six times true or false", "give one for each side")
    return SceneObject(
        id=id_,
        label=label,
        shape=_shape_from_json(item, source),
        role=role,
        occurrences=_count(item, "occurrences", source, default=1),
        opportunities=_count(item, "opportunities", source, default=1),
        residual=number(item, "residual", source, default=0.0),
        poor_fit=field(item, "poor_fit", bool, source, default=False),
        seen=tuple(seen),
        why=field(item, "why", str, source, default=""),
        doubt=field(item, "doubt", str, source, default=""),
        uncertainty=_uncertainty_from_json(item, source),
    )


def _uncertainty_from_json(item: Mapping[str, Any], source: str) -> Uncertainty | None:
    document = field(item, "uncertainty", (dict, type(None)), source, default=None)
    if document is None:
        return None
    source = f"{source}: uncertainty"
    counts = {"position": 3, "rotation": 3, "sizes": 3, "sides": 6}
    return Uncertainty(
        **{
            name: numbers(field(document, name, list, source), (count,), f"{source}: {name}")
            for name, count in counts.items()
        }
    )


def _shape_from_json(item: Mapping[str, Any], source: str) -> Box | Cylinder | Sphere:
    T_world_object = rigid_transform(field(item, "T_world_object", list, source), f"{source}: T_world_object")
    size = field(item, "size", (dict, list), source)
    values = list(size.values()) if isinstance(size, dict) else size
    lengths = numbers(values, (len(values),), f"{source}: size")
    if not (lengths > 0.0).all():
        raise InputError(source, f"size {size} is not positive", "give sizes in metres")
    return from_size(field(item, "shape", str, source), T_world_object, size, source)


def _support_to_json(s: Support) -> dict[str, Any]:
    item: dict[str, Any] = {
        "supporter": s.supporter,
        "supported": s.supported,
        "kind": s.kind,
        "certain": s.certain,
        "occurrences": s.occurrences,
        "opportunities": s.opportunities,
    }
    if s.contact_world is not None:
        item["contact"] = s.contact_world
    if s.normal_world is not None:
        item["normal"] = s.normal_world
    item["why"] = s.why
    return item


def _support_from_json(item: Any, ids: set[str], source: str) -> Support:
    _must_be_object(item, source)
    supporter, supported = (_known(item, key, ids, source) for key in ("supporter", "supported"))
    if supporter == supported:
        raise InputError(source, f"'{supporter}' supports itself", "remove the edge")
    kind: Kind = _one_of(item, "kind", get_args(Kind), source)
    return Support(
        supporter=supporter,
        supported=supported,
        kind=kind,
        certain=field(item, "certain", bool, source, default=True),
        occurrences=_count(item, "occurrences", source, default=1),
        opportunities=_count(item, "opportunities", source, default=1),
        contact_world=_vector(item, "contact", source),
        normal_world=_vector(item, "normal", source),
        why=field(item, "why", str, source, default=""),
    )


def _stability_from_json(id_: str, item: Any, ids: set[str], source: str) -> Stability:
    if id_ not in ids:
        raise InputError(source, f"no object is called '{id_}'", "remove it, or add the object")
    _must_be_object(item, source)
    return Stability(
        ratio=number(item, "ratio", source),
        overhang=inf if item.get("overhang", 0.0) is None else number(item, "overhang", source),
        small_area=field(item, "small_area", bool, source),
        tips=field(item, "tips", bool, source),
    )


def _known(item: Mapping[str, Any], key: str, ids: set[str], source: str) -> str:
    id_: str = field(item, key, str, source)
    if id_ not in ids:
        known = ", ".join(sorted(ids)) or "none"
        raise InputError(source, f"'{key}' is '{id_}', which is no object", f"the objects are {known}")
    return id_


def _one_of(item: Mapping[str, Any], key: str, choices: tuple[str, ...], source: str) -> Any:
    value = field(item, key, str, source)
    if value not in choices:
        raise InputError(source, f"'{key}' is '{value}'", f"use {', '.join(choices)}")
    return value


def _count(item: Mapping[str, Any], key: str, source: str, **default: int) -> int:
    value: int = field(item, key, int, source, **default)
    if value < 0:
        raise InputError(source, f"'{key}' is {value}", "give 0 or more")
    return value


def _vector(item: Mapping[str, Any], key: str, source: str) -> Array | None:
    value = field(item, key, (list, type(None)), source, default=None)
    return None if value is None else numbers(value, (3,), f"{source}: {key}")


def _must_be_object(item: Any, source: str) -> None:
    if not isinstance(item, dict):
        raise InputError(source, "is no JSON object", "give one object for each entry")
