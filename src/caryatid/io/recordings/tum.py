"""Folders of the TUM RGB-D benchmark: depth.txt, rgb.txt, groundtruth.txt and the images they name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Final

import numpy as np

from caryatid.config import RecordingConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io import images
from caryatid.io.json_files import number, read_json
from caryatid.io.recordings import sources
from caryatid.io.recordings.frame_filter import sharpness_of_colour, sharpness_of_depth
from caryatid.io.recordings.sources import Shot, Shots, Sieve, Timeline, within
from caryatid.io.recordings.transform_tree import SECOND, MissingTransform, TransformTree, is_pose
from caryatid.sensing.views import View, check_intrinsics

DEPTH_SCALE: Final = 0.2
"""Millimetres of one unit of depth in the data set: 5000 units are a metre."""
PUBLISHED: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy [px] that the data set publishes for its three cameras, of 640×480 pixels."""
_WORLD, _CAMERA = "world", "camera"


@dataclass(frozen=True, eq=False, slots=True)
class TumCamera:
    """The camera of a folder.

    Attributes:
        K: Pinhole matrix (3, 3) [px].
        depth_scale: One unit of depth [mm].
        size: Width and height [px] where they are known.
        note: Where this is from.
    """

    K: Array
    depth_scale: float
    size: tuple[int, int] | None
    note: str


def is_tum_folder(path: Path) -> bool:
    """Whether a path is a folder with a depth.txt."""
    return (path / "depth.txt").is_file()


def read_tum_camera(folder: Path, camera_file: Path | None) -> TumCamera:
    """Find the camera of a folder: as a file says, or as the data set publishes it.

    Args:
        folder: The folder; its name may hold `freiburg1`, `freiburg2` or `freiburg3`.
        camera_file: `camera.json` of the BOP format: fx, fy, cx, cy [px] and depth_scale [mm], or None.

    Raises:
        InputError: The file is broken, or there is none and the name says nothing.
    """
    if camera_file is not None:
        document = read_json(camera_file, "give fx, fy, cx, cy [px] and depth_scale [mm]")
        values = [number(document, key, str(camera_file)) for key in ("fx", "fy", "cx", "cy")]
        scale = number(document, "depth_scale", str(camera_file), default=DEPTH_SCALE)
        if not 0.0 < scale <= 10.0:
            raise InputError(camera_file, f"'depth_scale' is {scale:g}", "give millimetres of one depth unit")
        K = check_intrinsics(_matrix(*values), str(camera_file))
        return TumCamera(K, scale, None, f"camera: {camera_file}")
    for name, (fx, fy, cx, cy) in PUBLISHED.items():
        if name in folder.resolve().name.lower():
            note = f"camera: as published for {name}, fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} px"
            return TumCamera(_matrix(fx, fy, cx, cy), DEPTH_SCALE, (640, 480), note)
    raise InputError(
        folder,
        f"which camera it is from is not known: its name holds none of {', '.join(PUBLISHED)}",
        'give --camera FILE.json with {"fx": …, "fy": …, "cx": …, "cy": …}',
    )


@dataclass(frozen=True, slots=True)
class _File:
    """An image a list names, and when it was taken [ns]."""

    time: int
    path: Path


