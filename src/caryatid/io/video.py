"""Depth images ordered by time, each with the colour, camera and pose of its time."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from math import hypot
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, TypeVar

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
LATEST: Final = 2**32
"""Upper limit of times [s], in 2106: in nanoseconds, they and their differences fit in 64 bits."""


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


MAX_WAYS: Final = 1000
"""Most frames on all ways from a frame upwards that are visited."""
Timed = TypeVar("Timed", TimedImage, TimedCamera)


def make_video(
    path: Path,
    depths: Sequence[TimedImage],
    colours: Sequence[TimedImage] | None,
    cameras: Sequence[TimedCamera],
    poses: tuple[TransformTree, str] | None,
    config: RecordingConfig,
    notes: Sequence[str],
) -> Dataset:
    """Find the colour, camera and pose of each depth image; they are numbered in their order here.

    `poses` are transforms and the frame that is the world. Without them, views have no poses, and without
    `colours` no colour. Complete frames are ordered by time, others are counted.

    Raises:
        InputError: Two ways through the transforms contradict each other, or the depth images share no time
            with colours or transforms.
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
        camera = _nearest(cameras, depth.time) or cameras[0]
        if poses is not None:
            T_world_camera = poses[0].between(poses[1], depth.frame or camera.frame, depth.time)
            if T_world_camera is None:
                skipped[NO_POSE] += 1
                continue
        load = partial(_load, depth, colour, camera, T_world_camera, config.far)
        frames.append(Frame(depth.name, number, load, T_world_camera, depth.time))
    if depths and not frames:
        if colours:
            _check_clock(path, depths, "colour images", (colours[0].time, colours[-1].time))
        if poses is not None:
            tree, world = poses
            for child in (*tree.ancestors(depths[0].frame or cameras[0].frame), *tree.ancestors(world)):
                if times := tree.times(child):
                    _check_clock(path, depths, f"transforms of '{child}'", (min(times), max(times)))
    frames.sort(key=lambda frame: (frame.time, frame.number))
    return Dataset(path, frames, skipped, tuple(notes), is_video=True)


def _check_clock(path: Path, depths: Sequence[TimedImage], what: str, others: tuple[int, int]) -> None:
    """Refuse depth images more than a second before or after all others, given by their range [ns]."""
    first, last = min(depth.time for depth in depths), max(depth.time for depth in depths)
    if first > others[1] + SECOND or last < others[0] - SECOND:
        late = (first - others[0]) / SECOND
        reason = f"depth images and {what} share no time: the former begin {abs(late):.1f} s "
        reason += f"{'later' if late > 0 else 'earlier'}; if recorded together, their clocks differ by that"
        raise InputError(path, reason, "synchronise the clocks of all computers (or use_sim_time everywhere)")


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
    if camera.size not in (None, size) or _differ(camera.frame, depth.frame):
        others = _described(camera.size or size, camera.frame)
        reason = f"its images ({others}) differ from the depth images ({shown})"
        raise InputError(camera.name, reason, "give the camera of the depth images")
    rgb = None
    if colour is not None:
        rgb = colour.decode()
        if rgb.shape[1::-1] != size or _differ(colour.frame, depth.frame):
            registered = _described(rgb.shape[1::-1], colour.frame)
            reason = f"depth ({shown}) is not registered to colour ({registered})"
            raise InputError(depth.name, reason, "give depth aligned to colour, or omit colour")
    near = np.where(metres <= far, metres, np.float32(0.0))
    return View(near, camera.K, T_world_camera, rgb, name=depth.name)


def _differ(frame: str, other: str) -> bool:
    """Whether two frames differ; one without a name contradicts nothing."""
    return bool(frame and other) and frame != other


def _described(size: tuple[int, ...], frame: str) -> str:
    return f"{size[0]}×{size[1]} pixels, frame '{frame}'"


@dataclass
class _Link:
    """Poses of one frame in another over time: times [ns], and translations with quaternions, w last.

    Compact, because robots may record for hours. Without any, a fixed pose (4, 4) holds at all times.
    """

    times: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[float] = field(default_factory=lambda: array("d"))
    fixed: Array | None = None

    @cached_property
    def in_order(self) -> tuple[NDArray[np.int64], Array]:
        """Ascending times, and poses (N, 7); the last of equal times counts."""
        times, last = np.unique(np.array(self.times)[::-1], return_index=True)
        order = len(self.times) - 1 - last
        return times, np.array(self.numbers).reshape(-1, 7)[order]


