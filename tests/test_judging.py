"""Judgement of a fitted shape: seen and unseen sides, distances and normals, and sides without points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference_fits as reference
from scipy.spatial import cKDTree
from synthetic import box, cylinder, hausdorff, random_motion, sphere, surface_points

from caryatid.config import FitConfig
from caryatid.fitting import scoring as judging
from caryatid.fitting.least_squares import arrays, from_arrays
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere

CONFIG = FitConfig()
EYE = (-1.1, 0.35, 0.95)
T = random_motion(np.random.default_rng(1), 0.05)
SHAPES = [Box(T, np.array([0.06, 0.1, 0.14])), Cylinder(T, 0.04, 0.11), Sphere(T, 0.05)]
ALL = (True,) * 6

each = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)


def draw_in(shape, points, normals, config=CONFIG):
    """The shape drawn in and its seen sides."""
    kind, R, centre, half = arrays(shape)
    seen = np.empty(6, dtype=np.bool_)
    least = max(config.min_points / 3.0, config.side_share * len(points))
    judging.draw_in(
        kind,
        R,
        centre,
        half,
        points,
        normals,
        config.threshold,
        least,
        config.trim,
        config.min_extent,
        seen,
    )
    return from_arrays(shape.kind, R, centre, half), tuple(seen.tolist())


def misfit(shape, points, normals, config=CONFIG):
    return judging.misfit(*arrays(shape), points, normals, config.threshold)


def bare_share(shape, seen, points, config=CONFIG):
    return judging.bare_share(*arrays(shape), np.array(seen), points, config.bare_spacing)


def part_of(shape, seed, sigma=0.003):
    """Points of two thirds of what an eye sees of a shape, with noise and turned normals."""
    rng = np.random.default_rng(seed)
    points, normals = surface_points(shape, rng, eye=rng.uniform(-1.0, 1.0, 3), sigma=sigma)
    cut = points @ rng.normal(size=3)
    kept = cut > np.quantile(cut, 1.0 / 3.0)
    return points[kept], transforms.unit(normals + 0.4 * rng.normal(size=normals.shape))[kept]


def disturbed(shape, seed):
    """The shape moved by some millimetres, turned by some degrees and up to 4 cm larger."""
    rng = np.random.default_rng(seed)
    motion = transforms.rigid(
        transforms.rotation_from_vector(0.05 * rng.normal(size=3)), 0.003 * rng.normal(size=3)
    )
    pose = shape.T_world_object @ motion
    if isinstance(shape, Box):
        return Box(pose, shape.extents + rng.uniform(0.0, 0.04, 3))
    if isinstance(shape, Cylinder):
        return Cylinder(pose, shape.radius + 0.003 * rng.normal(), shape.height + rng.uniform(0.0, 0.04))
    return Sphere(pose, shape.radius + 0.003 * rng.normal())


# Sides


@each
@pytest.mark.parametrize("seed", range(6))
def test_shapes_are_drawn_in_as_the_reference_does(shape, seed):
    points, normals = part_of(shape, seed)
    start = disturbed(shape, seed)
    drawn, seen = draw_in(start, points, normals)
    expected, flags = reference.draw_in(start, points, normals, CONFIG)
    assert seen == tuple(bool(f) for f in flags)
    assert 0 < sum(seen) < 6
    np.testing.assert_allclose(drawn.T_world_object, expected.T_world_object, atol=1e-12)
    np.testing.assert_allclose(drawn.extents, expected.extents, atol=1e-12)
    if shape.kind != "sphere":
        assert hausdorff(drawn, start) > 0.001


@pytest.mark.parametrize("shape", SHAPES[:2], ids=lambda s: s.kind)
def test_a_shape_that_is_near_no_point_is_drawn_in_to_all_of_them(shape):
    points, normals = part_of(shape, 0)
    big = (
        Box(shape.T_world_object, shape.extents + 0.1)
        if isinstance(shape, Box)
        else Cylinder(shape.T_world_object, shape.radius + 0.05, shape.height + 0.1)
    )
    drawn, seen = draw_in(big, points, normals)
    expected, _ = reference.draw_in(big, points, normals, CONFIG)
    assert not any(seen)
    assert drawn.extents[2] < big.extents[2] - 0.05
    np.testing.assert_allclose(drawn.T_world_object, expected.T_world_object, atol=1e-12)
    np.testing.assert_allclose(drawn.extents, expected.extents, atol=1e-12)


def test_a_side_nobody_saw_is_drawn_in_to_where_the_points_end():
    shape = box((0.0, 0.0, 0.0), (0.08, 0.1, 0.12))
    points, normals = surface_points(shape, np.random.default_rng(0), eye=EYE, sigma=0.0)
    upper = points[:, 2] > -0.02
    too_tall = box((0.0, 0.0, -0.05), (0.08, 0.1, 0.22))
    drawn, seen = draw_in(too_tall, points[upper], normals[upper])
    assert seen == (True, False, False, True, False, True)
    top = drawn.T_world_object[2, 3] + drawn.extents[2] / 2.0
    assert top == pytest.approx(0.06)
    assert drawn.extents[2] == pytest.approx(0.08, abs=0.005)


def test_a_side_that_was_seen_stays_where_it_is():
    shape = box((0.0, 0.0, 0.0), (0.08, 0.1, 0.12))
    points, normals = surface_points(shape, np.random.default_rng(0), sigma=0.0)
    drawn, seen = draw_in(shape, points, normals)
    assert seen == ALL
    np.testing.assert_allclose(drawn.extents, shape.extents)


def test_no_side_is_drawn_in_beyond_the_least_extent():
    slab = box((0.0, 0.0, -0.02), (0.08, 0.1, 0.04))
    points, normals = surface_points(slab, np.random.default_rng(0), sigma=0.0)
    top = normals[:, 2] > 0.9
    drawn, seen = draw_in(slab, points[top], normals[top])
    assert seen == (False, False, False, False, False, True)
    assert drawn.extents[2] == pytest.approx(CONFIG.min_extent)
    assert drawn.T_world_object[2, 3] == pytest.approx(-CONFIG.min_extent / 2.0)


# Misfit


@each
@pytest.mark.parametrize("seed", range(3))
def test_the_misfit_is_that_of_the_reference(shape, seed):
    points, normals = part_of(shape, seed, sigma=0.006)
    start = disturbed(shape, seed)
    found = misfit(start, points, normals)
    np.testing.assert_allclose(found, reference.misfit(start, points, normals, CONFIG), rtol=1e-9)
    assert found[0] > 0.001
    assert found[1] > 0.01
    assert 0.1 < found[2] < 1.0


def test_distance_and_normals_are_weighed_by_themselves():
    ball = sphere((0.0, 0.0, 0.0), 0.05)
    points, normals = surface_points(ball, np.random.default_rng(0), sigma=0.0)
    assert misfit(ball, points, normals) == pytest.approx((0.0, 0.0, 1.0), abs=1e-9)
    across = transforms.perpendicular(normals)
    assert misfit(ball, points, across) == pytest.approx((0.0, 1.0, 1.0), abs=1e-9)
    assert misfit(ball, points, -normals) == pytest.approx((0.0, 1.0, 1.0), abs=1e-9)
    assert misfit(sphere((0.0, 0.0, 0.0), 0.054), points, normals) == pytest.approx(
        (0.004, 0.0, 1.0), abs=1e-9
    )
    far = misfit(sphere((0.0, 0.0, 0.0), 0.09), points, normals)
    assert far == pytest.approx((CONFIG.threshold, 0.0, 0.0), abs=1e-9)


# Bare sides

BARE = [
    box((0.0, 0.0, 0.0), (0.06, 0.1, 0.14)),
    box((0.0, 0.0, 0.0), (0.2, 0.15, 0.03)),
    cylinder((0.0, 0.0, 0.0), 0.04, 0.12),
    cylinder((0.0, 0.0, 0.0), 0.08, 0.05),
    sphere((0.0, 0.0, 0.0), 0.05),
    sphere((0.0, 0.0, 0.0), 0.08),
]


def side_areas(shape):
    """Area of each side [m²] that stands in the object's own axes."""
    x, y, z = shape.extents
    if shape.kind == "box":
        return np.repeat([y * z, x * z, x * y], 2)
    if shape.kind == "cylinder":
        return np.array([np.pi * x * z / 4.0] * 4 + [np.pi * x**2 / 4.0] * 2)
    return np.full(6, np.pi * x**2 / 6.0)


