"""Every object's points and the shape fitted to them, kept up to date view by view."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import Config
from caryatid.fitting.primitives import FitFailure, Oriented, fit_many
from caryatid.geometry import points as kernels
from caryatid.geometry.points import last_in_voxels, most_central
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, object_id
from caryatid.objects.association import associate
from caryatid.objects.description_length import Evidence, Explanation, best_explanation
from caryatid.objects.model_selection import GROWTH, best_merge, split
from caryatid.segmentation.observation import UP, Observation
from caryatid.sensing.clouds import thin
from caryatid.sensing.views import SUPPORT_LABEL, Cloud
from caryatid.sensing.voxel_map import VoxelMap

MEAN_TO_DEVIATION = 1.25
"""Standard deviation of a normal distribution over its mean absolute value."""
LEAST_NOISE = 0.002
"""Least standard deviation of points from their surfaces [m]; what registration leaves."""
SAME_PLACE = 0.02
"""Points of two views within this are at the same place [m]; 2σ of registration error of both views."""


@dataclass(frozen=True, eq=False, slots=True)
class SeenPoints:
    """Points of one object, those of later views behind those of earlier ones, and the view (N,) of each."""

    cloud: Cloud
    views: NDArray[np.intp]

    def select(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> SeenPoints:
        """Return some of the points, by a mask (N,) or indices (M,)."""
        return SeenPoints(self.cloud.select(kept), self.views[kept])

    def labelled(self, label: int) -> SeenPoints:
        """Return the points with this label."""
        return replace(self, cloud=labelled(self.cloud, label))

    def moved(self, T: Mapping[int, Array]) -> SeenPoints:
        """Return the points with those of some views moved, view → (4, 4)."""
        poses = np.array([T.get(view, np.eye(4)) for view in range(int(self.views.max()) + 1)])
        points = kernels.transform(poses, self.views, self.cloud.points_world)
        normals = kernels.rotate(poses, self.views, self.cloud.normals_world)
        return replace(self, cloud=replace(self.cloud, points_world=points, normals_world=normals))

    def followed_by(self, other: SeenPoints) -> SeenPoints:
        """Return these points and then the other ones."""
        return SeenPoints(joined([self.cloud, other.cloud]), np.concatenate([self.views, other.views]))


class ObjectPoints:
    """What has been seen of each object so far; grows with every view.

    Attributes:
        labels_used: The highest label an object ever had; new ones are numbered from the next one.
    """

    def __init__(self) -> None:
        self.labels_used = 0
        self._seen: dict[int, SeenPoints] = {}
        self._thinned: dict[tuple[int, float], tuple[Cloud, Cloud]] = {}

    def copy(self) -> ObjectPoints:
        """Return points that go on growing by themselves; the points so far are shared."""
        other = ObjectPoints()
        other.labels_used = self.labels_used
        other._seen = self._seen.copy()
        other._thinned = self._thinned.copy()
        return other

    def add(self, label: int, cloud: Cloud, view: int) -> None:
        """Add a view's points of an object, or of the support surface."""
        self._append(label, SeenPoints(joined([cloud]), np.full(len(cloud), view)))
        if label != SUPPORT_LABEL:
            self.labels_used = max(self.labels_used, label)

    def __contains__(self, label: int) -> bool:
        return label in self._seen

    @property
    def objects(self) -> list[int]:
        """Labels of the objects, without the support surface."""
        return sorted(k for k in self._seen if k != SUPPORT_LABEL)

    def of(self, label: int) -> Cloud:
        """All points of an object."""
        return self._seen[label].cloud if label in self._seen else joined([])

    def thinned(self, label: int, edge: float) -> Cloud:
        """Points of an object, of those in a voxel of this edge length [m] the one nearest to their mean."""
        cloud = self.of(label)
        before, result = self._thinned.get((label, edge), (None, None))
        if result is None or before is not cloud:
            result = cloud.select(thin(cloud.points_world, edge))
            self._thinned[label, edge] = cloud, result
        return result

    def newest(self, label: int) -> Cloud:
        """Points of an object in the newest view that showed it."""
        seen = self._seen[label]
        return seen.cloud.select(seen.views == seen.views[-1])

    def everything(self) -> Cloud:
        """All points of all objects and of the support surface, with labels."""
        return joined(self._seen[label].cloud for label in sorted(self._seen))

    def bound(self, label: int, voxel: float, depth: int) -> None:
        """Leave an object the newest points in each voxel, once more than twice as many views have shown it.

        Args:
            label: Which.
            voxel: Edge length of a voxel [m].
            depth: Points left in each.
        """
        seen = self._seen[label]
        if np.count_nonzero(np.bincount(seen.views)) > 2 * depth:
            self._seen[label] = seen.select(last_in_voxels(seen.cloud.points_world, voxel, depth))

    def move(self, T: Mapping[int, Array]) -> set[int]:
        """Move the points of some views, view → (4, 4); returns the labels that have such points."""
        moving = {k for k, seen in self._seen.items() if np.isin(seen.views, list(T)).any()} if T else set()
        for label in moving:
            self._seen[label] = self._seen[label].moved(T)
        return moving

    def merge(self, old: int, new: int) -> None:
        """Give the points of one object to another."""
        self._append(new, self._taken(old).labelled(new))

    def divide(self, label: int, groups: NDArray[np.intp]) -> list[int]:
        """Make several objects of one.

        Args:
            label: Which.
            groups: Group (N,), from 0, of each point of `of(label)`.

        Returns:
            Label of each group; the first keeps the old one.
        """
        seen = self._taken(label)
        names = [label, *range(self.labels_used + 1, self.labels_used + 1 + int(groups.max()))]
        for number, name in enumerate(names):
            self._seen[name] = seen.select(groups == number).labelled(name)
        self.labels_used = max(self.labels_used, *names)
        return names

    def _taken(self, label: int) -> SeenPoints:
        self._thinned = {key: held for key, held in self._thinned.items() if key[0] != label}
        return self._seen.pop(label)

    def _append(self, label: int, seen: SeenPoints) -> None:
        self._seen[label] = self._seen[label].followed_by(seen) if label in self._seen else seen


