"""Every object's points and the shape fitted to them, kept up to date view by view."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import Config
from caryatid.fitting.primitives import FitFailure, Oriented, fit_many
from caryatid.geometry.points import most_central
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, object_id
from caryatid.objects import association
from caryatid.objects.description_length import Evidence, evidence_of, explained_by
from caryatid.objects.model_merge import united
from caryatid.objects.model_split import split
from caryatid.objects.points import ObjectPoints
from caryatid.segmentation.perception import UP, Percept
from caryatid.sensing.clouds import thin
from caryatid.sensing.views import SUPPORT_LABEL, Cloud
from caryatid.sensing.voxel_map import VoxelMap

MEAN_TO_DEVIATION = 1.25
"""Standard deviation of a normal distribution over its mean absolute value."""


@dataclass(frozen=True, eq=False)
class _Parts:
    """What segmentation took for parts in one view: points (N, 3) [m] and the part (N,) each is of."""

    points: Array
    labels: NDArray[np.int32]

    @cached_property
    def tree(self) -> cKDTree:
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
        self._parts: list[_Parts] = []
        self._apart: dict[tuple[int, int], int] = {}

    def copy(self) -> ObjectModels:
        """Return models that know the same and go on by themselves; clouds, trees and shapes are shared."""
        other = copy.copy(self)
        other.points = self.points.copy()
        other.fits = self.fits.copy()
        other._undivided = self._undivided.copy()
        other._parts = self._parts.copy()
        other._apart = self._apart.copy()
        return other

    def associate(self, percept: Percept) -> Percept:
        """Give a view's automatic parts the labels of the objects they belong to, or new ones."""
        kept = np.flatnonzero((percept.labels != 0) & (percept.labels != SUPPORT_LABEL))
        kept = kept[thin(percept.cloud.points_world[kept], self._config.explanation.spacing)]
        self._parts.append(_Parts(percept.cloud.points_world[kept], percept.labels[kept]))
        labels = association.associate(
            percept.cloud.points_world,
            np.where(percept.labels == SUPPORT_LABEL, 0, percept.labels),
            {k: self.points.of(k).points_world for k in self.points.objects},
            {k: o.shape for k, o in self.fits.items()},
            self._config.segmentation,
            self.points.labels_used,
        )
        labels[percept.labels == SUPPORT_LABEL] = SUPPORT_LABEL
        return percept.with_labels(labels)

    def add(self, percept: Percept, view: int) -> set[int]:
        """Add a view's points, thinned, and return the labels of the objects among them."""
        config = self._config
        shown = set(percept.shown) - {0}
        voxels = np.full(max(shown, default=0) + 1, config.cloud.voxel)
        voxels[0] = 0.0
        voxels[SUPPORT_LABEL:] = config.surface.spacing
        kept = most_central(percept.cloud.points_world, percept.labels, voxels)
        labels = percept.labels[kept]
        for label in sorted(shown):
            self.points.add(label, percept.cloud.select(kept[labels == label]), view)
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
        self._fit(self.points.thinned(labels, self._config.cloud.voxel), voxels)

    def divide(self, labels: set[int], voxels: VoxelMap | None = None) -> set[int]:
        """Part objects that several shapes explain better than one; returns the labels that changed.

        Args:
            labels: Objects whose points have changed.
            voxels: Space seen free, which no shape may fill.
        """
        config = self._config
        changed: set[int] = set()
        grown = [
            k
            for k in sorted(labels & self.fits.keys())
            if len(self.points.of(k)) >= config.explanation.growth * self._undivided.get(k, 0)
        ]
        for label, evidence in self._gathered(grown, self._noise(), voxels).items():
            cloud = self.points.of(label)
            groups = split(
                evidence,
                explained_by(self.fits[label].shape, evidence, config.explanation),
                partial(self._hints, evidence.points),
                up=UP,
                config=config.split,
                costs=config.explanation,
                fit_config=config.fit,
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
        config = self._config
        noise = self._noise()
        evidence = self._gathered(sorted(self.fits), noise, voxels)
        given_up: dict[int, int] = {}
        alone = {k: explained_by(self.fits[k].shape, e, config.explanation) for k, e in evidence.items()}
        while True:
            pair = united(
                evidence,
                alone,
                labels,
                self._apart,
                costs=config.explanation,
                fit_config=config.fit,
                seed=self._seed,
            )
            if pair is None:
                return given_up
            new, old = pair
            self.points.merge(old, new)
            self._forget(set(pair))
            del self.fits[old], evidence[old], alone[old]
            given_up = {k: new if v == old else v for k, v in given_up.items()} | {old: new}
            self.fit_all({new}, voxels)
            evidence |= self._gathered([new], noise, voxels)
            alone[new] = explained_by(self.fits[new].shape, evidence[new], config.explanation)
            labels = labels | {new}

    def nearest(self, percept: Percept, labels: set[int]) -> Percept:
        """Give the points of a view that carry one of these labels the label of the nearest point of any."""
        among = np.flatnonzero(np.isin(percept.labels, sorted(labels)))
        known = [self.points.of(k) for k in sorted(labels)]
        owners = np.repeat(sorted(labels), [len(c) for c in known])
        _, nearest = cKDTree(np.concatenate([c.points_world for c in known])).query(
            percept.cloud.points_world[among]
        )
        changed: NDArray[np.int32] = percept.labels.copy()
        changed[among] = owners[nearest]
        return percept.with_labels(changed)

    def objects(self) -> list[SceneObject]:
        """The fitted objects in the order of their labels."""
        return [self.fits[k] for k in sorted(self.fits)]

    def _gathered(self, labels: Sequence[int], noise: float, voxels: VoxelMap | None) -> dict[int, Evidence]:
        """What explanations of objects go by; points that have not changed are not thinned again."""
        config = self._config.explanation
        clouds = self.points.thinned(labels, config.spacing)
        return {k: evidence_of(cloud, noise, voxels, config) for k, cloud in clouds.items()}

    def _hints(self, points: Array) -> list[NDArray[np.bool_]]:
        """Points (N,) that segmentation took for a part of its own in one of the views."""
        config = self._config
        hints = []
        for parts in self._parts:
            gap, index = parts.tree.query(points, distance_upper_bound=config.split.reach)
            owner = np.where(np.isfinite(gap), np.append(parts.labels, 0)[index], 0)
            for part in np.unique(owner[owner > 0]):
                own = owner == part
                if config.split.min_points <= own.sum() < 0.9 * (owner > 0).sum():
                    hints.append(own)
        return hints

    def _forget(self, labels: set[int]) -> None:
        """Drop what was found of objects that were others then: which are one, and which pairs are two."""
        self._undivided = {k: n for k, n in self._undivided.items() if k not in labels}
        self._apart = {pair: n for pair, n in self._apart.items() if not labels & set(pair)}

    def _noise(self) -> float:
        """Standard deviation of points from their surfaces [m]: that of the object in the middle."""
        residuals = [o.residual for o in self.fits.values()]
        spread = MEAN_TO_DEVIATION * float(np.median(residuals)) if residuals else 0.0
        return max(spread, self._config.explanation.least_noise)

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
            named = SceneObject(id=object_id(label), label=label, shape=result.shape)
            self.fits[label] = replace(
                named,
                residual=result.residual,
                poor_fit=result.poor,
                seen=result.seen,
                uncertainty=result.uncertainty,
            )