@pytest.mark.parametrize("shape", BARE, ids=lambda s: f"{s.kind} {s.extents.max():.2f}")
@pytest.mark.parametrize("side", range(6))
def test_samples_lie_evenly_on_their_side(shape, side):
    kind, _, _, half = arrays(shape)
    axis, sign = side // 2, 2 * (side % 2) - 1
    samples = judging._samples(kind, half, axis, sign, CONFIG.bare_spacing)
    np.testing.assert_allclose(shape.signed_distance(samples), 0.0, atol=1e-12)
    outward = -reference.linearise(shape, samples * (1.0 + 1e-6))[1][:, :3]
    assert (sign * outward[:, axis] >= np.abs(outward).max(axis=1) - 1e-9).all()
    gap, _ = cKDTree(samples).query(samples, k=2)
    assert gap[:, 1].max() < 1.05 * CONFIG.bare_spacing
    # One sample a square of the spacing, or up to three times as many: whole rows, less far apart on spheres.
    assert 0.8 < len(samples) * CONFIG.bare_spacing**2 / side_areas(shape)[side] < 3.0
    np.testing.assert_allclose(np.delete(samples.mean(axis=0), axis), 0.0, atol=1e-9)


@each
@pytest.mark.parametrize("seed", range(4))
def test_the_bare_share_is_what_a_search_tree_finds(shape, seed):
    points, _ = part_of(shape, seed)
    seen = np.random.default_rng(seed).random(6) < 0.6
    kind, _, _, half = arrays(shape)
    samples = [
        judging._samples(kind, half, k // 2, 2 * (k % 2) - 1, CONFIG.bare_spacing)
        for k in np.flatnonzero(seen)
    ]
    gap, _ = cKDTree(transforms.transform(transforms.invert(shape.T_world_object), points)).query(
        np.concatenate(samples)
    )
    expected = (gap > 2.0 * CONFIG.bare_spacing).mean()
    assert 0.05 < expected < 0.95
    assert bare_share(shape, seen, points) == pytest.approx(expected)


@pytest.mark.parametrize("shape", BARE, ids=lambda s: f"{s.kind} {s.extents.max():.2f}")
@pytest.mark.parametrize("seen", [ALL, (True, False, False, True, False, True), (False,) * 5 + (True,)])
def test_the_bare_share_is_that_of_samples_on_the_whole_surface(shape, seen):
    """Within a few percent: there are other samples, and some sides of round shapes meet elsewhere."""
    points, _ = surface_points(shape, np.random.default_rng(0), sigma=0.001)
    some = points[points @ (0.6, 0.48, 0.64) > 0.15 * shape.extents.min()]
    expected = reference.bare_share(shape, seen, some, CONFIG)
    assert bare_share(shape, seen, some) == pytest.approx(expected, abs=0.025)


def test_a_shape_all_of_whose_seen_sides_hold_points_is_not_bare():
    for shape in BARE:
        points, _ = surface_points(shape, np.random.default_rng(0))
        assert bare_share(shape, ALL, points) == 0.0
        assert bare_share(shape, (False,) * 6, points) == 1.0
        assert bare_share(shape, ALL, points + 1.0) == 1.0


def test_half_a_side_is_half_bare():
    shape = BARE[0]
    points, normals = surface_points(shape, np.random.default_rng(0))
    lower = points[(normals[:, 0] > 0.9) & (points[:, 2] < 0.001)]
    only = (False, True, False, False, False, False)
    # Samples up to twice the spacing beyond the points' end count as held.
    reach = 2.0 * CONFIG.bare_spacing / shape.extents[2]
    assert bare_share(shape, only, lower) == pytest.approx(0.5 - reach, abs=0.06)
    fine = replace(CONFIG, bare_spacing=0.004)
    assert bare_share(shape, only, lower, fine) == pytest.approx(0.5 - reach / 2.0, abs=0.03)
