"""Camera data: one registered RGB-D view, and the oriented points in it."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from caryatid.errors import InputError, check_type
from caryatid.geometry import points as kernels
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.runtime import Pictured
from caryatid.sensing.masks import labels_from_masks

SUPPORT_LABEL = 65535
"""The label of the main support surface in label images: the last of 16 bits, so that given labels stay."""
MAX_LABEL = 65519
"""The highest label of an object; those above are of support surfaces, at most 16, downwards from 65535."""


@dataclass(frozen=True, eq=False)
class View(Pictured):
    """One registered RGB-D view.

    Attributes:
        depth: Depth along the optical axis (H, W) [m]; 0 or NaN = no reading.
        K: Pinhole matrix (3, 3) [px].
        T_world_camera: Camera pose (4, 4), OpenCV camera frame, or None if unknown.
        rgb: Colour (H, W, 3) uint8, or None.
        labels: Object number of each pixel (H, W), 0, −1 or 65535 = nothing, or None without segmentation. A
            stack of masks (N, H, W), boolean or scores in [0, 1], becomes such an image of segments.
        normals_camera: Surface normals (H, W, 3) in the camera frame, or None to estimate them from depth.
        name: What to call the view in messages.
        labels_are: Whether a label is an object's in all views (`objects`) or a segment's in this view alone
            (`segments`).
        ignored: Pixels (H, W) that are left out, such as those of the robot's own arm: they have no reading
            and no label. None = none.
        names: What labels show, such as {3: "mug"}, or None; several may have one name.

    Raises:
        InputError: Sizes differ, depth is negative or infinite, K or the pose is not valid.
    """

    depth: NDArray[np.float32]
    K: Array
    T_world_camera: Array | None = None
    rgb: NDArray[np.uint8] | None = None
    labels: NDArray[np.int32] | None = None
    normals_camera: NDArray[np.float32] | None = None
    name: str = "view"
    labels_are: Literal["objects", "segments"] = "objects"
    ignored: NDArray[np.bool_] | None = None
    names: Mapping[int, str] | None = dataclasses.field(default=None, metadata={"sparse": True})

    def __post_init__(self) -> None:
        name, assign = self.name, partial(object.__setattr__, self)
        depth = _numbers(self.depth, np.float32, f"{name}: depth")
        if depth.ndim != 2 or depth.size == 0:
            raise InputError(name, f"depth has shape {depth.shape}", "give a depth image (H, W) in metres")
        depth = np.where(np.isnan(depth), np.float32(0.0), depth)
        if np.isinf(depth).any() or (depth < 0.0).any():
            bad = "infinite" if np.isinf(depth).any() else "negative"
            raise InputError(name, f"depth contains {bad} values", "mark missing readings with 0 or NaN")
        # Anything nearer than a micrometre is not a reading, and its inverse may be infinite.
        depth = np.where(depth < 1e-6, np.float32(0.0), depth)
        assign("depth", depth)
        assign("K", check_intrinsics(self.K, name))
        if self.T_world_camera is not None:
            assign("T_world_camera", transforms.as_rigid(self.T_world_camera, f"{name}: T_world_camera"))
        if self.names is not None:
            check_type(f"{name}: names", self.names, Mapping, 'give a name for each label: {3: "mug"}')
            names = {int(label): " ".join(said.split()) for label, said in self.names.items()}
            assign("names", {label: said for label, said in names.items() if label > 0 and said})
        if self.labels_are not in ("objects", "segments"):
            raise InputError(name, f"labels_are is '{self.labels_are}'", "choose objects or segments")
        if self.labels is not None and np.ndim(self.labels) == 3:
            assign("labels", labels_from_masks(self.labels))
            assign("labels_are", "segments")
        kinds = {"rgb": np.uint8, "labels": np.int32, "normals_camera": np.float32, "ignored": np.bool_}
        for field, dtype in kinds.items():
            image = getattr(self, field)
            if image is None:
                continue
            image = _numbers(image, None, f"{name}: {field}")
            if image.shape[:2] != depth.shape:
                reason = f"{field} is {_size(image)}, depth is {_size(depth)}"
                raise InputError(name, reason, "register the images to one size")
            if field == "rgb" and (image.dtype != np.uint8 or image.shape[2:] != (3,)):
                reason = f"rgb has shape {image.shape} and type {image.dtype}"
                raise InputError(name, reason, "give (H, W, 3) uint8, such as (255 * rgb).astype(np.uint8)")
            if field == "labels":
                image = check_labels(image, name)
            assign(field, image.astype(dtype, copy=False))
        if self.ignored is not None:
            assign("depth", np.where(self.ignored, np.float32(0.0), depth))
            if self.labels is not None:
                assign("labels", np.where(self.ignored, np.int32(0), self.labels))

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels (H, W) that hold a reading."""
        return self.depth > 0.0

    @cached_property
    def points_camera(self) -> Array:
        """Points (H, W, 3) [m] in the camera frame; the origin where there is no reading."""
        height, width = self.depth.shape
        u = (np.arange(width) - self.K[0, 2]) / self.K[0, 0]
        v = (np.arange(height) - self.K[1, 2]) / self.K[1, 1]
        z = self.depth.astype(np.float64)
        return np.stack([u[None, :] * z, v[:, None] * z, z], axis=-1)

    @property
    def pose(self) -> Array:
        """`T_world_camera` (4, 4), for code that needs one.

        Raises:
            InputError: The view has no pose.
        """
        if self.T_world_camera is None:
            raise InputError(self.name, "has no camera pose", "give T_world_camera")
        return self.T_world_camera

    def with_pose(self, T_world_camera: Array) -> View:
        """Return the same view seen from another pose (4, 4).

        Raises:
            InputError: The pose is not a rigid transform.
        """
        other = copy.copy(self)
        T = transforms.as_rigid(T_world_camera, f"{self.name}: T_world_camera")
        object.__setattr__(other, "T_world_camera", T)
        return other

    def every(self, step: int) -> View:
        """Return the view as every `step`-th pixel of every `step`-th row shows it."""
        K, taken = self.K / np.array([[step], [step], [1.0]]), dict[str, Any]()
        for name in ("depth", "rgb", "labels", "normals_camera", "ignored"):
            image = getattr(self, name)
            taken[name] = None if image is None else np.ascontiguousarray(image[::step, ::step])
        return replace(self, K=K, **taken)

    def __repr__(self) -> str:
        given = [name for name in ("rgb", "labels") if getattr(self, name) is not None]
        given += [] if self.T_world_camera is None else ["pose"]
        return f"View({self.name}: depth {_size(self.depth)}{''.join(f', {name}' for name in given)})"


