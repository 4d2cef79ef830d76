"""Recordings of phones: transforms.json of nerfstudio with depth, Record3D, and Stray Scanner.

Depth of a phone has fewer pixels than its colour, which is reduced to them. ARKit's world is y up; ours is
z up.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from caryatid.config import RecordingConfig
from caryatid.errors import InputError, needs_extra
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io import images
from caryatid.io.datasets import Dataset, Frame, OpenOptions
from caryatid.io.images import BrokenImageError
from caryatid.io.json_files import Numbers, parse_json, read_json
from caryatid.io.staging import read_errors
from caryatid.io.video import LATEST, SECOND, is_pose
from caryatid.segmentation.diagnosis import GL, Y_UP
from caryatid.sensing.views import View, check_intrinsics

COLUMNS: Final = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
"""Columns of odometry.csv that are read."""
PINHOLES: Final = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
"""Camera models of nerfstudio that are pinholes where the images are not distorted."""
AGAIN: Final = "export the recording again"
"""Remedy for broken files."""


def recognises(path: Path) -> bool:
    """Whether a path is a recording of a phone, by the names of its files."""
    return path.suffix == ".r3d" or _reader(path) is not None


def open_dataset(path: Path, config: RecordingConfig, options: OpenOptions) -> Dataset:
    """Open a folder of nerfstudio, Record3D or Stray Scanner.

    Raises:
        InputError: A library is not installed, a table is missing or broken, or no frame has depth.
    """
    reader = _reader(path)
    if reader is None:
        raise InputError(path, "is an archive", "unzip it, and give the folder with metadata and rgbd")
    if replace(options, masks=True) != OpenOptions():
        remedy = f"{path} is the recording of a phone; omit them"
        reason = "apply only to bags and TUM folders"
        raise InputError("--depth, --info, --rgb, --tf, --camera", reason, remedy)
    frames = [*reader(path, config)]
    if not frames:
        raise InputError(path, "has no frames with depth", "record depth too, and export it")
    return Dataset(path, sorted(frames, key=attrgetter("time", "number")), is_video=True)


def _reader(path: Path) -> Callable[[Path, RecordingConfig], Iterator[Frame]] | None:
    if (path / "transforms.json").is_file():
        return _read_nerfstudio
    if (path / "odometry.csv").is_file() and (path / "depth").is_dir():
        return _read_stray
    return _read_record3d if (path / "rgbd").is_dir() and _metadata(path).is_file() else None


def _metadata(path: Path) -> Path:
    """The table of a Record3D folder: `metadata` in an unzipped .r3d, `metadata.json` in other exports."""
    return path / ("metadata" if (path / "metadata").is_file() else "metadata.json")


def _frame(
    recording: str,
    far: float,
    number: int,
    time: float,
    T_world_camera: Array,
    K_colour: Array,
    size: tuple[int, int],
    read_depth: Callable[[], NDArray[np.float32]],
    read_colour: Callable[[], NDArray[np.uint8]],
) -> Frame:
    """A frame in a world with z up; K (3, 3) is for colour images of a size (width, height) [px]."""
    name = f"{recording}/{number:06d}"

    def load() -> View:
        depth, rgb = read_depth(), read_colour()
        if rgb.shape[1::-1] != size:
            shown = "×".join(map(str, rgb.shape[1::-1]))
            reason = f"colour has {shown} pixels, but its camera {size[0]}×{size[1]}"
            raise InputError(name, reason, AGAIN)
        scale = np.array(depth.shape[::-1]) / size
        if abs(scale[0] / scale[1] - 1.0) > 0.02:
            raise InputError(name, "depth and colour have different aspect ratios", "export them registered")
        K = K_colour.copy()
        K[[0, 1], [0, 1]] *= scale
        K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
        small = Image.fromarray(rgb).resize(depth.shape[::-1], Image.Resampling.BOX)
        near = np.where(depth <= far, depth, np.float32(0.0))
        return View(near, K, T_world_camera, np.array(small), name=name)

    return Frame(name, number, load, T_world_camera, round(time * SECOND))


@dataclass(frozen=True, eq=False, slots=True)
class _NerfFrame:
    """Keys of a frame, or of all frames together; a camera of four parameters, without distortion."""

    file_path: str
    transform_matrix: Annotated[Array, Numbers(4, 4, rigid=True)]
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    w: Annotated[float, Ge(1)]
    h: Annotated[float, Ge(1)]
    depth_file_path: str | None = None
    depth_unit_scale_factor: Annotated[float, Gt(0), Le(1)] = 0.001
    camera_model: str = "PINHOLE"


def _read_nerfstudio(path: Path, config: RecordingConfig) -> Iterator[Frame]:
    """Frames of transforms.json: poses of OpenGL cameras in a world with z up; all are taken for sharp."""
    table = path / "transforms.json"
    document = read_json(table)
    frames = document.pop("frames", None)
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(table, "'frames' is not a list of objects", AGAIN)
    make_frame = partial(_frame, path.resolve().name, config.far)
    for number, frame in enumerate(frames):
        where = f"{table}: frame {number}"
        known = parse_json(_NerfFrame, document | frame, where)
        if known.depth_file_path is None:
            continue
        if known.camera_model not in PINHOLES:
            raise InputError(
                where, f"its camera is {known.camera_model}, not a pinhole", "undistort its images"
            )
        if any((document | frame).get(name) for name in ("k1", "k2", "k3", "k4", "p1", "p2")):
            raise InputError(where, "its images are distorted (k1, k2, …)", "undistort them and depth first")
        K = np.array([[known.fl_x, 0.0, known.cx], [0.0, known.fl_y, known.cy], [0.0, 0.0, 1.0]])
        unit, size = 1000.0 * known.depth_unit_scale_factor, (int(known.w), int(known.h))
        T, K = known.transform_matrix @ GL, check_intrinsics(K, where)
        depth = partial(images.read_depth, path / known.depth_file_path, unit, config.max_pixels)
        colour = partial(images.decode_image, path / known.file_path, max_pixels=config.max_pixels)
        yield make_frame(number, float(number), T, K, size, depth, colour)


@dataclass(frozen=True, eq=False, slots=True)
class _Record3D:
    """Keys of a Record3D table; K is stored column by column, poses as qx, qy, qz, qw, x, y, z."""

    K: Annotated[Array, Numbers(9)]
    poses: Annotated[Array, Numbers(-1, 7)]
    w: Annotated[int, Ge(1)]
    h: Annotated[int, Ge(1)]
    dw: Annotated[int, Ge(1)]
    dh: Annotated[int, Ge(1)]
    fps: Annotated[float, Ge(0.001)] = 60.0


def _read_record3d(path: Path, config: RecordingConfig) -> Iterator[Frame]:
    """Frames of an unzipped .r3d: poses of OpenGL cameras in ARKit's world."""
    with needs_extra("phone", path):
        import lzfse

    def read_depth(file: Path) -> NDArray[np.float32]:
        try:
            metres = np.frombuffer(lzfse.decompress(file.read_bytes()), dtype="<f4")
            return metres.reshape(known.dh, known.dw).astype(np.float32)
        except Exception as error:  # the library raises its own, NumPy and the disk others
            raise BrokenImageError(file, f"cannot be read ({error})", AGAIN) from None

    table = _metadata(path)
    known = parse_json(_Record3D, read_json(table), table)
    K = check_intrinsics(known.K.reshape(3, 3).T, f"{table}: K")
    make_frame = partial(_frame, path.resolve().name, config.far)
    for number, pose in enumerate(known.poses):
        T = Y_UP @ _pose([*pose[4:], *pose[:4]], f"{table}: pose {number}") @ GL
        depth = partial(read_depth, path / f"rgbd/{number}.depth")
        colour = partial(images.decode_image, path / f"rgbd/{number}.jpg", max_pixels=config.max_pixels)
        yield make_frame(number, number / known.fps, T, K, (known.w, known.h), depth, colour)


