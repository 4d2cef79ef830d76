"""What clients of a session send and may set, and what it answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from annotated_types import Gt
from numpy.typing import ArrayLike, NDArray

from caryatid.config import Config, SessionConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.graph import Change, SupportGraph
from caryatid.io.graph_json import graph_to_json
from caryatid.io.images import DEPTH_MODES, MASK_MODES, decode_image, read_npy
from caryatid.io.json_files import Numbers, parse_json, read_json
from caryatid.io.staging import read_errors
from caryatid.planning.decision import Decision
from caryatid.sensing.views import View

_FILES: Final = {
    "depth": (DEPTH_MODES, "a 16-bit grey PNG"),
    "rgb": (("RGB", "RGBA", "L", "LA", "P"), "a colour PNG or JPEG"),
    "labels": (MASK_MODES[1:], "a grey PNG"),
}


@dataclass(frozen=True, eq=False, slots=True)
class CameraRecord:
    """camera.json: the data of a view besides its images.

    Attributes:
        K: Pinhole matrix (3, 3) [px].
        T_world_camera: Camera pose (4, 4) [m]; OpenCV camera frame, world z up. The first view may omit it;
            its table then defines the world frame.
        depth_scale: Millimetres per unit of a depth PNG.
        name: Name of the view in messages.
        labels_are: Whether a label identifies an object in all views or a segment of this view.
        names: Names of labels, such as {"1": "mug"}.
    """

    K: Annotated[Array, Numbers(3, 3)]
    T_world_camera: Annotated[Array, Numbers(4, 4, rigid=True)] | None = None
    depth_scale: Annotated[float, Gt(0.0)] = 1.0
    name: str = "view"
    labels_are: Literal["objects", "segments"] = "objects"
    names: dict[int, str] | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Capture:
    """One view, not decoded yet.

    Attributes:
        images: Files: `depth` and, if given, `rgb` and `labels`; PNG (rgb also JPEG), or .npy: depth
            (H, W) floats [m], rgb (H, W, 3) uint8, labels (H, W) integers.
        camera: Camera matrix and pose.
    """

    images: Mapping[str, bytes]
    camera: CameraRecord

    @classmethod
    def from_files(cls, files: Mapping[str, Path | None], camera: Path, config: SessionConfig) -> Capture:
        """Read the files of one view.

        Args:
            files: Images: `depth`, and optionally `rgb` and `labels`.
            camera: JSON with K, T_world_camera and, for a depth PNG, depth_scale.
            config: Limits on the size of images.

        Raises:
            InputError: A file is missing or too large, or the camera is not valid.
        """
        images = {}
        for key, path in files.items():
            if path is not None:
                with read_errors(path, "give a readable file"):
                    if path.stat().st_size > config.max_bytes:
                        reason = f"is larger than {config.max_bytes} bytes"
                        raise InputError(path, reason, "give a smaller file")
                    images[key] = path.read_bytes()
        remedy = "give K (3×3) and, for all views after the first, T_world_camera (4×4, in metres)"
        given = parse_json(CameraRecord, read_json(camera, remedy), camera, remedy)
        return cls(images, replace(given, name=str(files["depth"])))

    def decode(self, max_pixels: int) -> View:
        """Decode the images, each with at most this number of pixels.

        Raises:
            InputError: An image is broken, too large, or of the wrong kind; sizes differ; the camera is not
                a pinhole camera, or its pose is not a rigid transform.
        """
        keys = ("K", "T_world_camera", "name", "labels_are", "names")
        given: dict[str, Any] = {key: getattr(self.camera, key) for key in keys}
        return View(**given | {name: self._decoded(name, max_pixels) for name in self.images})

    def _decoded(self, key: str, max_pixels: int) -> NDArray[Any]:
        content, name = self.images[key], f"{self.camera.name}: {key}"
        if not content.startswith(b"\x93NUMPY"):
            image = decode_image(content, name, *_FILES[key], max_pixels)
            if key != "depth":
                return image
            return (image.astype(np.float64) * (self.camera.depth_scale / 1000.0)).astype(np.float32)
        array = read_npy(content, name)
        if array.ndim < 2 or (key == "depth" and array.dtype.kind != "f"):
            reason = f"wrong shape {array.shape} or type {array.dtype}"
            raise InputError(name, reason, "give an array (H, W), for depth of floats in metres")
        if array.shape[0] * array.shape[1] > max_pixels:
            reason = f"shape {array.shape} exceeds {max_pixels} pixels"
            raise InputError(name, reason, "give a smaller image, or raise recording.max_pixels")
        return np.ascontiguousarray(array)


@dataclass(frozen=True, eq=False, slots=True)
class Moved:
    """moved.json: the motion of an object.

    Attributes:
        T: Rigid transform (4, 4) in the world frame [m].
    """

    T: Annotated[Array, Numbers(4, 4, rigid=True)]


@dataclass(frozen=True, eq=False)
class CandidateViews:
    """Views that a robot can reach, or cannot: candidates.json.

    Attributes:
        T_world_camera: Camera poses (N, 4, 4) [m] to choose from; OpenCV camera frame, world z up. Null for
            those that the session's robot reaches.
        path_length: Path length (N,) [m] to each, or null for straight lines.
        refused: Camera poses (M, 4, 4) [m] to which the robot cannot go after all, or null for none.
    """

    T_world_camera: Annotated[Array, Numbers(-1, 4, 4)] | None = None
    path_length: Annotated[Array, Numbers(-1)] | None = None
    refused: Annotated[Array, Numbers(-1, 4, 4)] | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Added:
    """Result of adding a view.

    Attributes:
        number: Number of the view, from 0.
        graph: The fused support graph with it.
        changed: Whether it changed the graph.
        T_world_camera: Registered camera pose (4, 4), or None while the view waits.
        warnings: What may be wrong with the view, or why it waits; one sentence each.
        changes: Changes of objects since the previous view, seen or reported.
        open: Whether the view is still being added; the rest is then that of the views before it.
    """

    number: int
    graph: SupportGraph
    changed: bool
    T_world_camera: Array | None = None
    warnings: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()
    open: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the answer of `caryatid session add` and of the service."""
        pose = None if self.T_world_camera is None else self.T_world_camera.tolist()
        document = {"view": self.number, "open": self.open, "changed": self.changed, "T_world_camera": pose}
        known = {"warnings": list(self.warnings), "changes": [asdict(change) for change in self.changes]}
        return document | known | {"graph": graph_to_json(self.graph)}


