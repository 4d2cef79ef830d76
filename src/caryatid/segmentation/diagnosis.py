"""What the numbers of views mean: unit and kind of depth, camera, and convention of poses.

A table is a level plane. If the readings, the camera or the pose are of another kind than ours, it is bent or
tilted; the one kind that would make it flat and level is then named. Planes are found in the image: on one,
the inverse of depth is an affine function of the pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from caryatid.config.stages import Config
from caryatid.errors import WrongViewError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import UP, Array
from caryatid.sensing.views import View

AWAY = 100.0
"""Distance of a camera from the world's origin beyond which its pose is not in metres [m]: no room is larger,
and a camera farther than 10 cm from the origin is beyond it in millimetres."""
SAMPLES, TRIALS = 1500, 200
"""Numbers of pixels at which planes are looked for, and of triples that are tried [1]: 200 find a plane of a
quarter of the pixels with confidence 0.96."""
PLANES = 3
"""Maximum number of planes of a view, largest first, of which one may be the table [1]."""
FLAT = 0.005
"""Deviation of a reading from a plane, relative to the reading [1]: noise of depth cameras up to 3 m."""
LARGE = 0.2
"""Minimum share that says something: of the readings on one plane, and of what two views both show [1]."""
ODDS = 2.5
"""How many times the odds of such a share must be those of the share as declared [1]."""
BUFFER = 0.8
"""What nearly all values of a depth buffer exceed, if its near plane is at up to a fifth of the depth [1]."""
OFF_CENTRE = 0.2
"""How far the principal point may be from the image's middle [image widths and heights]."""
NEAR = 0.015
"""Distance of the same point in two views, relative to the reading [1]; poses are off by about 1 cm."""
MOUNTED = 2.0
"""Error of a camera's orientation on its arm that calibration leaves [deg]; 3.5 cm at 1 m."""
STEEP = 45.0
"""Tilt of a plane beyond which it is a wall, and no table [deg]."""
LEFT = 0.5
"""Maximum share of the planes' tilt that what explains it leaves [1]."""
SURE = 16.3
"""Sum of squares [σ²] that an explanation must save: its three numbers save it once in 1000 by chance."""
FOCAL_FACTORS = np.geomspace(0.5, 2.0, 57)
"""Factors of the focal lengths that are tried [1], 2.5 % apart: half and double mean another image size."""
LEAST = 20
"""Minimum number of points above the table that tell whether two views show the same [1]."""

GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Axes (4, 4) of OpenCV's camera frame, the optical one, in OpenGL's."""
BODY = transforms.rigid([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], np.zeros(3))
"""The same axes in the frame of a camera's body."""
Y_UP = transforms.rigid([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], np.zeros(3))
"""Pose (4, 4) of a world whose y axis points up, such as ARKit's, in one whose z axis does."""
Z_UP = "rotate the world so that its z axis points up (on the command line: --level)"
"""Remedy for a world frame that is not level."""
EARLY = "each pose is that of the view before: check the clocks of camera and poses"
"""A cause of wrong camera poses, and its remedy."""
LATE = "each pose is that of the view after: check the clocks of camera and poses"
"""A cause of wrong camera poses, and its remedy."""
OTHER_CAMERA = "K is for another resolution: multiply its first two rows by the ratio of the image sizes"
"""A cause of wrong lengths, and its remedy."""
GL_AXES = (
    "the camera axes are OpenGL's (y up, z backward) instead of OpenCV's (y down, z forward): give "
    "T_world_camera @ np.diag([1, -1, -1, 1]), or for a recording --set recording.axes=opengl"
)
"""A cause of a wrong camera pose, and its remedy."""
BODY_AXES = (
    "the pose is that of the camera's body (x forward, z up) instead of its optical frame (x right, y down, "
    "z forward): give the pose of the optical frame, or for a recording --set recording.axes=body"
)
"""A cause of a wrong camera pose, and its remedy."""
INVERSE = "T_world_camera is the inverse, world to camera: invert it"
"""A cause of a wrong camera pose, and its remedy."""


def _roll_quaternion(T: Array, by: int) -> Array:
    quaternion = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), by)
    return transforms.rigid(Rotation.from_quat(quaternion).as_matrix(), T[:3, 3])


