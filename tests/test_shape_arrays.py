from __future__ import annotations

import numpy as np
from synthetic import random_motion

from caryatid.geometry.shape_arrays import boxes_around, shape_arrays
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.signed_distance import BOX, CYLINDER, SPHERE


def some_shapes():
    rng = np.random.default_rng(0)
    poses = [random_motion(rng) for _ in range(30)]
    sizes = rng.uniform(0.02, 0.3, (30, 3))
    makers = [Box, lambda T, s: Cylinder(T, s[0], s[1]), lambda T, s: Sphere(T, s[0])]
    return [makers[k % 3](T, s) for k, (T, s) in enumerate(zip(poses, sizes, strict=True))]


def test_arrays_hold_the_shapes_in_their_order():
    shapes = some_shapes()
    kinds, R, centres, half = shape_arrays(shapes)
    assert kinds[:3].tolist() == [BOX, CYLINDER, SPHERE]
    for k, shape in enumerate(shapes):
        np.testing.assert_array_equal(R[k], shape.T_world_object[:3, :3])
        np.testing.assert_array_equal(centres[k], shape.T_world_object[:3, 3])
        np.testing.assert_array_equal(2.0 * half[k], shape.extents)


def test_changing_the_arrays_leaves_the_shapes_alone():
    shapes = some_shapes()
    arrays = shape_arrays(shapes)
    for array in arrays[1:]:
        array[:] = 0.0
    for before, after in zip(some_shapes(), shapes, strict=True):
        np.testing.assert_array_equal(before.T_world_object, after.T_world_object)
        np.testing.assert_array_equal(before.extents, after.extents)


def test_boxes_around_shapes_reach_as_far_as_these():
    shapes = some_shapes()
    low, high = boxes_around(shape_arrays(shapes))
    for k, shape in enumerate(shapes):
        reach = shape.support(np.eye(3))
        np.testing.assert_allclose(high[k], shape.T_world_object[:3, 3] + reach)
        np.testing.assert_allclose(low[k], shape.T_world_object[:3, 3] - reach)


def test_no_shapes_are_no_error():
    low, high = boxes_around(shape_arrays([]))
    assert low.shape == high.shape == (0, 3)