@dataclass(frozen=True, eq=False)
class Segments:
    """What segmentation found in one view: points (N, 3) [m] and the segment (N,) each is of."""

    points: Array
    labels: NDArray[np.int32]

    @cached_property
    def tree(self) -> cKDTree:
        """Tree of the points."""
        return cKDTree(self.points)


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
        self._undivided: dict[int, int] = {}
        self._segments: list[Segments] = []
        self._apart: dict[tuple[int, int], int] = {}

    def copy(self) -> ObjectModels:
        """Return models that know the same and go on by themselves; clouds, trees and shapes are shared."""
        other = copy.copy(self)
        other.points = self.points.copy()
        other.fits = self.fits.copy()
        other._undivided = self._undivided.copy()
        other._segments = self._segments.copy()
        other._apart = self._apart.copy()
        return other

    def associate(self, observation: Observation) -> Observation:
        """Give a view's automatic segments the labels of the objects they belong to, or new ones."""
        points, labels = observation.cloud.points_world, observation.labels
        segments = np.where(labels == SUPPORT_LABEL, 0, labels)
        kept = np.flatnonzero(segments)
        kept = kept[thin(points[kept], self._config.explanation.spacing)]
        self._segments.append(Segments(points[kept], labels[kept]))
        named = associate(
            points,
            segments,
            {k: self.points.of(k).points_world for k in self.points.objects},
            {k: o.shape for k, o in self.fits.items()},
            self._config.segmentation,
            self.points.labels_used,
        )
        return observation.with_labels(np.where(labels == SUPPORT_LABEL, labels, named))

    def add(self, observation: Observation, view: int) -> set[int]:
        """Add a view's points, thinned, and return the labels of the objects among them."""
        config = self._config
        shown = set(observation.shown) - {0}
        voxels = np.full(max(shown, default=0) + 1, config.cloud.voxel)
        voxels[0] = 0.0
        voxels[SUPPORT_LABEL:] = config.surface.spacing
        kept = most_central(observation.cloud.points_world, observation.labels, voxels)
        labels = observation.labels[kept]
        for label in sorted(shown):
            self.points.add(label, observation.cloud.select(kept[labels == label]), view)
            self.points.bound(label, voxels[label], config.cloud.depth)
        return shown - {SUPPORT_LABEL}

    def move(self, T: Mapping[int, Array]) -> set[int]:
        """Move the points of some views (view → (4, 4)); returns the labels of the objects that have some."""
        return self.points.move(T) - {SUPPORT_LABEL}

    def fit_newest(self, labels: set[int]) -> None:
        """Fit objects to the newest view's points alone, and forget all other fits (`sg`)."""
        self.fits = {}
        self._fit({label: self.points.newest(label) for label in labels})

    def fit_all(self, labels: set[int], voxels: VoxelMap | None = None) -> None:
        """Fit objects to all their points so far (`pc`, `pc+sg`), where shapes fill no space seen free."""
        self._fit({k: self.points.thinned(k, self._config.cloud.voxel) for k in labels}, voxels)

    def divide(self, labels: set[int], voxels: VoxelMap | None = None) -> set[int]:
        """Split objects that several shapes explain better than one; returns the labels that changed.

        Args:
            labels: Objects whose points have changed.
            voxels: Space seen free, which no shape may fill.
        """
        changed: set[int] = set()
        noise = self._noise()
        for label in sorted(labels & self.fits.keys()):
            cloud = self.points.of(label)
            if len(cloud) < GROWTH * self._undivided.get(label, 0):
                continue
            evidence = self._evidence(label, noise, voxels)
            groups = split(
                evidence,
                self._alone(label, evidence),
                partial(self._hints, evidence.points),
                up=UP,
                config=self._config,
                rng=np.random.default_rng([self._seed, label]),
            )
            if groups is None:
                self._undivided[label] = len(cloud)
            else:
                _, nearest = cKDTree(evidence.points).query(cloud.points_world)
                changed |= set(self.points.divide(label, groups[nearest]))
        self._forget(changed)
        self.fit_all(changed, voxels)
        return changed

    def unite(self, labels: set[int], voxels: VoxelMap | None = None) -> dict[int, int]:
        """Merge neighbours that one shape explains better than two.

        Args:
            labels: Objects whose points have changed.
            voxels: Space seen free, which no shape may fill.

        Returns:
            Label given up → label that takes its points.
        """
        noise = self._noise()
        evidence = {k: self._evidence(k, noise, voxels) for k in sorted(self.fits)}
        alone = {k: self._alone(k, e) for k, e in evidence.items()}
        given_up: dict[int, int] = {}
        while True:
            pair = best_merge(evidence, alone, labels, self._apart, config=self._config, seed=self._seed)
            if pair is None:
                return given_up
            new, old = pair
            self.points.merge(old, new)
            self._forget(set(pair))
            given_up = {k: new if v == old else v for k, v in given_up.items()} | {old: new}
            self.fit_all({new}, voxels)
            for label in pair:
                del evidence[label], alone[label]
            del self.fits[old]
            if new in self.fits:
                evidence[new] = self._evidence(new, noise, voxels)
                alone[new] = self._alone(new, evidence[new])
            labels = labels | {new}

    def nearest(self, observation: Observation, labels: set[int]) -> Observation:
        """Give the points of a view that carry one of these labels the label of the nearest point of any."""
        among = np.flatnonzero(np.isin(observation.labels, sorted(labels)))
        known = [self.points.of(k) for k in sorted(labels)]
        owners = np.repeat(sorted(labels), [len(c) for c in known])
        tree = cKDTree(np.concatenate([c.points_world for c in known]))
        changed = observation.labels.copy()
        changed[among] = owners[tree.query(observation.cloud.points_world[among])[1]]
        return observation.with_labels(changed)

    def objects(self) -> list[SceneObject]:
        """The fitted objects in the order of their labels."""
        return [self.fits[k] for k in sorted(self.fits)]

    def _evidence(self, label: int, noise: float, voxels: VoxelMap | None) -> Evidence:
        """What explanations of an object go by."""
        config = self._config.explanation
        cloud = self.points.thinned(label, config.spacing)
        weight = config.spacing**2 / config.reading
        return Evidence(cloud.points_world, cloud.normals_world, weight, noise, voxels)

    def _alone(self, label: int, evidence: Evidence) -> Explanation:
        """An object's explanation by the shape fitted to it."""
        return best_explanation([self.fits[label].shape], evidence, self._config.explanation)

    def _hints(self, points: Array) -> Sequence[NDArray[np.bool_]]:
        """Points (N,) that segmentation took for a segment of its own in one of the views."""
        hints = []
        for segments in self._segments:
            gap, index = segments.tree.query(points, distance_upper_bound=SAME_PLACE)
            owner = np.where(np.isfinite(gap), np.append(segments.labels, 0)[index], 0)
            for number in np.unique(owner[owner > 0]):
                own = owner == number
                if self._config.split.min_points <= own.sum() < 0.9 * (owner > 0).sum():
                    hints.append(own)
        return hints

    def _forget(self, labels: set[int]) -> None:
        """Drop what was found of objects that have changed: which are one, and which pairs are two."""
        self._undivided = {k: n for k, n in self._undivided.items() if k not in labels}
        self._apart = {pair: n for pair, n in self._apart.items() if not labels & set(pair)}

    def _noise(self) -> float:
        """Standard deviation of points from their surfaces [m]: that of the object in the middle."""
        residuals = [o.residual for o in self.fits.values()]
        spread = MEAN_TO_DEVIATION * float(np.median(residuals)) if residuals else 0.0
        return max(spread, LEAST_NOISE)

    def _fit(self, clouds: Mapping[int, Cloud], voxels: VoxelMap | None = None) -> None:
        """Fit objects, by label, to these points."""
        labels = sorted(clouds)
        results = fit_many(
            [Oriented(clouds[k].points_world, clouds[k].normals_world) for k in labels],
            config=self._config.fit,
            rngs=[np.random.default_rng([self._seed, k]) for k in labels],
            space=voxels,
        )
        for label, result in zip(labels, results, strict=True):
            if isinstance(result, FitFailure):
                self.fits.pop(label, None)
                continue
            self.fits[label] = SceneObject(
                id=object_id(label),
                label=label,
                shape=result.shape,
                residual=result.residual,
                poor_fit=result.poor,
                seen=result.seen,
                uncertainty=result.uncertainty,
            )


def labelled(cloud: Cloud, label: int) -> Cloud:
    """Return a cloud whose points all carry one label."""
    return replace(cloud, labels=np.full(len(cloud), label, dtype=np.int32))


def joined(clouds: Iterable[Cloud]) -> Cloud:
    """Put clouds together; colours and labels stay where all of them have them."""
    parts = list(clouds)
    if not parts:
        nothing: Array = np.zeros((0, 3))
        return Cloud(nothing, nothing, np.zeros(0, dtype=np.int32))
    rgb = [c.rgb for c in parts if c.rgb is not None]
    labels = [c.labels for c in parts if c.labels is not None]
    return Cloud(
        np.concatenate([c.points_world for c in parts]),
        np.concatenate([c.normals_world for c in parts]),
        np.concatenate(labels) if len(labels) == len(parts) else None,
        np.concatenate(rgb) if len(rgb) == len(parts) else None,
    )
