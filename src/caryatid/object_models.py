"""Every object's points and the shape fitted to them, kept up to date view by view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid import association
from caryatid.clouds import thin
from caryatid.config import Config
from caryatid.frames import Array
from caryatid.graph import SceneObject, object_id
from caryatid.object_points import ObjectPoints
from caryatid.perception import UP, Percept
from caryatid.primitives import FitFailure, fit
from caryatid.splitting import split
from caryatid.views import SUPPORT_LABEL, Cloud


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

    def associate(self, percept: Percept) -> Percept:
        """Give a view's automatic parts the labels of the objects they belong to, or new ones."""
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
        shown = {int(k) for k in np.unique(percept.labels) if k != 0}
        for label in sorted(shown):
            part = percept.cloud.select(percept.labels == label)
            voxel = config.surface.spacing if label == SUPPORT_LABEL else config.cloud.voxel
            self.points.add(label, part.select(thin(part.points_world, voxel)), view)
        return shown - {SUPPORT_LABEL}

    def move(self, T: Mapping[int, Array]) -> set[int]:
        """Move the points of some views (view → (4, 4)); returns the labels of the objects that have some."""
        return self.points.move(T) - {SUPPORT_LABEL}

    def fit_newest(self, labels: set[int]) -> None:
        """Fit objects to the newest view's points alone, and forget all other fits (`sg`)."""
        self.fits = {}
        for label in sorted(labels):
            self._fit(label, self.points.newest(label))

    def fit_all(self, labels: set[int]) -> None:
        """Fit objects to all their points so far (`pc`, `pc+sg`)."""
        for label in sorted(labels):
            cloud = self.points.of(label)
            self._fit(label, cloud.select(thin(cloud.points_world, self._config.cloud.voxel)))

    def divide(self, labels: set[int]) -> set[int]:
        """Part objects that no single shape explains and several do; returns the labels that changed."""
        changed: set[int] = set()
        for label in sorted(labels & self.fits.keys()):
            cloud = self.points.of(label)
            if len(cloud) < self._config.split.growth * self._undivided.get(label, 0):
                continue
            groups = split(
                cloud.points_world,
                cloud.normals_world,
                self.fits[label].residual,
                up=UP,
                config=self._config.split,
                fit_config=self._config.fit,
                rng=np.random.default_rng([self._seed, label]),
            )
            if groups is None:
                self._undivided[label] = len(cloud)
            else:
                changed |= set(self.points.divide(label, groups))
        self.fit_all(changed)
        return changed

    def unite(self) -> dict[int, int]:
        """Merge objects that lie in another's shape; returns label given up → label that takes its points."""
        given_up = association.duplicates(
            {k: self.points.of(k).points_world for k in self.points.objects},
            {k: o.shape for k, o in self.fits.items()},
            self._config.segmentation,
        )
        for old, new in given_up.items():
            self.points.merge(old, new)
            del self.fits[old]
        self.fit_all(set(given_up.values()))
        return given_up

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

    def _fit(self, label: int, cloud: Cloud) -> None:
        rng = np.random.default_rng([self._seed, label])
        result = fit(cloud.points_world, cloud.normals_world, config=self._config.fit, rng=rng)
        if isinstance(result, FitFailure):
            self.fits.pop(label, None)
            return
        named = SceneObject(id=object_id(label), label=label, shape=result.shape)
        self.fits[label] = replace(
            named,
            residual=result.residual,
            poor_fit=result.poor,
            seen=result.seen,
            uncertainty=result.uncertainty,
        )
