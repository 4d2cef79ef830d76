"""How far points are from objects: compiled as by NumPy."""

from __future__ import annotations

import numpy as np
from synthetic import box, cylinder, sphere, surface_points

from caryatid.objects.object_distance import KnownObjects, gaps_to_objects, gaps_to_objects_reference

SHAPES = [box((0.0, 0.0, 0.8), (0.1, 0.12, 0.1), 30.0), cylinder((0.12, 0.0, 0.8), 0.04, 0.1), None]
SHAPES += [sphere((0.0, 0.12, 0.79), 0.04)]


def known():
    rng = np.random.default_rng(0)
    seen = [surface_points(s or box((0.0, -0.1, 0.8), (0.1, 0.05, 0.1)), rng)[0] for s in SHAPES]
    return KnownObjects.of([*seen[:3], np.zeros((0, 3))], SHAPES)


def test_gaps_are_those_of_numpy():
    points = np.random.default_rng(1).uniform((-0.2, -0.2, 0.7), (0.2, 0.2, 0.9), (2000, 3))
    for reach in (0.02, 0.07):
        gaps = gaps_to_objects(points, known(), reach)
        np.testing.assert_allclose(
            gaps, gaps_to_objects_reference(points, known(), SHAPES, reach), atol=1e-12
        )
        assert (np.isfinite(gaps).sum(axis=0) > 30).all()
        assert np.isinf(gaps).any()


def test_gaps_to_some_of_the_objects_are_the_same():
    points = np.random.default_rng(1).uniform((-0.2, -0.2, 0.7), (0.2, 0.2, 0.9), (500, 3))
    some = np.array([3, 0])
    np.testing.assert_array_equal(
        gaps_to_objects(points, known().select(some), 0.05), gaps_to_objects(points, known(), 0.05)[:, some]
    )


def test_fewer_points_of_an_object_are_no_nearer():
    points = np.random.default_rng(1).uniform((-0.2, -0.2, 0.7), (0.2, 0.2, 0.9), (500, 3))
    few = known().keep(np.arange(0, len(known().points), 5))
    assert (gaps_to_objects(points, few, 0.05) >= gaps_to_objects(points, known(), 0.05)).all()


def test_where_nothing_is_known_nothing_is_near():
    assert gaps_to_objects(np.zeros((3, 3)), KnownObjects.of([], []), 0.05).shape == (3, 0)
