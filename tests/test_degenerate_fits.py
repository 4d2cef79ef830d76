"""Fits of points that determine no shape, or are no numbers: no exception, no warning, nothing infinite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import surface_points
from test_primitives import CONFIG, SHAPES, fits_of, heap, same

from caryatid.fitting.primitives import Fit, FitFailure, Oriented, fit
from caryatid.geometry import transforms

COUNT = 60
UP = np.tile((0.0, 0.0, 1.0), (COUNT, 1))


CLOUD = np.random.default_rng(0).uniform(-0.05, 0.05, (COUNT, 3))
NUMBER = np.arange(COUNT)[:, None]
POINTS = {
    "a spot": np.full((COUNT, 3), 0.3),
    "a line": 0.1 / COUNT * NUMBER * (1.0, 0.5, 0.2),
    "a line along the normals": 0.1 / COUNT * NUMBER * (0.0, 0.0, 1.0),
    "a plane": CLOUD * (1.0, 1.0, 0.0),
    "a plane along the normals": CLOUD * (0.0, 1.0, 1.0),
    "a cloud": CLOUD,
    "a kilometre away": CLOUD + 1000.0,
    "kilometres wide": 1e5 * CLOUD,
    "absurdly wide": 1e200 * CLOUD,
    "some are no numbers": np.where(NUMBER % 3 == 0, np.nan, CLOUD),
    "two are infinite": np.where(NUMBER == 0, np.inf, np.where(NUMBER == 1, -np.inf, CLOUD)),
    "none is a number": np.full((COUNT, 3), np.nan),
    "no point": CLOUD[:0],
    "one point": CLOUD[:1],
    "two points": CLOUD[:2],
    "the least number": CLOUD[: CONFIG.min_points],
}
NORMALS = {
    "up": UP,
    "any way": transforms.unit(np.random.default_rng(1).normal(size=(COUNT, 3))),
    "up and down": np.where(NUMBER % 2 == 1, UP, -UP),
    "no direction": 0.0 * UP,
    "half no numbers": np.where(NUMBER % 2 == 1, UP, np.nan),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("normals", NORMALS)
@pytest.mark.parametrize("points", POINTS)
@pytest.mark.parametrize("least", [CONFIG.min_points, 1])
def test_points_that_determine_no_shape_do_not_break_it(points, normals, least):
    """What comes out, if anything, is a shape of finite size."""
    points = POINTS[points]
    normals = NORMALS[normals][: len(points)]
    config = replace(CONFIG, min_points=least)
    result = fit(points, normals, config=config, rng=np.random.default_rng(0))
    if isinstance(result, FitFailure):
        assert result.reason
        return
    assert (np.isfinite(points) & np.isfinite(normals)).all(axis=1).sum() >= least
    assert np.isfinite(result.shape.T_world_object).all()
    assert (result.shape.extents >= 0.99 * CONFIG.min_extent).all()
    assert (result.shape.extents <= CONFIG.max_extent).all()
    assert np.isfinite([result.residual, result.inliers, result.cost]).all()
    for deviation in (result.uncertainty.position, result.uncertainty.sizes, result.uncertainty.sides):
        assert np.isfinite(deviation).all()


@pytest.mark.filterwarnings("error")
def test_one_broken_object_leaves_the_others_alone():
    good = heap()[:3]
    broken = [Oriented(points, UP[: len(points)]) for points in POINTS.values()]
    mixed = fits_of([*broken, *good], [0] * len(broken) + [0, 1, 2])
    for result, alone in zip(mixed[-3:], fits_of(good, range(3)), strict=True):
        assert isinstance(result, Fit)
        assert same(result, alone)


def test_a_failure_counts_the_points_that_are_numbers():
    points, normals = surface_points(SHAPES[0], np.random.default_rng(0))
    points[5:] = np.nan
    result = fit(points, normals, config=CONFIG, rng=np.random.default_rng(0))
    assert isinstance(result, FitFailure)
    assert result.reason == f"5 points are fewer than the {CONFIG.min_points} a shape needs"
