"""Description length: what it costs to explain points by shapes, in nats. The least cost decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ExplanationConfig, FitConfig
from caryatid.fitting.primitives import Oriented, candidates, free_inside
from caryatid.geometry.shapes import Box, Primitives, Shape
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
    distance, outward = Primitives.of([shape]).gradient(0, evidence.points)
    turned = 1.0 - np.einsum("ij,ij->i", outward, evidence.normals)
    cost = distance**2 / (2.0 * evidence.noise**2) + config.normal_weight * turned
    return np.minimum(cost, config.outlier)


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
    parts: Sequence[Evidence],
    config: ExplanationConfig,
    fit_config: FitConfig,
    rngs: Sequence[np.random.Generator],
    *,
    first_look: bool = False,
) -> list[Explanation]:
    """Find the shape that explains points at the least cost, for each of several objects at once.

    Args:
        parts: Their points.
        config: What explanations cost.
        fit_config: Settings of the fits.
        rngs: Source of the samples of each.
        first_look: A quick fit will do, which only tells what is worth a full one.
    """
    quick = replace(fit_config, hypotheses=10, polish=1, steps=6, max_points=150)
    full = replace(fit_config, polish=1, search_points=fit_config.max_points)
    oriented = [Oriented(e.points, e.normals) for e in parts]
    fits = candidates(oriented, config=quick if first_look else full, rngs=rngs, whole=False)
    return [
        best_explanation([f.shape for f in found], evidence, config)
        for evidence, found in zip(parts, fits, strict=True)
    ]