def _read_stray(path: Path, config: RecordingConfig) -> Iterator[Frame]:
    """Frames of Stray Scanner: poses of optical frames in ARKit's world; doubtful depth is dropped."""
    video = _Video(path / "rgb.mp4")

    def read_depth(number: int) -> NDArray[np.float32]:
        depth = images.read_depth(path / f"depth/{number:06d}.png", 1.0, config.max_pixels)
        file = path / f"confidence/{number:06d}.png"
        trusted = images.read_mask(file, max_pixels=config.max_pixels) if file.is_file() else np.array(True)
        if trusted.shape not in ((), depth.shape):
            raise BrokenImageError(file, "has another size than the depth image", AGAIN)
        return depth * trusted

    camera, table = path / "camera_matrix.csv", path / "odometry.csv"
    K = check_intrinsics(np.array([_numbers(row, camera, 3) for row in _read_csv(camera)]), str(camera))
    make_frame = partial(_frame, path.resolve().name, config.far)
    header, *rows = _read_csv(table)
    if missing := [name for name in COLUMNS if name not in header]:
        raise InputError(table, f"the column '{missing[0]}' is missing", AGAIN)
    for row in rows:
        told = dict(zip(header, _numbers(row, table, len(header)), strict=True))
        time, number, *pose = (told[name] for name in COLUMNS)
        if not (0.0 <= number < LATEST and abs(time) < LATEST):
            raise InputError(table, f"frame {number:g} at {time:g} s is impossible", AGAIN)
        T, index = Y_UP @ _pose(pose, f"{table}: frame {number:.0f}"), int(number)
        depth, colour = partial(read_depth, index), partial(video.decode, index)
        yield make_frame(index, time, T, K, video.size, depth, colour)


