"""A tree of frames that move against each other over time, as robots publish it."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import hypot, isfinite

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array

SECOND = 1_000_000_000
"""Nanoseconds of a second: times are whole nanoseconds, which floats cannot hold since 1970."""


class MissingTransform(Exception):  # noqa: N818
    """There is no transform between two frames at a time."""


@dataclass(slots=True)
class _Link:
    """Where one frame was in its parents over time, as compact as robots that send for hours need it.

    Attributes:
        times: When [ns].
        parents: In which frame.
        numbers: Translation [m] and quaternion, w last, seven for each time.
        fixed: Parent and `T_parent_child` where the pose holds for all times.
        ordered: Whether times rise.
    """

    times: array[int] = field(default_factory=lambda: array("q"))
    parents: list[str] = field(default_factory=list)
    numbers: array[float] = field(default_factory=lambda: array("d"))
    fixed: tuple[str, Array] | None = None
    ordered: bool = True

    def pose(self, index: int) -> Array:
        """`T_parent_child` (4, 4) of one time."""
        return _matrix(self.numbers[7 * index : 7 * index + 7])


class TransformTree:
    """Poses of frames in their parent frames, asked for between any two frames at any time.

    Args:
        max_gap: Poses further apart in time than this are not interpolated across [s].
    """

    def __init__(self, max_gap: float) -> None:
        self._max_gap = round(max_gap * SECOND)
        self._links: dict[str, _Link] = {}

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted(set(self._links) | {parent for _, parent in self._edges()})

    def add(self, parent: str, child: str, time: int, pose: Sequence[float], *, fixed: bool = False) -> None:
        """Take in one pose; of two at the same time the later one counts.

        Args:
            parent: Frame the pose is given in.
            child: Frame whose pose it is.
            time: When [ns].
            pose: Translation [m] and quaternion, w last, of any length but 0: seven numbers for which
                `is_pose` holds.
            fixed: It holds for all times.
        """
        link = self._links.setdefault(child, _Link())
        if fixed:
            link.fixed = (parent, _matrix(pose))
            return
        link.ordered = link.ordered and (not link.times or time > link.times[-1])
        link.times.append(time)
        link.parents.append(parent)
        link.numbers.extend(pose)

    def between(self, target: str, source: str, time: int) -> Array:
        """`T_target_source` (4, 4): the pose of one frame in another at a time [ns].

        Between two poses the rotation is interpolated along the shortest arc and the translation linearly.

        Raises:
            MissingTransform: The frames are not connected, or a link has no pose around that time.
        """
        T_up_source = dict(self._upwards(source, time))
        if target in T_up_source:
            return T_up_source[target]
        for frame, T_frame_target in self._upwards(target, time):
            if frame in T_up_source:
                return transforms.invert(T_frame_target) @ T_up_source[frame]
        raise MissingTransform(f"'{source}' has no pose in '{target}' at {time / SECOND:.3f} s")

    def _upwards(self, frame: str, time: int) -> Iterator[tuple[str, Array]]:
        """The frame and those above it, each with the pose of `frame` in it, as far as is known."""
        T_up_frame = np.eye(4)
        met: set[str] = set()
        while frame not in met:
            yield frame, T_up_frame
            met.add(frame)
            step = self._step(frame, time)
            if step is None:
                return
            frame, T_parent_child = step
            T_up_frame = T_parent_child @ T_up_frame

    def _step(self, child: str, time: int) -> tuple[str, Array] | None:
        """Parent of a frame and its pose in it at a time, or None where that is not known."""
        link = self._links.get(child)
        if link is None or not link.times:
            return None if link is None else link.fixed
        if not link.ordered:
            _sort(link)
        after = bisect_right(link.times, time)
        if after > 0 and link.times[after - 1] == time:
            return link.parents[after - 1], link.pose(after - 1)
        if after in (0, len(link.times)) or link.parents[after - 1] != link.parents[after]:
            return None
        start, stop = link.times[after - 1], link.times[after]
        if stop - start > self._max_gap:
            return None
        share = (time - start) / (stop - start)
        return link.parents[after], _between(link.pose(after - 1), link.pose(after), share)

    def _edges(self) -> Iterator[tuple[str, str]]:
        for child, link in self._links.items():
            fixed = [link.fixed[0]] if link.fixed is not None and not link.times else []
            for parent in {*link.parents, *fixed}:
                yield child, parent


def nearest(times: Sequence[int], time: int) -> int | None:
    """Index of the time nearest to another, of two as near the earlier one; None where there is none."""
    after = bisect_left(times, time)
    around = range(max(after - 1, 0), min(after + 1, len(times)))
    return min(around, key=lambda index: abs(times[index] - time), default=None)


def is_pose(numbers: Sequence[float]) -> bool:
    """Whether numbers are a translation and a quaternion: seven, finite, the quaternion not of length 0."""
    return len(numbers) == 7 and all(map(isfinite, numbers)) and hypot(*numbers[3:]) > 1e-6


def _matrix(pose: Sequence[float]) -> Array:
    return transforms.rigid(Rotation.from_quat(pose[3:]).as_matrix(), pose[:3])


def _between(T_start: Array, T_stop: Array, share: float) -> Array:
    """The pose a share of the way from one to the other."""
    turn = Rotation.from_matrix(T_start[:3, :3].T @ T_stop[:3, :3]).as_rotvec()
    R = T_start[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    return transforms.rigid(R, (1.0 - share) * T_start[:3, 3] + share * T_stop[:3, 3])


def _sort(link: _Link) -> None:
    """Put poses in the order of time; of those at the same time the last one that came stays."""
    last = {time: index for index, time in enumerate(link.times)}
    order = [last[time] for time in sorted(last)]
    numbers = np.array(link.numbers).reshape(-1, 7)[order]
    link.times = array("q", [link.times[i] for i in order])
    link.parents = [link.parents[i] for i in order]
    link.numbers = array("d", numbers.ravel())
    link.ordered = True
