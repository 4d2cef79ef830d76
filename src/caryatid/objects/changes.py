"""Change detection: whether a new view shows objects where earlier views showed them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from caryatid.config import Config
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import Change, ChangeKind, SceneObject
from caryatid.objects.fusion import extents_ratio
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.views import Cloud, View
from caryatid.sensing.voxel_map import FREE, OCCUPIED, VoxelMap

DEPTH_MARGIN = 0.02
"""Distance behind a point at which a reading contradicts it [m], at 1.5 m and growing with z²: 2σ of pose
and depth.
"""
PIXEL_MARGIN = 0.01
"""Distance beside a point within which readings count [m]: 2σ of registration, so that a view past a rim does
not contradict it.
"""
CELL = 0.02
"""Edge of the cells in which points count once [m]: nearer points share their errors."""
ERROR_SHARE = 0.2
"""Maximum share of cells that errors contradict on an object that has not moved [1]."""
TINY = 1e-300
"""Minimum probability [1], so that logarithms stay finite."""
PRIOR_ODDS = 7.0
"""Log-odds against a change, before anything is seen: one in a thousand objects changes between two views."""
BEHIND = 2
"""Depth to which earlier views must have looked through the surface of a point [voxels]. A voxel of the
surface itself is half free, and a pose that could not be registered is wrong by a voxel."""
SIZE_TOLERANCE = 0.2
"""Share by which sizes of one object may differ [1], beyond what the fits' uncertainty explains."""


class ChangeDetector:
    """Finds objects that were removed, moved or added between views, and keeps the history of them.

    Attributes:
        history: All changes so far, oldest first.
    """

    def __init__(self) -> None:
        self.history: tuple[Change, ...] = ()
        self._odds: dict[str, float] = {}
        self._lost: dict[str, SceneObject] = {}
        self._unmatched: frozenset[int] = frozenset()

    def copy(self) -> ChangeDetector:
        """Return an independent copy."""
        other = copy.copy(self)
        other._lost = self._lost.copy()
        return other

    def missing(self, view: View, surfaces: Mapping[str, tuple[Array, Array]]) -> dict[str, str]:
        """Find objects whose last known place views up to this one look through: their ids, with the reason.

        Surfaces are points and outward normals (N, 3) of each object.
        """
        sight, missing = Sight(view), dict[str, str]()
        odds, self._odds = self._odds, {}
        for object_id, (points, normals) in surfaces.items():
            through, confirmed = sight.cells(points, normals)
            self._odds[object_id] = max(odds.get(object_id, 0.0) + likelihood_ratio(through, confirmed), 0.0)
            if self._odds[object_id] > PRIOR_ODDS:
                total = through + confirmed
                missing[object_id] = f"{view.name} sees through {through} of {total} points of its surface"
        return missing

    def report(self, change: Change) -> None:
        """Add a change that the robot made; earlier views no longer contradict the object."""
        self._odds = {k: odds for k, odds in self._odds.items() if k != change.object_id}
        self.history = (*self.history, change)

    def lose(self, object_id: str, o: SceneObject | None) -> None:
        """Record an object as missing; its shape helps to find it again."""
        self._odds.pop(object_id, None)
        if o is not None:
            self._lost[object_id] = o

    def found_again(
        self, fits: Mapping[int, SceneObject], new: Mapping[int, str], label_of: Callable[[str], int | None]
    ) -> dict[int, int]:
        """Match new objects with lost ones of the same shape.

        Args:
            fits: Fitted shape of each object, by label.
            new: Labels of the objects that appeared in free space in the newest view.
            label_of: Gives the label of a lost object.

        Returns:
            Label of the new object → label it had before.
        """
        self._unmatched = (self._unmatched | new.keys()) & fits.keys()
        found: dict[int, int] = {}
        for object_id, o in self._lost.items():
            label = label_of(object_id)
            among = [k for k in sorted(self._unmatched - found.keys()) if alike(fits[k], o)]
            if among and label is not None:
                found[min(among, key=lambda k: extents_ratio(fits[k], o))] = label
        self._unmatched -= found.keys()
        return found

    def record(
        self, view: int, missing: Mapping[str, str], appeared: Mapping[str, str], present: set[str]
    ) -> None:
        """Add the changes before a view to the history.

        Args:
            view: Its number.
            missing: Ids of the objects that are not where they were, each with the reason.
            appeared: Ids of the objects that are where space was free, each with the reason.
            present: Ids of all objects; one both lost and present was moved.
        """
        for object_id in sorted(self._lost.keys() | appeared.keys()):
            why = missing.get(object_id) or appeared.get(object_id, "found again")
            if object_id in present:
                kind: ChangeKind = "moved" if self._lost.pop(object_id, None) else "added"
                self.history = (*self.history, Change(kind, object_id, view, why))
            elif object_id in missing:
                self.history = (*self.history, Change("removed", object_id, view, why))


