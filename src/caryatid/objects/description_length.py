"""Description length: what it costs to explain points by shapes, in nats. The least cost decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import ExplanationConfig, FitConfig
from caryatid.fitting.primitives import candidates, free_inside
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.signed_distance import gradient, local
from caryatid.geometry.transforms import Array
from caryatid.sensing.voxel_map import VoxelMap


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """Oriented points of the objects to be explained, and what is known of the space around them.

    Attributes:
        points: (N, 3) [m], thinned: a place counts once, as all that is seen there errs alike.
        normals: Unit normals (N, 3).
        weight: Independent readings each point stands for [1].
        noise: Standard deviation of the points from the surfaces they are on [m].
        voxels: Space seen free, or None where nothing is known.
    """

    points: Array
    normals: Array
    weight: float
    noise: float
    voxels: VoxelMap | None

    def __len__(self) -> int:
        return len(self.points)

    def select(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> Evidence:
        """Return the evidence of some of the points, by a mask (N,) or indices (M,)."""
        return replace(self, points=self.points[kept], normals=self.normals[kept])

    def joined(self, other: Evidence) -> Evidence:
        """Return the evidence of two objects together; noise and space are the same for both."""
        points = np.concatenate([self.points, other.points])
        return replace(self, points=points, normals=np.concatenate([self.normals, other.normals]))


@dataclass(frozen=True, eq=False, slots=True)
class Explanation:
    """The best shape for some points.

    Attributes:
        shape: The shape, or None where the points cost less as an irregular object.
        cost: Cost of all the points and of the object itself [nats].
    """

    shape: Shape | None
    cost: float


def price(shape: Shape | None, config: ExplanationConfig) -> float:
    """Price [nats] of an object: of the parameters of its shape; an irregular one has as many as a box."""
    return config.parameter_cost * (Box if shape is None else shape).parameters


def point_costs(shape: Shape | None, evidence: Evidence, config: ExplanationConfig) -> Array:
    """Cost (N,) [nats] of each point on a shape, or on an irregular object, before its weight."""
    if shape is None:
        return np.full(len(evidence), config.irregular)
    costs: Array = _point_costs(
        shape.code, shape.T_world_object, shape.extents / 2.0, evidence.points, evidence.normals,
        evidence.noise, config.normal_weight, config.outlier,
    )  # fmt: skip
    return costs


@njit(cache=True, error_model="numpy", nogil=True)
def _point_costs(kind, T, half, points, normals, noise, normal_weight, outlier):  # type: ignore[no-untyped-def]
    costs, hx, hy, hz = np.empty(len(points)), half[0], half[1], half[2]
    centre, origin = T[:3, 3], np.zeros(3)
    for i in range(len(points)):
        x, y, z = local(T, centre, points, i)
        distance, gx, gy, gz = gradient(kind, x, y, z, hx, hy, hz)
        u, v, w = local(T, origin, normals, i)
        turned = 1.0 - (gx * u + gy * v + gz * w)
        costs[i] = min(distance**2 / (2.0 * noise**2) + normal_weight * turned, outlier)
    return costs


def best_explanation(shapes: Sequence[Shape], evidence: Evidence, config: ExplanationConfig) -> Explanation:
    """Explain points by one of some shapes, or as an irregular object, whichever costs least."""
    found = [Explanation(shape, _cost(shape, evidence, config)) for shape in (None, *shapes)]
    return min(found, key=lambda e: e.cost)


def _cost(shape: Shape | None, evidence: Evidence, config: ExplanationConfig) -> float:
    """Cost [nats] of points as one object: of the points, the space seen free inside it, and its price."""
    cost = float(point_costs(shape, evidence, config).sum()) * evidence.weight
    if shape is not None and evidence.voxels is not None:
        # A surface voxel may be half free.
        inset = max(1.2 * evidence.voxels.config.size, 3.0 * evidence.noise)
        cost += config.free_cost * free_inside(shape, evidence.voxels, inset)[1]
    return cost + price(shape, config)


def explain(
    evidence: Evidence,
    config: ExplanationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
    *,
    first_look: bool = False,
) -> Explanation:
    """Find the shape that explains points at the least cost.

    Args:
        evidence: The points.
        config: What explanations cost.
        fit_config: Settings of the fits.
        rng: Source of the samples.
        first_look: A quick fit will do, which only tells what is worth a full one.
    """
    settings = replace(fit_config, polish=1, search_points=fit_config.max_points)
    if first_look:
        settings = replace(fit_config, polish=1, hypotheses=10, steps=6, max_points=150)
    fits = candidates(evidence.points, evidence.normals, config=settings, rng=rng, whole=False)
    return best_explanation([f.shape for f in fits], evidence, config)
