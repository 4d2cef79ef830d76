"""Recordings: scene folders of the BOP benchmark format, read frame by frame and written view by view."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

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

log = logging.getLogger(__name__)

DEPTH_ENDINGS: Final = (".png", ".tif", ".tiff")
COLOUR_ENDINGS: Final = (*DEPTH_ENDINGS, ".jpg", ".jpeg")
"""Files of depth and colour images; the first existing one counts."""


@dataclass(frozen=True, eq=False, slots=True)
class _Camera:
    cam_K: Annotated[Array, Numbers(9)]  # noqa: N815
    depth_scale: Annotated[float, Gt(0)]
    cam_R_w2c: Annotated[Array, Numbers(9)] | None = None  # noqa: N815
    cam_t_w2c: Annotated[Array, Numbers(3)] | None = None


@dataclass(frozen=True, slots=True)
class _Mask:
    obj_id: Annotated[int, Ge(1), Le(MAX_LABEL)]


@dataclass(frozen=True, slots=True)
class _Masks:
    """The masks of a scene: file and `obj_id` (0 = unknown) of each mask of a frame, and names of ids.

    Where an `obj_id` names a model and not one object, labels count the masks of a view. Frames whose masks
    overlap are noted when they are loaded.
    """

    frames: dict[int, list[tuple[Path, int]]]
    labels_are: Literal["objects", "segments"] = "objects"
    notes: tuple[str, ...] = ()
    names: dict[int, str] | None = None
    overlapping: list[int] = field(default_factory=list)


def recognises(path: Path) -> bool:
    """Whether a path is a scene folder, or the depth folder of one of its sensors."""
    has_depth = (path / "depth").is_dir() and not (path / "depth.txt").exists()
    return has_depth or any(path.glob("scene_camera*.json")) or _is_depth(path)


def open_dataset(path: Path, config: RecordingConfig, options: OpenOptions) -> Dataset:
    """Read a scene folder; see `read_recording`.

    Raises:
        InputError: It is broken.
    """
    return read_recording(path, config, masks=options.masks)


def read_recording(
    folder: str | Path, config: RecordingConfig | None = None, *, masks: bool = True
) -> Dataset:
    """Read a BOP scene folder: `scene_camera.json`, `depth/`, and where they exist `rgb/` and `mask_visib/`.

    `names.json` may name the objects by their `obj_id`: {"1": "mug"}. Masks are segments of their view if two
    of a frame have one `obj_id`, or without `scene_gt.json`. Of masks that overlap, the smallest is on top.
    Cameras, poses and the table of masks are checked here, images when a view is loaded. A rotation matrix
    that is orthonormal to 0.02 is replaced by the nearest rotation.

    Args:
        folder: The scene folder, or `sample-recording`. Lengths in it are millimetres. If each sensor has
            files of its own, the folder of depth images of one, such as `000001/depth_cam1`.
        config: Maximum size of images.
        masks: Whether to read the masks.

    Raises:
        InputError: A table is missing or broken, a camera or pose is not valid, a mask names no object,
            several frames have no poses, or there is no frame or a choice of sensors. Loading a frame raises
            it if an image is missing, broken, or of another size or mode.
    """
    check_type("folder", folder, (str, Path), "give a scene folder in the BOP format")
    folder = find_sample(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "give a scene folder in the BOP format")
    folder, end = _find_sensor(folder)
    path = folder / f"scene_camera{end}.json"
    remedy = "a recording needs it: cam_K and depth_scale of each frame"
    cameras = parse_json(dict[int, _Camera], read_json(path, remedy), path, remedy)
    if not cameras:
        raise InputError(folder, f"has no frames: {path.name} is empty", "give a recording with frames")
    stems = {f"{number:06d}" for number in cameras}
    for image in sorted((folder / f"depth{end}").glob("*.*")):
        if image.suffix in DEPTH_ENDINGS and image.stem not in stems:
            remedy = "add its camera there, or delete the image"
            raise InputError(image, f"has no entry in {path.name}", remedy)
    known, most = _Masks({}), (config or RecordingConfig()).max_pixels
    if masks and (folder / f"mask_visib{end}").is_dir():
        known = _read_masks(folder / f"mask_visib{end}", folder / f"scene_gt{end}.json", set(cameras))
    known = replace(known, names=read_names(folder) if masks else None)
    frames = [_frame(folder, end, n, cameras[n], known, f"{path}: frame {n}", most) for n in sorted(cameras)]
    without = [f.number for f in frames if f.T_world_camera is None]
    if len(frames) > 1 and without:
        reason = f"{len(without)} of {len(frames)} frames have no pose (cam_R_w2c, cam_t_w2c)"
        reason += f"; the first is frame {without[0]}"
        raise InputError(path, reason, "add poses, or give a single frame")
    return Dataset(folder, frames, notes=known.notes)


def write_recording(folder: str | Path, views: Iterable[View]) -> None:
    """Write views as a BOP scene folder, whole or not at all; `read_recording` reads them back.

    Depth is stored in units of 0.1 mm, enough for 6.5 m in 16 bits; if a view reaches farther, in 0.2 mm,
    0.4 mm and so on.

    Args:
        folder: The folder; must not exist, or be empty.
        views: In frame order. Labels become one mask each and `obj_id` = label. Those of segments have no
            scene_gt.json and no names, because they name no objects.

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
    objects, names = dict[str, Any](), dict[int, str]()
    are_segments = False
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
            are_segments |= view.labels_are == "segments"
            present = [int(k) for k in np.unique(view.labels) if k > 0]
            objects[str(index)] = [{"obj_id": k} for k in present]
            names |= {k: name for k, name in (view.names or {}).items() if k in present}
            for order, label in enumerate(present):
                mask = np.where(view.labels == label, np.uint8(255), np.uint8(0))
                folder.write(f"mask_visib/{index:06d}_{order:06d}.png", images.png(mask))
    if not cameras:
        raise InputError(folder.folder, "no views to write", "give at least one")
    folder.write("scene_camera.json", json_text(cameras).encode())
    if objects and not are_segments:
        folder.write("scene_gt.json", json_text(objects).encode())
        if names:
            folder.write("names.json", json_text({str(k): name for k, name in names.items()}).encode())
    folder.publish()


