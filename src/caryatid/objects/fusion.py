"""Fusing support graphs over views: matching and merging objects, counting evidence (section III-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from caryatid.config import FusionConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import LIKELY, SUPPORT_SURFACE_ID, SceneObject, Support, SupportGraph, object_id

Pair = tuple[str, str]
Graphs = tuple[SupportGraph, ...]

_EARLIER = 0.25
"""Probability that an earlier view was right about a support that it was sure of and the newest denies [1]:
3 of 11 in simulated scenes of boards on pillars."""
_TURNS = np.rint(Rotation.create_group("O").as_matrix())
"""The 24 rotations (24, 3, 3) of a cube: ways to name the axes of a box."""


def fuse(
    graphs: Graphs, graph: SupportGraph, config: FusionConfig, *, same_labels: bool
) -> tuple[Graphs, dict[str, str]]:
    """Add one view's support graph to those before, with the ids of the fused objects.

    Args:
        graphs: The graphs of all earlier views.
        graph: G_s^{t+1}: of this view alone (`sg`), or of the registered cloud so far (`pc`, `pc+sg`).
        config: Tolerances of the match.
        same_labels: A label means the same object in every view, so shapes are not compared.

    Returns:
        All graphs, and the fused id of each of the new graph's objects.
    """
    sightings, _ = _by_view(graphs)
    # By label alone, any sighting is enough.
    known = [seen[max(seen)] if same_labels else _vertex(seen, config) for seen in sightings.values()]
    names = match(known, list(graph.objects), config, same_labels=same_labels)
    taken = {*sightings, *names.values()}
    for o in graph.objects:
        if o.id not in names:
            names[o.id] = _fresh_id(o, taken)
            taken.add(names[o.id])
    if config.method != "sg" and graphs:  # The last one stays whole: a report may replace the one added here.
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

    A support between two equal ids is dropped.
    """
    objects: dict[str, SceneObject] = {}
    for o in graph.objects:
        new_id = names.get(o.id, o.id)
        named = o if new_id == o.id else replace(o, id=new_id, label=int(new_id[1:]))
        objects.setdefault(new_id, named)
    supports: dict[Pair, Support] = {}
    for s in graph.supports:
        a, b = (names.get(i, i) for i in s.pair)
        if a != b:
            supports[a, b] = replace(s, supporter=a, supported=b)
    stability = {names.get(i, i): verdict for i, verdict in graph.stability.items()}
    return SupportGraph(tuple(objects.values()), tuple(supports.values()), stability)


def without(graph: SupportGraph, ids: Set[str]) -> SupportGraph:
    """Return a graph without some objects and their supports."""
    objects = tuple(o for o in graph.objects if o.id not in ids)
    return SupportGraph(objects, tuple(s for s in graph.supports if ids.isdisjoint(s.pair)))