def _turn_camera(T: Array, angle: float) -> Array:
    turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
    return transforms.rigid(T[:3, :3] @ turn, T[:3, 3])


def _transpose_rotation(T: Array) -> Array:
    return transforms.rigid(T[:3, :3].T, T[:3, 3])


def describe_unit(readings: NDArray[np.floating]) -> str:
    """Say in which other unit readings (N,) would be about a metre, as of a table; else ""."""
    median, counts = float(np.median(readings)), {"": 1.0, **DEPTH_UNITS}
    unit = min(counts, key=lambda name: abs(np.log(median / counts[name])))
    return f", as if in {unit}" if unit else ""


def undo_unit(unit: str) -> str:
    """Say how to convert readings that `describe_unit` says something of to metres."""
    return "".join(f": {undo_factor(k)}" for name, k in DEPTH_UNITS.items() if unit.endswith(name))


def undo_factor(factor: float) -> str:
    """Say what undoes a factor."""
    return f"divide it by {factor:.5g}" if factor > 1.0 else f"multiply it by {1.0 / factor:.5g}"


def _scale_translation(T: Array, factor: float) -> Array:
    return transforms.rigid(T[:3, :3], factor * T[:3, 3])


CAMERAS: Mapping[str, Callable[[Array], Array]] = {
    "": lambda T: T,
    GL_AXES: lambda T: T @ GL,
    BODY_AXES: lambda T: T @ BODY,
    **{
        f"the image is turned by {angle}° against its pose, as if the hand-eye calibration were {how}: give "
        f"T_world_camera @ {matrix}": partial(_turn_camera, angle=angle)
        for angle, how, matrix in (
            (90, "forgotten", "[[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"),
            (180, "inverted", "np.diag([-1, -1, 1, 1])"),
            (-90, "forgotten", "[[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"),
        )
    },
}
"""Conventions of camera frames other than ours, with their remedy, and how to read such a pose (4, 4)."""
WORLDS: Mapping[str, Callable[[Array], Array]] = {
    "": lambda T: T,
    f"the world's y axis points up: {Z_UP}": lambda T: Y_UP @ T,
    f"the world's z axis points down: {Z_UP}": lambda T: GL @ T,
}
"""The same of world frames."""
REORDER = "give the rotation of T_world_camera whose quaternion is np.roll(quaternion as read"
"""Remedy for a quaternion in another order."""
WAYS: Mapping[str, Callable[[Array], Array]] = {
    "": lambda T: T,
    INVERSE: transforms.invert,
    f"the quaternion of the pose begins with w, but was read as x y z w: {REORDER}, -1)": partial(
        _roll_quaternion, by=-1
    ),
    f"the quaternion of the pose ends with w, but was read as w x y z: {REORDER}, 1)": partial(
        _roll_quaternion, by=1
    ),
}
"""The same of how poses are written."""


def _apply(T: Array, steps: Sequence[Callable[[Array], Array]]) -> Array:
    for step in steps:
        T = step(T)
    return T


POSES: Mapping[str, Callable[[Array], Array]] = {
    ", and ".join(filter(None, causes)): partial(
        _apply, steps=(WAYS[causes[0]], CAMERAS[causes[1]], WORLDS[causes[2]])
    )
    for causes in product(WAYS, CAMERAS, WORLDS)
    if any(causes)
}
"""Combinations of them."""
LIKELY = {*WAYS, *CAMERAS, *WORLDS, *(cause for cause in POSES if GL_AXES in cause)}
"""Those that the table alone may tell; of many, some fit by chance."""
DEPTH_UNITS: Mapping[str, float] = {
    "millimetres": 1e3, "centimetres": 1e2, "tenths of a millimetre": 1e4, "kilometres": 1e-3,
}  # fmt: skip
"""How many of the units that depth is met in make a metre [1]."""
UNITS: Mapping[str, float] = {
    f"the translation of T_world_camera is {1.0 / factor:.4g} times as long as depth says{unit}: "
    f"{undo_factor(1.0 / factor)}, if depth is right": factor
    for factor, unit in {
        **dict.fromkeys((100.0, 39.37, 10.0, 5.0, 4.0, 2.0, 0.5, 0.25, 0.2), ""),
        1e3: ", as if in kilometres", 0.1: ", as if in decimetres", 0.0254: ", as if in inches",
        0.01: ", as if in centimetres", 0.001: ", as if in millimetres",
    }.items()
}  # fmt: skip
"""Ratios [1] of the units of poses and depth that are met, by what is said of them."""
MIRRORED = (
    "the images are mirrored: flip them left to right, with colour and masks, and set cx = width - 1 - cx; "
    "or the poses are left-handed, as in Unity and Unreal: give S @ T_world_camera @ S with "
    "S = np.diag([-1, 1, 1, 1]); depth cannot tell which: the other one mirrors the world"
)
"""Causes of a mirrored world, and their remedies."""
INCONSISTENT = (
    "the largest planes are tilted, in each view another way, and no known convention explains it: check "
    "poses and K"
)
"""What is said of tilted planes that no rotation of the world makes level."""
TRANSPOSED = "only the rotation of T_world_camera is inverse: transpose it"
"""A cause of wrong camera poses, and its remedy."""
FIXED = "all views have the same pose, but do not show the same: give each its own"
"""A cause of wrong camera poses, and its remedy."""


