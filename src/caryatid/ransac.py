"""The one RANSAC loop: many hypotheses drawn and scored at once, MSAC score, early stop by confidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from caryatid.frames import Array

H = TypeVar("H")
BATCH = 25
"""Hypotheses drawn between two looks at the stopping rule."""


class Model(Protocol[H]):
    """What RANSAC needs to know of a model; `H` holds many hypotheses at once."""

    @property
    def sample_size(self) -> int:
        """Oriented points that determine a hypothesis."""
        ...

    def estimate(self, samples: NDArray[np.intp], points: Array, normals: Array) -> H:
        """Make hypotheses from samples (B, sample_size) of indices into points (N, 3), normals (N, 3)."""
        ...

    def distances(self, hypotheses: H, points: Array) -> Array:
        """Unsigned distance (B, N) [m] of points (N, 3) to each hypothesis; infinite for an invalid one."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Ranked:
    """One drawn hypothesis.

    Attributes:
        sample: The indices (sample_size,) it was made from.
        cost: Mean truncated squared distance in units of the threshold: 0 perfect, 1 no inlier.
        inliers: Share of the points within the threshold.
    """

    sample: NDArray[np.intp]
    cost: float
    inliers: float


def ransac(
    points: Array,
    normals: Array,
    model: Model[H],
    *,
    threshold: float,
    hypotheses: int,
    confidence: float,
    keep: int,
    rng: np.random.Generator,
) -> list[Ranked]:
    """Draw hypotheses from oriented points and return the `keep` best by MSAC, the best first.

    Args:
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        model: Makes hypotheses from samples and measures distances to them.
        threshold: Distance at which the cost is truncated [m].
        hypotheses: How many are drawn at the most.
        confidence: Stop once a sample of inliers has been drawn with this probability.
        keep: How many to return; fewer where fewer are valid, an empty list where none is.
        rng: Source of the samples.
    """
    count = len(points)
    ranked: list[Ranked] = []
    if count < model.sample_size:
        return ranked
    drawn = 0
    while drawn < hypotheses:
        batch = min(BATCH, hypotheses - drawn)
        samples = rng.integers(0, count, size=(batch, model.sample_size))
        distance = model.distances(model.estimate(samples, points, normals), points)
        cost = np.minimum((distance / threshold) ** 2, 1.0).mean(axis=1)
        inliers = (distance < threshold).mean(axis=1)
        drawn += batch
        ranked += [
            Ranked(samples[b], float(cost[b]), float(inliers[b])) for b in range(batch) if inliers[b] > 0.0
        ]
        ranked = sorted(ranked, key=lambda r: r.cost)[:keep]
        if ranked and drawn >= _enough(ranked[0].inliers, model.sample_size, confidence, keep):
            break
    return ranked


def _enough(inliers: float, sample_size: int, confidence: float, keep: int) -> float:
    """Draws after which `keep` samples of inliers alone have been seen with the given confidence."""
    hit = inliers**sample_size
    return keep * np.log(1.0 - confidence) / np.log(1.0 - min(max(hit, 1e-9), 1.0 - 1e-9))
