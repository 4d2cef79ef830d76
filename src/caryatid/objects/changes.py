"""Whether objects are still where they were: what a new view should show of them against what it shows."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import minimum_filter
from scipy.special import betainc

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject
from caryatid.sensing.views import View

BEYOND = 0.02
"""How far behind a point a reading contradicts it [m] at 1.5 m, and times z²: 2σ of pose and depth."""
ASIDE = 0.01
"""How far aside of a point readings are looked at [m]: 2σ of registration; rims are seen past otherwise."""
CELL = 0.02
"""Edge of the cells in which points count once [m]: what is nearer errs alike."""
ERRS = 0.2
"""Share of the cells of an object up to which errors contradict them though it stayed where it was [1]."""
TINY = 1e-300
"""What probabilities are cut at [1]: their logarithm stays finite."""
ODDS = 7.0
"""Log-odds against a change, before anything is seen: one in a thousand objects changes between two views."""
ALIKE = 0.2
"""Share by which sizes of one object may differ [1], beyond what the fits' uncertainty explains."""


class Sight:
    """What a view shows at points known from earlier ones.

    Args:
        view: A view with a pose.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        depth = np.where(view.depth > 0.0, view.depth, np.inf)
        typical = float(np.median(depth[np.isfinite(depth)])) if np.isfinite(depth).any() else 1.0
        reach = max(1, round(ASIDE * float(view.K[0, 0]) / typical))
        self._nearest = minimum_filter(depth, 2 * reach + 1)
        assert view.T_world_camera is not None
        self._T_camera_world = transforms.invert(view.T_world_camera)

    def cells(self, points_world: Array, normals_world: Array) -> tuple[int, int]:
        """How many cells of a surface the view looks through, and how many it confirms.

        A point is looked through where all readings around it lie behind it, and confirmed where its own is
        at its depth; where one lies before it, or it is turned away, it says nothing.

        Args:
            points_world: (N, 3) [m].
            normals_world: Outward unit normals (N, 3).
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
        beyond = BEYOND * np.maximum(1.0, (z / 1.5) ** 2)
        nearest, reading = self._nearest[v, u], self._view.depth[v, u]
        through = np.isfinite(nearest) & (nearest > z + beyond)
        confirmed = (reading > 0.0) & (np.abs(reading - z) <= beyond)
        return distinct(points_world[rows[through]]), distinct(points_world[rows[confirmed]])


def likelihood_ratio(contradicted: int, confirmed: int) -> float:
    """Log of how much likelier cells are contradicted so often after a change than without one.

    Without one a share of up to `ERRS` of them is, after one a larger share; any such share is as likely.
    """
    few = betainc(contradicted + 1, confirmed + 1, ERRS)
    many = betainc(confirmed + 1, contradicted + 1, 1.0 - ERRS)
    return float(np.log(max(many, TINY) / (1.0 - ERRS)) - np.log(max(few, TINY) / ERRS))


def distinct(points_world: Array) -> int:
    """How many cells hold points (N, 3) [m]."""
    return len(np.unique(np.floor(points_world / CELL), axis=0))


def alike(a: SceneObject, b: SceneObject) -> bool:
    """Whether two shapes, wherever they are, can be those of one object, by kind and sizes."""
    if a.shape.kind != b.shape.kind:
        return False
    order = [np.argsort(o.shape.extents, kind="stable") for o in (a, b)]
    unsure = [np.zeros(3) if o.uncertainty is None else 2.0 * o.uncertainty.sizes for o in (a, b)]
    first, second = (o.shape.extents[rows] for o, rows in zip((a, b), order, strict=True))
    excess = np.abs(first - second) - np.hypot(*(u[rows] for u, rows in zip(unsure, order, strict=True)))
    return bool((excess <= ALIKE * np.minimum(first, second)).all())
