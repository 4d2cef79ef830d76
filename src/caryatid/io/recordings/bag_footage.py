"""The frames of a bag: depth, the camera it was taken with, colour of its time, and where the camera was."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RecordingConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io.recordings import messages, sources
from caryatid.io.recordings.bags import Bag, open_bag
from caryatid.io.recordings.frame_filter import sharpness_of_colour, sharpness_of_depth
from caryatid.io.recordings.sources import Shot, Shots, Sieve, Timeline, within
from caryatid.io.recordings.transform_tree import SECOND, MissingTransform, TransformTree
from caryatid.sensing.views import View


@dataclass(frozen=True, slots=True)
class Topics:
    """What to take from a bag.

    Attributes:
        depth: Topic of depth images, registered to the colour where there is one.
        info: Topic of the depth images' camera.
        rgb: Topic of colour images, or None.
        world: Frame that is to be the world: level, z up; None without poses.
    """

    depth: str | None = None
    info: str | None = None
    rgb: str | None = None
    world: str | None = None


@dataclass(frozen=True, eq=False, slots=True)
class _Image:
    """An image as it is remembered: everything but its pixels.

    Attributes:
        number: Which message of its topic it is.
        time: When it was taken [ns].
        frame: Frame of its camera.
        size: Width and height [px].
        sharpness: How sharp it is.
    """

    number: int
    time: int
    frame: str
    size: tuple[int, int]
    sharpness: float


@dataclass(frozen=True, eq=False, slots=True)
class _Camera:
    """What a message said about a camera."""

    time: int
    frame: str
    K: Array
    size: tuple[int, int]
    distorts: bool


class BagFootage:
    """The frames of a bag.

    Args:
        path: The bag.
        topics: What to take from it.
        config: Limits of time and range.
    """

    def __init__(self, path: Path, topics: Topics, config: RecordingConfig) -> None:
        self.path = path
        self._topics = topics
        self._config = config
        self._cameras: Timeline[_Camera] = Timeline(())
        self._colour_of: dict[int, int] = {}

    def look_through(self) -> Shots:
        """Find all frames.

        Raises:
            InputError: The bag is damaged, lacks a topic or a frame, or its images do not fit each other.
        """
        with open_bag(self.path) as bag:
            depth_topic = bag.require("--depth", self._topics.depth)
            info_topic = bag.require("--info", self._topics.info)
            rgb_topic = None if self._topics.rgb is None else bag.require("--rgb", self._topics.rgb)
            self._cameras = self._read_cameras(bag, info_topic)
            tree = self._read_transforms(bag)
            sieve = Sieve()
            depths, colours, reach, whole = self._read_images(bag, depth_topic, rgb_topic, sieve)
        read = len(depths) + sum(sieve.skipped.values())
        self._check_frame(tree, depths)
        for depth in depths:
            self._check_camera(depth)
            self._sift(depth, colours if rgb_topic is not None else None, tree, sieve)
        scale = 1.0 if whole else sources.finest_scale(reach)
        return sieve.shots(read, scale, self._notes())

    def load(self, shots: Sequence[Shot]) -> Iterator[View]:
        """Decode frames, in the order given.

        Raises:
            InputError: The bag has been changed meanwhile.
        """
        depth_topic, rgb_topic = self._topics.depth or "", self._topics.rgb
        waiting = list(shots)
        wanted = {shot.number for shot in shots}, {self._colour_of.get(shot.number) for shot in shots}
        depths: dict[int, NDArray[np.float32]] = {}
        colours: dict[int, NDArray[np.uint8]] = {}
        with open_bag(self.path) as bag:
            for topic, number, _, message in _numbered(bag, depth_topic, rgb_topic):
                if topic == depth_topic and number in wanted[0]:
                    depths[number] = within(messages.depth_of(message, topic), self._config.far)
                elif topic == rgb_topic and number in wanted[1]:
                    colours[number] = messages.colour_of(message, topic)
                while waiting and self._is_there(waiting[0], depths, colours):
                    shot = waiting.pop(0)
                    colour = None if rgb_topic is None else colours[self._colour_of[shot.number]]
                    yield self._view(shot, depths.pop(shot.number), colour)
        if waiting:
            raise InputError(self.path, "has been changed while it was read", "import it again")

    def _is_there(self, shot: Shot, depths: dict[int, Any], colours: dict[int, Any]) -> bool:
        has_colour = self._topics.rgb is None or self._colour_of[shot.number] in colours
        return has_colour and shot.number in depths

    def _view(self, shot: Shot, depth: NDArray[np.float32], colour: NDArray[np.uint8] | None) -> View:
        camera = self._camera_at(shot.time)
        return View(
            depth=depth,
            K=camera.K,
            T_world_camera=shot.T_world_camera,
            rgb=colour,
            name=f"{self.path.name}: depth image {shot.number}",
        )

    def _camera_at(self, time: int) -> _Camera:
        camera = self._cameras.at(time)
        if camera is None:
            raise RuntimeError("a bag that was looked through has a camera")
        return camera

    def _read_cameras(self, bag: Bag, topic: str) -> Timeline[_Camera]:
        cameras = []
        for _, received, message in bag.messages([topic]):
            K, size, distorts = messages.camera_of(message, f"{self.path}: {topic}")
            frame = messages.frame_name(message.header.frame_id)
            cameras.append(_Camera(messages.stamp(message.header, received), frame, K, size, distorts))
        if not cameras:
            raise InputError(self.path, f"'{topic}' holds no message", "record the camera's info too")
        return Timeline(cameras)

    def _read_transforms(self, bag: Bag) -> TransformTree | None:
        if self._topics.world is None:
            return None
        tree = TransformTree(self._config.pose_gap)
        fixed = dict(bag.transform_topics())
        for topic, received, message in bag.messages(fixed):
            for parent, child, time, pose in messages.poses_of(message, received):
                tree.add(parent, child, time, pose, fixed=fixed[topic])
        return tree

    def _read_images(
        self, bag: Bag, depth_topic: str, rgb_topic: str | None, sieve: Sieve
    ) -> tuple[list[_Image], Timeline[_Image], float, bool]:
        """Depth images with enough readings, colour images, the farthest reading [m], and if they are mm."""
        depths: list[_Image] = []
        colours: list[_Image] = []
        reach, whole = 0.0, True
        for topic, number, received, message in _numbered(bag, depth_topic, rgb_topic):
            time = messages.stamp(message.header, received)
            frame = messages.frame_name(message.header.frame_id)
            source = f"{self.path}: {topic}"
            try:
                if topic == depth_topic:
                    depth = within(messages.depth_of(message, source), self._config.far)
                    readings = sharpness_of_depth(depth)
                    if readings < self._config.min_readings:
                        sieve.skipped[sources.DARK] += 1
                        continue
                    reach = max(reach, float(depth.max()))
                    whole = whole and messages.counts_millimetres(message)
                    depths.append(_Image(number, time, frame, depth.shape[::-1], readings))
                else:
                    colour = messages.colour_of(message, source)
                    size = (colour.shape[1], colour.shape[0])
                    colours.append(_Image(number, time, frame, size, sharpness_of_colour(colour)))
            except messages.BrokenMessageError:
                sieve.skipped[sources.BROKEN] += topic == depth_topic
        return depths, Timeline(colours), reach, whole

    def _sift(
        self, depth: _Image, colours: Timeline[_Image] | None, tree: TransformTree | None, sieve: Sieve
    ) -> None:
        sharpness = depth.sharpness
        if colours is not None:
            colour = colours.at(depth.time)
            if colour is None or abs(colour.time - depth.time) > self._config.colour_gap * SECOND:
                sieve.skipped[sources.NO_COLOUR] += 1
                return
            self._check_registered(depth, colour)
            self._colour_of[depth.number] = colour.number
            sharpness = colour.sharpness
        T_world_camera: Array | None = None
        if tree is not None and self._topics.world is not None:
            try:
                T_world_camera = tree.between(self._topics.world, depth.frame, depth.time)
            except MissingTransform:
                sieve.skipped[sources.NO_POSE] += 1
                return
        sieve.usable.append(Shot(depth.number, depth.time, sharpness, T_world_camera))

    def _check_camera(self, depth: _Image) -> None:
        camera = self._camera_at(depth.time)
        if camera.size != depth.size:
            raise InputError(
                f"{self.path}: {self._topics.info}",
                f"is the camera of {_size(camera.size)} pixel images, the depth has {_size(depth.size)}",
                "give the info topic of the depth images",
            )
        if camera.frame != depth.frame:
            raise InputError(
                f"{self.path}: {self._topics.info}",
                f"is the camera '{camera.frame}', the depth is of '{depth.frame}'",
                "give the info topic of the depth images",
            )

    def _check_registered(self, depth: _Image, colour: _Image) -> None:
        if colour.size != depth.size or colour.frame != depth.frame:
            raise InputError(
                self.path,
                f"depth ({_size(depth.size)}, frame '{depth.frame}') is not registered to colour "
                f"({_size(colour.size)}, frame '{colour.frame}')",
                "give the topic of depth aligned to colour, or leave --rgb out",
            )

    def _check_frame(self, tree: TransformTree | None, depths: list[_Image]) -> None:
        """Say that a frame is nowhere in the bag, which no frame's being skipped would make clear."""
        if tree is None:
            return
        known = tree.frames
        if not known:
            raise InputError(self.path, "holds no transforms", "record /tf and /tf_static, or leave --tf out")
        for frame in dict.fromkeys([self._topics.world, *(depth.frame for depth in depths)]):
            if frame not in known:
                raise InputError(
                    self.path,
                    f"there is no frame '{frame}' in its transforms",
                    f"there are {', '.join(known)}",
                )

    def _notes(self) -> list[str]:
        notes = []
        if self._topics.world is None:
            notes.append("no --tf FRAME: poses are not known, a single frame is taken")
        if any(camera.distorts for camera in self._cameras.items):
            notes.append(
                "the lens distorts, and a pinhole is assumed: give rectified topics, unless these are"
            )
        return notes


def _numbered(bag: Bag, *topics: str | None) -> Iterator[tuple[str, int, int, Any]]:
    """Topic, number within the topic, time of receipt [ns] and message."""
    counts = dict.fromkeys((topic for topic in topics if topic is not None), 0)
    for topic, received, message in bag.messages(counts):
        yield topic, counts[topic], received, message
        counts[topic] += 1


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]}×{size[1]}"
