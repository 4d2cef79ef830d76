from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from reference_fits import refined
from synthetic import hausdorff, random_motion, surface_points

from caryatid.fitting.least_squares import (
    NOISE_FLOOR,
    ROBUST_WIDTH,
    distances,
    linearise,
    refine_reference,
    stepped,
)
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.signed_distance import BOX, CYLINDER, SPHERE, normal_equations, signed_distances

T = random_motion(np.random.default_rng(1))
SHAPES = [Box(T, np.array([0.06, 0.1, 0.14])), Cylinder(T, 0.04, 0.11), Sphere(T, 0.05)]
CODES = {"box": BOX, "cylinder": CYLINDER, "sphere": SPHERE}
COLUMNS = {
    "box": (0, 1, 2, 3, 4, 5, 6, 7, 8),
    "cylinder": (0, 1, 2, 3, 4, 5, 6, 8),
    "sphere": (0, 1, 2, 3, 4, 5, 6),
}
OPTIONS = {"steps": 25, "min_extent": 0.008, "shrink": 2e-5}

each = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)


def half_extents(shape):
    """Sum of the sizes the pull works on [m]."""
    if isinstance(shape, Box):
        return shape.extents.sum() / 2.0
    return shape.radius + (shape.height / 2.0 if isinstance(shape, Cylinder) else 0.0)


def points_about(shape, count=300, seed=0):
    """Points inside and outside, off faces as well as edges and corners."""
    rng = np.random.default_rng(seed)
    local = rng.uniform(-0.8, 0.8, (count, 3)) * shape.extents
    return local @ shape.T_world_object[:3, :3].T + shape.T_world_object[:3, 3]


def arrays(shape):
    T_world_object = np.ascontiguousarray(shape.T_world_object)
    R = np.ascontiguousarray(T_world_object[:3, :3])
    return CODES[shape.kind], R, T_world_object[:3, 3].copy(), shape.extents / 2.0


def disturbed(shape, seed, metres=0.008, radians=0.15):
    rng = np.random.default_rng(seed)
    count = linearise(shape, points_about(shape, 1))[1].shape[1]
    step = np.concatenate([rng.normal(size=3) * metres, rng.normal(size=3) * radians, np.zeros(count - 6)])
    step[6:] = rng.uniform(-metres, metres, count - 6)
    return stepped(shape, step, 0.008)


def robust_scale(distance):
    return ROBUST_WIDTH * max(1.4826 * np.median(np.abs(distance)), NOISE_FLOOR)


def geman_mcclure(distance, scale):
    return scale**2 * np.mean(distance**2 / (distance**2 + scale**2))


@each
def test_distances_are_the_shapes_own(shape):
    points = points_about(shape)
    np.testing.assert_allclose(linearise(shape, points)[0], shape.signed_distance(points), atol=1e-12)


@each
def test_derivatives_are_those_of_finite_differences(shape):
    points = points_about(shape)
    distance, J = linearise(shape, points)
    h = 1e-6
    smooth = np.ones(len(points), dtype=bool)
    difference = np.empty_like(J)
    for k in range(J.shape[1]):
        step = np.zeros(J.shape[1])
        step[k] = h
        forward = stepped(shape, step, 1e-4).signed_distance(points) - distance
        backward = distance - stepped(shape, -step, 1e-4).signed_distance(points)
        smooth &= np.abs(forward - backward) < 1e-3 * h
        difference[:, k] = (forward + backward) / (2.0 * h)
    # Kinks lie between faces: a few points are within h of one.
    assert smooth.mean() > 0.98
    np.testing.assert_allclose(J[smooth], difference[smooth], atol=1e-4)


@each
def test_compiled_distances_are_those_of_the_reference(shape):
    points = points_about(shape)
    np.testing.assert_allclose(
        signed_distances(*arrays(shape), points), linearise(shape, points)[0], atol=1e-12
    )


@each
def test_compiled_normal_equations_are_those_of_the_reference(shape):
    points = points_about(shape)
    distance, J = linearise(shape, points)
    scale = 0.01
    weight = 1.0 / (1.0 + (distance / scale) ** 2) ** 2 / len(points)
    H, g = np.empty((9, 9)), np.empty(9)
    normal_equations(*arrays(shape), points, scale, H, g)
    columns = list(COLUMNS[shape.kind])
    np.testing.assert_allclose(H[np.ix_(columns, columns)], J.T @ (weight[:, None] * J), atol=1e-12)
    np.testing.assert_allclose(g[columns], J.T @ (weight * distance), atol=1e-12)