class TransformTree:
    """Poses of frames in their parents over time, interpolated across gaps of at most `max_gap` [s].

    A frame may have several parents, as when a driver and a calibration both publish it. Errors use the name.
    """

    def __init__(self, max_gap: float, name: str = "transforms") -> None:
        self._name = name
        self._max_gap = round(max_gap * SECOND)
        self._links: defaultdict[str, defaultdict[str, _Link]] = defaultdict(lambda: defaultdict(_Link))

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted({*self._links}.union(*self._links.values()))

    def times(self, frame: str) -> list[int]:
        """All times [ns] of the poses of a frame; none if it is fixed."""
        return [time for link in self._links.get(frame, {}).values() for time in link.times]

    def add(self, parent: str, child: str, time: int, pose: Sequence[float], *, fixed: bool = False) -> None:
        """Add the pose of a child in its parent at a time [ns], before the first query.

        A pose fulfils `is_pose`; of two at the same time, the later one counts. A fixed one holds at all
        times, unless there are poses with times.
        """
        link = self._links[child][parent]
        if fixed:
            link.fixed = transforms.rigid(Rotation.from_quat(pose[3:]).as_matrix(), pose[:3])
        else:
            link.times.append(time)
            link.numbers.extend(pose)

    def parents(self, frame: str) -> list[str]:
        """All parents of a frame, by name."""
        return sorted(self._links.get(frame, ()))

    def ancestors(self, frame: str) -> list[str]:
        """The frame, its parents, their parents and so on, at any time."""
        found = [frame]
        for child in found:
            found += [parent for parent in self.parents(child) if parent not in found]
        return found

    def between(self, target: str, source: str, time: int) -> Array | None:
        """`T_target_source` (4, 4): the pose of one frame in another at a time [ns].

        Between two poses the rotation is interpolated along the shortest arc and the translation linearly.
        None if the frames are not connected, or a link has no pose around that time.

        Raises:
            InputError: A frame has two parents, and the two ways differ by more than a millimetre.
        """
        down = list(islice(self._upwards(target, time), MAX_WAYS))
        up = islice(self._upwards(source, time, {frame for frame, _ in down}), MAX_WAYS)
        ways = [
            transforms.invert(T_frame_target) @ T_frame_source
            for met, T_frame_source in up
            for frame, T_frame_target in down
            if frame == met
        ]
        if any(not np.allclose(T, ways[0], rtol=0.0, atol=1e-3) for T in ways[1:]):
            above = (*self.ancestors(source), *self.ancestors(target))
            twice = next(frame for frame in above if len(self.parents(frame)) > 1)
            others = " and ".join(f"'{parent}'" for parent in self.parents(twice))
            reason = f"frame '{twice}' has two parents, {others}, that place it differently"
            raise InputError(self._name, reason, "record again with only one publisher of its transform")
        return ways[0] if ways else None

    def _upwards(self, frame: str, time: int, ends: Collection[str] = ()) -> Iterator[tuple[str, Array]]:
        """The frame and its ancestors up to any of `ends`, by each way, with the pose of `frame` in them."""
        ways: list[tuple[str, Array, tuple[str, ...]]] = [(frame, np.eye(4), ())]
        while ways:
            child, T_child_frame, met = ways.pop()
            yield child, T_child_frame
            for parent in self.parents(child)[::-1] if child not in ends else ():
                T_parent_child = self._step(child, parent, time)
                if T_parent_child is not None and parent not in met:
                    ways.append((parent, T_parent_child @ T_child_frame, (*met, child)))

    def _step(self, child: str, parent: str, time: int) -> Array | None:
        """The pose of a frame in its parent at a time, or None if unknown."""
        link = self._links[child][parent]
        if not link.times:
            return link.fixed
        times, poses = link.in_order
        stop = int(np.searchsorted(times, time))
        if stop == len(times):
            return None
        start = stop if times[stop] == time else stop - 1
        gap = int(times[stop] - times[start])
        if start < 0 or gap > self._max_gap:
            return None
        share = (time - int(times[start])) / max(gap, 1)
        turn = Slerp((0.0, 1.0), Rotation.from_quat(poses[[start, stop], 3:]))
        position = (1.0 - share) * poses[start, :3] + share * poses[stop, :3]
        return transforms.rigid(turn(share).as_matrix(), position)


def is_pose(numbers: Sequence[float]) -> bool:
    """Whether numbers are a translation and a quaternion: seven, none huge, and no zero quaternion."""
    return len(numbers) == 7 and all(abs(n) <= 1e9 for n in numbers) and hypot(*numbers[3:]) > 1e-6