@dataclass(frozen=True, eq=False, slots=True)
class Cloud(Pictured):
    """Oriented points in the world frame, organised or not.

    Attributes:
        points_world: (N, 3) [m].
        normals_world: Normals (N, 3) that point towards the sensor; a scene scales them to length 1.
        labels: Object number of each point (N,), 0, −1 or 65535 = nothing, or None.
        rgb: (N, 3) uint8, or None.
        viewpoint_world: Where the sensor was (3,) [m], or None.
        name: What to call the cloud in messages.

    Raises:
        InputError: Sizes differ, or something is not an array of numbers.
    """

    points_world: Array
    normals_world: Array
    labels: NDArray[np.int32] | None = None
    rgb: NDArray[np.uint8] | None = None
    viewpoint_world: Array | None = None
    name: str = "cloud"

    def __post_init__(self) -> None:
        for field, shape in {"points_world": (3,), "normals_world": (3,), "labels": (), "rgb": (3,)}.items():
            if (values := getattr(self, field)) is None and field in ("labels", "rgb"):
                continue
            array = _numbers(values, None, f"{self.name}: {field}")
            if array.shape != (len(self.points_world), *shape):
                reason, wanted = f"{field} has shape {array.shape}", ", ".join(["N", *map(str, shape)])
                raise InputError(self.name, reason, f"give ({wanted}), one for each point")
            object.__setattr__(self, field, array)

    def __len__(self) -> int:
        return len(self.points_world)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Cloud:
        """Return the points picked by a mask (N,) or by indices."""
        index = np.flatnonzero(keep) if keep.dtype == np.bool_ else keep
        taken: dict[str, Any] = {}
        for name in ("points_world", "normals_world", "labels", "rgb"):
            values = getattr(self, name)
            taken[name] = None if values is None else np.take(values, index, axis=0)
        return replace(self, **taken)

    def moved(self, T: Array) -> Cloud:
        """Return the cloud moved by a rigid transform (4, 4) of the world."""
        if np.array_equal(T, np.eye(4)):
            return self
        eye, only = self.viewpoint_world, np.zeros(len(self), dtype=np.intp)
        return replace(
            self,
            points_world=kernels.transform(T[None], only, self.points_world),
            normals_world=kernels.rotate(T[None], only, self.normals_world),
            viewpoint_world=None if eye is None else transforms.transform(T, eye),
        )

    def __repr__(self) -> str:
        given = [name for name in ("rgb", "labels") if getattr(self, name) is not None]
        return f"Cloud({self.name}: {len(self)} points{''.join(f', {name}' for name in given)})"


