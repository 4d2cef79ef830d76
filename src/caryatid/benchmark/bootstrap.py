"""How sure a mean over scenes is: the percentile bootstrap (Efron and Tibshirani 1993, chapter 13)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from caryatid.geometry.transforms import Array


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure and the interval it lies in.

    Attributes:
        value: The figure; infinite where it is a threshold that was not reached.
        low: Lower end of the interval, or None where fewer than two scenes tell nothing of it.
        high: Upper end, or None.
    """

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def excludes_zero(self) -> bool:
        """Whether the whole interval lies on one side of 0."""
        return self.low is not None and self.high is not None and (self.low > 0.0 or self.high < 0.0)


@dataclass(frozen=True, slots=True)
class Bootstrap:
    """Resamples of scenes; the same for every figure over as many scenes, whatever is asked first.

    Attributes:
        seed: Of the resamples.
        resamples: How many.
        confidence: Probability with which an interval covers the true mean [1].
    """

    seed: int
    resamples: int
    confidence: float

    def means(self, values: Array) -> Array:
        """Mean over the scenes, and over every resample of them.

        Args:
            values: One figure a scene (S, ...); NaN where a scene has none.

        Returns:
            Means (1 + resamples, ...), the scenes themselves first; NaN where no scene has a figure.
        """
        count = len(values)
        shape = (1 + self.resamples, *values.shape[1:])
        if count == 0:
            return np.full(shape, np.nan)
        weights = _weights(self.seed, count, self.resamples)
        flat = values.reshape(count, -1)
        known = np.isfinite(flat)
        total = weights @ np.where(known, flat, 0.0)
        number = weights @ known.astype(np.float64)
        means = np.divide(total, number, out=np.full_like(total, np.nan), where=number > 0.0)
        return means.reshape(shape)

    def estimate(self, figures: Array, scenes: int) -> Estimate:
        """The figure of the scenes, with the interval its resamples span.

        Args:
            figures: Of the scenes and of each resample (1 + resamples,), made of what `means` returns;
                infinite where a threshold is not reached.
            scenes: How many there are.
        """
        drawn = np.sort(figures[1:][~np.isnan(figures[1:])])
        if scenes < 2 or len(drawn) == 0:
            return Estimate(float(figures[0]))
        tail = (1.0 - self.confidence) / 2.0 * (len(drawn) - 1)
        low, high = drawn[math.floor(tail)], drawn[len(drawn) - 1 - math.floor(tail)]
        return Estimate(float(figures[0]), float(low), float(high))


@lru_cache(maxsize=16)
def _weights(seed: int, count: int, resamples: int) -> Array:
    """How often each scene is in each resample (1 + resamples, count); in the first row once each."""
    drawn = np.random.default_rng((seed, count)).multinomial(
        count, np.full(count, 1.0 / count), size=resamples
    )
    weights = np.concatenate([np.ones((1, count)), drawn])
    weights.flags.writeable = False
    return weights
