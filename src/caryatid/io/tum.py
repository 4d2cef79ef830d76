"""Folders of the TUM RGB-D benchmark: depth.txt, rgb.txt, groundtruth.txt and the images they list."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from annotated_types import Gt, Le
from numpy.typing import NDArray

from caryatid.config import RecordingConfig
from caryatid.errors import InputError
from caryatid.io import images
from caryatid.io.datasets import Dataset, OpenOptions
from caryatid.io.json_files import parse_json, read_json
from caryatid.io.video import LATEST, SECOND, TimedCamera, TimedImage, TransformTree, is_pose, make_video
from caryatid.sensing.views import check_intrinsics

PUBLISHED: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""Published fx, fy, cx, cy [px] of the data set's three cameras of 640×480 pixels."""
_WORLD, _CAMERA = "world", "camera"


@dataclass(frozen=True, slots=True)
class _CameraFile:
    """--camera FILE.json; 5000 units of depth are a metre in the data set."""

    fx: float
    fy: float
    cx: float
    cy: float
    depth_scale: Annotated[float, Gt(0), Le(10)] = 0.2


def recognises(path: Path) -> bool:
    """Whether a path is a folder with a depth.txt."""
    return (path / "depth.txt").is_file()


def open_dataset(path: Path, config: RecordingConfig, options: OpenOptions) -> Dataset:
    """Open a TUM RGB-D folder; without a camera file, the name of the folder says which camera it is.

    Raises:
        InputError: A list is missing or broken, or the camera is unknown.
    """
    if replace(options, camera_file=None, masks=True) != OpenOptions():
        remedy = f"{path} is a TUM RGB-D folder; omit them"
        raise InputError("--depth, --info, --rgb, --tf", "apply only to bags", remedy)
    file, size, note = _read_camera(path, options.camera_file)
    K = np.array([[file.fx, 0.0, file.cx], [0.0, file.fy, file.cy], [0.0, 0.0, 1.0]])
    camera = TimedCamera(f"{path}: camera", 0, _CAMERA, check_intrinsics(K, str(options.camera_file)), size)
    limit: dict[str, Any] = {"max_pixels": config.max_pixels}
    depths = _read_list(path / "depth.txt", partial(images.read_depth, depth_scale=file.depth_scale, **limit))
    decode = partial(images.decode_image, **limit)
    colours = _read_list(path / "rgb.txt", decode) if (path / "rgb.txt").is_file() else None
    tree, notes = TransformTree(config.pose_gap), [note]
    poses = path / "groundtruth.txt"
    if poses.is_file():
        for time, words in _read_rows(poses, 8):
            with suppress(ValueError):
                if is_pose(pose := [float(word) for word in words]):
                    tree.add(_WORLD, _CAMERA, time, pose)
                    continue
            raise _broken(poses, f"'{' '.join(words)}' is not a pose")
    else:
        notes.append("no groundtruth.txt: poses are unknown, so only one frame is imported")
    return make_video(
        path, depths, colours, [camera], (tree, _WORLD) if poses.is_file() else None, config, notes
    )


def _read_camera(folder: Path, camera_file: Path | None) -> tuple[_CameraFile, tuple[int, int] | None, str]:
    """The camera from a file or as published, its image size [px] if known, and a note."""
    if camera_file is not None:
        remedy = (
            "give fx, fy, cx, cy [px], and depth_scale, the millimetres of a unit: 0.2 if 5000 are a metre"
        )
        document = read_json(camera_file, remedy)
        return parse_json(_CameraFile, document, camera_file, remedy), None, f"camera: {camera_file}"
    for name, (fx, fy, cx, cy) in PUBLISHED.items():
        if name in folder.resolve().name.lower():
            note = f"published camera of {name}: fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} px"
            return _CameraFile(fx, fy, cx, cy), (640, 480), note
    reason = f"the camera is unknown: the folder's name contains none of {', '.join(PUBLISHED)}"
    raise InputError(folder, reason, 'give --camera FILE.json with {"fx": …, "fy": …, "cx": …, "cy": …}')


def _read_list(path: Path, read: Callable[[Path], NDArray[Any]]) -> list[TimedImage]:
    files = ((time, path.parent / file) for time, (file,) in _read_rows(path, 2))
    return [TimedImage(str(file), time, _CAMERA, partial(read, file)) for time, file in files]


def _read_rows(path: Path, columns: int) -> list[tuple[int, list[str]]]:
    """Rows of a list: a time, in ns here, and the other columns; further ones are left out.

    Commas separate columns as spaces do, and a first line of names is skipped.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise _broken(path, f"cannot be read ({error})") from None
    timed = []
    rows = [words for line in lines if (words := line.partition("#")[0].replace(",", " ").split())]
    for words in rows[1:] if rows and re.search("time|stamp", rows[0][0].lower()) else rows:
        try:
            time = Decimal(words[0])
            valid = abs(time) < LATEST
        except ArithmeticError:
            valid = False
        if not valid:
            raise _broken(path, "a row does not start with a time in seconds")
        if len(words) < columns:
            raise _broken(path, f"'{' '.join(words)}' has {len(words)} columns, not {columns}")
        timed.append((int(time * SECOND), words[1:columns]))
    return timed


def _broken(path: Path, reason: str) -> InputError:
    return InputError(path, reason, "use the file as the data set provides it")
