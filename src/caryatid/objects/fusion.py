"""Fusing support graphs over views: matching objects and counting evidence (section III-B, Table I)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from caryatid.config import FusionConfig
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SUPPORT_SURFACE_ID, SceneObject, Support, SupportGraph, object_id
from caryatid.objects.sightings import axes_rotation, merge

Pair = tuple[str, str]


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """What the graphs of all views so far have said.

    Attributes:
        sightings: Per fused object id, its vertex in each view's graph that has it: view → vertex.
        supports: Per (supporter, supported), the edge in each view's graph that has it: view → edge.
        views: How many views have been fused.
    """

    sightings: Mapping[str, Mapping[int, SceneObject]] = field(default_factory=dict)
    supports: Mapping[Pair, Mapping[int, Support]] = field(default_factory=dict)
    views: int = 0


def fuse(
    evidence: Evidence, graph: SupportGraph, config: FusionConfig, *, same_labels: bool
) -> tuple[Evidence, dict[str, str]]:
    """Add one view's support graph to the evidence.

    Args:
        evidence: All views before.
        graph: G_s^{t+1}: of this view alone (`sg`), or of the registered cloud so far (`pc`, `pc+sg`).
        config: Tolerances of the match.
        same_labels: A label means the same object in every view, so that shapes need not be compared.

    Returns:
        The evidence with this view, and the fused id of each of the graph's objects.
    """
    # By label alone, any sighting will do.
    known = [_newest(seen) if same_labels else _vertex(seen, config) for seen in evidence.sightings.values()]
    names = match(known, list(graph.objects), config, same_labels=same_labels)
    taken = {*evidence.sightings, *names.values()}
    for o in graph.objects:
        if o.id not in names:
            names[o.id] = _fresh_id(o, taken)
            taken.add(names[o.id])
    sightings = {i: dict(seen) for i, seen in evidence.sightings.items()}
    for o in graph.objects:
        new_id = names[o.id]
        sightings.setdefault(new_id, {})[evidence.views] = _named(o, new_id)
    supports = {pair: dict(seen) for pair, seen in evidence.supports.items()}
    for s in graph.supports:
        renamed = replace(s, supporter=names[s.supporter], supported=names[s.supported])
        supports.setdefault(renamed.pair, {})[evidence.views] = renamed
    return Evidence(sightings, supports, evidence.views + 1), names


def absorbed(evidence: Evidence, names: Mapping[str, str]) -> Evidence:
    """Return the evidence with some objects taken for others: what was said of the old id counts for the new.

    Args:
        evidence: All views so far.
        names: Id to give up → id that takes its place; a support between the two is dropped.
    """
    if not names:
        return evidence
    sightings: dict[str, dict[int, SceneObject]] = {}
    for i, seen in evidence.sightings.items():
        new_id = names.get(i, i)
        merged = sightings.setdefault(new_id, {})
        merged.update({v: _named(o, new_id) for v, o in seen.items() if v not in merged})
    supports: dict[Pair, dict[int, Support]] = {}
    for (a, b), found in evidence.supports.items():
        pair = names.get(a, a), names.get(b, b)
        if pair[0] != pair[1]:
            renamed = {v: replace(s, supporter=pair[0], supported=pair[1]) for v, s in found.items()}
            supports.setdefault(pair, {}).update(renamed)
    return Evidence(sightings, supports, evidence.views)


def fused_graph(
    evidence: Evidence,
    config: FusionConfig,
    *,
    shown: Mapping[str, int] | None = None,
    contradicted: Mapping[str, int] | None = None,
) -> SupportGraph:
    """Read the fused graph off the evidence.

    With `pc` it is the newest graph, with its counts; with `sg` all that most of the views that could tell
    agree on; with `pc+sg` the newest graph's edges, and those of earlier ones that were mostly found.

    Args:
        evidence: All views.
        config: Method and the share an edge must keep.
        shown: Per object id, in how many views it was seen; without it, in how many graphs it is.
        contradicted: Per object id, in how many views something behind it was seen instead.
    """
    shown, contradicted = shown or {}, contradicted or {}
    newest = evidence.views - 1
    objects: dict[str, SceneObject] = {}
    for i, seen in evidence.sightings.items():
        if config.method == "pc" and newest not in seen:
            continue
        occurrences = shown.get(i, len(seen))
        opportunities = occurrences + contradicted.get(i, 0)
        if occurrences >= config.keep_share * opportunities:
            vertex = _vertex(seen, config)
            objects[i] = replace(vertex, occurrences=occurrences, opportunities=opportunities)
    supports = []
    for pair, found in evidence.supports.items():
        if pair[0] not in objects or pair[1] not in objects:
            continue
        both = evidence.sightings[pair[0]].keys() & evidence.sightings[pair[1]].keys()
        is_newest = newest in found
        mostly = len(found) >= config.keep_share * len(both)
        kept = {
            "pc": is_newest,
            "sg": mostly,
            "pc+sg": is_newest or len(found) > config.keep_share * len(both),
        }
        if kept[config.method]:
            last = found[max(found)]
            certain = last.certain if config.method != "sg" else any(s.certain for s in found.values())
            supports.append(replace(last, certain=certain, occurrences=len(found), opportunities=len(both)))
    ordered = sorted(objects.values(), key=lambda o: (o.role != "support_surface", o.label))
    rank = {o.id: k for k, o in enumerate(ordered)}
    supports.sort(key=lambda s: (rank[s.supporter], rank[s.supported]))
    return SupportGraph(tuple(ordered), tuple(supports))


def match(
    known: list[SceneObject], seen: list[SceneObject], config: FusionConfig, *, same_labels: bool
) -> dict[str, str]:
    """Match objects one to one: by label, or by shape, position, orientation and extent.

    Args:
        known: The fused objects.
        seen: The objects of a new graph.
        config: Tolerances.
        same_labels: A label means the same object in both; nothing else is compared then.

    Returns:
        Id of a new object → id of the known one it is.
    """
    if not known or not seen:
        return {}
    if same_labels:
        by_label = {(k.role, k.label): k.id for k in known}
        return {s.id: by_label[s.role, s.label] for s in seen if (s.role, s.label) in by_label}
    distances = _distances(known, seen, config)
    cost = np.full(distances.shape, np.inf)
    for r, c in np.argwhere(distances <= 1.0):
        cost[r, c] = _difference(known[r], seen[c], float(distances[r, c]), config)
    rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e6))
    return {seen[c].id: known[r].id for r, c in zip(rows, columns, strict=True) if np.isfinite(cost[r, c])}


def _distances(known: list[SceneObject], seen: list[SceneObject], config: FusionConfig) -> Array:
    """Distances (K, S) of the centres, as shares of what is tolerated; a table is only ever a table."""
    centres = [np.array([o.centre_world for o in objects]) for objects in (known, seen)]
    half = [np.array([o.shape.extents.min() / 2.0 for o in objects]) for objects in (known, seen)]
    sigma = [np.array([np.linalg.norm(_position(o)) for o in objects]) for objects in (known, seen)]
    table = [np.array([o.role == "support_surface" for o in objects]) for objects in (known, seen)]
    reach = np.maximum(config.max_distance, np.minimum(half[0][:, None], half[1]))
    reach += config.sigmas * np.hypot(sigma[0][:, None], sigma[1])
    distances = np.linalg.norm(centres[0][:, None] - centres[1], axis=-1) / reach
    distances[table[0][:, None] & table[1]] = 0.0
    distances[table[0][:, None] != table[1]] = np.inf
    return distances


def _difference(known: SceneObject, seen: SceneObject, distance: float, config: FusionConfig) -> float:
    """How different two sightings are: 0 the same, up to 4 within the tolerances, infinite beyond."""
    if known.role == "support_surface":
        return 0.0
    a, b = known.shape, seen.shape
    ratio = _extent_ratio(known, seen, config)
    kind_differs = a.kind != b.kind
    angle = 0.0 if kind_differs or _is_round(a) else np.degrees(axes_rotation(b, a)[1]) / config.max_angle
    size = np.log(ratio) / np.log(config.max_ratio)
    total = distance + size + angle + float(kind_differs)
    return total if max(distance, size, angle) <= 1.0 else np.inf


def _extent_ratio(known: SceneObject, seen: SceneObject, config: FusionConfig) -> float:
    """Largest ratio of the sorted extents, once what both fits' uncertainty explains is taken off."""
    a, b = known.shape.extents, seen.shape.extents
    first, second = np.argsort(a, kind="stable"), np.argsort(b, kind="stable")
    unsure = config.sigmas * np.hypot(_sizes(known)[first], _sizes(seen)[second])
    excess = np.maximum(np.abs(a[first] - b[second]) - unsure, 0.0)
    return float(np.max(1.0 + excess / np.minimum(a[first], b[second])))


