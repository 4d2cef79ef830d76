"""The points of each object, and which view showed each of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry import points as kernels
from caryatid.geometry.points import last_in_voxels, most_central
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import SUPPORT_LABEL, Cloud


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """Points of one object, those of later views behind those of earlier ones, and the view (N,) of each."""

    cloud: Cloud
    views: NDArray[np.intp]

    def select(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> _Seen:
        return _Seen(self.cloud.select(kept), self.views[kept])

    def relabelled(self, label: int) -> _Seen:
        return replace(self, cloud=relabelled(self.cloud, label))

    def moved(self, T: Mapping[int, Array]) -> _Seen:
        poses = np.array([T.get(view, np.eye(4)) for view in range(int(self.views.max()) + 1)])
        points = kernels.transform(poses, self.views, self.cloud.points_world)
        normals = kernels.rotate(poses, self.views, self.cloud.normals_world)
        return replace(self, cloud=replace(self.cloud, points_world=points, normals_world=normals))

    def followed_by(self, other: _Seen) -> _Seen:
        return _Seen(joined([self.cloud, other.cloud]), np.concatenate([self.views, other.views]))


class ObjectPoints:
    """What has been seen of each object so far; grows with every view.

    Attributes:
        labels_used: The highest label an object ever had; new ones are numbered from the next one.
    """

    def __init__(self) -> None:
        self.labels_used = 0
        self._seen: dict[int, _Seen] = {}
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
        self._append(label, _Seen(joined([cloud]), np.full(len(cloud), view)))
        if label != SUPPORT_LABEL:
            self.labels_used = max(self.labels_used, label)

    def __contains__(self, label: int) -> bool:
        return label in self._seen

    @property
    def objects(self) -> list[int]:
        """Labels of the objects, the support surface left out."""
        return sorted(k for k in self._seen if k != SUPPORT_LABEL)

    def of(self, label: int) -> Cloud:
        """All points of an object."""
        return self._seen[label].cloud if label in self._seen else joined([])

    def thinned(self, labels: Iterable[int], edge: float) -> dict[int, Cloud]:
        """All points of objects, of those in a voxel of this edge length [m] the one nearest to their mean.

        Objects whose points are the same as when this was last asked for are not looked at again.
        """
        clouds = {label: self.of(label) for label in labels}
        held = {k: self._thinned.get((k, edge), (None, None)) for k in clouds}
        changed = [k for k, cloud in clouds.items() if held[k][0] is not cloud]
        if changed:
            sizes = [len(clouds[k]) for k in changed]
            owners = np.repeat(np.arange(len(changed), dtype=np.int32), sizes)
            points = np.concatenate([clouds[k].points_world for k in changed])
            kept = most_central(points, owners, np.full(len(changed), edge))
            first = np.cumsum([0, *sizes])
            ends = np.searchsorted(kept, first)
            for n, k in enumerate(changed):
                own = kept[ends[n] : ends[n + 1]] - first[n]
                self._thinned[k, edge] = clouds[k], clouds[k].select(own)
        return {k: self._thinned[k, edge][1] for k in clouds}

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
        if not T:
            return set()
        views = np.zeros(2 + max(T), dtype=bool)
        views[list(T)] = True
        moving = [k for k, seen in self._seen.items() if np.take(views, seen.views, mode="clip").any()]
        for label in moving:
            self._seen[label] = self._seen[label].moved(T)
        return set(moving)

    def merge(self, old: int, new: int) -> None:
        """Give the points of one object to another."""
        self._append(new, self._taken(old).relabelled(new))

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
            self._seen[name] = seen.select(groups == number).relabelled(name)
        self.labels_used = max(self.labels_used, *names)
        return names

    def _taken(self, label: int) -> _Seen:
        self._thinned = {key: held for key, held in self._thinned.items() if key[0] != label}
        return self._seen.pop(label)

    def _append(self, label: int, seen: _Seen) -> None:
        self._seen[label] = self._seen[label].followed_by(seen) if label in self._seen else seen


def relabelled(cloud: Cloud, label: int) -> Cloud:
    """Return a cloud whose points all carry one label."""
    labels = np.full(len(cloud), label, dtype=np.int32)
    return Cloud(
        cloud.points_world, cloud.normals_world, labels, cloud.rgb, cloud.viewpoint_world, cloud.name
    )


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