@dataclass(frozen=True, eq=False, slots=True)
class NextView:
    """The next best view.

    Attributes:
        number: Number of the next view, from 0.
        decision: Pose, waypoints (none with given candidates), expected gain, cost and reason.
        stop: Why another view may not be worth its path, or None.
    """

    number: int
    decision: Decision
    stop: str | None

    def to_json(self) -> dict[str, Any]:
        """Return the answer of `caryatid session next` and of the service."""
        d = self.decision
        waypoints = [posture.to_json() for posture in d.waypoints]
        there = waypoints[-1] if waypoints else dict.fromkeys(("platform", "camera_height", "gaze", "joints"))
        return {
            "view": self.number,
            "T_world_camera": d.T_world_camera.tolist(),
            "candidate": d.index,
            **there,
            "waypoints": waypoints,
            "expected_gain": d.saliency,
            "cost": d.cost,
            "score": d.score,
            "why": d.why,
            "stop": self.stop,
        }


def check_limits(own: Config, asked: Config) -> None:
    """Reject settings of a client that change a limit of a service, or another by more than a factor of ten.

    Raises:
        InputError: The error names the setting.
    """
    remedy = "change it in the settings of the service"
    for stage, values in asdict(asked).items():
        for name, value in values.items():
            before = getattr(getattr(own, stage), name)
            if value != before and (stage == "session" or name in ("max_voxels", "max_pixels")):
                raise InputError(f"{stage}.{name}", "is a limit of the service", remedy)
            if _is_far(value, before):
                reason = f"differs from this service's {before} by more than a factor of ten"
                raise InputError(f"{stage}.{name}", reason, remedy)


def _is_far(value: ArrayLike, before: ArrayLike) -> bool:
    """Whether numbers differ by more than a factor of ten in size, or in how many there are."""
    given, ours = np.ravel(value), np.ravel(before)
    if given.dtype.kind not in "if" or not ours.any():
        return False
    given, ours = np.abs(given), np.abs(ours)
    far = (given > 0) & ((given < ours[ours > 0].min() / 10.0) | (given > 10.0 * ours.max()))
    return bool(far.any()) or len(given) > 10 * len(ours)