@dataclass(frozen=True, eq=False, slots=True)
class ImagePlane:
    """The largest plane of an image.

    Attributes:
        affine: Coefficients (3,) of its inverse depth at pixels (u, v, 1) [1/m].
        share: Share of the readings that lie on it [1].
    """

    affine: Array
    share: float

    def residuals(self, view: View) -> Array:
        """How much farther (H, W) each pixel of the image is than it, relative to it [1]; −1 = no reading."""
        v, u = np.indices(view.depth.shape)
        inverse: Array = u * self.affine[0] + v * self.affine[1] + self.affine[2]
        return inverse * view.depth - 1.0

    def mask(self, view: View) -> NDArray[np.bool_]:
        """Which pixels (H, W) of the image lie on it, with twice the usual noise."""
        return np.abs(self.residuals(view)) < 2.0 * FLAT

    def normal_camera(self, K: Array) -> Array:
        """Its unit normal (3,) towards the camera, if the pinhole matrix is K (3, 3) [px]."""
        return -transforms.unit(self.affine @ K)


def find_image_plane(view: View, kind: str = "axis") -> ImagePlane:
    """Find the largest plane of a view, if its readings are of a kind.

    Args:
        view: The view.
        kind: `axis` for depth along the optical axis, `ray` for distance along the ray of each pixel,
            `inverse` for inverse depth.
    """
    rng, index = np.random.default_rng(0), np.flatnonzero(view.valid)
    if len(index) < 3:
        return ImagePlane(np.array([0.0, 0.0, 1.0]), 0.0)
    index = index[np.linspace(0, len(index) - 1, min(SAMPLES, len(index))).astype(np.intp)]
    v, u = np.divmod(index, view.depth.shape[1])
    pixels, w = np.stack([u, v, np.ones(len(u))]), view.depth.ravel()[index].astype(np.float64)
    q = w if kind == "inverse" else 1.0 / w
    if kind == "ray":
        q = q * np.linalg.norm(np.linalg.inv(view.K) @ pixels, axis=0)
    triples = rng.integers(0, len(q), (TRIALS, 3))
    corners = pixels.T[triples]
    proper = np.abs(np.linalg.det(corners)) > 1.0
    if not proper.any():
        return ImagePlane(np.array([0.0, 0.0, 1.0]), 0.0)
    planes = np.linalg.solve(corners[proper], q[triples[proper]][..., None])[..., 0]
    near = np.abs(planes @ pixels - q) < FLAT * q
    best = int(np.argmax(np.count_nonzero(near, axis=1)))
    on, plane = near[best], planes[best]
    for _ in range(2):
        plane = np.linalg.lstsq(pixels[:, on].T, q[on], rcond=None)[0]
        refined = np.abs(plane @ pixels - q) < FLAT * q
        on = refined if np.count_nonzero(refined) > 3 else on
    return ImagePlane(plane, float(on.mean()))


def ray_lengths(view: View) -> Array:
    """Length (H, W) of each pixel's ray up to depth 1: distance along the ray / depth along the axis [1]."""
    x, y = ((np.arange(n) - view.K[k, 2]) / view.K[k, k] for k, n in enumerate(view.depth.shape[::-1]))
    return np.asarray(np.sqrt(1.0 + x**2 + y[:, None] ** 2), dtype=np.float64)