def _position(o: SceneObject) -> Array:
    """Standard deviations (3,) [m] of the centre; zero where they are not known."""
    return np.zeros(3) if o.uncertainty is None else o.uncertainty.position


def _sizes(o: SceneObject) -> Array:
    """Standard deviations (3,) [m] of the extents; zero where they are not known."""
    return np.zeros(3) if o.uncertainty is None else o.uncertainty.sizes


def _is_round(shape: Shape) -> bool:
    """Orientation says nothing of a sphere, nor of a cylinder about as high as wide."""
    across, along = shape.extents[[0, 2]]
    return len(set(shape.ties)) < 3 and bool(abs(along - across) < 0.2 * along)


def _vertex(seen: Mapping[int, SceneObject], config: FusionConfig) -> SceneObject:
    return merge([seen[v] for v in sorted(seen)], config) if config.method == "sg" else _newest(seen)


def _newest(seen: Mapping[int, SceneObject]) -> SceneObject:
    return seen[max(seen)]


def _named(o: SceneObject, new_id: str) -> SceneObject:
    return o if new_id == o.id else replace(o, id=new_id, label=int(new_id[1:]))


def _fresh_id(o: SceneObject, taken: set[str]) -> str:
    if o.role == "support_surface":
        return SUPPORT_SURFACE_ID
    label = o.label
    while object_id(label) in taken:
        label += 1
    return object_id(label)
