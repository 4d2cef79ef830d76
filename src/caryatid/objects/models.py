"""The points of every object and the shape fitted to them, updated view by view."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from itertools import combinations, compress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from caryatid.config import Config, SegmentationConfig
from caryatid.fitting.primitives import ALONG, CONFIRMED, Fit, FitFailure, fit, free_inside
from caryatid.geometry import transforms
from caryatid.geometry.points import last_in_voxels, most_central, rotate, transform
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, object_id
from caryatid.objects.compounds import Compound, shape_costs
from caryatid.objects.description_length import (
    Evidence,
    Explanation,
    best_compound,
    best_explanation,
    colour_costs,
    explained,
    plain_colour,
)
from caryatid.objects.model_selection import GROWTH, Groups, best_merge, split
from caryatid.objects.reasons import Reasons, explain_object, explain_pair
from caryatid.objects.solids import as_solid
from caryatid.runtime.parallel import on_threads
from caryatid.segmentation.observation import Observation
from caryatid.sensing.clouds import GRAZING, thin
from caryatid.sensing.views import MAX_LABEL, SUPPORT_LABEL, Cloud
from caryatid.sensing.voxel_map import VoxelMap

OtherColour = Callable[[int, NDArray[np.intp]], NDArray[np.bool_]]
"""Which points of an index (M,) have another colour than the object of a name: (M,)."""


class ObjectPoints:
    """What has been seen of each object, and of the support surface, so far; grows with every view.

    The points are grouped by object. Those of one object are in the order of their views, and those taken
    over from another one come after them.

    Attributes:
        labels_used: The highest label an object ever had; new ones are numbered from the next one.
    """

    def __init__(self) -> None:
        self.labels_used = 0
        self._cloud = Cloud(np.zeros((0, 3)), np.zeros((0, 3)))
        self._labels = np.zeros(0, dtype=np.int32)
        self._views = np.zeros(0, dtype=np.int32)
        self._grazing_mask = np.zeros(0, dtype=np.bool_)
        self._colourless: frozenset[int] = frozenset()
        self._selected: dict[tuple[int, float], Cloud] = {}

    def copy(self) -> ObjectPoints:
        """Return points that go on growing by themselves; the points so far are shared."""
        other = copy.copy(self)
        other._selected = self._selected.copy()
        return other

    def add(self, cloud: Cloud, labels: NDArray[np.int32], view: int, *, masked: bool = True) -> None:
        """Add a view's points with their labels (N,), from masks or not; colours stay if all have them."""
        order = np.argsort(labels, kind="stable")
        labels, cloud, known = labels[order], cloud.select(order), self._cloud
        after = np.searchsorted(self._labels, labels, side="right")
        rgb = cloud.rgb
        if len(known) and rgb is not None:
            rgb = None if known.rgb is None else np.insert(known.rgb, after, rgb, axis=0)
        self._cloud = Cloud(
            np.insert(known.points_world, after, cloud.points_world, axis=0),
            np.insert(known.normals_world, after, cloud.normals_world, axis=0),
            rgb=rgb,
        )
        self._views = np.insert(self._views, after, view)
        self._labels = np.insert(self._labels, after, labels)
        self._grazing_mask = np.insert(
            self._grazing_mask, after, False if masked else _find_grazing_mask(cloud)
        )
        changed = set(np.unique(labels).tolist())
        self._forget(changed)
        self.labels_used = max(self.labels_used, *(k for k in changed if k <= MAX_LABEL), 0)

    def put(self, cloud: Cloud, label: int, view: int) -> None:
        """Add points of an object that no view showed; its colour stays unknown."""
        rgb = None if self._cloud.rgb is None else np.zeros((len(cloud), 3), dtype=np.uint8)
        self.add(replace(cloud, rgb=rgb), np.full(len(cloud), label, dtype=np.int32), view)
        self._colourless |= {label}

    @property
    def objects(self) -> list[int]:
        """Labels of the objects, without the support surface."""
        labels: list[int] = np.flatnonzero(np.bincount(self._labels)).tolist()
        return [k for k in labels if k <= MAX_LABEL]

    def of(self, label: int, edge: float = 0.0) -> Cloud:
        """Points of an object: all, or of those in each voxel of this edge [m] the one nearest their mean.

        If several views show the object, the latter omit points seen at a grazing angle: beside an edge,
        sensors read ramps from it to what lies behind. Points from masks all count.
        """
        if not edge:
            rows, cloud = self._rows(label), self._cloud
            rgb = None if cloud.rgb is None or label in self._colourless else cloud.rgb[rows]
            return Cloud(cloud.points_world[rows], cloud.normals_world[rows], self._labels[rows], rgb)
        if (label, edge) not in self._selected:
            cloud, rows = self.of(label), self._rows(label)
            several = (self._views[rows] != self._views[rows][:1]).any()
            if several and not self._grazing_mask[rows].all():
                cloud = cloud.select(~self._grazing_mask[rows])
            self._selected[label, edge] = cloud.select(thin(cloud.points_world, edge))
        return self._selected[label, edge]

    def newest(self, label: int) -> Cloud:
        """Points of an object in the newest view that showed it."""
        views = self._views[self._rows(label)]
        return self.of(label).select(views == views[-1])

    def everything(self) -> Cloud:
        """A copy of all points of all objects and of the support surface, with labels."""
        return replace(self._cloud, labels=self._labels).select(np.arange(len(self._labels)))

    def bound(self, voxels: Mapping[int, float], views: int, depth: int) -> None:
        """Leave objects that more than this number of views show the newest `depth` points in each voxel.

        `voxels` are the objects and the edge lengths of their voxels [m].
        """
        if self._views.max(initial=0) < views:
            return
        kept, changed = np.ones(len(self._labels), dtype=np.bool_), set()
        for label, edge in voxels.items():
            rows = self._rows(label)
            if np.count_nonzero(np.bincount(self._views[rows])) > views:
                kept[rows] = False
                kept[rows][last_in_voxels(self._cloud.points_world[rows], edge, depth)] = True
                changed.add(label)
        if changed:
            self._keep(np.flatnonzero(kept), self._labels, changed)

    def forget(self, labels: set[int]) -> None:
        """Drop the points of some objects."""
        kept = np.flatnonzero(~np.isin(self._labels, sorted(labels)))
        self._keep(kept, self._labels, labels)

    def relocate(self, label: int, T: Array) -> None:
        """Move the points of an object by T (4, 4)."""
        which = (self._labels == label).astype(np.intp)
        self._transform(np.stack([np.eye(4), T]), which, {label})

    def move(self, T: Mapping[int, Array]) -> set[int]:
        """Move the points of some views, view → (4, 4); returns the labels that have such points."""
        moving = np.isin(self._views, list(T))
        if not moving.any():
            return set()
        poses = np.array([T.get(view, np.eye(4)) for view in range(int(self._views.max()) + 1)])
        changed = set(np.unique(self._labels[moving]).tolist())
        self._transform(poses, self._views.astype(np.intp), changed)
        return changed

    def merge(self, old: int, new: int) -> None:
        """Give the points of one object to another."""
        self._colourless |= {new} if old in self._colourless else set()
        # Stable: of the two, the points of the new one come first.
        order = np.argsort(np.where(self._labels == old, 2, self._labels == new), kind="stable")
        self._keep(order, np.where(self._labels == old, np.int32(new), self._labels), {old, new})

    def divide(self, label: int, groups: NDArray[np.intp]) -> list[int]:
        """Make an object of each group (N,), from 0, of the points of `of(label)`.

        Returns:
            Label of each group; the first keeps the old one.
        """
        names = [label, *range(self.labels_used + 1, self.labels_used + 1 + int(groups.max()))]
        labels = self._labels.copy()
        labels[self._rows(label)] = np.array(names)[groups]
        self._keep(np.arange(len(labels)), labels, set(names))
        self.labels_used = max(self.labels_used, *names)
        return names

    def _rows(self, label: int) -> slice:
        # With a label of another type, NumPy would convert all labels.
        own = np.int32(label)
        return slice(*(int(np.searchsorted(self._labels, own, side)) for side in ("left", "right")))

    def _transform(self, poses: Array, which: NDArray[np.intp], changed: set[int]) -> None:
        """Move each point by one (N,) of some poses (K, 4, 4); forget what was selected of some labels."""
        points = transform(poses, which, self._cloud.points_world)
        normals = rotate(poses, which, self._cloud.normals_world)
        self._cloud = replace(self._cloud, points_world=points, normals_world=normals)
        self._forget(changed)

    def _keep(self, rows: NDArray[np.intp], labels: NDArray[np.int32], changed: set[int]) -> None:
        """Keep these rows, in this order, with the labels (N,) of all; forget what was selected of some."""
        rows = rows[np.argsort(labels[rows], kind="stable")]
        self._cloud, self._views, self._labels = self._cloud.select(rows), self._views[rows], labels[rows]
        self._grazing_mask = self._grazing_mask[rows]
        self._forget(changed)

    def _forget(self, labels: set[int]) -> None:
        self._selected = {key: held for key, held in self._selected.items() if key[0] not in labels}


