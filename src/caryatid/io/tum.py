"""Folders of the TUM RGB-D benchmark: depth.txt, rgb.txt, groundtruth.txt and the images they name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from annotated_types import Gt, Le

from caryatid.config import RecordingConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io import images
from caryatid.io.datasets import Dataset, OpenOptions, Topics
from caryatid.io.json_files import parse_json, read_json
from caryatid.io.video import SECOND, Decoded, TimedImage, TransformTree, is_pose, make_video
from caryatid.sensing.views import check_intrinsics

DEPTH_SCALE: Final = 0.2
"""Millimetres of one unit of depth in the data set: 5000 units are a metre."""
PUBLISHED: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy [px] that the data set publishes for its three cameras, of 640×480 pixels."""
_WORLD, _CAMERA = "world", "camera"


@dataclass(frozen=True, slots=True)
class _CameraFile:
    fx: float
    fy: float
    cx: float
    cy: float
    depth_scale: Annotated[float, Gt(0), Le(10)] = DEPTH_SCALE


@dataclass(frozen=True, eq=False, slots=True)
class _Camera:
    """Pinhole matrix, one unit of depth [mm], width and height [px] where known, and where it is from."""

    K: Array
    depth_scale: float
    size: tuple[int, int] | None
    note: str

    def decode(self, depth: _Image, colour: _Image | None) -> Decoded:
        metres = images.read_depth(depth.path, self.depth_scale)
        rgb = None if colour is None else images.read_colour(colour.path)
        if rgb is not None and rgb.shape[:2] != metres.shape:
            reason = "its colour image is of another size"
            raise InputError(depth.path, reason, "register the images to one size")
        if self.size not in (None, metres.shape[::-1]):
            height, width = metres.shape
            reason = f"is {width}×{height} pixels, the published camera has 640×480"
            raise InputError(depth.path, reason, "give --camera FILE.json")
        return metres, rgb, self.K


@dataclass(frozen=True, slots=True)
class _Image(TimedImage):
    path: Path


def recognises(path: Path) -> bool:
    """Whether a path is a folder with a depth.txt."""
    return (path / "depth.txt").is_file()


def open_dataset(path: Path, config: RecordingConfig, options: OpenOptions) -> Dataset:
    """Open a TUM RGB-D folder.

    Args:
        path: The folder; its name may hold `freiburg1`, `freiburg2` or `freiburg3`.
        config: Limits of time and range.
        options: The camera.

    Raises:
        InputError: A list is missing or broken, or the camera is not known.
    """
    if options.topics != Topics():
        remedy = f"{path} is a TUM RGB-D folder; leave them out"
        raise InputError("--depth, --info, --rgb, --tf", "are for bags", remedy)
    camera = _read_camera(path, options.camera_file)
    depths = _read_list(path / "depth.txt")
    colours = _read_list(path / "rgb.txt") if (path / "rgb.txt").is_file() else None
    pose_at, notes = None, [camera.note]
    if (path / "groundtruth.txt").is_file():
        tree = _read_poses(path / "groundtruth.txt", config.pose_gap)
        pose_at = lambda depth: tree.between(_WORLD, _CAMERA, depth.time)  # noqa: E731
    else:
        notes.append("no groundtruth.txt: poses are not known, a single frame is taken")
    video = make_video(path, depths, colours, pose_at, camera.decode, config)
    return replace(video, notes=tuple(notes), depth_scale=camera.depth_scale)


def _read_camera(folder: Path, camera_file: Path | None) -> _Camera:
    """The camera that a file describes, or that the data set publishes."""
    if camera_file is not None:
        document = read_json(camera_file, "give fx, fy, cx, cy [px] and depth_scale [mm]")
        c = parse_json(_CameraFile, document, camera_file)
        K = check_intrinsics(_matrix(c.fx, c.fy, c.cx, c.cy), str(camera_file))
        return _Camera(K, c.depth_scale, None, f"camera: {camera_file}")
    for name, (fx, fy, cx, cy) in PUBLISHED.items():
        if name in folder.resolve().name.lower():
            note = f"camera: as published for {name}, fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} px"
            return _Camera(_matrix(fx, fy, cx, cy), DEPTH_SCALE, (640, 480), note)
    raise InputError(
        folder,
        f"which camera it is from is not known: its name holds none of {', '.join(PUBLISHED)}",
        'give --camera FILE.json with {"fx": …, "fy": …, "cx": …, "cy": …}',
    )


def _read_poses(path: Path, max_gap: float) -> TransformTree:
    tree = TransformTree(max_gap)
    for time, words in _read_rows(path, 8):
        try:
            pose = [float(word) for word in words]
        except ValueError:
            pose = []
        if not is_pose(pose):
            raise _broken(path, f"'{' '.join(words)}' is no pose")
        tree.add(_WORLD, _CAMERA, time, pose)
    return tree


def _read_list(path: Path) -> list[_Image]:
    files = ((time, path.parent / file) for time, (file,) in _read_rows(path, 2))
    return [_Image(str(file), time, file) for time, file in files]


def _read_rows(path: Path, columns: int) -> list[tuple[int, list[str]]]:
    """Rows of a list: a time, here in ns, and the other columns."""
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
