"""Recordings: scene folders of the BOP benchmark format, read frame by frame."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io import images
from caryatid.io.json_files import field, number, numbers, read_json
from caryatid.sensing.views import SUPPORT_LABEL, View, check_intrinsics

COLOUR_ENDINGS: Final = (".png", ".jpg", ".jpeg")
"""Files of colour images, the first that exists."""
ROTATION_DRIFT: Final = 0.02
"""How far RᵀR of a recorded rotation may be from the identity (per entry): trackers that multiply up single
precision drift by 5e-4 in 1000 frames; a scaled or sheared matrix is far beyond this."""
_MASK_NAME: Final = re.compile(r"(\d{6})_(\d{6})")


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One recorded frame, checked but not decoded yet.

    Attributes:
        number: Its number in the recording.
        name: Folder and number, as the view will be called.
        depth_path: 16-bit depth image.
        depth_scale: One unit of depth [mm].
        rgb_path: Colour image, or None where the recording has no colour.
        masks: Mask file and label (`obj_id`) of each object, or None where the frame has no segmentation.
        K: Pinhole matrix (3, 3) [px].
        T_world_camera: Pose (4, 4), or None where it is not known.
        size: Width and height [px].
    """

    number: int
    name: str
    depth_path: Path
    depth_scale: float
    rgb_path: Path | None
    masks: tuple[tuple[Path, int], ...] | None
    K: Array
    T_world_camera: Array | None
    size: tuple[int, int]

    def load(self) -> View:
        """Decode the frame.

        Raises:
            InputError: A file has gone or is broken, the depth image is empty, or masks overlap.
        """
        return View(
            depth=images.read_depth(self.depth_path, self.depth_scale),
            K=self.K,
            T_world_camera=self.T_world_camera,
            rgb=None if self.rgb_path is None else images.read_colour(self.rgb_path),
            labels=None if self.masks is None else self.load_labels(),
            name=self.name,
        )

    def load_labels(self) -> NDArray[np.int32]:
        """Decode the masks alone: object number of each pixel (H, W), 0 = nothing.

        Raises:
            InputError: The frame has no masks, one is broken, or two overlap.
        """
        if self.masks is None:
            raise InputError(self.name, "has no masks", "add mask_visib/ and scene_gt.json")
        labels = np.zeros(self.size[::-1], dtype=np.int32)
        for path, label in self.masks:
            mask = images.read_mask(path)
            taken = labels[mask]
            if taken.any():
                other = int(taken[taken > 0][0])
                raise InputError(
                    path,
                    f"overlaps the mask of obj_id {other} in {int((taken > 0).sum())} pixels",
                    "give each pixel to one object",
                )
            labels[mask] = label
        return labels


