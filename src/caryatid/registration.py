"""Refining a view's pose against the map: point-to-plane ICP, the expected registration error as prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from caryatid import frames
from caryatid.config import RegistrationConfig
from caryatid.frames import Array
from caryatid.views import Cloud


@dataclass(frozen=True, eq=False, slots=True)
class Alignment:
    """How a view was moved onto the map.

    Attributes:
        twist: Translation [m] and rotation vector [rad] about the pivot (6,), zero where it was refused.
        pivot_world: What it turns about (3,) [m].
        residual_before: Robust mean distance [m] of matched points to the map's planes.
        residual_after: The same once moved.
        matched: Points that found a partner.
    """

    twist: Array
    pivot_world: Array
    residual_before: float
    residual_after: float
    matched: int

    @property
    def T(self) -> Array:
        """The move (4, 4) of the world."""
        return twist_transform(self.twist, self.pivot_world)


def align(cloud: Cloud, known: Cloud, pivot_world: Array, config: RegistrationConfig) -> Alignment:
    """Find the small move that lays a view's points onto the map's surfaces.

    Maximum a posteriori: squared point-to-plane distances against the expected registration error, so that
    what the overlap does not determine stays as reported. Refused, that is zero, where too few points
    match, where the move is beyond the limits or betters nothing, or where the view fits as reported.

    Args:
        cloud: The new view, in the world as reported; with labels, only equal labels are matched.
        known: The map's points.
        pivot_world: What rotations turn about (3,) [m]; best amid the points.
        config: Expected errors and limits.
    """
    tree = cKDTree(known.points_world)
    twist = np.zeros(6)
    first = last = np.inf
    count = 0
    prior = np.diag(np.repeat([1.0 / config.translation**2, 1.0 / np.radians(config.rotation) ** 2], 3))
    for iteration in range(config.iterations):
        T = twist_transform(twist, pivot_world)
        points = frames.transform(T, cloud.points_world)
        normals = frames.rotate(T, cloud.normals_world)
        gap, partner = tree.query(points, distance_upper_bound=config.reach)
        matched = np.flatnonzero(np.isfinite(gap))
        partner = partner[matched]
        agree = np.sum(normals[matched] * known.normals_world[partner], axis=1) > config.min_cosine
        if cloud.labels is not None and known.labels is not None:
            agree &= cloud.labels[matched] == known.labels[partner]
        matched, partner = matched[agree], partner[agree]
        if len(matched) < config.min_points:
            return Alignment(np.zeros(6), pivot_world, 0.0, 0.0, len(matched))
        n = known.normals_world[partner]
        residual = np.sum((points[matched] - known.points_world[partner]) * n, axis=1)
        last = float(np.minimum(np.abs(residual), config.outlier).mean())
        if iteration == 0:
            first, count = last, len(matched)
            if first < config.exact:
                return Alignment(np.zeros(6), pivot_world, first, first, count)
        weight = 1.0 / (1.0 + (residual / config.outlier) ** 2) ** 2 / config.noise**2
        J = np.concatenate([n, np.cross(points[matched] - pivot_world, n)], axis=1)
        H = J.T @ (weight[:, None] * J) + prior
        step = -np.linalg.solve(H, J.T @ (weight * residual) + prior @ twist)
        twist = twist + step
        if np.abs(step[:3]).max() < 1e-5 and np.abs(step[3:]).max() < 1e-5:
            break
    too_far = np.linalg.norm(twist[:3]) > config.max_translation
    too_far |= np.linalg.norm(twist[3:]) > np.radians(config.max_rotation)
    if too_far or last > first:
        return Alignment(np.zeros(6), pivot_world, first, first, count)
    return Alignment(twist, pivot_world, first, last, count)


def twist_transform(twist: Array, pivot_world: Array) -> Array:
    """The rigid transform (4, 4) that turns about a pivot (3,) [m] and moves: twist = [3 × m, 3 × rad]."""
    R = frames.rotation_from_vector(twist[3:])
    return frames.rigid(R, pivot_world - R @ pivot_world + twist[:3])