def _is_depth(path: Path) -> bool:
    """Whether a path is the folder of depth images of a sensor."""
    return path.name.startswith("depth") and (path.parent / f"scene_camera{path.name[5:]}.json").is_file()


def _find_sensor(path: Path) -> tuple[Path, str]:
    """The scene folder, and the end of the names of its files: `_cam1` if sensors have files of their own."""
    if _is_depth(path):
        return path.parent, path.name[5:]
    ends = sorted(file.stem.removeprefix("scene_camera") for file in path.glob("scene_camera*.json"))
    if not ends or "" in ends:
        return path, ""
    usable = [end for end in ends if (path / f"depth{end}").is_dir()]
    if len(usable) != 1:
        reason = f"{len(usable)} of its sensors have depth: {', '.join(e[1:] for e in usable or ends)}"
        folder = f"such as {path / f'depth{usable[0]}'}" if usable else f"named depth{ends[0]}"
        raise InputError(path, reason, f"give the folder of depth images of one, {folder}")
    return path, usable[0]


def _frame(
    folder: Path, end: str, number: int, camera: _Camera, known: _Masks, source: str, max_pixels: int
) -> Frame:
    K = check_intrinsics(camera.cam_K.reshape(3, 3), f"{source}: cam_K")
    T_world_camera = _pose(camera, source)
    depth_path, rgb_path = _image(folder / f"depth{end}", number, DEPTH_ENDINGS), None
    if (folder / f"rgb{end}").is_dir():
        rgb_path = _image(folder / f"rgb{end}", number, COLOUR_ENDINGS)
    name, masks, names = f"{folder.resolve().name}/{number:06d}", known.frames.get(number), known.names
    if masks is not None and known.labels_are == "segments":
        names = names and {label: names[k] for label, (_, k) in enumerate(masks, 1) if k in names}
        masks = [(path, label) for label, (path, _) in enumerate(masks, 1)]

    def load() -> View:
        depth = images.read_depth(depth_path, camera.depth_scale, max_pixels)
        if not depth.any():
            reason = "the frame is empty: no pixel has a depth reading"
            raise InputError(depth_path, reason, "remove this frame")
        rgb = None if rgb_path is None else images.decode_image(rgb_path, max_pixels=max_pixels)
        labels = None
        if masks is not None:
            labels, shared = _read_labels(masks, depth, max_pixels)
            if shared and not known.overlapping:  # frames are loaded several times, and one line is enough
                known.overlapping.append(number)
                said = "%s: masks overlap, in frame %d in %d pixels; each goes to the smallest mask"
                log.info(said, folder / f"mask_visib{end}", number, shared)
        return View(
            depth, K, T_world_camera, rgb, labels, name=name, labels_are=known.labels_are, names=names
        )

    return Frame(name, number, load, T_world_camera, has_labels=masks is not None)


