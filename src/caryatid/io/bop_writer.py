"""Recordings written as scene folders of the BOP benchmark format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.io import images
from caryatid.io.json_files import json_text
from caryatid.io.staging import StagedFolder
from caryatid.sensing.views import View


class RecordingWriter:
    """Writes a BOP scene folder view by view; it appears whole, at `finish`, or not at all.

    Args:
        folder: Where; must not exist, or be empty.

    Raises:
        InputError: The folder cannot be written.
    """

    def __init__(self, folder: str | Path) -> None:
        self._staged = StagedFolder(Path(folder), lambda _: False, "give a new folder")
        self._cameras: dict[str, Any] = {}
        self._objects: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._staged.discard()

    def add_view(self, view: View, depth_scale: float = 0.1) -> None:
        """Write the next view.

        Args:
            view: Labels become one mask each and `obj_id` = label.
            depth_scale: One unit of depth [mm]; 0.1 reaches to 6.5 m.

        Raises:
            InputError: Depth beyond what 16 bits hold, or the disk is full or refuses.
        """
        index = len(self._cameras)
        self._cameras[str(index)] = _camera_to_json(view, depth_scale)
        self._staged.write(f"depth/{index:06d}.png", images.png(_depth_units(view, depth_scale)))
        if view.rgb is not None:
            self._staged.write(f"rgb/{index:06d}.png", images.png(view.rgb))
        if view.labels is not None:
            present = [int(k) for k in np.unique(view.labels) if k > 0]
            self._objects[str(index)] = [{"obj_id": k} for k in present]
            for order, label in enumerate(present):
                mask = np.where(view.labels == label, np.uint8(255), np.uint8(0))
                self._staged.write(f"mask_visib/{index:06d}_{order:06d}.png", images.png(mask))

    def finish(self) -> None:
        """Put the folder in its place.

        Raises:
            InputError: The place has been taken meanwhile, or the disk is full or refuses.
        """
        self._staged.write("scene_camera.json", json_text(self._cameras).encode())
        if self._objects:
            self._staged.write("scene_gt.json", json_text(self._objects).encode())
        self._staged.publish()


def write_recording(folder: str | Path, views: Sequence[View], depth_scale: float = 0.1) -> None:
    """Write views as a BOP scene folder; `read_recording` gives them back to half a `depth_scale`.

    Args:
        folder: Where; must not exist, or be empty.
        views: In frame order. Labels become one mask each and `obj_id` = label.
        depth_scale: One unit of depth [mm]; 0.1 reaches to 6.5 m.

    Raises:
        InputError: No views, depth beyond what 16 bits hold, or the folder cannot be written.
    """
    if not views:
        raise InputError(folder, "there are no views to write", "give at least one")
    with RecordingWriter(folder) as writer:
        for view in views:
            writer.add_view(view, depth_scale)
        writer.finish()


def _camera_to_json(view: View, depth_scale: float) -> dict[str, Any]:
    camera: dict[str, Any] = {"cam_K": view.K.ravel(), "depth_scale": depth_scale}
    if view.T_world_camera is not None:
        T_camera_world = transforms.invert(view.T_world_camera)
        camera["cam_R_w2c"] = T_camera_world[:3, :3].ravel()
        camera["cam_t_w2c"] = T_camera_world[:3, 3] * 1000.0
    return camera


def _depth_units(view: View, depth_scale: float) -> NDArray[np.uint16]:
    units = np.rint(view.depth.astype(np.float64) * (1000.0 / depth_scale))
    if units.max() > np.iinfo(np.uint16).max:
        raise InputError(
            view.name,
            f"depth reaches {view.depth.max():.1f} m, 16 bits of {depth_scale:g} mm do not",
            "take a larger depth_scale",
        )
    return units.astype(np.uint16)