@each
def test_compiled_outward_directions_are_those_of_the_reference(shape):
    points = points_about(shape)
    distance, outward = distances(shape, points)
    np.testing.assert_allclose(distance, shape.signed_distance(points), atol=1e-12)
    np.testing.assert_allclose(outward, -linearise(shape, points)[1][:, :3], atol=1e-9)


@each
@pytest.mark.parametrize("seed", range(3))
def test_compiled_refinement_is_that_of_the_reference(shape, seed):
    points, _ = surface_points(shape, np.random.default_rng(seed), eye=(0.0, -2.0, 1.0), sigma=0.002)
    start = disturbed(shape, seed)
    for steps in (1, 6, 25):
        options = OPTIONS | {"steps": steps}
        compiled, plain = refined(start, points, **options), refine_reference(start, points, **options)
        assert hausdorff(compiled, start) > 0.001
        assert hausdorff(compiled, plain) < 1e-7


@each
def test_no_step_makes_an_extent_smaller_than_the_least(shape):
    count = linearise(shape, points_about(shape, 1))[1].shape[1]
    shrunk = stepped(shape, np.concatenate([np.zeros(6), np.full(count - 6, -1.0)]), 0.01)
    np.testing.assert_allclose(shrunk.extents, 0.01)


@each
@pytest.mark.parametrize("seed", range(4))
def test_the_true_shape_is_found_from_a_start_beside_it(shape, seed):
    points, _ = surface_points(shape, np.random.default_rng(seed), sigma=0.0)
    start = disturbed(shape, seed)
    assert hausdorff(start, shape) > 0.004
    found = refined(start, points, **OPTIONS)
    # The pull moves each face, of a sixth of the points or so, by shrink / (2 · 1/6) = 0.06 mm.
    assert hausdorff(found, shape) < 0.0004


@each
def test_noise_averages_out(shape):
    rng = np.random.default_rng(0)
    points, _ = surface_points(shape, rng, sigma=0.002)
    found = refined(disturbed(shape, 1), points, **OPTIONS)
    assert hausdorff(found, shape) < 0.001


@each
def test_outliers_have_next_to_no_say(shape):
    rng = np.random.default_rng(0)
    points, _ = surface_points(shape, rng, sigma=0.001)
    stray = points_about(shape, len(points) // 5, seed=3) + 0.05
    with_stray = refined(disturbed(shape, 1), np.concatenate([points, stray]), **OPTIONS)
    assert hausdorff(with_stray, shape) < 0.0015


@each
def test_every_step_lowers_the_cost(shape):
    points, _ = surface_points(shape, np.random.default_rng(2), sigma=0.002)
    start = disturbed(shape, 5, metres=0.012)
    iterates = [start, *(refined(start, points, **OPTIONS | {"steps": k}) for k in range(1, 8))]
    moves = 0
    for before, after in itertools.pairwise(iterates):
        if hausdorff(before, after) == 0.0:
            continue
        moves += 1
        scale = robust_scale(before.signed_distance(points))
        costs = [
            geman_mcclure(s.signed_distance(points), scale) + OPTIONS["shrink"] * half_extents(s)
            for s in (before, after)
        ]
        assert costs[1] < costs[0]
    assert moves >= 2


def test_a_side_that_no_point_bears_out_does_not_grow():
    shape = SHAPES[0]
    points, normals = surface_points(shape, np.random.default_rng(0), sigma=0.001)
    axis_world = shape.T_world_object[:3, 0]
    top = points[normals @ axis_world > 0.9]
    start = Box(shape.T_world_object, np.array([0.03, 0.1, 0.14]))
    start = replace(start, T_world_object=start.moved(_shift(0.015 * axis_world)).T_world_object)
    found = refined(start, top, **OPTIONS)
    assert found.extents[0] <= 0.0301
    assert abs(found.signed_distance(top)).mean() < 0.0012


def test_nothing_handed_in_is_changed():
    shape = SHAPES[0]
    points, _ = surface_points(shape, np.random.default_rng(0))
    start = disturbed(shape, 0)
    kept = points.copy(), start.T_world_object.copy(), start.extents.copy()
    refined(start, points, **OPTIONS)
    np.testing.assert_array_equal(points, kept[0])
    np.testing.assert_array_equal(start.T_world_object, kept[1])
    np.testing.assert_array_equal(start.extents, kept[2])


def _shift(by):
    motion = np.eye(4)
    motion[:3, 3] = by
    return motion
