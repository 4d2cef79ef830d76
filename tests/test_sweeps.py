from __future__ import annotations

import numpy as np
import pytest
from synthetic import box, cylinder, random_motion, sphere

from caryatid.geometry.shapes import Box, Cylinder, Primitives, Sphere
from caryatid.objects.sweeps import way_to_shapes

DOWN = np.array([0.0, 0.0, -1.0])
OVERLAP, LEAST = 0.004, 0.0005


def way(points, direction, limit, shapes, near=None):
    near = np.arange(len(shapes)) if near is None else np.asarray(near, dtype=np.intp)
    return way_to_shapes(points, direction, limit, OVERLAP, LEAST, near, *Primitives.of(shapes))


def way_reference(points, direction, limit, shapes):
    """The same in plain NumPy."""
    length = 0.0
    while shapes and length < limit:
        nearest = min(s.signed_distance(points + length * direction).min() for s in shapes) + OVERLAP
        if nearest < LEAST:
            return max(length - OVERLAP, 0.0)
        length += nearest
    return limit


@pytest.mark.parametrize("seed", range(20))
def test_the_way_is_that_of_the_reference(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.05, 0.05, (30, 3))
    poses = [random_motion(rng, 0.25) for _ in range(6)]
    sizes = rng.uniform(0.02, 0.1, (6, 3))
    kinds = [Box, lambda T, s: Cylinder(T, s[0], s[1]), lambda T, s: Sphere(T, s[0])]
    shapes = [kinds[k % 3](T, s) for k, (T, s) in enumerate(zip(poses, sizes, strict=True))]
    assert way(points, DOWN, 0.3, shapes) == pytest.approx(way_reference(points, DOWN, 0.3, shapes), abs=1e-9)


def test_points_stop_a_little_inside_what_is_in_their_way():
    points = np.array([[0.0, 0.0, 0.3], [0.1, 0.0, 0.3]])
    for shape in (
        box((0, 0, 0), (0.1, 0.1, 0.2)),
        cylinder((0, 0, 0), 0.05, 0.2),
        sphere((0.1, 0, 0.05), 0.05),
    ):
        assert 0.2 - OVERLAP <= way(points, DOWN, 1.0, [shape]) <= 0.2 + OVERLAP
        assert way(points, DOWN, 0.15, [shape]) == 0.15
        assert way(points, -DOWN, 1.0, [shape]) == 1.0


def test_what_they_are_in_already_lets_them_go_nowhere():
    assert way(np.zeros((1, 3)), DOWN, 1.0, [sphere((0, 0, 0), 0.1)]) == 0.0


def test_only_the_shapes_asked_about_are_in_the_way():
    shapes = [box((0, 0, 0), (0.1, 0.1, 0.2)), box((0, 0, -0.5), (0.1, 0.1, 0.2))]
    points = np.array([[0.0, 0.0, 0.3]])
    assert way(points, DOWN, 2.0, shapes, [1]) == pytest.approx(0.7, abs=OVERLAP)
    assert way(points, DOWN, 2.0, shapes, []) == 2.0