@dataclass(frozen=True, eq=False, slots=True)
class Recording(Sequence[View]):
    """The frames of a recording in their order; views are decoded when asked for and not kept.

    Attributes:
        folder: The scene folder.
        frames: The frames.
    """

    folder: Path
    frames: tuple[Frame, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [frame.load() for frame in self.frames[index]]
        return self.frames[index].load()

    def __iter__(self) -> Iterator[View]:
        return (frame.load() for frame in self.frames)

    @property
    def has_poses(self) -> bool:
        """Every frame has a pose."""
        return all(frame.T_world_camera is not None for frame in self.frames)

    @property
    def has_labels(self) -> bool:
        """Every frame has a segmentation."""
        return all(frame.masks is not None for frame in self.frames)

    def frame(self, name: str) -> Frame:
        """Return the frame whose number ends `name`, as in a view's name.

        Raises:
            InputError: There is none.
        """
        for frame in self.frames:
            if frame.name.rpartition("/")[2] == name.rpartition("/")[2]:
                return frame
        raise InputError(self.folder, f"has no frame '{name}'", "give the recording the run was made from")


def read_recording(folder: str | Path) -> Recording:
    """Read a BOP scene folder: `scene_camera.json`, `depth/`, and where they exist `rgb/` and `mask_visib/`.

    Cameras and poses are checked here, and every image for being whole and of the right size and mode;
    views are decoded when they are asked for. A rotation that has drifted from orthonormal by less than
    `ROTATION_DRIFT` is replaced by the nearest rotation.

    Args:
        folder: The scene folder. Lengths in it are millimetres.

    Raises:
        InputError: A file is missing or broken, sizes differ, a camera or pose is not valid, a mask names
            no object, several frames have no poses, or there is no frame.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "is no folder", "give a scene folder of the BOP format")
    camera_path = folder / "scene_camera.json"
    cameras = _by_frame(
        read_json(camera_path, "a recording needs it: cam_K and depth_scale of each frame"), camera_path
    )
    if not cameras:
        raise InputError(folder, "has no frames: scene_camera.json is empty", "give a recording with frames")
    _check_no_stray_depth(folder, set(cameras))
    masks = _read_mask_table(folder, set(cameras))
    result = Recording(
        folder, tuple(_read_frame(folder, n, cameras[n], masks.get(n), camera_path) for n in sorted(cameras))
    )
    without = [f.number for f in result.frames if f.T_world_camera is None]
    if len(result) > 1 and without:
        raise InputError(
            camera_path,
            f"{len(without)} of {len(result)} frames have no pose (cam_R_w2c, cam_t_w2c), the first is frame "
            f"{without[0]}",
            "several frames need poses; without them give a single frame",
        )
    return result


def _read_frame(
    folder: Path,
    number_: int,
    camera: dict[str, Any],
    masks: tuple[tuple[Path, int], ...] | None,
    source: Path,
) -> Frame:
    name = f"{source}: frame {number_}"
    depth_path = folder / "depth" / f"{number_:06d}.png"
    size = images.check_image(depth_path, images.DEPTH_MODES, "a 16-bit grey PNG")
    rgb_path = _colour_path(folder, number_)
    for path in ([] if rgb_path is None else [rgb_path]) + [path for path, _ in masks or ()]:
        other = images.check_image(path, None if path is rgb_path else images.MASK_MODES, "a grey PNG")
        if other != size:
            raise InputError(
                path,
                f"is {other[0]}×{other[1]} pixels, the depth image {depth_path} is {size[0]}×{size[1]}",
                "register the images to one size",
            )
    depth_scale = number(camera, "depth_scale", name)
    if depth_scale <= 0.0:
        raise InputError(name, f"'depth_scale' is {depth_scale:g}", "give the millimetres of one depth unit")
    K = numbers(field(camera, "cam_K", list, name), (9,), f"{name}: cam_K").reshape(3, 3)
    return Frame(
        number=number_,
        name=f"{folder.resolve().name}/{number_:06d}",
        depth_path=depth_path,
        depth_scale=depth_scale,
        rgb_path=rgb_path,
        masks=masks,
        K=check_intrinsics(K, f"{name}: cam_K"),
        T_world_camera=_pose(camera, name),
        size=size,
    )


def _pose(camera: dict[str, Any], name: str) -> Array | None:
    if "cam_R_w2c" not in camera and "cam_t_w2c" not in camera:
        return None
    R = numbers(field(camera, "cam_R_w2c", list, name), (9,), f"{name}: cam_R_w2c").reshape(3, 3)
    t_mm = numbers(field(camera, "cam_t_w2c", list, name), (3,), f"{name}: cam_t_w2c")
    if np.linalg.det(R) > 0.0 and np.allclose(R.T @ R, np.eye(3), atol=ROTATION_DRIFT):
        left, _, right = np.linalg.svd(R)
        R = left @ right
    T_camera_world = transforms.as_rigid(transforms.rigid(R, t_mm / 1000.0), f"{name}: cam_R_w2c")
    return transforms.invert(T_camera_world)


def _colour_path(folder: Path, number_: int) -> Path | None:
    if not (folder / "rgb").is_dir():
        return None
    paths = [folder / "rgb" / f"{number_:06d}{ending}" for ending in COLOUR_ENDINGS]
    return next((path for path in paths if path.exists()), paths[0])


def _check_no_stray_depth(folder: Path, known: set[int]) -> None:
    for path in sorted((folder / "depth").glob("*.png")):
        if not path.stem.isdigit() or int(path.stem) not in known:
            raise InputError(
                path, "has no entry in scene_camera.json", "add its camera there, or take the image out"
            )


def _read_mask_table(folder: Path, known: set[int]) -> dict[int, tuple[tuple[Path, int], ...]]:
    mask_folder, gt_path = folder / "mask_visib", folder / "scene_gt.json"
    if not mask_folder.is_dir():
        return {}
    table: dict[int, tuple[tuple[Path, int], ...]] = {}
    expected: set[Path] = set()
    for frame, entries in _by_frame(read_json(gt_path, "masks need it: the obj_id of each"), gt_path).items():
        source = f"{gt_path}: frame {frame}"
        if frame not in known:
            raise InputError(source, "is not in scene_camera.json", "add its camera there")
        if not isinstance(entries, list):
            raise InputError(source, "is no list of objects", 'give one {"obj_id": …} for each mask')
        labels = [_obj_id(entry, f"{source}, mask {index}") for index, entry in enumerate(entries)]
        for index, label in enumerate(labels):
            if label in labels[:index]:
                raise InputError(
                    source, f"two masks have obj_id {label}", "number each object of the scene by itself"
                )
        paths = [mask_folder / f"{frame:06d}_{index:06d}.png" for index in range(len(labels))]
        table[frame] = tuple(zip(paths, labels, strict=True))
        expected.update(paths)
    for path in sorted(mask_folder.glob("*.png")):
        if path not in expected:
            match = _MASK_NAME.fullmatch(path.stem)
            which = f"mask {int(match[2])} of frame {int(match[1])}" if match else "that name"
            raise InputError(
                path, f"names no object: scene_gt.json has no entry for {which}", "add its obj_id there"
            )
    return table


def _obj_id(entry: Any, source: str) -> int:
    if not isinstance(entry, dict):
        raise InputError(source, "is no JSON object", 'give {"obj_id": …}')
    label: int = field(entry, "obj_id", int, source)
    if not 0 < label < SUPPORT_LABEL:
        raise InputError(source, f"obj_id is {label}", f"number objects from 1 to {SUPPORT_LABEL - 1}")
    return label


def _by_frame(document: dict[str, Any], source: Path) -> dict[int, Any]:
    result: dict[int, Any] = {}
    for key, item in document.items():
        if not key.isascii() or not key.isdigit() or int(key) in result:
            raise InputError(
                source, f"'{key}' is no frame number, or is there twice", "number the frames 0, 1, …"
            )
        if source.name == "scene_camera.json" and not isinstance(item, dict):
            raise InputError(f"{source}: frame {key}", "is no JSON object", "give cam_K and depth_scale")
        result[int(key)] = item
    return result
