"""Recordings: scene folders of the BOP benchmark format, read frame by frame and written view by view."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from caryatid.config import RecordingConfig
from caryatid.errors import InputError, check_type
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io import images
from caryatid.io.datasets import Dataset, Frame, OpenOptions, find_sample
from caryatid.io.json_files import Numbers, json_text, parse_json, read_json, read_names
from caryatid.io.staging import StagedFolder
from caryatid.sensing.views import MAX_LABEL, View, check_intrinsics

COLOUR_ENDINGS: Final = (".png", ".jpg", ".jpeg")
"""Files of colour images; the first existing one counts."""


@dataclass(frozen=True, eq=False, slots=True)
class _Camera:
    cam_K: Annotated[Array, Numbers(9)]  # noqa: N815
    depth_scale: Annotated[float, Gt(0)]
    cam_R_w2c: Annotated[Array, Numbers(9)] | None = None  # noqa: N815
    cam_t_w2c: Annotated[Array, Numbers(3)] | None = None


@dataclass(frozen=True, slots=True)
class _Mask:
    obj_id: Annotated[int, Ge(1), Le(MAX_LABEL)]


Masks = tuple[tuple[Path, int], ...]
"""Mask file and label (`obj_id`) of each object in a frame."""


def recognises(path: Path) -> bool:
    """Whether a path is a scene folder."""
    has_depth = (path / "depth").is_dir() and not (path / "depth.txt").exists()
    return has_depth or (path / "scene_camera.json").is_file()


def open_dataset(path: Path, config: RecordingConfig, options: OpenOptions) -> Dataset:
    """Read a scene folder; see `read_recording`.

    Raises:
        InputError: It is broken.
    """
    return read_recording(path, config)


def read_recording(folder: str | Path, config: RecordingConfig | None = None) -> Dataset:
    """Read a BOP scene folder: `scene_camera.json`, `depth/`, and where they exist `rgb/` and `mask_visib/`.

    `names.json` may name the objects by their `obj_id`: {"1": "mug"}.
    Cameras, poses and the table of masks are checked here, images when a view is loaded. A rotation matrix
    that is orthonormal to 0.02 is replaced by the nearest rotation.

    Args:
        folder: The scene folder, or `sample-recording`. Lengths in it are millimetres.
        config: Maximum size of images.

    Raises:
        InputError: A table is missing or broken, a camera or pose is not valid, a mask names no object,
            several frames have no poses, or there is no frame. Loading a frame raises it if an image is
            missing, broken, or of another size or mode, or if masks overlap.
    """
    check_type("folder", folder, (str, Path), "give a scene folder in the BOP format")
    folder = find_sample(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "give a scene folder in the BOP format")
    path = folder / "scene_camera.json"
    remedy = "a recording needs it: cam_K and depth_scale of each frame"
    cameras = parse_json(dict[int, _Camera], read_json(path, remedy), path, remedy)
    if not cameras:
        raise InputError(folder, "has no frames: scene_camera.json is empty", "give a recording with frames")
    for image in sorted((folder / "depth").glob("*.png")):
        if image.stem not in {f"{number:06d}" for number in cameras}:
            remedy = "add its camera there, or delete the image"
            raise InputError(image, "has no entry in scene_camera.json", remedy)
    masks, most = _read_masks(folder, set(cameras)), (config or RecordingConfig()).max_pixels
    names = read_names(folder)
    frames = tuple(
        _frame(folder, n, cameras[n], masks.get(n), names, f"{path}: frame {n}", most)
        for n in sorted(cameras)
    )
    without = [f.number for f in frames if f.T_world_camera is None]
    if len(frames) > 1 and without:
        reason = f"{len(without)} of {len(frames)} frames have no pose (cam_R_w2c, cam_t_w2c)"
        reason += f"; the first is frame {without[0]}"
        raise InputError(path, reason, "add poses, or give a single frame")
    return Dataset(folder, frames)


def write_recording(folder: str | Path, views: Iterable[View]) -> None:
    """Write views as a BOP scene folder, whole or not at all; `read_recording` reads them back.

    Depth is stored in units of 0.1 mm, enough for 6.5 m in 16 bits; if a view reaches farther, in 0.2 mm,
    0.4 mm and so on.

    Args:
        folder: The folder; must not exist, or be empty.
        views: In frame order. Labels become one mask each and `obj_id` = label.

    Raises:
        InputError: No views, or the folder cannot be written.
    """
    with StagedFolder(folder) as staged:
        write_views(staged, views)


def write_views(folder: StagedFolder, views: Iterable[View]) -> None:
    """Write views into a staged folder, as `write_recording` does, and publish it.

    Raises:
        InputError: No views, the folder's place is taken, or the disk cannot be written.
    """
    cameras: dict[str, Any] = {}
    objects: dict[str, Any] = {}
    for index, view in enumerate(views):
        depth_scale = 0.1
        while view.depth.max() > depth_scale * np.iinfo(np.uint16).max / 1000.0:
            depth_scale *= 2.0
        camera: dict[str, Any] = {"cam_K": view.K.ravel(), "depth_scale": depth_scale}
        if view.T_world_camera is not None:
            T_camera_world = transforms.invert(view.T_world_camera)
            camera["cam_R_w2c"] = T_camera_world[:3, :3].ravel()
            camera["cam_t_w2c"] = T_camera_world[:3, 3] * 1000.0
        cameras[str(index)] = camera
        units = np.rint(view.depth.astype(np.float64) * (1000.0 / depth_scale)).astype(np.uint16)
        folder.write(f"depth/{index:06d}.png", images.png(units))
        if view.rgb is not None:
            folder.write(f"rgb/{index:06d}.png", images.png(view.rgb))
        if view.labels is not None:
            present = [int(k) for k in np.unique(view.labels) if k > 0]
            objects[str(index)] = [{"obj_id": k} for k in present]
            for order, label in enumerate(present):
                mask = np.where(view.labels == label, np.uint8(255), np.uint8(0))
                folder.write(f"mask_visib/{index:06d}_{order:06d}.png", images.png(mask))
    if not cameras:
        raise InputError(folder.folder, "no views to write", "give at least one")
    folder.write("scene_camera.json", json_text(cameras).encode())
    if objects:
        folder.write("scene_gt.json", json_text(objects).encode())
    folder.publish()


def _frame(
    folder: Path,
    number: int,
    camera: _Camera,
    masks: Masks | None,
    names: dict[int, str] | None,
    source: str,
    max_pixels: int,
) -> Frame:
    K = check_intrinsics(camera.cam_K.reshape(3, 3), f"{source}: cam_K")
    T_world_camera = _pose(camera, source)
    depth_path, rgb_path = folder / f"depth/{number:06d}.png", None
    if (folder / "rgb").is_dir():
        paths = [folder / f"rgb/{number:06d}{ending}" for ending in COLOUR_ENDINGS]
        rgb_path = next((path for path in paths if path.exists()), paths[0])
    name = f"{folder.resolve().name}/{number:06d}"

    def load() -> View:
        depth = images.read_depth(depth_path, camera.depth_scale, max_pixels)
        if not depth.any():
            reason = "the frame is empty: no pixel has a depth reading"
            raise InputError(depth_path, reason, "remove this frame")
        rgb = None if rgb_path is None else images.decode_image(rgb_path, max_pixels=max_pixels)
        labels = None if masks is None else _read_labels(masks, depth, max_pixels)
        return View(depth, K, T_world_camera, rgb, labels, name=name, names=names)

    return Frame(name, number, load, T_world_camera, has_labels=masks is not None)


def _read_labels(masks: Masks, depth: NDArray[np.float32], max_pixels: int) -> NDArray[np.int32]:
    """Object number of each pixel (H, W), 0 = nothing."""
    labels = np.zeros(depth.shape, dtype=np.int32)
    for path, label in masks:
        mask = images.read_mask(path, max_pixels=max_pixels)
        if mask.shape != depth.shape:
            (height, width), (rows, columns) = mask.shape, depth.shape
            reason = f"has {width}×{height} pixels, but the depth image has {columns}×{rows}"
            raise InputError(path, reason, "register the images to one size")
        taken = labels[mask & (labels > 0)]
        if len(taken):
            reason = f"overlaps the mask of obj_id {taken[0]} in {len(taken)} pixels"
            raise InputError(path, reason, "give each pixel to one object")
        labels[mask] = label
    return labels


def _pose(camera: _Camera, name: str) -> Array | None:
    if camera.cam_R_w2c is None and camera.cam_t_w2c is None:
        return None
    if camera.cam_R_w2c is None or camera.cam_t_w2c is None:
        missing = "cam_R_w2c" if camera.cam_R_w2c is None else "cam_t_w2c"
        raise InputError(name, f"the key '{missing}' is missing", "add it")
    R = camera.cam_R_w2c.reshape(3, 3)
    # Trackers in single precision drift by 5e-4 in 1000 frames; scaled matrices are far beyond.
    if np.linalg.det(R) > 0.0 and np.allclose(R.T @ R, np.eye(3), atol=0.02):
        left, _, right = np.linalg.svd(R)
        R = left @ right
    T_camera_world = transforms.rigid(R, camera.cam_t_w2c / 1000.0)
    return transforms.invert(transforms.as_rigid(T_camera_world, f"{name}: cam_R_w2c"))


def _read_masks(folder: Path, known: set[int]) -> dict[int, Masks]:
    mask_folder, path = folder / "mask_visib", folder / "scene_gt.json"
    if not mask_folder.is_dir():
        return {}
    remedy = f'masks need it: one {{"obj_id": …}} for each, from 1 to {MAX_LABEL}'
    table: dict[int, Masks] = {}
    for frame, masks in parse_json(dict[int, list[_Mask]], read_json(path, remedy), path, remedy).items():
        source = f"{path}: frame {frame}"
        if frame not in known:
            raise InputError(source, "is not in scene_camera.json", "add its camera there")
        labels = [mask.obj_id for mask in masks]
        for twice in {label for label in labels if labels.count(label) > 1}:
            reason = f"two masks have obj_id {twice}"
            raise InputError(source, reason, "give each object of the scene its own number")
        names = (f"{frame:06d}_{index:06d}.png" for index in range(len(labels)))
        table[frame] = tuple((mask_folder / name, label) for name, label in zip(names, labels, strict=True))
    expected = {image for masks_of_frame in table.values() for image, _ in masks_of_frame}
    for image in sorted(set(mask_folder.glob("*.png")) - expected):
        raise InputError(image, "names no object: scene_gt.json has no entry for it", "add its obj_id there")
    return table