def appeared(
    name: str, points_world: Array, labels: NDArray[np.int32], states: NDArray[np.int8]
) -> dict[int, str]:
    """Find segments that lie where earlier views saw free space.

    Points in unknown space do not count: an object there may be new, or seen for the first time.

    Args:
        name: Name of the view.
        points_world: Points (N, 3) [m] of its segments.
        labels: Segment (N,) of each.
        states: States (N, M) of the voxels around each, from earlier views.

    Returns:
        Labels of these segments, each with the reason.
    """
    free, occupied = (states == FREE).all(axis=1), (states == OCCUPIED).any(axis=1)
    new = dict[int, str]()
    for label in np.unique(labels).tolist():
        own = labels == label
        there, other = distinct(points_world[own & free]), distinct(points_world[own & occupied])
        if likelihood_ratio(there, other) > PRIOR_ODDS:
            new[label] = f"{name} shows {there} of its points where space was free, {other} where not"
    return new


def describe_contradiction(cloud: Cloud, surface: SupportSurface, voxels: VoxelMap, config: Config) -> str:
    """Say how much of what a view shows above the table earlier views looked through; "" if too little.

    They looked through it and into what is behind.

    Args:
        cloud: Points of the view that no change explains.
        surface: The support surface.
        voxels: The map of earlier views.
        config: All settings.
    """
    points, inward = cloud.points_world, -voxels.config.size * cloud.normals_world
    over = surface.height(points) > 2.0 * config.surface.tolerance
    over &= ((points > voxels.origin_world) & (points < voxels.end_world)).all(axis=1)
    points, inward = points[over], inward[over]
    free = [voxels.state_at(points + step * inward) == FREE for step in range(BEHIND + 1)]
    through = np.all(free, axis=0)
    there, other = distinct(points[through]), distinct(points[~through])
    if likelihood_ratio(there, other) <= PRIOR_ODDS:
        return ""
    return f"{through.mean():.0%} of its points above the table are in space that earlier views saw as free"


class Sight:
    """What a view, which has a pose, shows at known points."""

    def __init__(self, view: View) -> None:
        self._view = view
        readings = view.depth[view.depth > 0.0]
        typical = float(np.median(readings)) if len(readings) else 1.0
        self._reach = max(1, round(PIXEL_MARGIN * float(view.K[0, 0]) / typical))
        assert view.T_world_camera is not None
        self._T_camera_world = transforms.invert(view.T_world_camera)

    def cells(self, points_world: Array, normals_world: Array) -> tuple[int, int]:
        """Number of cells of a surface that the view looks through, and that it confirms.

        A point (N, 3) [m] with an outward unit normal (N, 3) is looked through if its reading and all around
        it lie behind it, and confirmed if its own is at its depth. It does not count without a reading, with
        one in front of it, or if it is turned away.
        """
        points = transforms.transform(self._T_camera_world, points_world)
        normals = normals_world @ self._T_camera_world[:3, :3].T
        distance = np.linalg.norm(points, axis=1)
        facing = -np.einsum("ij,ij->i", points, normals) > 0.25 * distance
        height, width = self._view.depth.shape
        z = np.maximum(points[:, 2], 1e-3)
        u, v = np.rint((points @ self._view.K.T)[:, :2] / z[:, None]).astype(np.intp).T
        rows = np.flatnonzero(
            facing & (points[:, 2] > 0.1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        )
        u, v, z = u[rows], v[rows], z[rows]
        beyond = DEPTH_MARGIN * np.maximum(1.0, (z / 1.5) ** 2)
        reading = self._view.depth[v, u]
        confirmed = (reading > 0.0) & (np.abs(reading - z) <= beyond)
        behind = np.flatnonzero(reading > z + beyond)
        around = self._nearest(u[behind], v[behind])
        through = behind[np.isfinite(around) & (around > (z + beyond)[behind])]
        return distinct(points_world[rows[through]]), distinct(points_world[rows[confirmed]])

    def _nearest(self, u: NDArray[np.intp], v: NDArray[np.intp]) -> Array:
        """Nearest reading (N,) [m] around each pixel (N,); infinite if there is none."""
        step = np.arange(-self._reach, self._reach + 1)
        height, width = self._view.depth.shape
        columns = np.clip(u[:, None] + step, 0, width - 1)[:, None, :]
        lines = np.clip(v[:, None] + step, 0, height - 1)[:, :, None]
        depth = self._view.depth[lines, columns]
        return np.asarray(np.where(depth > 0.0, depth, np.inf).min(axis=(1, 2)))


def likelihood_ratio(contradicted: int, confirmed: int) -> float:
    """Log-likelihood ratio of a change, given the number of contradicted and confirmed cells.

    Without a change, errors contradict a share of up to `ERROR_SHARE`; after one the share is larger. Within
    its range, every share is equally likely.
    """
    few = betainc(contradicted + 1, confirmed + 1, ERROR_SHARE)
    many = betainc(confirmed + 1, contradicted + 1, 1.0 - ERROR_SHARE)
    return float(np.log(max(many, TINY) / (1.0 - ERROR_SHARE)) - np.log(max(few, TINY) / ERROR_SHARE))


def distinct(points_world: Array) -> int:
    """Number of cells that hold points (N, 3) [m]."""
    cells = np.floor(points_world / CELL).astype(np.int64) + (1 << 20)
    return len(np.unique(cells @ np.array([1 << 42, 1 << 21, 1])))


def alike(a: SceneObject, b: SceneObject) -> bool:
    """Whether two shapes, wherever they are, can be those of one object, by kind and sizes."""
    return a.shape.kind == b.shape.kind and extents_ratio(a, b) <= 1.0 + SIZE_TOLERANCE
