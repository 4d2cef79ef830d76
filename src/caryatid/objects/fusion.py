"""Fusing support graphs over views: matching and merging objects, counting evidence (section III-B)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.config import FusionConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Cylinder, Shape, Sphere
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import LIKELY, SceneObject, Support, SupportGraph, label_of, object_id, vertex_order

Pair = tuple[str, str]
Graphs = tuple[SupportGraph, ...]

_EARLIER = 0.25
"""Probability that an earlier view was right about a support that it was sure of and the newest denies [1]:
3 of 11 in simulated scenes of boards on pillars."""
_TURNS = np.rint(Rotation.create_group("O").as_matrix())
"""The 24 rotations (24, 3, 3) of a cube: ways to name the axes of a box."""


def fuse(
    graphs: Graphs, graph: SupportGraph, matched: Mapping[str, str] | None = None, *, whole: bool = False
) -> tuple[Graphs, dict[str, str]]:
    """Add one view's support graph to those before, with the ids of the fused objects.

    Args:
        graphs: The graphs of all earlier views.
        graph: G_s^{t+1}, of the registered cloud so far or, for `sg`, of this view alone.
        matched: Id of a new object → id of the same known object; without it, a label means the same object
            in every view.
        whole: Keep all of the earlier graphs, also what no longer counts beside a newer one.

    Returns:
        All graphs, and the fused id of each of the new graph's objects.
    """
    sightings, _ = group_by_view(graphs)
    if matched is None:
        newest = (seen[max(seen)] for seen in sightings.values())
        by_label = {(o.role, o.label): o.id for o in newest}
        matched = {o.id: by_label[o.role, o.label] for o in graph.objects if (o.role, o.label) in by_label}
    names, taken = dict(matched), {*sightings, *matched.values()}
    for o in graph.objects:
        if o.id not in names:
            names[o.id] = _fresh_id(o, taken)
            taken.add(names[o.id])
    if graphs and not whole:  # The last one stays whole: a report may replace the one added here.
        graphs = (*_superseded(graphs[:-1], graphs[-1]), graphs[-1])
    return (*graphs, renamed(graph, names)), names


def _superseded(graphs: Graphs, newer: SupportGraph) -> Graphs:
    """Keep of graphs only what counts beside a newer one: ids, and probabilities of supports.

    Without this, the memory of a session would grow with every view.
    """
    objects, pairs = {o.id: o for o in newer.objects}, {s.pair for s in newer.supports}
    return tuple(
        SupportGraph(
            tuple(objects.get(o.id, o) for o in g.objects),
            tuple(_bare(s) if s.why and s.pair in pairs else s for s in g.supports),
        )
        for g in graphs
    )


def _bare(s: Support) -> Support:
    return replace(s, contact_world=None, normal_world=None, why="")


def renamed(graph: SupportGraph, names: Mapping[str, str]) -> SupportGraph:
    """Return a graph of one view with other names, old id → new id; of two with the same new id, one stays.

    A support between two equal ids is dropped. Texts name the new ids.
    """
    known = re.compile(rf"\b({'|'.join(map(re.escape, names))})\b" if names else r"(?!)")

    def told(text: str) -> str:
        return known.sub(lambda found: names[found[0]], text)

    objects: dict[str, SceneObject] = {}
    for o in graph.objects:
        new_id = names.get(o.id, o.id)
        named = o if new_id == o.id else replace(o, id=new_id, label=label_of(new_id))
        if o.doubt:
            named = _without_doubts(replace(named, doubt=told(o.doubt)), {new_id})
        objects.setdefault(new_id, named)
    supports: dict[Pair, Support] = {}
    for s in graph.supports:
        a, b = (names.get(i, i) for i in s.pair)
        if a != b:
            supports[a, b] = replace(s, supporter=a, supported=b, why=told(s.why))
    stability = {names.get(i, i): verdict for i, verdict in graph.stability.items()}
    return SupportGraph(tuple(objects.values()), tuple(supports.values()), stability)


def without(graph: SupportGraph, ids: Set[str]) -> SupportGraph:
    """Return a graph without some objects, their supports, and the doubts that name them."""
    objects = tuple(_without_doubts(o, ids) for o in graph.objects if o.id not in ids)
    supports = tuple(s for s in graph.supports if ids.isdisjoint(s.pair))
    return SupportGraph(objects, supports, {i: v for i, v in graph.stability.items() if i not in ids})


def _without_doubts(o: SceneObject, ids: Set[str]) -> SceneObject:
    """An object without the doubts that name some ids."""
    doubt = "; ".join(d for d in o.doubt.split("; ") if ids.isdisjoint(d.split()))
    return o if doubt == o.doubt else replace(o, doubt=doubt)


def fused_graph(
    graphs: Graphs, config: FusionConfig, *, shown: Sequence[frozenset[str]] | None = None
) -> SupportGraph:
    """Derive the fused graph from those of all views.

    With `pc` it is the newest graph, with its counts; with `pc+sg` the newest graph's edges, and those
    earlier ones that were mostly found. Where the newest graph denies a support that the one before it was
    sure of, its others of that object are less probable.

    Args:
        graphs: The graphs of all views, with the ids of the fused objects.
        config: Method and the share an edge must keep.
        shown: Ids of the objects each view showed; without it, those in its graph. Only a view that showed
            both ends could have shown an edge.
    """
    newest, (sightings, edges) = len(graphs) - 1, group_by_view(graphs)
    showing = find_views_showing(graphs, shown)
    disputed = {
        pair[1]
        for pair, found in edges.items()
        if newest - 1 in found and newest not in found and not found[newest - 1].doubtful
        and all(newest in sightings[i] for i in pair)
    }  # fmt: skip
    objects = {
        i: replace(seen[max(seen)], occurrences=len(showing[i]), opportunities=len(showing[i]))
        for i, seen in sightings.items()
        if config.method != "pc" or newest in seen
    }
    supports = []
    for pair, found in edges.items():
        if pair[0] not in objects or pair[1] not in objects:
            continue
        views = set.intersection(*(showing[i] & sightings[i].keys() for i in pair))
        occurrences = len(views & found.keys())
        if newest not in found and (config.method == "pc" or occurrences <= config.keep_share * len(views)):
            continue
        last = found[max(found)]
        if last.probability is not None and views and newest not in found:
            last = replace(last, probability=average_belief(found, views))
        elif last.probability is not None and pair[1] in disputed and newest in found:
            before = found[newest - 1].belief if newest - 1 in found else 0.0
            last = replace(last, probability=(1.0 - _EARLIER) * last.probability + _EARLIER * before)
        if last.belief >= LIKELY:
            supports.append(replace(last, occurrences=occurrences, opportunities=len(views)))
    gone = {i for i in sightings if i not in objects}
    return arrange_graph((_without_doubts(o, gone) for o in objects.values()), supports)


def find_views_showing(graphs: Graphs, shown: Sequence[frozenset[str]] | None) -> dict[str, set[int]]:
    """Find the views that showed each object; by default, those whose graphs have it."""
    showing: dict[str, set[int]] = {o.id: set() for graph in graphs for o in graph.objects}
    for view, ids in enumerate(shown or [{o.id for o in graph.objects} for graph in graphs]):
        for i in ids & showing.keys():
            showing[i].add(view)
    return showing


def average_belief(found: Mapping[int, Support], views: Set[int]) -> float:
    """Average the belief in a support over views; one that did not find it counts 0."""
    return sum(found[v].belief for v in views & found.keys()) / len(views)


def arrange_graph(objects: Iterable[SceneObject], supports: Iterable[Support]) -> SupportGraph:
    """Make a graph: support surfaces first, objects by label, and supports in the order of objects."""
    ordered = sorted(objects, key=vertex_order)
    rank = {o.id: k for k, o in enumerate(ordered)}
    edges = sorted(supports, key=lambda s: (rank[s.supporter], rank[s.supported]))
    return SupportGraph(tuple(ordered), tuple(edges))


def extents_ratio(a: SceneObject, b: SceneObject) -> float:
    """Largest ratio of the sorted extents of two objects, less what the uncertainty of both explains."""
    order = [np.argsort(o.shape.extents, kind="stable") for o in (a, b)]
    first, second = (o.shape.extents[rows] for o, rows in zip((a, b), order, strict=True))
    unsure = [np.zeros(3) if o.uncertainty is None else 2.0 * o.uncertainty.sizes for o in (a, b)]
    excess = np.abs(first - second) - np.hypot(*(u[rows] for u, rows in zip(unsure, order, strict=True)))
    return float(np.max(1.0 + np.maximum(excess, 0.0) / np.minimum(first, second)))


def group_by_view(
    graphs: Graphs,
) -> tuple[dict[str, dict[int, SceneObject]], dict[Pair, dict[int, Support]]]:
    """Return vertices by id and edges by their ends, each in the views whose graphs have it: view → it."""
    sightings: dict[str, dict[int, SceneObject]] = {}
    edges: dict[Pair, dict[int, Support]] = {}
    for view, graph in enumerate(graphs):
        for o in graph.objects:
            sightings.setdefault(o.id, {})[view] = o
        for s in graph.supports:
            edges.setdefault(s.pair, {})[view] = s
    return sightings, edges


def _fresh_id(o: SceneObject, taken: set[str]) -> str:
    if o.role == "support_surface":
        return object_id(o.label)
    label = o.label
    while object_id(label) in taken:
        label += 1
    return object_id(label)


def axes_rotation(shape: Shape, reference: Shape) -> tuple[Array, float]:
    """Rotation of a shape's axes, within its symmetry, that brings them nearest to a reference's.

    Returns:
        The rotation (3, 3), to be applied on the right of the shape's own, and the remaining angle [rad];
        for a sphere the identity and 0.
    """
    if isinstance(shape, Sphere):
        return np.eye(3), 0.0
    R, R_reference = shape.T_world_object[:3, :3], reference.T_world_object[:3, :3]
    if isinstance(shape, Solid):
        return np.eye(3), float(Rotation.from_matrix(R_reference.T @ R).magnitude())
    round_ = isinstance(shape, Cylinder)
    turn = find_turns(R[None], R_reference, round_)[0]
    if round_:
        return turn, float(transforms.angle_between((R @ turn)[:, 2], R_reference[:, 2]))
    trace = float(np.sum((R @ turn) * R_reference))
    return turn, float(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def find_turns(R: Array, R_reference: Array, axis_only: bool) -> Array:
    """Find the turns (K, 3, 3) within a shape's symmetry that bring axes (K, 3, 3) nearest to (3, 3)."""
    if axis_only:
        flipped = R[:, :, 2] @ R_reference[:, 2] < 0.0
        return np.where(flipped[:, None, None], np.diag([1.0, -1.0, -1.0]), np.eye(3))
    traces = (np.swapaxes(R, 1, 2) @ R_reference).reshape(-1, 9) @ _TURNS.reshape(-1, 9).T
    return _TURNS[traces.argmax(axis=1)]


def changed(before: SupportGraph, after: SupportGraph, config: FusionConfig) -> bool:
    """Whether a vertex came, went or changed its shape beyond the tolerance, or an edge came or went."""
    earlier = {o.id: o for o in before.objects}
    if earlier.keys() != {o.id for o in after.objects}:
        return True
    if {s.pair for s in before.supports} != {s.pair for s in after.supports}:
        return True
    return any(reshaped(earlier[o.id], o, config) for o in after.movable)


def reshaped(before: SceneObject, after: SceneObject, config: FusionConfig) -> bool:
    """Whether an object's shape moved, turned or grew by more than the tolerance."""
    a, b = before.shape, after.shape
    if a is b:
        return False
    if a.kind != b.kind or np.linalg.norm(before.centre_world - after.centre_world) > config.settled:
        return True
    turn, angle = axes_rotation(b, a)
    lever = float(a.extents.max()) / 2.0
    return bool(
        np.abs(a.extents - np.abs(turn.T @ b.extents)).max() > config.settled
        or angle * lever > config.settled
    )
