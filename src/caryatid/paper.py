"""The paper as printed, where the defaults differ: graphs of single views, matching by shape, and eq. 1.

`Scene(config)` is a `PaperScene` with `fusion.matching = "shapes"` or `support.stability = "area"`, and a
`ViewScene` with `fusion.method = "sg"`: the same stages, composed as in section III.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from caryatid.config import Config, FusionConfig, SupportConfig
from caryatid.geometry import polygons, transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import LIKELY, SceneObject, Stability, Support, SupportGraph
from caryatid.objects.fusion import (
    Graphs,
    arrange_graph,
    average_belief,
    axes_rotation,
    extents_ratio,
    find_turns,
    find_views_showing,
    group_by_view,
)
from caryatid.scene import Scene
from caryatid.segmentation.observation import Observation
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.views import Cloud, View
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.support.equilibrium import touching
from caryatid.support.relations import make_support, nearest_contacts, sort_objects
from caryatid.support.stability import assess


def choose_scene(config: Config) -> type[Scene]:
    """Choose the class of scene that the settings ask for."""
    if config.fusion.method == "sg":
        return ViewScene
    by_paper = config.fusion.matching == "shapes" or config.support.stability == "area"
    return PaperScene if by_paper else Scene


class PaperScene(Scene):
    """A scene whose vertices are matched by shape (III-B), or whose supports follow from areas (eq. 1)."""

    def _named(self, source: View | Cloud) -> bool:
        return self.config.fusion.matching == "points" and super()._named(source)

    def _rename_objects(self, names: dict[str, str]) -> None:
        if self.config.fusion.matching == "points":
            super()._rename_objects(names)

    def _match_objects(self, newest: SupportGraph, given: bool) -> dict[str, str] | None:
        if self.config.fusion.matching == "points":
            return super()._match_objects(newest, given)
        vertices = [seen[max(seen)] for seen in group_by_view(self._graphs)[0].values()]
        return match_by_shape(vertices, newest.objects, self.config.fusion)

    def _infer_supports(self, objects: Sequence[SceneObject]) -> SupportGraph:
        if self.config.support.stability == "area":
            return infer_by_area(objects, self.config.support)
        return super()._infer_supports(objects)


class ViewScene(PaperScene):
    """A scene that fuses the graphs of its views, each from the points of one view (`sg`, III-B)."""

    def _label_of(self, object_id: str) -> int | None:
        label = super()._label_of(object_id)
        return label if self.identified or label in self._ids else None

    def _associate_segments(
        self, observation: Observation, given: bool, new: dict[int, str]
    ) -> tuple[Observation, dict[int, str]]:
        return super()._associate_segments(observation, given, new) if given else (observation, new)

    def _list_known_objects(self) -> list[SceneObject]:
        # The models have the newest view's objects alone.
        return list(self.graph.movable)

    def _find_appeared(self, observation: Observation, voxels: VoxelMap) -> dict[int, str]:
        return super()._find_appeared(observation, voxels) if self.identified else {}

    def _mapped(self, observation: Observation, carrying: Sequence[SupportSurface]) -> VoxelMap:
        """Add the view to the map; return one of this view alone."""
        super()._mapped(observation, carrying)
        assert self.sphere is not None
        voxels = VoxelMap.around(self.sphere.centre_world, self.config.voxels)
        if observation.view is not None:
            voxels = voxels.integrate(observation.view, self.config.cloud.max_depth)
        return voxels

    def _form_objects(
        self, observation: Observation, shown: set[int], voxels: VoxelMap, table: Array, given: bool
    ) -> Observation:
        self._models.fit_newest(set(observation.shown_objects), voxels)
        return observation

    def _surfaces(self) -> dict[str, tuple[Array, Array]]:
        return {o.id: o.shape.surface(0.01) for o in self.graph.movable}

    def _match_objects(self, newest: SupportGraph, given: bool) -> dict[str, str] | None:
        if given and self.config.fusion.matching == "points":
            return super()._match_objects(newest, given)
        vertices = [merge_sightings([*seen.values()]) for seen in group_by_view(self._graphs)[0].values()]
        return match_by_shape(vertices, newest.objects, self.config.fusion)

    def _fuse_graphs(self) -> SupportGraph:
        return unite_graphs(self._graphs, self.config.fusion, shown=self._shown)


def infer_by_area(objects: Sequence[SceneObject], config: SupportConfig) -> SupportGraph:
    """Infer supports by the rules of the paper: separating planes and eq. 1, without probabilities.

    At each separating plane, the lower object supports the upper one, and everything on top of an object with
    a small support area holds it down.

    Args:
        objects: Shapes in the world frame; nothing supports those with role `support_surface`.
        config: The stage's numbers.

    Raises:
        InputError: Two objects have the same id.
    """
    ordered = sort_objects(objects)
    nearest = nearest_contacts(ordered, touching(ordered, config.contact_margin))
    below = {pair: c for pair, c in nearest.items() if c.tilt <= config.max_tilt}
    stability: dict[str, Stability] = {}
    supports = {pair: make_support(ordered, c, config) for pair, c in below.items()}
    for k, o in enumerate(ordered):
        if o.role == "support_surface":
            continue
        patches = [polygons.hull(c.points_world) for (_, b), c in below.items() if b == k]
        stability[o.id] = assess(o.shape, patches, config)
        if not stability[o.id].stable:
            riders = {(b, a) for a, b in below if a == k} - supports.keys()
            supports |= {pair: make_support(ordered, nearest[pair], config) for pair in riders}
    return SupportGraph(ordered, tuple(supports[pair] for pair in sorted(supports)), stability)


def unite_graphs(
    graphs: Graphs, config: FusionConfig, *, shown: Sequence[frozenset[str]] | None = None
) -> SupportGraph:
    """Unite the graphs of single views: everything that most of the views that could show it agree on (`sg`).

    Args:
        graphs: The graphs of all views, with the ids of the fused objects.
        config: The share an edge must keep.
        shown: Ids of the objects each view showed; without it, those in its graph. Only a view that showed
            both ends could have shown an edge.
    """
    sightings, edges = group_by_view(graphs)
    showing = find_views_showing(graphs, shown)
    objects = [
        replace(merge_sightings([*seen.values()]), occurrences=len(showing[i]), opportunities=len(showing[i]))
        for i, seen in sightings.items()
    ]
    supports = list[Support]()
    for pair, found in edges.items():
        views = set.intersection(*(showing[i] & sightings[i].keys() for i in pair))
        occurrences = len(views & found.keys())
        if occurrences < config.keep_share * len(views):
            continue
        last = replace(found[max(found)], certain=any(s.certain for s in found.values()))
        if last.probability is not None and views:
            last = replace(last, probability=average_belief(found, views))
        if last.belief >= LIKELY:
            supports.append(replace(last, occurrences=occurrences, opportunities=len(views)))
    return arrange_graph(objects, supports)


def match_by_shape(
    known: Sequence[SceneObject], seen: Sequence[SceneObject], config: FusionConfig
) -> dict[str, str]:
    """Match objects one to one by shape, position, orientation and extent.

    Args:
        known: The fused objects.
        seen: The objects of a new graph.
        config: Tolerances.

    Returns:
        Id of a new object → id of the same known object.
    """
    if not known or not seen:
        return {}
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


def _is_round(shape: Shape) -> bool:
    """A sphere has no orientation, nor does a cylinder about as high as wide."""
    across, along = shape.extents[[0, 2]]
    return len(set(shape.ties)) < 3 and bool(abs(along - across) < 0.2 * along)


def merge_sightings(sightings: Sequence[SceneObject]) -> SceneObject:
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


def _merged_sides(
    same: Sequence[SceneObject], weights: Array, best: SceneObject
) -> tuple[Box | Cylinder, Any]:
    """Average axes, then each of the six sides along them."""
    T = np.array([o.shape.T_world_object for o in same])
    extents = np.array([o.shape.extents for o in same])
    round_ = isinstance(best.shape, Cylinder)
    turns = find_turns(T[:, :3, :3], best.shape.T_world_object[:3, :3], round_)
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


def _mean_axes(mean: Array, axis_only: bool) -> Array:
    """Chordal mean of rotations from their average; for a cylinder only the axis matters."""
    if axis_only:
        z = transforms.unit(mean[:, 2])
        x = transforms.perpendicular(z)
        return np.stack([x, np.cross(z, x), z], axis=1)
    u, _, vt = np.linalg.svd(mean)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
