"""What it costs to explain points by shapes: residuals over noise, free space inside, a price an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import ExplanationConfig, FitConfig
from caryatid.fitting import explaining as kernels
from caryatid.fitting.free_space import free_inside
from caryatid.fitting.primitives import Oriented, candidates
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.sensing.clouds import thin
from caryatid.sensing.views import Cloud
from caryatid.sensing.voxel_map import VoxelMap


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """Oriented points of the objects to be explained, and what is known of the space around them.

    Attributes:
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        weights: Independent readings each point stands for (N,) [1].
        noise: Standard deviation of the points from the surfaces they are on [m].
        voxels: Space seen free, or None where nothing is known.
    """

    points: Array
    normals: Array
    weights: Array
    noise: float
    voxels: VoxelMap | None

    def select(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> Evidence:
        """Return the evidence of some of the points, by a mask (N,) or indices (M,)."""
        return replace(self, points=self.points[kept], normals=self.normals[kept], weights=self.weights[kept])


def gather(cloud: Cloud, noise: float, voxels: VoxelMap | None, config: ExplanationConfig) -> Evidence:
    """Thin an object's points to evidence: a place counts once, as all that is seen there errs alike.

    Args:
        cloud: Points of one object, oriented.
        noise: How far readings are off [m].
        voxels: What is known to be free, or None.
        config: Sizes and prices.
    """
    return evidence_of(cloud.select(thin(cloud.points_world, config.spacing)), noise, voxels, config)


def evidence_of(cloud: Cloud, noise: float, voxels: VoxelMap | None, config: ExplanationConfig) -> Evidence:
    """Take points that are thinned already for evidence.

    Args:
        cloud: Points of one object, oriented.
        noise: How far readings are off [m].
        voxels: What is known to be free, or None.
        config: Sizes and prices.
    """
    weights = np.full(len(cloud), config.spacing**2 / config.reading)
    return Evidence(cloud.points_world, cloud.normals_world, weights, noise, voxels)


@dataclass(frozen=True, eq=False, slots=True)
class Explanation:
    """The best shape for some points.

    Attributes:
        shape: The shape, or None where none could be fitted, or the points are better left without one.
        cost: Cost of all the points and of the object itself [nats].
    """

    shape: Shape | None
    cost: float


def price(shape: Shape | None, config: ExplanationConfig) -> float:
    """Price [nats] of an object: of the parameters of its shape; an irregular one has as many as a box."""
    return config.parameter_cost * (9 if shape is None else shape.parameters)


def point_costs(shape: Shape, evidence: Evidence, config: ExplanationConfig) -> Array:
    """Cost (N,) [nats] of each point as one of a shape's surface, before its weight."""
    return np.asarray(
        kernels.point_costs(
            *Primitives.of([shape]).row(0),
            evidence.points,
            evidence.normals,
            evidence.noise,
            config.normal_weight,
            config.outlier,
        )
    )


def free_cost(shape: Shape, evidence: Evidence, config: ExplanationConfig) -> float:
    """Cost [nats] of the space seen free that a shape fills."""
    if evidence.voxels is None:
        return 0.0
    inset = max(config.inset * evidence.voxels.config.size, 3.0 * evidence.noise)
    return config.free_cost * free_inside(shape, evidence.voxels, inset)[1]


def shape_cost(shape: Shape, evidence: Evidence, config: ExplanationConfig) -> float:
    """Cost [nats] of points explained by one shape, without the price of an object."""
    costs = point_costs(shape, evidence, config)
    return float(costs @ evidence.weights) + free_cost(shape, evidence, config)


def explained_by(shape: Shape, evidence: Evidence, config: ExplanationConfig) -> Explanation:
    """Explain points by a given shape, or as an irregular object where that costs less."""
    irregular = config.irregular * float(evidence.weights.sum())
    cost = shape_cost(shape, evidence, config)
    regular = Explanation(shape, cost + price(shape, config))
    left = Explanation(None, irregular + price(None, config))
    return min(regular, left, key=lambda e: e.cost)


def explain(
    parts: Sequence[Evidence],
    config: ExplanationConfig,
    fit_config: FitConfig,
    rngs: Sequence[np.random.Generator],
) -> list[Explanation]:
    """Find the shape that explains points at the least cost, for each of several objects at once.

    An irregular object has a price of its own.

    Args:
        parts: Their points.
        config: What explanations cost.
        fit_config: Settings of the fits.
        rngs: Source of the samples of each.
    """
    fits = candidates([Oriented(e.points, e.normals) for e in parts], config=fit_config, rngs=rngs)
    best = []
    for evidence, found in zip(parts, fits, strict=True):
        irregular = Explanation(None, config.irregular * float(evidence.weights.sum()) + price(None, config))
        costs = (shape_cost(f.shape, evidence, config) + price(f.shape, config) for f in found)
        regular = (Explanation(f.shape, cost) for f, cost in zip(found, costs, strict=True))
        best.append(min([irregular, *regular], key=lambda e: e.cost))
    return best


def first_look(fit_config: FitConfig, config: ExplanationConfig) -> FitConfig:
    """Settings of fits that only tell what is worth a full one."""
    return replace(
        fit_config,
        hypotheses=config.hypotheses,
        polish=1,
        steps=config.steps,
        max_points=config.sample,
    )


def joined(a: Evidence, b: Evidence) -> Evidence:
    """Put the evidence of two objects together; noise and space are the same for both."""
    return replace(
        a,
        points=np.concatenate([a.points, b.points]),
        normals=np.concatenate([a.normals, b.normals]),
        weights=np.concatenate([a.weights, b.weights]),
    )


def around(points: Array, neighbours: int) -> NDArray[np.intp]:
    """Indices (N, K) of each point's nearest neighbours among points (N, 3), itself among them."""
    count = min(neighbours, len(points))
    if not count:
        return np.zeros((len(points), 0), dtype=np.intp)
    return np.asarray(cKDTree(points).query(points, np.arange(1, count + 1))[1])


def border_cost(
    second: NDArray[np.bool_], evidence: Evidence, near: NDArray[np.intp], config: ExplanationConfig
) -> tuple[float, float]:
    """Cost [nats] of a border between two objects where the surface goes on without a concave crease.

    Args:
        second: Which points (N,) belong to the second object.
        evidence: The points of both.
        near: Each point's nearest neighbours (N, K), as of `around`.
        config: What counts as a crease, and the price.

    Returns:
        The cost, and the share of the border without a crease; nothing where they have no border.
    """
    count = near.shape[1]
    row, col = np.repeat(np.arange(len(second)), count), near.ravel()
    across = second[row] != second[col]
    row, col = row[across], col[across]
    between = evidence.points[col] - evidence.points[row]
    turn = evidence.normals[col] - evidence.normals[row]
    bend = np.einsum("ij,ij->i", turn, between) / np.maximum(np.linalg.norm(between, axis=1), 1e-9)
    flat = bend > -np.sin(np.radians(config.crease))
    length = evidence.weights[row] / count
    smooth = float(length[flat].sum())
    return config.border * smooth, smooth / max(float(length.sum()), 1e-12)


def lies_on(shape: Shape, points: Array, config: ExplanationConfig) -> bool:
    """Whether most points (N, 3) lie so near a shape's surface [m], or in it, that they may be of it."""
    near = shape.signed_distance(points) < config.layer
    return float(near.mean()) >= config.layer_share