class Camera(Protocol):
    """Takes a view from a pose: simulation, recording or hardware."""

    def capture(self, T_world_camera: Array) -> View:
        """Take a view from a requested pose (4, 4); its own pose is the one that the robot reports."""
        ...


def depth_behind(shape: Shape, depth: NDArray[np.float32], K: Array) -> Array:
    """Distances (N,) [m] of readings behind the surface of a shape that faces the camera.

    The shape is in the camera frame; readings (H, W) [m] are 0 where there is none, and K is a pinhole matrix
    (3, 3) [px]. Distances are at points about 1 cm apart on the shape; −inf without a reading.
    """
    points, outward = shape.surface(0.01)
    facing = np.einsum("ij,ij->i", points, outward) < 0.0
    points = points[facing & (points[:, 2] > 1e-3)]
    u, v = np.rint((points @ K.T)[:, :2] / points[:, 2:]).astype(np.intp).T
    height, width = depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    reading = depth[v[inside], u[inside]]
    return np.where(reading > 0.0, reading - points[inside, 2], -np.inf)


def check_intrinsics(K: Array, name: str) -> Array:
    """Check a pinhole matrix (3, 3) [px] and return it as float64; errors use the name.

    Raises:
        InputError: Wrong shape, NaN, or a focal length that is not positive.
    """
    matrix = _numbers(K, np.float64, f"{name}: K")
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise InputError(name, "K is not a finite 3×3 matrix", "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    if matrix[0, 0] <= 0.0 or matrix[1, 1] <= 0.0:
        reason = f"K has focal lengths {matrix[0, 0]:g}, {matrix[1, 1]:g}"
        raise InputError(name, reason, "give positive focal lengths in pixels")
    return matrix


def check_labels(labels: NDArray[Any], name: str) -> NDArray[Any]:
    """Check labels (...) and return them (...) with 0 for the background, which many number −1.

    65535, void in 16 bits and the support surface in label images of ours, is background too.

    Raises:
        InputError: They are not integers, or out of range.
    """
    if labels.dtype.kind == "f" and (labels != np.rint(labels)).any():
        remedy = "give integers, or for a view a stack of masks (N, H, W)"
        raise InputError(name, "labels are not integers", remedy)
    if not labels.size or (labels.min() >= 0 and labels.max() <= MAX_LABEL):
        return labels
    nothing = (labels == -1) | (labels == SUPPORT_LABEL)
    if ((labels < 0) | (labels > MAX_LABEL))[~nothing].any():
        remedy = f"number objects from 1, 0, −1 or {SUPPORT_LABEL} = no object"
        raise InputError(name, f"labels exceed 0…{MAX_LABEL}", remedy)
    return np.where(nothing, 0, labels)


def _numbers(values: Any, dtype: DTypeLike | None, name: str) -> NDArray[Any]:
    """The values as an array of numbers of a type; None = as they are."""
    try:
        array = np.asarray(values, dtype=dtype)
    except (TypeError, ValueError):
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        reason = f"expected an array of numbers, not {type(values).__name__}"
        raise InputError(name, reason, "give a NumPy array")
    return array


def _size(image: NDArray[np.generic]) -> str:
    return "×".join(map(str, image.shape[1::-1])) or "a single number"