def _image(folder: Path, number: int, endings: tuple[str, ...]) -> Path:
    """The image of a frame, by the first ending that exists."""
    paths = [folder / f"{number:06d}{ending}" for ending in endings]
    return next((path for path in paths if path.exists()), paths[0])


def _read_labels(
    masks: list[tuple[Path, int]], depth: NDArray[np.float32], max_pixels: int
) -> tuple[NDArray[np.int32], int]:
    """Label of each pixel (H, W), 0 = nothing, and the number of pixels in several masks.

    The smallest mask is on top, as in `labels_from_masks`: a mug in front of a box stays whole.
    """
    read = []
    for path, label in masks:
        mask = images.read_mask(path, max_pixels=max_pixels)
        if mask.shape != depth.shape:
            (height, width), (rows, columns) = mask.shape, depth.shape
            reason = f"has {width}×{height} pixels, but the depth image has {columns}×{rows}"
            raise InputError(path, reason, "register the images to one size")
        read.append((int(mask.sum()), mask, label))
    labels = np.zeros(depth.shape, dtype=np.int32)
    for _, mask, label in sorted(read, key=lambda sized: -sized[0]):
        labels[mask] = label
    return labels, int((sum(mask.astype(np.intp) for _, mask, _ in read) > np.intp(1)).sum())


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


def _read_masks(folder: Path, path: Path, frames: set[int]) -> _Masks:
    """The masks in a folder, with the `obj_id` that a table gives them; lost ones are left out."""
    files, repeats, notes = sorted(folder.glob("*.png")), "", []
    table: dict[int, list[tuple[Path, int]]] = {}
    if not path.exists():
        for file in files:
            if not (file.stem[:6].isdecimal() and int(file.stem[:6]) in frames):
                raise InputError(file, "is of no frame in scene_camera.json", "name it FRAME_MASK.png")
            table.setdefault(int(file.stem[:6]), []).append((file, 0))
        note = f"no {path.name}: masks are segments of their view"
        return _Masks(table, "segments", (note,) if files else ())
    remedy = f'masks need it: one {{"obj_id": …}} for each, from 1 to {MAX_LABEL}'
    for frame, masks in parse_json(dict[int, list[_Mask]], read_json(path, remedy), path, remedy).items():
        if frame not in frames:
            source = f"{path}: frame {frame}"
            raise InputError(source, "is not in scene_camera.json", "add its camera there")
        ids = [mask.obj_id for mask in masks]
        table[frame] = [(folder / f"{frame:06d}_{index:06d}.png", k) for index, k in enumerate(ids)]
        if len(set(ids)) < len(ids) and not repeats:
            twice = next(k for k in ids if ids.count(k) > 1)
            repeats = f"two masks of frame {frame} have obj_id {twice}"
            notes.append(f"{path.name}: {repeats}, so masks are segments of their view")
    expected = {file for masks in table.values() for file, _ in masks}
    for image in files:
        if image not in expected:
            reason = f"names no object: {path.name} has no entry for it"
            raise InputError(image, reason, "add its obj_id there")
    if lost := expected.difference(files):
        notes.append(f"{len(lost)} of {len(expected)} masks are left out: {min(lost)} is missing")
        table = {frame: [m for m in masks if m[0] not in lost] for frame, masks in table.items()}
    if not files:
        return _Masks({}, notes=tuple(notes))
    return _Masks(table, "segments" if repeats else "objects", tuple(notes))
