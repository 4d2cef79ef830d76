"""Laying views onto each other: point-to-plane matching between views, the reported poses as priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid import frames
from caryatid.config import RegistrationConfig
from caryatid.frames import Array
from caryatid.surfels import Surfels, even_sample


@dataclass(frozen=True, eq=False, slots=True)
class RegisteredView:
    """One view as registration keeps it.

    Attributes:
        surfels: Its patches, in the world as reported.
        sample: Indices of the patches that look for partners in other views.
        tree: Finds the patch nearest in place, direction and label.
        information: Inverse covariance (6, 6) of the reported pose's error, as a twist about the pivot.
    """

    surfels: Surfels
    sample: NDArray[np.intp]
    tree: cKDTree
    information: Array

    @classmethod
    def of(
        cls, surfels: Surfels, viewpoint_world: Array | None, pivot_world: Array, config: RegistrationConfig
    ) -> RegisteredView:
        """Prepare a view.

        Args:
            surfels: Its patches.
            viewpoint_world: Where the camera was (3,) [m], which errors of orientation turn about, or None.
            pivot_world: What twists turn about (3,) [m].
            config: Expected errors and the size of the sample.
        """
        arm = np.zeros(3) if viewpoint_world is None else viewpoint_world - pivot_world
        at_camera = np.eye(6)
        at_camera[:3, 3:] = -frames.skew(arm)
        sigma = np.repeat([config.translation, np.radians(config.rotation)], 3)
        information = at_camera.T @ (at_camera / sigma[:, None] ** 2)
        sample = even_sample(surfels, config.sample)
        tree = cKDTree(_features(surfels.points_world, surfels.normals_world, surfels.labels, config))
        return cls(surfels, sample, tree, information)


@dataclass(frozen=True, eq=False, slots=True)
class Matches:
    """Patches of one view and their partners in another, each in its view's world as reported.

    Attributes:
        moving: The view that looked for partners.
        still: The view they are in.
        points: (N, 3) [m], of the moving view.
        normals: Unit normals (N, 3) of the moving view.
        partners: (N, 3) [m].
        partner_normals: (N, 3).
        variance: Of the distance between partners (N,) [m²].
    """

    moving: int
    still: int
    points: Array
    normals: Array
    partners: Array
    partner_normals: Array
    variance: Array


@dataclass(frozen=True, eq=False, slots=True)
class Solution:
    """Where views are, after some rounds.

    Attributes:
        twists: Move (V, 6) of each view from where it was reported: 3 × m, 3 × rad, about the pivot.
        hessian: Inverse covariance (6·F, 6·F) of the free views' twists, the reports among the evidence.
    """

    twists: Array
    hessian: Array


def twist_transform(twist: Array, pivot_world: Array) -> Array:
    """The rigid transform (4, 4) that turns about a pivot (3,) [m] and moves: twist = [3 × m, 3 × rad]."""
    R = frames.rotation_from_vector(twist[3:])
    return frames.rigid(R, pivot_world - R @ pivot_world + twist[:3])


def match(
    views: Sequence[RegisteredView],
    moving: int,
    still: int,
    T: Sequence[Array],
    reach: float,
    config: RegistrationConfig,
) -> Matches:
    """Find the partners of a view's sample in another view.

    Args:
        views: All views.
        moving: Whose sample looks for partners.
        still: In which view.
        T: Move (4, 4) of each view from where it was reported.
        reach: How far away a partner may be [m].
        config: How much directions may differ.
    """
    a, b = views[moving], views[still]
    T_still_moving = frames.invert(T[still]) @ T[moving]
    points, normals = a.surfels.points_world[a.sample], a.surfels.normals_world[a.sample]
    there, facing = frames.transform(T_still_moving, points), frames.rotate(T_still_moving, normals)
    labels = a.surfels.labels[a.sample]
    bound = np.hypot(reach, config.normal_reach * np.sqrt(2.0 - 2.0 * config.min_cosine))
    gap, partner = b.tree.query(_features(there, facing, labels, config), distance_upper_bound=bound)
    found = np.flatnonzero(np.isfinite(gap))
    partner = partner[found]
    near = np.linalg.norm(there[found] - b.surfels.points_world[partner], axis=1) < reach
    near &= np.sum(facing[found] * b.surfels.normals_world[partner], axis=1) > config.min_cosine
    found, partner = found[near], partner[near]
    return Matches(
        moving,
        still,
        points[found],
        normals[found],
        b.surfels.points_world[partner],
        b.surfels.normals_world[partner],
        a.surfels.variance[a.sample[found]] + b.surfels.variance[partner] + config.noise**2,
    )


def solve(
    views: Sequence[RegisteredView],
    pairs: Sequence[Matches],
    twists: Array,
    free: Sequence[int],
    pivot_world: Array,
    outlier: float,
    config: RegistrationConfig,
) -> Solution:
    """Move the free views such that partners come to lie in each other's planes.

    Gauss–Newton on the robust, symmetric point-to-plane distance, maximum a posteriori.

    Args:
        views: All views.
        pairs: Their partners.
        twists: Where the views are (V, 6).
        free: The views that may move.
        pivot_world: What twists turn about (3,) [m].
        outlier: Distance beyond which partners lose their weight [m].
        config: Noise and rounds.
    """
    column = {v: 6 * k for k, v in enumerate(free)}
    for _ in range(config.steps):
        T = [twist_transform(t, pivot_world) for t in twists]
        hessian = np.zeros((6 * len(free), 6 * len(free)))
        gradient = np.zeros(6 * len(free))
        for v, k in column.items():
            hessian[k : k + 6, k : k + 6] += views[v].information
            gradient[k : k + 6] += views[v].information @ twists[v]
        for pair in pairs:
            residual, jacobians = _linearised(pair, T, pivot_world)
            weight = config.independent / pair.variance / (1.0 + (residual / outlier) ** 2) ** 2
            for v, J in jacobians.items():
                if v not in column:
                    continue
                gradient[column[v] : column[v] + 6] += J.T @ (weight * residual)
                for w, other in jacobians.items():
                    if w in column:
                        block = np.s_[column[v] : column[v] + 6, column[w] : column[w] + 6]
                        hessian[block] += J.T @ (weight[:, None] * other)
        step = -np.linalg.solve(hessian, gradient).reshape(-1, 6)
        if np.abs(step).max(initial=0.0) < config.converged:
            break
        twists = twists.copy()
        twists[list(free)] += step
    return Solution(twists, hessian)


def misfit(
    pairs: Sequence[Matches], asked: int | None, twists: Array, pivot_world: Array, outlier: float
) -> float:
    """Mean distance [m] of partners from each other's planes, none counting more than an outlier.

    Args:
        pairs: The partners.
        asked: How many patches looked for a partner: those that found none count as outliers; None =
            only those that found one count.
        twists: Where the views are (V, 6).
        pivot_world: What twists turn about (3,) [m].
        outlier: The largest distance that counts [m].
    """
    T = [twist_transform(t, pivot_world) for t in twists]
    distances = [np.minimum(np.abs(_linearised(pair, T, pivot_world)[0]), outlier) for pair in pairs]
    found = sum(len(d) for d in distances)
    asked = found if asked is None else asked
    return float(sum(d.sum() for d in distances) + (asked - found) * outlier) / max(asked, 1)


def _linearised(pair: Matches, T: Sequence[Array], pivot_world: Array) -> tuple[Array, dict[int, Array]]:
    """Distances (N,) [m] of partners along their normal, and derivatives (N, 6) by each view's twist."""
    p, q = frames.transform(T[pair.moving], pair.points), frames.transform(T[pair.still], pair.partners)
    n = frames.rotate(T[pair.moving], pair.normals) + frames.rotate(T[pair.still], pair.partner_normals)
    n = frames.unit(n)
    residual = np.sum((p - q) * n, axis=1)
    return residual, {
        pair.moving: np.concatenate([n, np.cross(p - pivot_world, n)], axis=1),
        pair.still: -np.concatenate([n, np.cross(q - pivot_world, n)], axis=1),
    }


def _features(points: Array, normals: Array, labels: NDArray[np.int32], config: RegistrationConfig) -> Array:
    """Place (N, 7) in which partners are near each other: equal labels, near in place and direction."""
    apart = labels.astype(np.float64)[:, None]
    return np.concatenate([points, config.normal_reach * normals, apart], axis=1)
