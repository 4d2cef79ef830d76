"""graph.json: the support graph for other programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from math import inf, isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le
from pydantic import BeforeValidator

from caryatid.errors import InputError
from caryatid.geometry.shapes import Uncertainty, from_size
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import Kind, Role, SceneObject, Stability, Support, SupportGraph
from caryatid.io.json_files import Numbers, json_text, parse_json, plain, read_json
from caryatid.sensing.views import SUPPORT_LABEL

Count = Annotated[int, Ge(0)]
Probability = Annotated[float, Ge(0.0), Le(1.0)]


@dataclass(frozen=True, eq=False)
class _Uncertainty:
    position: Annotated[Array, Numbers(3)]
    rotation: Annotated[Array, Numbers(3)]
    sizes: Annotated[Array, Numbers(3)]
    sides: Annotated[Array, Numbers(6)]


@dataclass(frozen=True, eq=False)
class _Object:
    """An entry of `objects`; keys are written in this order."""

    id: str
    role: Role
    label: Annotated[int, Ge(0), Le(SUPPORT_LABEL)]
    shape: str
    T_world_object: Annotated[Array, Numbers(4, 4, rigid=True)]
    size: dict[str, float] | dict[Literal["parts"], list[list[tuple[float, float, float]]]] | list[float]
    occurrences: Count = 1
    opportunities: Count = 1
    residual: float = 0.0
    poor_fit: bool = False
    seen: tuple[bool, bool, bool, bool, bool, bool] = (True,) * 6
    why: str = ""
    doubt: str = ""
    uncertainty: _Uncertainty | None = None
    probability: Probability | None = None
    name: str | None = None

    def decoded(self, source: str) -> SceneObject:
        source = f"{source} ('{self.id}')"
        lengths = self.size.values() if isinstance(self.size, dict) else self.size
        positive = all(isinstance(length, float) and length > 0.0 for length in lengths)
        if self.shape != Solid.kind and not positive:
            raise InputError(source, f"size {self.size} is not positive", "give sizes in metres")
        given = dict(vars(self))
        given["shape"] = from_size(self.shape, given.pop("T_world_object"), given.pop("size"), source)
        if self.uncertainty is not None:
            given["uncertainty"] = Uncertainty(**vars(self.uncertainty))
        return SceneObject(**given)


@dataclass(frozen=True, eq=False)
class _Support:
    """An entry of `supports`: the fields of a `Support` in their order."""

    supporter: str
    supported: str
    kind: Kind
    certain: bool = True
    occurrences: Count = 1
    opportunities: Count = 1
    contact: Annotated[Array, Numbers(3)] | None = None
    normal: Annotated[Array, Numbers(3)] | None = None
    why: str = ""
    probability: Probability | None = None


def _with_infinity(entry: Any) -> Any:
    """An entry of `stability`; JSON has no infinity, so an infinite overhang is null."""
    if isinstance(entry, dict) and entry.get("overhang", 0.0) is None:
        return entry | {"overhang": inf}
    return entry


@dataclass(frozen=True, eq=False)
class _Graph:
    format: Literal["caryatid/graph"]
    version: Literal[1]
    objects: list[_Object]
    supports: list[_Support]
    stability: dict[str, Annotated[Stability, BeforeValidator(_with_infinity)]] = field(default_factory=dict)


def graph_to_json(graph: SupportGraph) -> dict[str, Any]:
    """Write a graph as the document of graph.json: plain dicts, lists, texts and numbers.

    Keys come in a fixed order and floats are rounded to a nanometre, so the same graph gives the same bytes.
    """
    objects = []
    for o in graph.objects:
        item = {key.name: getattr(o, key.name, None) for key in fields(_Object)}
        item |= {"shape": o.shape.kind, "T_world_object": o.shape.T_world_object, "size": o.shape.size}
        objects.append({key: value for key, value in item.items() if value is not None})
    document: dict[str, Any] = {
        "format": "caryatid/graph",
        "version": 1,
        "frame": "world, z up, metres",
        "objects": objects,
        "supports": [
            {key.removesuffix("_world"): value for key, value in asdict(s).items() if value is not None}
            for s in graph.supports
        ],
    }
    if graph.stability:
        document["stability"] = {
            id_: asdict(verdict) | ({} if isfinite(verdict.overhang) else {"overhang": None})
            for id_, verdict in sorted(graph.stability.items())
        }
    return plain(document)


def graph_text(graph: SupportGraph) -> str:
    """Text of graph.json.

    Raises:
        ValueError: A number in the graph is NaN or infinite.
    """
    return json_text(graph_to_json(graph))


def graph_from_json(document: Mapping[str, Any], source: str | Path) -> SupportGraph:
    """Read a graph from the document of graph.json; unknown keys are ignored, errors name the source.

    Raises:
        InputError: Another format or version, a missing key, an edge to an object that does not exist, a
            transform that is not rigid, or sizes that are not positive.
    """
    name = str(source)
    given = parse_json(_Graph, document, name, "give a graph.json of version 1")
    ids = [o.id for o in given.objects]
    pairs = [(s.supporter, s.supported) for s in given.supports]
    for twice in (i for i, count in Counter(ids).items() if count > 1):
        raise InputError(name, f"two objects have the id '{twice}'", "give each object a unique id")
    for (one, other), count in Counter(pairs).items():
        if one == other:
            raise InputError(name, f"'{one}' supports itself", "remove the edge")
        if count > 1:
            raise InputError(name, f"duplicate edge {one} → {other}", "keep one of them")
    known = {*ids}
    for named in (*(i for pair in pairs for i in pair), *given.stability):
        if named not in known:
            raise InputError(name, f"unknown object '{named}'", f"known objects: {', '.join(ids) or 'none'}")
    return SupportGraph(
        tuple(o.decoded(name) for o in given.objects),
        tuple(Support(*vars(s).values()) for s in given.supports),
        given.stability,
    )


def read_graph(path: str | Path) -> SupportGraph:
    """Read a graph.json.

    Raises:
        InputError: The file is missing, broken or not a graph; see `graph_from_json`.
    """
    return graph_from_json(read_json(Path(path)), Path(path))