def check_camera(view: View, max_coordinate: float) -> None:
    """Reject a view with an implausible camera or pose, or with depth above a maximum [m].

    Raises:
        WrongViewError: The camera is implausible, or pose or depth are not in metres.
    """
    height, width = view.depth.shape
    (fx, _, cx), (_, fy, cy) = view.K[:2]
    pinhole = np.allclose(view.K, [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], atol=1e-3 * fx)
    # Focal lengths of 0.05 and 50 image widths are 168° and 1° of view.
    wide = min(fx, fy) >= 0.05 * width and max(fx, fy) <= 50.0 * width
    if not (pinhole and wide and -width <= cx <= 2 * width and -height <= cy <= 2 * height):
        remedy = "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels of this image"
        raise WrongViewError(view.name, f"K is implausible for a camera with {describe_camera(view)}", remedy)
    far = 0.0 if view.T_world_camera is None else float(np.linalg.norm(view.T_world_camera[:3, 3]))
    if far > AWAY:
        reason = f"the camera is {far:.4g} m from the world's origin, as if in millimetres or centimetres"
        remedy = f"give T_world_camera in metres, in a world whose origin is within {AWAY:g} m"
        raise WrongViewError(view.name, reason, remedy)
    if float(view.depth.max(initial=0.0)) > max_coordinate:
        unit = describe_unit(view.depth[view.valid])
        reason = f"depth reaches {view.depth.max():.4g} m{unit}"
        raise WrongViewError(view.name, reason, f"give depth in metres{undo_unit(unit)}")


def describe_camera(view: View) -> str:
    """Image size, focal lengths and principal point of a view's camera."""
    height, width = view.depth.shape
    (fx, _, cx), (_, fy, cy) = view.K[:2]
    camera = f"focal lengths {fx:.4g}, {fy:.4g} and principal point {cx:.4g}, {cy:.4g} px"
    return f"{width}×{height} pixels, {camera}"


def check_depth(view: View) -> None:
    """Reject a view whose readings are not depth along the optical axis, as its largest plane shows.

    Raises:
        WrongViewError: They are distances along rays, or inverse.
    """
    declared = find_image_plane(view).share
    kinds = {
        "ray": (
            "the distance along the ray of each pixel",
            "divide it by the length of K⁻¹ (u, v, 1), or for a recording add --set recording.depth=ray",
        ),
        "inverse": ("inverse depth or disparity", "give its inverse, in metres"),
    }
    for kind, (what, remedy) in kinds.items():
        share = find_image_plane(view, kind).share
        if _is_better(share, declared):
            bent = f"as such, {share:.0%} of the readings lie on one plane, and only {declared:.0%} otherwise"
            reason = f"depth is {what}, not that along the optical axis: {bent}"
            raise WrongViewError(view.name, reason, remedy)


def describe_centre(view: View) -> str:
    """Say that the principal point is far from the image's middle, as for another resolution; else ""."""
    size, centre = np.array(view.depth.shape[::-1]), view.K[:2, 2]
    if (np.abs(centre - (size - 1) / 2.0) <= OFF_CENTRE * size).all():
        return ""
    where = f"K has its principal point at ({centre[0]:.0f}, {centre[1]:.0f}) in {size[0]}×{size[1]} pixels"
    if (K := scaled_camera(view)) is None:
        return f"{where}; is K for another resolution?"
    scale = K[0, 0] / view.K[0, 0]
    whole = 8 * np.rint(size / scale / 8.0).astype(np.intp)  # as images are
    remedy = f"multiply its first two rows by {size[0] / whole[0]:.3g}, the ratio of the image sizes"
    return f"{where}; if K is for a resolution of {whole[0]}×{whole[1]}, {remedy}"


def scaled_camera(view: View) -> Array | None:
    """K (3, 3) scaled to the view's image, if it is for one of the same shape and another size; else None."""
    if (view.K[:2, 2] < 0.0).any():
        return None
    scales = np.array(view.depth.shape[::-1]) / (2.0 * view.K[:2, 2] + 1.0)
    scale = float(np.sqrt(scales.prod()))
    if abs(scale - 1.0) <= OFF_CENTRE or np.abs(np.log(scales / scale)).max() > 0.05:
        return None
    rows = np.array([[scale], [scale], [1.0]])
    return np.asarray(view.K * rows, dtype=np.float64)


