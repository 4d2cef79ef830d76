from __future__ import annotations

import numpy as np
import pytest

from caryatid.geometry.ranks import quantile, select


@pytest.mark.parametrize("values", [2, 30, 10_000])
@pytest.mark.parametrize("count", [1, 2, 7, 200])
def test_ranks_are_those_of_numpy(count, values):
    """Of numbers some of which are equal, and of all different ones."""
    numbers = np.random.default_rng(count).integers(0, values, count) / 7.0
    for rank in {0, count // 3, count // 2, count - 1}:
        mixed = numbers.copy()
        assert select(mixed, rank) == np.sort(numbers)[rank]
        assert (mixed[:rank] <= mixed[rank]).all()
        assert (mixed[rank:] >= mixed[rank]).all()
        np.testing.assert_array_equal(np.sort(mixed), np.sort(numbers))


@pytest.mark.parametrize("count", [1, 2, 7, 200])
def test_quantiles_are_those_of_numpy(count):
    numbers = np.random.default_rng(count).normal(size=count)
    for share in (0.0, 0.005, 0.31, 0.5, 0.995, 1.0):
        assert quantile(numbers.copy(), share) == pytest.approx(np.quantile(numbers, share))


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_do_not_keep_it_busy(odd):
    for seed in range(50):
        rng = np.random.default_rng(seed)
        numbers = np.where(rng.random(40) < 0.3, odd, rng.normal(size=40))
        select(numbers, int(rng.integers(40)))
    select(np.full(5, odd), 2)
