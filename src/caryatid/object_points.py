"""The points of each object, view by view."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from caryatid.frames import Array
from caryatid.views import SUPPORT_LABEL, Cloud


class ObjectPoints:
    """What has been seen of each object so far; grows with every view.

    Attributes:
        labels_used: The highest label an object ever had; new ones are numbered from the next one.
    """

    def __init__(self) -> None:
        self.labels_used = 0
        self._clouds: dict[int, list[tuple[int, Cloud]]] = {}

    def copy(self) -> ObjectPoints:
        """Return points that go on growing by themselves; the clouds so far are shared."""
        other = ObjectPoints()
        other.labels_used = self.labels_used
        other._clouds = {label: list(clouds) for label, clouds in self._clouds.items()}
        return other

    def add(self, label: int, cloud: Cloud, view: int) -> None:
        """Add a view's points of an object, or of the support surface."""
        self._clouds.setdefault(label, []).append((view, cloud))
        if label != SUPPORT_LABEL:
            self.labels_used = max(self.labels_used, label)

    def __contains__(self, label: int) -> bool:
        return label in self._clouds

    @property
    def objects(self) -> list[int]:
        """Labels of the objects, the support surface left out."""
        return sorted(k for k in self._clouds if k != SUPPORT_LABEL)

    def of(self, label: int) -> Cloud:
        """All points of an object."""
        return joined(cloud for _, cloud in self._clouds.get(label, []))

    def newest(self, label: int) -> Cloud:
        """Points of an object in the newest view that showed it."""
        return self._clouds[label][-1][1]

    def everything(self) -> Cloud:
        """All points of all objects and of the support surface, with labels."""
        return joined(c for label in sorted(self._clouds) for _, c in self._clouds[label])

    def move(self, T: Mapping[int, Array]) -> set[int]:
        """Move the points of some views, view → (4, 4); returns the labels that have such points."""
        moved: set[int] = set()
        for label, clouds in self._clouds.items():
            if any(view in T for view, _ in clouds):
                moved.add(label)
                self._clouds[label] = [(view, c.moved(T[view]) if view in T else c) for view, c in clouds]
        return moved

    def merge(self, old: int, new: int) -> None:
        """Give the points of one object to another."""
        taken = [(view, relabelled(c, new)) for view, c in self._clouds.pop(old)]
        self._clouds[new] = [*self._clouds[new], *taken]

    def divide(self, label: int, groups: NDArray[np.intp]) -> list[int]:
        """Make several objects of one.

        Args:
            label: Which.
            groups: Group (N,), from 0, of each point of `of(label)`.

        Returns:
            Label of each group; the first keeps the old one.
        """
        clouds = self._clouds.pop(label)
        ends = np.cumsum([len(c) for _, c in clouds])
        names = [label, *range(self.labels_used + 1, self.labels_used + 1 + int(groups.max()))]
        for (view, cloud), part in zip(clouds, np.split(groups, ends[:-1]), strict=True):
            for number, name in enumerate(names):
                if (part == number).any():
                    self.add(name, relabelled(cloud.select(part == number), name), view)
        return names


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