def _pose(numbers: Sequence[float], where: str) -> Array:
    """A pose (4, 4) of a translation and a quaternion, w last."""
    if not is_pose(numbers):
        raise InputError(where, f"{list(numbers)} is not a pose", AGAIN)
    return transforms.rigid(Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3])


def _read_csv(path: Path) -> list[list[str]]:
    """Words of the rows of a CSV file that has any."""
    with read_errors(path, AGAIN):
        lines = path.read_text("utf-8-sig", errors="replace").splitlines()
    try:
        rows = [row for row in csv.reader(lines, skipinitialspace=True) if any(row)]
    except csv.Error as error:
        raise InputError(path, str(error), AGAIN) from None
    if not rows:
        raise InputError(path, "is empty", AGAIN)
    return rows


def _numbers(row: list[str], path: Path, count: int) -> list[float]:
    try:
        numbers = [float(word) for word in row]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise InputError(path, f"'{', '.join(row)}' is not {count} numbers", AGAIN)
    return numbers


class _Video:
    """The frames of a video, decoded forwards; to go back, it starts again."""

    def __init__(self, path: Path) -> None:
        with needs_extra("phone", path):
            import av
        self._path, self._av = path, av
        self._start()

    def _start(self) -> None:
        try:
            file = self._av.open(str(self._path), metadata_errors="replace")
            stream = file.streams.video[0]
            self.size = stream.width, stream.height
        except (self._av.error.FFmpegError, OSError, IndexError, AttributeError) as error:
            reason = f"cannot be read ({getattr(error, 'strerror', error)})"
            raise InputError(self._path, reason, AGAIN) from None
        self._frames, self._last = enumerate(file.decode(stream)), -1

    def decode(self, number: int) -> NDArray[np.uint8]:
        """Decode a frame (H, W, 3)."""
        if number <= self._last:
            self._start()
        try:
            for place, frame in self._frames:
                self._last = place
                if place == number:
                    return np.asarray(frame.to_ndarray(format="rgb24"))
            reason = f"has no frame {number}"
        except self._av.error.FFmpegError as error:
            reason = f"frame {number} cannot be decoded ({error.strerror})"
        raise BrokenImageError(self._path, reason, AGAIN)