class TumFootage:
    """The frames of a TUM RGB-D folder.

    Args:
        folder: The folder.
        camera: Its camera.
        config: Limits of time and range.
    """

    def __init__(self, folder: Path, camera: TumCamera, config: RecordingConfig) -> None:
        self.path = folder
        self._camera = camera
        self._config = config
        self._depths: list[_File] = []
        self._colour_of: dict[int, Path] = {}

    def look_through(self) -> Shots:
        """Find all frames.

        Raises:
            InputError: A list is missing or broken, or images do not fit each other.
        """
        self._depths = _read_list(self.path, "depth.txt")
        has_colour = (self.path / "rgb.txt").is_file()
        colours = Timeline(_read_list(self.path, "rgb.txt")) if has_colour else None
        tree = self._read_poses()
        sieve = Sieve()
        for index, depth in enumerate(self._depths):
            self._sift(index, depth, colours, tree, sieve)
        notes = [self._camera.note]
        if tree is None:
            notes.append("no groundtruth.txt: poses are not known, a single frame is taken")
        return sieve.shots(len(self._depths), self._camera.depth_scale, notes)

    def load(self, shots: Sequence[Shot]) -> Iterator[View]:
        """Decode frames, in the order given.

        Raises:
            InputError: An image has gone or is broken.
        """
        for shot in shots:
            path, colour = self._depths[shot.number].path, self._colour_of.get(shot.number)
            depth = images.read_depth(path, self._camera.depth_scale)
            yield View(
                depth=within(depth, self._config.far),
                K=self._camera.K,
                T_world_camera=shot.T_world_camera,
                rgb=None if colour is None else images.read_colour(colour),
                name=str(path),
            )

    def _sift(
        self,
        index: int,
        depth: _File,
        colours: Timeline[_File] | None,
        tree: TransformTree | None,
        sieve: Sieve,
    ) -> None:
        """Find out whether a depth image can become a view, the cheap questions first."""
        T_world_camera: Array | None = None
        if tree is not None:
            try:
                T_world_camera = tree.between(_WORLD, _CAMERA, depth.time)
            except MissingTransform:
                sieve.skipped[sources.NO_POSE] += 1
                return
        colour_file = None
        if colours is not None:
            colour_file = colours.at(depth.time)
            if colour_file is None or abs(colour_file.time - depth.time) > self._config.colour_gap * SECOND:
                sieve.skipped[sources.NO_COLOUR] += 1
                return
        try:
            units = images.read_units(depth.path)
            colour = None if colour_file is None else images.read_colour(colour_file.path)
        except InputError:
            sieve.skipped[sources.BROKEN] += 1
            return
        self._check_sizes(depth.path, units.shape, None if colour is None else colour.shape[:2])
        metres = (units * (self._camera.depth_scale / 1000.0)).astype(np.float32)
        sharpness = sharpness_of_depth(within(metres, self._config.far))
        if sharpness < self._config.min_readings:
            sieve.skipped[sources.DARK] += 1
            return
        if colour is not None and colour_file is not None:
            sharpness = sharpness_of_colour(colour)
            self._colour_of[index] = colour_file.path
        sieve.usable.append(Shot(index, depth.time, sharpness, T_world_camera))

    def _read_poses(self) -> TransformTree | None:
        path = self.path / "groundtruth.txt"
        if not path.is_file():
            return None
        tree = TransformTree(self._config.pose_gap)
        for time, words in _read_rows(path, 8):
            try:
                pose = [float(word) for word in words]
            except ValueError:
                pose = []
            if not is_pose(pose):
                raise _broken(path, f"'{' '.join(words)}' is no pose")
            tree.add(_WORLD, _CAMERA, time, pose)
        return tree

    def _check_sizes(
        self, path: Path, depth_shape: tuple[int, ...], colour_shape: tuple[int, ...] | None
    ) -> None:
        if colour_shape not in (None, depth_shape):
            raise InputError(path, "its colour image is of another size", "register the images to one size")
        if self._camera.size not in (None, depth_shape[::-1]):
            raise InputError(
                path,
                f"is {depth_shape[1]}×{depth_shape[0]} pixels, the published camera has 640×480",
                "give --camera FILE.json",
            )


def _read_list(folder: Path, name: str) -> list[_File]:
    """The files a list names."""
    return [_File(time, folder / file) for time, (file,) in _read_rows(folder / name, 2)]


def _read_rows(path: Path, columns: int) -> list[tuple[int, list[str]]]:
    """Rows of a list: a time, here in ns, and the other columns.

    Raises:
        InputError: The file cannot be read, or a row has other columns or no time.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise _broken(path, f"cannot be read ({error})") from None
    rows = [words for line in lines if (words := line.partition("#")[0].split())]
    try:
        timed = [(int(Decimal(words[0]) * SECOND), words[1:]) for words in rows]
    except (InvalidOperation, ValueError, OverflowError):
        raise _broken(path, "a row does not begin with a time in seconds") from None
    for words in rows:
        if len(words) != columns:
            raise _broken(path, f"'{' '.join(words)}' has {len(words)} columns, not {columns}")
    return timed


def _broken(path: Path, reason: str) -> InputError:
    return InputError(path, reason, "take the file as the data set has it")


def _matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
