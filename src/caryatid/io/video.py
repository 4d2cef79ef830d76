"""Depth images ordered by time, each with the colour, camera and pose of its time."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import hypot
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from caryatid.config import RecordingConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.datasets import NO_COLOUR, NO_POSE, Dataset, Frame
from caryatid.sensing.views import View

SECOND = 1_000_000_000
"""Nanoseconds per second: times are whole nanoseconds since 1970, which floats cannot hold."""


@dataclass(frozen=True, slots=True)
class TimedImage:
    """An image that is not decoded yet: its time [ns], and the frame of its camera.

    `decode` returns depth (H, W) [m], or colour (H, W, 3), and raises `InputError` on failure.
    """

    name: str
    time: int
    frame: str
    decode: Callable[[], NDArray[Any]]


@dataclass(frozen=True, eq=False, slots=True)
class TimedCamera:
    """The pinhole camera at a time [ns]: K (3, 3), and width and height of its images [px] if known."""

    name: str
    time: int
    frame: str
    K: Array
    size: tuple[int, int] | None


Timed = TypeVar("Timed", TimedImage, TimedCamera)


def make_video(
    path: Path,
    depths: Sequence[TimedImage],
    colours: Sequence[TimedImage] | None,
    cameras: Sequence[TimedCamera],
    pose_at: Callable[[str, int], Array | None] | None,
    config: RecordingConfig,
    notes: Sequence[str],
) -> Dataset:
    """Find the colour, camera and pose of each depth image; they are numbered in their order here.

    `pose_at` gives the pose (4, 4) of a frame at a time [ns], or None if it is unknown. Without it, views
    have no poses, and without `colours` no colour. Complete frames are ordered by time, others are counted.
    """
    frames, skipped = [], Counter[str]()
    by_time = attrgetter("time")
    colours = None if colours is None else sorted(colours, key=by_time)
    cameras = sorted(cameras, key=by_time)
    for number, depth in enumerate(depths):
        colour, T_world_camera = None, None
        if colours is not None:
            colour = _nearest(colours, depth.time)
            if colour is None or abs(colour.time - depth.time) > config.colour_gap * SECOND:
                skipped[NO_COLOUR] += 1
                continue
        if pose_at is not None:
            T_world_camera = pose_at(depth.frame, depth.time)
            if T_world_camera is None:
                skipped[NO_POSE] += 1
                continue
        camera = _nearest(cameras, depth.time) or cameras[0]
        load = partial(_load, depth, colour, camera, T_world_camera, config.far)
        frames.append(Frame(depth.name, number, load, T_world_camera, depth.time))
    frames.sort(key=lambda frame: (frame.time, frame.number))
    return Dataset(path, frames, skipped, tuple(notes), is_video=True)


def _nearest(items: Sequence[Timed], time: int) -> Timed | None:
    """The item nearest to a time, the earlier of two equally near; None if there is none."""
    after = bisect_left(items, time, key=attrgetter("time"))
    around = items[max(after - 1, 0) : after + 1]
    return min(around, key=lambda item: abs(item.time - time), default=None)


def _load(
    depth: TimedImage,
    colour: TimedImage | None,
    camera: TimedCamera,
    T_world_camera: Array | None,
    far: float,
) -> View:
    """Decode a depth image and its colour, which must fit each other and the camera."""
    metres = depth.decode()
    size = metres.shape[::-1]
    shown = _described(size, depth.frame)
    if camera.size not in (None, size) or camera.frame != depth.frame:
        others = _described(camera.size or size, camera.frame)
        reason = f"its images ({others}) differ from the depth images ({shown})"
        raise InputError(camera.name, reason, "give the camera of the depth images")
    rgb = None
    if colour is not None:
        rgb = colour.decode()
        registered = _described(rgb.shape[1::-1], colour.frame)
        if registered != shown:
            reason = f"depth ({shown}) is not registered to colour ({registered})"
            raise InputError(depth.name, reason, "give depth aligned to colour, or omit colour")
    near = np.where(metres <= far, metres, np.float32(0.0))
    return View(near, camera.K, T_world_camera, rgb, name=depth.name)


def _described(size: tuple[int, ...], frame: str) -> str:
    return f"{size[0]}×{size[1]} pixels, frame '{frame}'"


@dataclass
class _Link:
    """Poses of one frame over time: times [ns], parents, and translations with quaternions, w last.

    Compact, because robots may record for hours.
    """

    times: array[int] = field(default_factory=lambda: array("q"))
    parents: list[str] = field(default_factory=list)
    numbers: array[float] = field(default_factory=lambda: array("d"))

    @cached_property
    def in_order(self) -> tuple[NDArray[np.int64], list[str], Array]:
        """Ascending times, with parents and poses (N, 7); the last of equal times counts."""
        times, last = np.unique(np.array(self.times)[::-1], return_index=True)
        order = len(self.times) - 1 - last
        return times, [self.parents[i] for i in order], np.array(self.numbers).reshape(-1, 7)[order]


class TransformTree:
    """Poses of frames in their parents over time, interpolated across gaps of at most `max_gap` [s]."""

    def __init__(self, max_gap: float) -> None:
        self._max_gap = round(max_gap * SECOND)
        self._fixed: dict[str, tuple[str, Array]] = {}
        self._links: defaultdict[str, _Link] = defaultdict(_Link)

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        parents = {parent for link in self._links.values() for parent in link.parents}
        parents |= {parent for parent, _ in self._fixed.values()}
        return sorted({*self._links, *self._fixed} | parents)

    def add(self, parent: str, child: str, time: int, pose: Sequence[float], *, fixed: bool = False) -> None:
        """Add the pose of a child in its parent at a time [ns], before the first query.

        A pose fulfils `is_pose`; of two at the same time, the later one counts. A fixed one holds at all
        times, unless there are poses with times.
        """
        if fixed:
            rotation = Rotation.from_quat(pose[3:]).as_matrix()
            self._fixed[child] = parent, transforms.rigid(rotation, pose[:3])
            return
        link = self._links[child]
        link.times.append(time)
        link.parents.append(parent)
        link.numbers.extend(pose)

    def between(self, target: str, source: str, time: int) -> Array | None:
        """`T_target_source` (4, 4): the pose of one frame in another at a time [ns].

        Between two poses the rotation is interpolated along the shortest arc and the translation linearly.
        None if the frames are not connected, or a link has no pose around that time.
        """
        T_up_source = dict(self._upwards(source, time))
        for frame, T_frame_target in self._upwards(target, time):
            if frame in T_up_source:
                return transforms.invert(T_frame_target) @ T_up_source[frame]
        return None

    def _upwards(self, frame: str, time: int) -> Iterator[tuple[str, Array]]:
        """The frame and its known ancestors, each with the pose of `frame` in it."""
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
        """Parent of a frame and its pose in it at a time, or None if unknown."""
        if child not in self._links:
            return self._fixed.get(child)
        times, parents, poses = self._links[child].in_order
        stop = int(np.searchsorted(times, time))
        if stop == len(times):
            return None
        start = stop if times[stop] == time else stop - 1
        gap = int(times[stop] - times[start])
        if start < 0 or parents[start] != parents[stop] or gap > self._max_gap:
            return None
        share = (time - int(times[start])) / max(gap, 1)
        turn = Slerp((0.0, 1.0), Rotation.from_quat(poses[[start, stop], 3:]))
        position = (1.0 - share) * poses[start, :3] + share * poses[stop, :3]
        return parents[stop], transforms.rigid(turn(share).as_matrix(), position)


def is_pose(numbers: Sequence[float]) -> bool:
    """Whether numbers are a translation and a quaternion: seven, none huge, and no zero quaternion."""
    return len(numbers) == 7 and all(abs(n) <= 1e9 for n in numbers) and hypot(*numbers[3:]) > 1e-6