def fused_graph(
    graphs: Graphs, config: FusionConfig, *, shown: Sequence[frozenset[str]] | None = None
) -> SupportGraph:
    """Derive the fused graph from those of all views.

    With `pc` it is the newest graph, with its counts; with `sg` everything that most of the views that could
    show it agree on; with `pc+sg` the newest graph's edges, and those earlier ones that were mostly found.
    Where the newest graph denies a support that the one before it was sure of, its others of that object are
    less probable.

    Args:
        graphs: The graphs of all views, with the ids of the fused objects.
        config: Method and the share an edge must keep.
        shown: Ids of the objects each view showed; without it, those in its graph. Only a view that showed
            both ends could have shown an edge.
    """
    newest, (sightings, edges) = len(graphs) - 1, _by_view(graphs)
    showing: dict[str, set[int]] = {i: set() for i in sightings}
    for view, ids in enumerate(shown or [{o.id for o in graph.objects} for graph in graphs]):
        for i in ids & showing.keys():
            showing[i].add(view)
    disputed = {
        pair[1]
        for pair, found in edges.items()
        if newest - 1 in found and newest not in found and not found[newest - 1].doubtful
        and all(newest in sightings[i] for i in pair)
    }  # fmt: skip
    objects: dict[str, SceneObject] = {}
    for i, seen in sightings.items():
        if config.method == "pc" and newest not in seen:
            continue
        count = len(showing[i])
        objects[i] = replace(_vertex(seen, config), occurrences=count, opportunities=count)
    supports = []
    for pair, found in edges.items():
        if pair[0] not in objects or pair[1] not in objects:
            continue
        views = set.intersection(*(showing[i] & sightings[i].keys() for i in pair))
        occurrences, least = len(views & found.keys()), config.keep_share * len(views)
        mostly = occurrences >= least if config.method == "sg" else occurrences > least
        if (mostly and config.method != "pc") or (newest in found and config.method != "sg"):
            last = found[max(found)]
            certain = last.certain if config.method != "sg" else any(s.certain for s in found.values())
            if last.probability is not None and views and (newest not in found or config.method == "sg"):
                # A view that did not find it counts 0.
                likely = sum(found[v].belief for v in views & found.keys()) / len(views)
                last = replace(last, probability=likely)
            elif last.probability is not None and pair[1] in disputed and newest in found:
                before = found[newest - 1].belief if newest - 1 in found else 0.0
                likely = (1.0 - _EARLIER) * last.probability + _EARLIER * before
                last = replace(last, probability=likely)
            if last.belief < LIKELY:
                continue
            supports.append(replace(last, certain=certain, occurrences=occurrences, opportunities=len(views)))
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
        same_labels: A label means the same object in both; then nothing else is compared.

    Returns:
        Id of a new object → id of the same known object.
    """
    if not known or not seen:
        return {}
    if same_labels:
        by_label = {(k.role, k.label): k.id for k in known}
        return {s.id: by_label[s.role, s.label] for s in seen if (s.role, s.label) in by_label}
    cost = np.array([[_difference(k, s, config) for s in seen] for k in known])
    rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e6))
    return {seen[c].id: known[r].id for r, c in zip(rows, columns, strict=True) if np.isfinite(cost[r, c])}


def _difference(known: SceneObject, seen: SceneObject, config: FusionConfig) -> float:
    """How different two sightings are: 0 the same, up to 4 within the tolerances, infinite beyond."""
    if "support_surface" in (known.role, seen.role):
        return 0.0 if known.role == seen.role else np.inf
    a, b = known.shape, seen.shape
    place, other = (np.zeros(3) if o.uncertainty is None else o.uncertainty.position for o in (known, seen))
    reach = max(config.max_distance, float(min(a.extents.min(), b.extents.min())) / 2.0)
    reach += 2.0 * float(np.hypot(np.linalg.norm(place), np.linalg.norm(other)))
    distance = float(np.linalg.norm(known.centre_world - seen.centre_world)) / reach
    if distance > 1.0:
        return np.inf
    kind_differs = a.kind != b.kind
    angle = 0.0 if kind_differs or _is_round(a) else np.degrees(axes_rotation(b, a)[1]) / config.max_angle
    size = float(np.log(extents_ratio(known, seen)) / np.log(config.max_ratio))
    total = distance + size + angle + float(kind_differs)
    return total if max(size, angle) <= 1.0 else np.inf


def extents_ratio(a: SceneObject, b: SceneObject) -> float:
    """Largest ratio of the sorted extents of two objects, less what the uncertainty of both explains."""
    order = [np.argsort(o.shape.extents, kind="stable") for o in (a, b)]
    first, second = (o.shape.extents[rows] for o, rows in zip((a, b), order, strict=True))
    unsure = [np.zeros(3) if o.uncertainty is None else 2.0 * o.uncertainty.sizes for o in (a, b)]
    excess = np.abs(first - second) - np.hypot(*(u[rows] for u, rows in zip(unsure, order, strict=True)))
    return float(np.max(1.0 + np.maximum(excess, 0.0) / np.minimum(first, second)))


def _is_round(shape: Shape) -> bool:
    """A sphere has no orientation, nor does a cylinder about as high as wide."""
    across, along = shape.extents[[0, 2]]
    return len(set(shape.ties)) < 3 and bool(abs(along - across) < 0.2 * along)


def _vertex(seen: Mapping[int, SceneObject], config: FusionConfig) -> SceneObject:
    return merged_sightings([seen[v] for v in sorted(seen)]) if config.method == "sg" else seen[max(seen)]


def _by_view(
    graphs: Graphs,
) -> tuple[dict[str, dict[int, SceneObject]], dict[Pair, dict[int, Support]]]:
    """Vertices by their ids and edges by their ends, each in the views whose graphs have it: view → it."""
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
        return SUPPORT_SURFACE_ID
    label = o.label
    while object_id(label) in taken:
        label += 1
    return object_id(label)


def merged_sightings(sightings: Sequence[SceneObject]) -> SceneObject:
    """Merge sightings of one object into a vertex with a better shape.

    The kind is the one with the most evidence; among solids, the best one is used as it is. Poses and radii
    are averaged with the evidence as weight. Each side is averaged over the sightings that saw it, or lies
    farthest out if none did. Apart from rounding, the result does not depend on the order of the sightings,
    except that id, label and role are those of the first.
    """
    # The number of seen sides, or little if there are none; half of it at a residual of 1 cm.
    weights = [(0.1 + sum(o.seen)) / (1.0 + (o.residual / 0.01) ** 2) for o in sightings]
    votes = {o.shape.kind: 0.0 for o in sorted(sightings, key=lambda o: o.shape.kind)}
    for weight, o in zip(weights, sightings, strict=True):
        votes[o.shape.kind] += weight
    kind = max(votes, key=lambda k: votes[k])
    same = [o for o in sightings if o.shape.kind == kind]
    w = np.array([weight for weight, o in zip(weights, sightings, strict=True) if o.shape.kind == kind])
    best = same[int(np.argmax(w))]
    shape, seen = best.shape, best.seen
    if len(same) > 1 and isinstance(shape, Sphere):
        centre = np.average([o.centre_world for o in same], axis=0, weights=w)
        radius = float(np.average([o.shape.extents[0] / 2.0 for o in same], weights=w))
        shape = Sphere(transforms.rigid(np.eye(3), centre), radius)
    elif len(same) > 1 and not isinstance(shape, Solid):
        shape, seen = _merged_sides(same, w, best)
    return replace(
        sightings[0],
        shape=shape,
        seen=seen,
        residual=float(np.average([o.residual for o in same], weights=w)),
        poor_fit=best.poor_fit,
        uncertainty=best.uncertainty,
        why=best.why,
        doubt=sightings[-1].doubt,
    )


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
    turn = _turns(R[None], R_reference, round_)[0]
    if round_:
        return turn, float(transforms.angle_between((R @ turn)[:, 2], R_reference[:, 2]))
    trace = float(np.sum((R @ turn) * R_reference))
    return turn, float(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def _merged_sides(
    same: Sequence[SceneObject], weights: Array, best: SceneObject
) -> tuple[Box | Cylinder, Any]:
    """Average axes, then each of the six sides along them."""
    T = np.array([o.shape.T_world_object for o in same])
    extents = np.array([o.shape.extents for o in same])
    round_ = isinstance(best.shape, Cylinder)
    turns = _turns(T[:, :3, :3], best.shape.T_world_object[:3, :3], round_)
    R = _mean_axes(np.average(T[:, :3, :3] @ turns, axis=0, weights=weights), round_)
    middles = T[:, :3, 3] @ R
    half = np.abs(np.einsum("kij,ki->kj", turns, extents))[:, :, None] / 2.0
    ends = middles[:, :, None] + half * (-1.0, 1.0)
    # The sides along a new axis are those along one of the old axes, in reverse order if it points back.
    sources = np.abs(turns).argmax(axis=1)
    seen = np.take_along_axis(np.array([o.seen for o in same]).reshape(-1, 3, 2), sources[:, :, None], axis=1)
    ahead = turns.sum(axis=1)[:, :, None] > 0.0
    seen = np.where(ahead, seen, seen[:, :, ::-1])
    share = weights[:, None, None] * seen
    known = seen.any(axis=0)
    mean = (share * ends).sum(axis=0) / np.where(known, share.sum(axis=0), 1.0)
    widest = np.stack([ends[:, :, 0].min(axis=0), ends[:, :, 1].max(axis=0)], axis=1)
    low, high = np.where(known, mean, widest).T
    flags = tuple(known.ravel().tolist())
    if round_:
        centre = np.average(middles, axis=0, weights=weights)
        centre[2] = (low[2] + high[2]) / 2.0
        radius = float(np.average(extents[:, 0] / 2.0, weights=weights))
        return Cylinder(transforms.rigid(R, R @ centre), radius, float(max(high[2] - low[2], 1e-3))), flags
    return Box(transforms.rigid(R, R @ ((low + high) / 2.0)), np.maximum(high - low, 1e-3)), flags


def _turns(R: Array, R_reference: Array, axis_only: bool) -> Array:
    """Turns (K, 3, 3) within a shape's symmetry that bring axes (K, 3, 3) nearest to a reference's (3, 3)."""
    if axis_only:
        flipped = R[:, :, 2] @ R_reference[:, 2] < 0.0
        return np.where(flipped[:, None, None], np.diag([1.0, -1.0, -1.0]), np.eye(3))
    traces = (np.swapaxes(R, 1, 2) @ R_reference).reshape(-1, 9) @ _TURNS.reshape(-1, 9).T
    return _TURNS[traces.argmax(axis=1)]


def _mean_axes(mean: Array, axis_only: bool) -> Array:
    """Chordal mean of rotations from their average; for a cylinder only the axis matters."""
    if axis_only:
        z = transforms.unit(mean[:, 2])
        x = transforms.perpendicular(z)
        return np.stack([x, np.cross(z, x), z], axis=1)
    u, _, vt = np.linalg.svd(mean)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def changed(before: SupportGraph, after: SupportGraph, config: FusionConfig) -> bool:
    """Whether a vertex came, went or changed its shape beyond the tolerance, or an edge came or went."""
    earlier = {o.id: o for o in before.objects}
    if earlier.keys() != {o.id for o in after.objects}:
        return True
    if {s.pair for s in before.supports} != {s.pair for s in after.supports}:
        return True
    return any(reshaped(earlier[o.id], o, config) for o in after.objects if o.role == "object")


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