def thin_view(view: View) -> View:
    """A view of at most 160 columns, without colour and labels; its planes are the same."""
    bare = replace(view, rgb=None, labels=None, normals_camera=None, ignored=None, names=None)
    return bare.every(max(1, view.depth.shape[1] // 160))


def name_causes(view: View, max_tilt: float) -> list[str]:
    """Name conventions, with their remedies, in which the largest plane of a view with a pose is level.

    Args:
        view: The view.
        max_tilt: Maximum tilt of a plane that counts as level [deg].
    """
    plane = find_image_plane(view)
    if plane.share < LARGE:
        return []
    normal = plane.normal_camera(view.K)
    causes = [c for c, read in POSES.items() if c in LIKELY and _tilt(read(view.pose), normal) <= max_tilt]
    if (K := scaled_camera(view)) is not None and _tilt(view.pose, plane.normal_camera(K)) <= max_tilt:
        causes.append(OTHER_CAMERA)
    readings = view.depth[view.valid]
    if not causes and np.percentile(readings, 5.0) > BUFFER and readings.max() <= 1.0:
        causes.append("depth is a buffer in [0, 1]: give metres")
    return causes or [Z_UP]


def explain_mismatch(first: View, other: View, max_tilt: float) -> str:
    """Say in which convention or unit two views would show the same above the table; "" if in none.

    Of a single view, the table alone may not tell; what stands on it does, from two sides.

    Args:
        first: A view with a pose.
        other: A later one.
        max_tilt: Maximum tilt of a plane that counts as level [deg].
    """
    shares = _overlaps([first, other], max_tilt)
    return _best_reading(shares) or describe_centre(first)


def _overlaps(views: Sequence[View], max_tilt: float) -> dict[str, float]:
    """Median share of what each view shows above the table that the one before shows too, by how it is read.

    Read as declared, that is "".
    """
    readings: dict[str, tuple[Callable[[View], View], Callable[[Array], Array]]] = {
        "": (_keep, _keep), **{cause: (_keep, read) for cause, read in POSES.items()},
        **{cause: (_keep, partial(_scale_translation, factor=factor)) for cause, factor in UNITS.items()},
        TRANSPOSED: (_keep, _transpose_rotation),
        MIRRORED: (_mirror, _keep),
        OTHER_CAMERA: (_scale_camera, _keep),
    }  # fmt: skip
    changes = {change for change, _ in readings.values()}
    shown = {change: [_RaisedPoints.of(change(view)) for view in views] for change in changes}
    poses, shares = [view.pose for view in views], {}
    for cause, (change, read) in readings.items():
        shares[cause] = _overlap(shown[change], [read(T) for T in poses], max_tilt)
    if len(views) > 3:  # One pair of views may agree by chance.
        shares[EARLY] = _overlap(shown[_keep][:-1], poses[1:], max_tilt)
        shares[LATE] = _overlap(shown[_keep][1:], poses[:-1], max_tilt)
    return shares


def _best_reading(shares: Mapping[str, float]) -> str:
    """How views are to be read to agree; "" if as declared, or if nothing is sure."""
    best = max(shares, key=lambda cause: shares[cause])
    return best if _is_better(shares[best], shares[""]) else ""


def _is_better(share: float, declared: float) -> bool:
    """Whether a share is large, and much larger than the one as declared."""
    odds, odds_declared = (p / (1.0 - p) for p in np.clip([share, declared], 0.01, 0.99))
    return bool(share >= LARGE and odds > ODDS * odds_declared)


def _overlap(shown: Sequence[_RaisedPoints], poses: Sequence[Array], max_tilt: float) -> float:
    clouds, shares = [view.points_world(T, max_tilt) for view, T in zip(shown, poses, strict=True)], []
    readings = np.concatenate([view.points_camera[:, 2] for view in shown])
    near = NEAR * float(np.median(readings)) if len(readings) else NEAR
    for before, after in pairwise(clouds):
        if min(len(before), len(after)) < LEAST:
            shares.append(0.0)
            continue
        away, _ = cKDTree(before).query(after, distance_upper_bound=near)
        shares.append(float(np.isfinite(away).mean()))
    return float(np.median(shares))


@dataclass(frozen=True, eq=False, slots=True)
class _RaisedPoints:
    """What a view shows above its largest plane.

    Attributes:
        normal_camera: Normal (3,) of the plane.
        points_camera: Points (N, 3) [m].
    """

    normal_camera: Array
    points_camera: Array

    @classmethod
    def of(cls, view: View) -> _RaisedPoints:
        plane = find_image_plane(view)
        above = np.flatnonzero(view.valid & (plane.residuals(view) < -4.0 * FLAT))
        above = above[:: max(1, len(above) // SAMPLES)] if plane.share >= LARGE else above[:0]
        return cls(plane.normal_camera(view.K), view.points_camera.reshape(-1, 3)[above])

    def points_world(self, T_world_camera: Array, max_tilt: float) -> Array:
        """The points (N, 3) [m] from a pose (4, 4), if the plane is then tilted by at most so much [deg]."""
        level = _tilt(T_world_camera, self.normal_camera) <= max_tilt
        return transforms.transform(T_world_camera, self.points_camera[: None if level else 0])


def _keep(value: Any) -> Any:
    return value


def _mirror(view: View) -> View:
    return replace(view, depth=np.ascontiguousarray(view.depth[:, ::-1]))


def _scale_camera(view: View) -> View:
    K = scaled_camera(view)
    return view if K is None else replace(view, K=K)


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What was found out about views.

    Attributes:
        views: What each is: its name, `width` and `height` [px], the share of pixels with a reading,
            `near` and `far` between which nine in ten readings are [m], horizontal field of view [deg], the
            share of the readings on its largest plane, and that plane's tilt [deg], or None without a pose.
        problems: What is wrong, and how to mend it.
        doubts: What could not be confirmed, and why, if nothing is wrong.
    """

    views: list[dict[str, Any]]
    problems: list[str]
    doubts: list[str]


def diagnose(views: Iterable[View], config: Config) -> Diagnosis:
    """Find out what views show, and whether units, camera and poses are ours.

    Args:
        views: The views, each looked at once.
        config: The largest depth, and the tilt of a level plane.
    """
    rows, thin, found = list[dict[str, Any]](), list[View](), dict[str, list[str]]()
    conventions = set[str]()
    max_tilt = config.surface.max_tilt
    for view in views:
        if not view.valid.any():
            found.setdefault("omit it", []).append(f"{view.name} has no depth readings: omit it")
            continue
        near, far = np.percentile(view.depth[view.valid], (5.0, 95.0))
        bare, plane, posed = thin_view(view), find_image_plane(view), view.T_world_camera is not None
        level, centre = posed and _is_level_somewhere(bare, max_tilt), describe_centre(view)
        # Parts of images have their principal point anywhere.
        said = {"": "", "K": "" if level else centre}
        if unit := describe_unit(view.depth[view.valid]):
            said["unit"] = f"depth is {near:.4g}–{far:.4g} m{unit}: give metres{undo_unit(unit)}"
        for check in (partial(check_camera, max_coordinate=config.cloud.max_coordinate), check_depth):
            try:
                check(view)
            except WrongViewError as error:
                said["unit" if unit else error.remedy] = f"{error.reason}: {error.remedy}"
        if posed and not level:
            each = name_causes(bare, max_tilt)
            if OTHER_CAMERA in each and centre:
                each[each.index(OTHER_CAMERA)], said["K"] = centre, ""
            causes = " or ".join(each)
            said[causes] = causes
            conventions.add(causes)
        for key, text in said.items():
            found.setdefault(key, []).extend([text] if text else [])
        tilt = _tilt(view.pose, plane.normal_camera(view.K)) if posed else None
        height, width = view.depth.shape
        angle = np.degrees(np.arctan(width / view.K[0, 0] / 2.0))
        rows.append(
            {
                "view": view.name, "width": width, "height": height, "readings": float(view.valid.mean()),
                "near": float(near), "far": float(far), "field_of_view": float(2.0 * angle),
                "plane": plane.share, "tilt": tilt,
            }
        )  # fmt: skip
        thin += [bare] if posed else []
    # One view may show a wall, and no table.
    usual = {key: texts[0] for key, texts in found.items() if 2 * len(texts) > len(rows)}
    tilted = sum(len(found[key]) for key in conventions)
    if 2 * tilted > len(rows) and not conventions & usual.keys():
        usual[Z_UP] = Z_UP
        conventions.add(Z_UP)
    if Z_UP in usual:
        normals = np.array([transforms.rotate(v.pose, find_image_plane(v).normal_camera(v.K)) for v in thin])
        away = transforms.angle_between(normals, np.median(normals, axis=0))
        if np.degrees(np.median(away)) > max_tilt:
            usual[Z_UP] = INCONSISTENT
    doubts, flat = list[str](), sum(row["plane"] >= LARGE for row in rows)
    if 2 * flat < len(rows):
        doubts.append("depth and axes, because most views show no plane that holds a fifth of the readings")
    if len(thin) > 1:
        shares = _overlaps(thin, max_tilt)
        best = _best_reading(shares)
        cause, angle, of_world = _explain_tilts(thin, config.registration.rotation)
        mounting = best in ("", EARLY, LATE) and usual.keys() <= {Z_UP} and not of_world
        if mounting and angle >= MOUNTED:
            usual = {cause: cause}
        elif best == OTHER_CAMERA:
            usual = {key: text for key, text in usual.items() if key not in conventions}
            usual["K"] = centre or OTHER_CAMERA
        elif best in UNITS and "unit" in usual:
            factor, length = UNITS[best], usual["unit"].partition(",")[0]
            named = {k: f" as if in {unit}," for unit, k in DEPTH_UNITS.items()}.get(factor, "")
            usual["unit"] = (
                f"{length},{named} {factor:.4g} times as long as by the poses: {undo_factor(factor)}"
            )
        elif best:
            usual = {key: text for key, text in usual.items() if key not in conventions} | {best: best}
        elif _have_one_pose(thin):
            usual = {FIXED: FIXED}
        elif shares[""] < LARGE:
            shared = f"{shares['']:.0%} of what they show above their largest planes"
            doubts.append(f"poses, because consecutive views share only {shared}")
        if not cause and (strays := _list_strays(thin, config.registration.rotation)):
            doubts.append(f"single poses, because tables are tilted against those of most views: {strays}")
        # Registration can mend small errors of single poses, but not what all have in common.
        doubts += [f"level tables, because {cause}"] * (angle >= 2.0 * config.registration.rotation)
    # What is wrong may hide the rest.
    return Diagnosis(rows, list(usual.values()), [] if usual else doubts)


def _have_one_pose(views: Sequence[View]) -> bool:
    """Whether all views have one pose, though most of what one shows above its largest plane moves."""
    if any(not np.allclose(view.pose, views[0].pose, atol=1e-6) for view in views):
        return False
    shares = []
    for before, after in pairwise(views):
        raised = before.valid & (find_image_plane(before).residuals(before) < -4.0 * FLAT)
        same = (
            np.abs(before.depth - after.depth) < NEAR * before.depth
            if before.depth.shape == after.depth.shape
            else np.zeros_like(raised)
        )
        shares.append(1.0 - float(same[raised].mean()) if raised.any() else 0.0)
    return bool(np.median(shares) > 0.5)


def _explain_tilts(views: Sequence[View], sigma: float) -> tuple[str, float, bool]:
    """Say what tilts the tables of views alike, or ""; how far [deg]; and whether it is the world alone.

    A camera turned on its arm, or with other focal lengths, tilts them in its own frame. Poses are noisy by
    sigma [deg].
    """
    planes = [(view, plane) for view in views if (plane := find_image_plane(view)).share >= LARGE]
    if len(planes) < 3:  # The turn of a camera explains nearly all of two.
        return "", 0.0, False
    ups = np.array([view.pose[2, :3] for view, _ in planes])
    scaled = np.array([
        [plane.normal_camera(view.K * [[f, 1, 1], [1, f, 1], [1, 1, 1]]) for view, plane in planes]
        for f in (1.0, *FOCAL_FACTORS)
    ])  # fmt: skip
    best = int(np.argmin(np.median(transforms.angle_between(scaled, ups), axis=1)))
    normals, factor = scaled[0], (1.0, *FOCAL_FACTORS)[best]
    turn, known = _find_turn(normals, ups, np.radians(sigma))
    world = np.array([transforms.rotate(v.pose, n) for (v, _), n in zip(planes, normals, strict=True)])
    mean = np.median(world, axis=0)
    pairs = (normals, ups), (turn.apply(normals), ups), (scaled[best], ups), (world, mean)
    left = np.degrees([transforms.angle_between(a, b) for a, b in pairs])
    tables = left.min(axis=0) < STEEP
    declared, *costs = ((left[:, tables] / sigma) ** 2).sum(axis=1)
    if 2 * tables.sum() <= len(views) or declared - min(costs) < SURE or min(costs) > LEFT**2 * declared:
        return "", 0.0, False
    mount, focal, tilted = (bool(cost - min(costs) < SURE) for cost in costs)
    by, tilt = np.degrees([turn.magnitude(), transforms.angle_between(mean, UP)]).tolist()
    vector = ", ".join(f"{x:.1f}" for x in turn.as_rotvec(degrees=True))
    lost = ", perhaps forgotten or inverted" * (by > STEEP)
    mended = f", or multiply poses on the right by Rotation.from_rotvec([{vector}], degrees=True)" * known
    causes = [
        f"all poses are off by the same turn of the camera, {'' if known else 'at least '}{by:.1f}°: the "
        f"hand-eye calibration is wrong{lost}: calibrate again{mended}"
    ] * mount
    # Calibration leaves small turns; wrong focal lengths are those of another image.
    causes += [f"multiply the focal lengths by {factor:.2g}"] * (focal and (by >= MOUNTED or not mount))
    causes += [f"the world is tilted by {tilt:.1f}° (is the robot's base level?): {Z_UP}"] * tilted
    return ", or ".join(causes), by if mount or focal else tilt, not (mount or focal)


def _list_strays(views: Sequence[View], sigma: float) -> str:
    """List the views whose table is tilted against the others', by more than noise sigma [deg] can."""
    tables = [(view, plane) for view in views if (plane := find_image_plane(view)).share >= LARGE]
    if len(tables) < 3:
        return ""
    normals = np.array([transforms.rotate(view.pose, plane.normal_camera(view.K)) for view, plane in tables])
    away = np.degrees(transforms.angle_between(normals, np.median(normals, axis=0)))
    strays = zip(tables, away.tolist(), strict=True)
    far = np.sqrt(SURE) * sigma
    return ", ".join(f"{view.name} by {angle:.1f}°" for (view, _), angle in strays if far < angle < STEEP)


def _find_turn(vectors: Array, others: Array, sigma: float) -> tuple[Rotation, bool]:
    """Find the rotation of vectors (N, 3) onto others, noise [rad], that fits best, and whether all is known.

    Vectors that are alike do not tell the turn about them: the least turn that fits is taken.
    """
    turn, rank = Rotation.identity(), 0
    # From the mean of all to the median, on which a few walls have no influence.
    for tolerance in np.geomspace(np.pi, sigma):
        turned = turn.apply(vectors)
        weights = 1.0 / np.maximum(transforms.angle_between(turned, others), tolerance)
        # A small turn q moves each vector v by the part of q across v.
        across = np.eye(3) - turned[:, :, None] * turned[:, None, :]
        rows, values = weights[:, None, None] * across, weights[:, None] * np.cross(turned, others)
        q, _, rank, _ = np.linalg.lstsq(rows.reshape(-1, 3), values.ravel(), rcond=0.1)
        turn = Rotation.from_rotvec(q) * turn
    return turn, bool(rank == 3)


def _is_level_somewhere(view: View, max_tilt: float) -> bool:
    """Whether one of the largest planes of a view with a pose is level."""
    enough = LARGE * np.count_nonzero(view.valid)
    for _ in range(PLANES):
        plane = find_image_plane(view)
        if plane.share == 0.0 or _tilt(view.pose, plane.normal_camera(view.K)) <= max_tilt:
            return plane.share > 0.0
        view = replace(view, depth=np.where(plane.mask(view), np.float32(0.0), view.depth))
        if np.count_nonzero(view.valid) < enough:  # Small planes are level by chance.
            return False
    return False


def _tilt(T_world_camera: Array, normal_camera: Array) -> float:
    """Angle [deg] between a plane's normal and the vertical."""
    return float(np.degrees(transforms.angle_between(transforms.rotate(T_world_camera, normal_camera), UP)))