def _find_grazing_mask(cloud: Cloud) -> NDArray[np.bool_]:
    """Which points (N,) the sensor saw at a grazing angle."""
    if cloud.viewpoint_world is None:
        return np.zeros(len(cloud), dtype=np.bool_)
    rays = transforms.unit(cloud.viewpoint_world - cloud.points_world)
    return np.asarray(np.einsum("ij,ij->i", rays, cloud.normals_world) < GRAZING, dtype=np.bool_)


class ObjectModels:
    """Points and fitted shapes of all objects.

    Args:
        config: All stages' settings.
        seed: Seed of the fits.

    Attributes:
        points: What has been seen of each object.
        fits: Shape of each object that has one, by label.
    """

    def __init__(self, config: Config, seed: int) -> None:
        self.points = ObjectPoints()
        self.fits: dict[int, SceneObject] = {}
        self._config = config
        self._seed = seed
        self._fitted: dict[int, tuple[int, int]] = {}
        self._solids: dict[int, SceneObject] = {}
        self._compounds: dict[int, Shape | Compound | None] = {}
        self._undivided: dict[int, int] = {}
        self._segments: list[tuple[cKDTree, NDArray[np.int32]]] = []
        self._owners: dict[int, tuple[Cloud, NDArray[np.int32]]] = {}
        self._colours: dict[int, tuple[Cloud, Array | None]] = {}
        self._apart: dict[tuple[int, int], int] = {}
        self._distinct: set[frozenset[int]] = set()
        self._table: tuple[Cloud | None, float] = None, 0.0

    def copy(self) -> ObjectModels:
        """Return an independent copy; clouds, trees and shapes are shared."""
        other = object.__new__(ObjectModels)
        vars(other).update(vars(self))
        for name, value in vars(self).items():
            if isinstance(value, ObjectPoints | dict | list | set):
                setattr(other, name, value.copy())
        return other

    def __getstate__(self) -> dict[str, Any]:
        """The state to store, with the points of search trees in place of the trees."""
        return vars(self) | {
            "_segments": [(np.asarray(tree.data), labels) for tree, labels in self._segments]
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        segments = [(cKDTree(points), labels) for points, labels in state["_segments"]]
        vars(self).update(state | {"_segments": segments})

    def forget(self, labels: set[int]) -> None:
        """Drop the points and shapes of some objects."""
        self.points.forget(labels)
        for label in labels:
            for known in (self.fits, self._solids, self._compounds):
                known.pop(label, None)
        self._forget(labels)

    def relocate(self, label: int, T: Array) -> None:
        """Move an object, points and shape, by T (4, 4)."""
        self.points.relocate(label, T)
        for known in (self.fits, self._solids):
            if label in known:
                known[label] = replace(known[label], shape=known[label].shape.moved(T))
        self._compounds.pop(label, None)
        self._forget({label})

    def rename(self, old: int, new: int) -> None:
        """Give an object a label that no object has."""
        self.points.merge(old, new)
        for known in (self.fits, self._solids):
            if old in known:
                known[new] = replace(known.pop(old), id=object_id(new), label=new)
        self._compounds.pop(old, None)
        self._distinct = {frozenset(new if k == old else k for k in two) for two in self._distinct}
        self._forget({old, new})

    def put(self, shape: Shape, label: int, view: int) -> None:
        """Add an object of this shape, as if a view had shown it from all sides."""
        self.points.put(Cloud(*shape.surface(self._config.cloud.voxel)), label, view)
        self.fits[label] = SceneObject(object_id(label), label, shape)

    def associate(
        self,
        observation: Observation,
        known: Sequence[SceneObject],
        *,
        masks: bool = False,
        new: Set[int] = frozenset(),
    ) -> Observation:
        """Give a view's segments the labels of the objects they belong to, or new ones.

        Args:
            observation: The view.
            known: The objects so far.
            masks: Whether its segments are given; two segments of one view are never merged.
            new: Labels of segments that belong to no known object.
        """
        points, labels = observation.cloud.points_world, observation.labels
        segments = np.where(labels > MAX_LABEL, 0, labels)
        if observation.view is not None and not masks:
            kept = np.flatnonzero(segments)
            kept = kept[thin(points[kept], self._config.explanation.spacing)]
            self._segments.append((cKDTree(points[kept]), labels[kept]))
            if len(self._segments) > self._config.cloud.views:
                del self._segments[0]
                self._owners = {k: (cloud, rows[1:]) for k, (cloud, rows) in self._owners.items()}
        named = associate(
            points,
            segments,
            {k: self.points.of(k).points_world for k in self.points.objects},
            {o.label: o.shape for o in known},
            self._config.segmentation,
            self.points.labels_used,
            masks=masks,
            other_colour=None if masks else self._other_colour(observation),
            new=new,
        )
        if masks:
            self._distinct |= set(map(frozenset, combinations(np.unique(named[named > 0]).tolist(), 2)))
        for pair in observation.apart:
            names = frozenset(int(np.bincount(named[labels == label]).argmax()) for label in pair)
            self._distinct |= {names} if len(names) == 2 else set()
        return observation.with_labels(np.where(labels > MAX_LABEL, labels, named))

    def _other_colour(self, observation: Observation) -> OtherColour | None:
        """Which points of a view have another colour than a plain object; None if the view has no colours."""
        config, rgb = self._config.explanation, observation.cloud.rgb
        if rgb is None:
            return None

        def differ(name: int, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
            colour = self._plain_colour(name)
            if colour is None:
                return np.zeros(len(rows), dtype=np.bool_)
            return colour_costs(rgb[rows], colour[None], config)[:, 0] >= config.outlier

        return differ

    def mislabelled(self, observation: Observation) -> tuple[int, int]:
        """Number of labels of a view that lie on objects with other labels, and number of its labels."""
        config = self._config.segmentation
        rows = np.flatnonzero((observation.labels > 0) & (observation.labels <= MAX_LABEL))
        rows = rows[:: len(rows) // 1000 + 1]  # some are enough to tell where a mask lies
        points = observation.cloud.points_world[rows]
        shown, index, count = np.unique(observation.labels[rows], return_inverse=True, return_counts=True)
        own, on_another = np.zeros(len(shown)), np.zeros(len(shown), dtype=bool)
        for o in self.objects():
            near = np.abs(o.shape.signed_distance(points)) < config.overlap_reach
            share = np.bincount(index[near], minlength=len(shown)) / count
            own += np.where(shown == o.label, share, 0.0)
            on_another |= (shown != o.label) & (share >= 0.5)
        return int(np.count_nonzero(on_another & (own < config.overlap))), len(shown)

    def add(self, observation: Observation, view: int, *, masked: bool) -> set[int]:
        """Add a view's points, thinned, and return the labels of the objects among them."""
        config = self._config
        shown = set(observation.shown) - {0}
        voxels = np.full(max(shown, default=0) + 1, config.cloud.voxel)
        voxels[0] = 0.0
        voxels[MAX_LABEL + 1 :] = config.surface.spacing
        kept = most_central(observation.cloud.points_world, observation.labels, voxels)
        self.points.add(observation.cloud.select(kept), observation.labels[kept], view, masked=masked)
        edges = {label: float(voxels[label]) for label in shown}
        self.points.bound(edges, config.cloud.views, config.cloud.depth)
        return {label for label in shown if label <= MAX_LABEL}

    def find_outdated(self, labels: set[int], voxels: VoxelMap) -> set[int]:
        """Find the objects among these whose shapes a new view may change.

        A shape holds while it explains the newest points as well as true shapes do, on sides that earlier
        points confirm, and no more of its inside is seen free; and until there are so many more points that
        their noise matters less.
        """
        config, sigma = self._config, self._noise()
        found = labels - self.fits.keys()
        for label in sorted(labels - found):
            o, cloud = self._solids.get(label, self.fits[label]), self.points.newest(label)
            points, normals = cloud.points_world, cloud.normals_world
            if isinstance(o.shape, Solid):
                squares = o.shape.signed_distance(points) ** 2 / (2.0 * sigma**2)
                costs = np.minimum(squares, config.explanation.outlier)
            else:
                costs = shape_costs(o.shape, points, normals, sigma, config.explanation)
            facing = normals @ o.shape.T_world_object[:3, :3]
            sides = np.count_nonzero(np.stack([-facing, facing], axis=2) > ALONG, axis=0).ravel()
            new_mask = (sides >= max(config.fit.min_points, CONFIRMED * len(points))) & ~np.array(o.seen)
            count, free = self._fitted.get(label, (0, 0))
            if (
                costs.mean() > config.explanation.usual
                or new_mask.any()
                or len(self.points.of(label)) >= GROWTH * count
                or _count_free_inside(self.fits[label].shape, voxels) > free
            ):
                found.add(label)
        return found

    def fit_newest(self, labels: set[int], voxels: VoxelMap | None = None) -> None:
        """Fit objects to the newest view's points alone, and forget all other fits (`sg`).

        Shapes fill no space that this view sees free.
        """
        self.fits, self._compounds = {}, {}
        self._fit(labels, self.points.newest, voxels)

    def fit_all(self, labels: set[int], voxels: VoxelMap | None = None) -> None:
        """Fit objects to all their points so far (`pc`, `pc+sg`), where shapes fill no space seen free."""
        self._fit(labels, partial(self.points.of, edge=self._config.cloud.voxel), voxels)

    def divide(self, labels: set[int], voxels: VoxelMap | None = None) -> set[int]:
        """Split objects with new points that several shapes explain better than one.

        Returns:
            The labels that changed.
        """
        changed, noise, clouds = set[int](), self._noise(), dict[int, Cloud]()
        for label in sorted(labels & self.fits.keys()):
            if len(cloud := self.points.of(label)) >= GROWTH * self._undivided.get(label, 0):
                clouds[label] = cloud
        tried = list(clouds)

        def divided(number: int) -> Groups | None:
            evidence, whole = self._explained(tried[number], noise, voxels, sighted=True)
            rng = np.random.default_rng([self._seed, tried[number]])
            groups = split(evidence, whole, config=self._config, rng=rng)
            points = clouds[tried[number]].points_world
            return None if groups is None else groups[cKDTree(evidence.points).query(points)[1]]

        for label, groups in zip(tried, on_threads(divided, len(tried)), strict=True):
            if groups is None:
                self._undivided[label] = len(clouds[label])
            else:
                changed |= set(self.points.divide(label, groups))
        self._forget(changed)
        self.fit_all(changed, voxels)
        return changed

    def unite(self, labels: set[int], voxels: VoxelMap | None = None) -> dict[int, int]:
        """Merge objects with new points and neighbours that one shape explains better than two.

        Returns:
            Label given up → label that takes its points.
        """
        noise, given_up, gains = self._noise(), dict[int, int](), dict[tuple[int, int], float]()
        evidence = {k: self._evidence(k, noise, voxels) for k in self.fits}
        plain = {k: self._plain_colour(k) for k in self.fits}

        def alone(label: int) -> Explanation:
            return self._explained(label, noise, voxels, compound=True)[1]

        while pair := best_merge(
            evidence, plain, alone, labels, gains, self._apart,
            distinct=self._distinct, config=self._config, seed=self._seed,
        ):  # fmt: skip
            new, old = pair
            self.points.merge(old, new)
            self._distinct = {frozenset(new if k == old else k for k in two) for two in self._distinct}
            self._forget(set(pair))
            given_up = {k: new if v == old else v for k, v in given_up.items()} | {old: new}
            del self.fits[old], evidence[old], evidence[new]
            self.fit_all({new}, voxels)
            if new in self.fits:
                evidence[new], plain[new] = self._evidence(new, noise, voxels), self._plain_colour(new)
            gains = {two: gain for two, gain in gains.items() if not {*pair} & {*two}}
            labels = labels | {new}
        return given_up

    def nearest(self, observation: Observation, labels: set[int]) -> Observation:
        """Relabel the points of a view with one of these labels by the nearest known point of any."""
        among = np.flatnonzero(np.isin(observation.labels, sorted(labels)))
        known = [self.points.of(k) for k in sorted(labels)]
        owners = np.repeat(sorted(labels), [len(c) for c in known])
        tree = cKDTree(np.concatenate([c.points_world for c in known]))
        changed = observation.labels.copy()
        changed[among] = owners[tree.query(observation.cloud.points_world[among])[1]]
        return observation.with_labels(changed)

    def form(self, labels: set[int], voxels: VoxelMap | None, table: Array) -> None:
        """Replace primitives of objects with new points by solids where these cost less without a primitive.

        A primitive does not explain points of other objects, or of the support surface below them (M, 3) [m],
        inside it.
        """
        noise, config = self._noise(), self._config.explanation
        changed = sorted(labels & self.fits.keys())
        seen = {k: self.points.of(k, config.spacing).points_world for k in sorted(self.fits)}
        every = np.concatenate([table, *seen.values()])
        owners = np.repeat([SUPPORT_LABEL, *seen], [len(table), *map(len, seen.values())])
        tree = cKDTree(every)
        shapes = {k: o.shape for k, o in self.fits.items()}
        middles = np.array([s.T_world_object[:3, 3] for s in shapes.values()]).reshape(-1, 3)
        radii = np.array([np.linalg.norm(s.extents) / 2.0 for s in shapes.values()])

        def formed(number: int) -> SceneObject | None:
            label = changed[number]
            evidence, explanation = self._explained(label, noise, voxels)
            shape = shapes[label]
            middle, size = shape.T_world_object[:3, 3], float(np.linalg.norm(shape.extents))
            near = np.array(tree.query_ball_point(middle, size / 2.0), dtype=np.intp)
            inside = shape.signed_distance(every[near[owners[near] != label]]) < -3.0 * noise
            taken = config.outlier * evidence.weight * np.count_nonzero(inside)
            irregular = best_explanation([], evidence, config)
            if explanation.shape is not None and explanation.cost + taken <= irregular.cost:
                return None
            cloud = self.points.of(label, self._config.cloud.voxel)
            reach = size / 2.0 + radii + self._config.voxels.size
            close = np.linalg.norm(middles - middle, axis=1) <= reach
            others = [s for k, s in compress(shapes.items(), close) if k != label]
            whole = self._explained(label, noise, voxels, compound=True)[1].shape
            backs = [shape] if whole is None or whole is shape else [shape, whole]
            return as_solid(self.fits[label], cloud, evidence, backs, others, self._config.fit)

        for label, o in zip(changed, on_threads(formed, len(changed)), strict=True):
            self._solids.pop(label, None)
            if o is not None:
                self._solids[label] = o

    def objects(self) -> list[SceneObject]:
        """The objects in the order of their labels: as solids, or with the primitives fitted to them."""
        return [self._solids.get(k, self.fits[k]) for k in sorted(self.fits)]

    def reasons(self, labels: Sequence[int], voxels: VoxelMap | None) -> Reasons:
        """Why an object is what it is, or why two are two.

        Args:
            labels: One or two labels of objects that have a shape.
            voxels: Space seen free.
        """
        noise, names = self._noise(), tuple(map(object_id, labels))
        rng = np.random.default_rng([self._seed, *labels])
        known = [self._explained(k, noise, voxels, compound=True, sighted=True) for k in labels]
        if len(known) == 2:
            return explain_pair(names, known, frozenset(labels) in self._distinct, self._config, rng)
        evidence, explanation = known[0]
        if labels[0] in self._solids:  # which draws a compound too
            compound = explanation.shape if not isinstance(explanation.shape, Shape) else None
            shapes = [] if compound is None else [compound]
            explanation = best_explanation(shapes, evidence, self._config.explanation)
        return explain_object(names[0], explanation, evidence, self._config, rng)

    def _explained(
        self,
        label: int,
        noise: float,
        voxels: VoxelMap | None,
        *,
        compound: bool = False,
        sighted: bool = False,
    ) -> tuple[Evidence, Explanation]:
        """Evidence of an object, and its best explanation: its fitted shape or, if asked, a compound.

        If asked, the evidence has the segments of all views.
        """
        config, evidence = self._config.explanation, self._evidence(label, noise, voxels, sighted=sighted)
        shape = self.fits[label].shape
        explanation = best_explanation([shape], evidence, config)
        if not compound or explained(explanation, evidence, config):
            return evidence, explanation
        if label not in self._compounds:
            self._compounds[label] = best_compound(evidence, self._config, explanation.cost).shape
        known = self._compounds[label]
        return evidence, explanation if known is None else best_explanation([shape, known], evidence, config)

    def _evidence(
        self, label: int, noise: float, voxels: VoxelMap | None, *, sighted: bool = False
    ) -> Evidence:
        """Evidence of an object; if asked, with the segments of all views."""
        config = self._config.explanation
        cloud = self.points.of(label, config.spacing)
        weight = config.spacing**2 / config.reading
        shown = self._shown(label, cloud) if sighted else None
        return Evidence(cloud.points_world, cloud.normals_world, weight, noise, voxels, cloud.rgb, shown)

    def _plain_colour(self, label: int) -> Array | None:
        """The main plain colour of an object, or None for a print."""
        cloud = self.points.of(label, self._config.explanation.spacing)
        if self._colours.get(label, (None,))[0] is not cloud:
            colour = None if cloud.rgb is None else plain_colour(cloud.rgb, self._config.explanation)[1]
            self._colours[label] = cloud, colour
        return self._colours[label][1]

    def _shown(self, label: int, cloud: Cloud) -> NDArray[np.int32]:
        """Segment (V, N) on which each view shows the points of an object, 0 = none."""
        of, known = self._owners.get(label, (cloud, np.zeros((0, len(cloud)), dtype=np.int32)))
        known = known if of is cloud else np.zeros((0, len(cloud)), dtype=np.int32)
        rows = [known]
        for tree, labels in self._segments[len(known) :]:
            # 2 cm: 2σ of the registration error of both views.
            gap, index = tree.query(cloud.points_world, distance_upper_bound=0.02)
            rows.append(np.where(np.isfinite(gap), np.append(labels, 0)[index], 0)[None].astype(np.int32))
        self._owners[label] = cloud, np.concatenate(rows)
        return self._owners[label][1]

    def _forget(self, labels: set[int]) -> None:
        """Drop what earlier splits and merges found out about objects that have changed."""
        self._undivided = {k: n for k, n in self._undivided.items() if k not in labels}
        self._apart = {pair: n for pair, n in self._apart.items() if not labels & set(pair)}
        self._owners = {k: known for k, known in self._owners.items() if k not in labels}
        self._colours = {k: known for k, known in self._colours.items() if k not in labels}
        self._fitted = {k: known for k, known in self._fitted.items() if k not in labels}

    def _noise(self) -> float:
        """Standard deviation of points from their surfaces [m]: the table's, or the primitives' if larger.

        Primitives alone do not tell: with more noise, fewer objects are primitives.
        """
        config, table = self._config, self.points.of(SUPPORT_LABEL, self._config.explanation.spacing)
        if self._table[0] is not table:
            points = table.points_world - table.points_world.mean(axis=0) if len(table) else np.zeros((1, 3))
            distances = np.abs(points @ np.linalg.eigh(points.T @ points)[1][:, 0])
            self._table = table, 1.48 * float(np.median(distances))
        # 1.48 median or 1.25 mean absolute values of a normal distribution are one standard deviation.
        residuals = [o.residual for k, o in self.fits.items() if k not in self._solids]
        primitives = 1.25 * float(np.median(residuals)) if residuals else 0.0
        return max(self._table[1], primitives, config.fit.registration)

    def _fit(
        self, labels: set[int], points_of: Callable[[int], Cloud], voxels: VoxelMap | None = None
    ) -> None:
        """Fit objects to their points on all cores; the result for each does not depend on the others."""
        names = sorted(labels)

        def fitted(number: int) -> Fit | FitFailure:
            cloud, rng = points_of(names[number]), np.random.default_rng([self._seed, names[number]])
            points, normals = cloud.points_world, cloud.normals_world
            return fit(points, normals, config=self._config.fit, rng=rng, space=voxels)

        for label, result in zip(names, on_threads(fitted, len(names)), strict=True):
            self.fits.pop(label, None)
            self._compounds.pop(label, None)
            if isinstance(result, Fit):
                free = 0 if voxels is None else _count_free_inside(result.shape, voxels)
                self._fitted[label] = len(self.points.of(label)), free
                self.fits[label] = SceneObject(
                    id=object_id(label),
                    label=label,
                    shape=result.shape,
                    residual=result.residual,
                    poor_fit=result.poor,
                    seen=result.seen,
                    uncertainty=result.uncertainty,
                )


def _count_free_inside(shape: Shape, voxels: VoxelMap) -> int:
    """Number of voxels seen free well inside a shape."""
    return free_inside(shape, voxels, 1.2 * voxels.config.size)[1]


def associate(
    points_world: Array,
    labels: NDArray[np.int32],
    known_points: Mapping[int, Array],
    known_shapes: Mapping[int, Shape],
    config: SegmentationConfig,
    labels_used: int = 0,
    *,
    masks: bool = False,
    other_colour: OtherColour | None = None,
    new: Set[int] = frozenset(),
) -> NDArray[np.int32]:
    """Give the points of each new segment the label of the object they belong to, or one never used before.

    An automatic segment with a tenth of its points or more on each of several known objects is divided among
    them: each point goes to the nearest. A point whose colour differs from all of these goes to the nearest
    object of its own colour, if there is one within reach.
    A mask is all that a view shows of one object. Masks and objects are matched one to one, so that they
    share as many points as possible.

    Args:
        points_world: (N, 3) [m].
        labels: Segment of each point (N,); 0 belongs to none.
        known_points: Points (M, 3) [m] of each known object.
        known_shapes: Fitted shape of each known object that has one.
        config: Share that must overlap, and the distance that counts as overlap.
        labels_used: Highest label ever given; new objects are numbered from the next one.
        masks: Whether the segments are masks.
        other_colour: Which points differ in colour from a known object; None if none does.
        new: Segments that belong to no known object.

    Returns:
        Label of the object (N,) of each point; 0 where there was no segment.
    """
    reach = config.overlap_reach
    spacing = reach / 4.0
    known = _KnownObjects(known_points, known_shapes, spacing, reach, other_colour)
    names = known.names
    counts = np.bincount(labels, minlength=1)
    kept = most_central(points_world, labels, np.where(np.arange(len(counts)) > 0, spacing, 0.0))
    owner = known.nearest(points_world, kept)
    segments = np.flatnonzero(counts[1:]) + 1
    shared = np.zeros((len(segments), len(names)), dtype=np.intp)
    near = owner >= 0
    np.add.at(shared, (np.searchsorted(segments, labels[kept][near]), owner[near]), 1)
    shared[np.isin(segments, sorted(new))] = 0
    shares = shared / np.bincount(labels[kept], minlength=len(counts))[segments, None]
    chosen = _one_to_one(shared, shares, config.overlap) if masks else _all_near(shares, config.overlap)
    highest = max(labels_used, int(names.max(initial=0)))
    result = np.zeros(len(labels), dtype=np.int32)
    for segment, among in zip(segments, chosen, strict=True):
        index = np.flatnonzero(labels == segment)
        if not len(among):
            highest += 1
            result[index] = highest
        else:
            nearest = np.full(len(index), among[0], dtype=np.int32)
            if len(among) > 1:
                nearest = known.nearest(points_world, index, among)
            unmatched = known.unlike(among, index)
            if unmatched.any():
                nearest[unmatched] = known.nearest(points_world, index[unmatched])
            far = nearest < 0
            if far.any():
                theirs = np.isin(known.owners, among)
                tree = cKDTree(known.points[theirs])
                nearest[far] = known.owners[theirs][tree.query(points_world[index[far]])[1]]
            result[index] = names[nearest]
    return result


def _all_near(shares: Array, least: float) -> list[NDArray[np.intp]]:
    """Objects that hold a tenth of each segment's points or more; none where all together hold too few."""
    enough = (shares.sum(axis=1) >= least) & (shares > 0.0).any(axis=1)
    return [
        np.flatnonzero(own >= min(0.1, own.max())) if held else np.zeros(0, dtype=np.intp)
        for own, held in zip(shares, enough, strict=True)
    ]


def _one_to_one(shared: NDArray[np.intp], shares: Array, least: float) -> list[NDArray[np.intp]]:
    """The one object of each mask, or none: the match that shares most points."""
    worth = np.where((shares >= least) & (shared > 0), shared, 0)
    matched = {m: k for m, k in zip(*linear_sum_assignment(-worth), strict=True) if worth[m, k]}
    return [np.array([matched[m]] if m in matched else [], dtype=np.intp) for m in range(len(worth))]


class _KnownObjects:
    """Known objects 0 … K − 1, in the order of their names, to which new points may belong.

    Args:
        points: Points (M, 3) [m] of each object, by its name.
        shapes: Shape of each object that has one.
        spacing: Edge length [m] of the voxels in which one point of each object is enough.
        reach: Objects from here on count as none [m].
        other_colour: Which points differ in colour from an object; None if none does.

    Attributes:
        names: (K,).
        points: Thinned points (M, 3) [m] of all.
        owners: Object (M,) of each; ascending.
    """

    def __init__(
        self,
        points: Mapping[int, Array],
        shapes: Mapping[int, Shape],
        spacing: float,
        reach: float,
        other_colour: OtherColour | None,
    ) -> None:
        self.names = np.array(sorted(points), dtype=np.int32)
        count = len(self.names)
        owners = np.repeat(np.arange(count, dtype=np.int32), [len(points[k]) for k in self.names])
        every = np.concatenate([np.zeros((0, 3)), *(points[k] for k in self.names)])
        thinned = most_central(every, owners, np.full(count, spacing))
        self.points, self.owners = every[thinned], owners[thinned]
        self._shapes = [shapes.get(k) for k in self.names.tolist()]
        self._reach, self._other_colour = reach, other_colour
        self._ends = np.searchsorted(self.owners, np.arange(count + 1))
        self._trees: dict[int, cKDTree] = {}
        # Bounds of each object's points, and of its shape.
        self._low, self._high = np.full((count, 2, 3), np.inf), np.full((count, 2, 3), -np.inf)
        seen = np.flatnonzero(np.diff(self._ends))
        if len(seen):
            self._low[seen, 0] = np.minimum.reduceat(self.points, self._ends[seen]) - reach
            self._high[seen, 0] = np.maximum.reduceat(self.points, self._ends[seen]) + reach
        shaped = [number for number, shape in enumerate(self._shapes) if shape is not None]
        low, high = Primitives.of([s for s in self._shapes if s is not None]).bounds()
        self._low[shaped, 1], self._high[shaped, 1] = low - reach, high + reach

    def nearest(
        self, points: Array, index: NDArray[np.intp], among: NDArray[np.intp] | None = None
    ) -> NDArray[np.int32]:
        """Which object (M,), of all or of some, is nearest to points of an index (M,); −1 = none.

        What counts is the distance to its points or to its shape's surface.
        """
        own = points[index]
        nearest, gap = np.full(len(own), -1, dtype=np.int32), np.full(len(own), self._reach)
        if not len(own):
            return nearest
        near = ((self._low <= own.max(axis=0)) & (self._high >= own.min(axis=0))).all(axis=2)
        if among is not None:
            near[np.setdiff1d(np.arange(len(near)), among)] = False
        # Points in the order of x: those within an object's bounds along it lie side by side.
        order = np.argsort(own[:, 0])
        starts = np.searchsorted(own[order, 0], self._low[..., 0], "right")
        ends = np.searchsorted(own[order, 0], self._high[..., 0], "left")
        for number, by in np.argwhere(near).tolist():
            rows = order[starts[number, by] : ends[number, by]]
            within = (own[rows] > self._low[number, by]) & (own[rows] < self._high[number, by])
            rows = rows[within.all(axis=1)]
            rows = rows[~self.unlike([number], index[rows])]
            if not len(rows):
                continue
            distance = self._distance(number, by == 1, own[rows])
            nearer = distance < gap[rows]
            nearest[rows[nearer]], gap[rows[nearer]] = number, distance[nearer]
        return nearest

    def unlike(self, numbers: Iterable[int], index: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which points of an index (M,) have another colour than each of some objects."""
        unlike = np.full(len(index), self._other_colour is not None)
        for number in numbers:
            if self._other_colour is not None and unlike.any():
                unlike[unlike] = self._other_colour(int(self.names[number]), index[unlike])
        return unlike

    def _distance(self, number: int, by_shape: bool, points: Array) -> Array:
        """Distance (M,) [m] of points (M, 3) to an object's shape or points; infinite beyond reach."""
        shape = self._shapes[number]
        if by_shape and shape is not None:
            return np.abs(shape.signed_distance(points))
        if number not in self._trees:
            own = self.points[self._ends[number] : self._ends[number + 1]]
            self._trees[number] = cKDTree(own, compact_nodes=False, balanced_tree=False)
        distance: Array = self._trees[number].query(points, distance_upper_bound=self._reach)[0]
        return distance
