"""The search for shapes through two oriented points: hypotheses, their score, and when to stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference_fits as reference
from synthetic import random_motion, sphere, surface_points

from caryatid.config import FitConfig
from caryatid.fitting.least_squares import CODES, arrays
from caryatid.fitting.ransac import BATCH, hypothesis, msac, search, trimmed_range
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere

CONFIG = FitConfig()
KINDS = sorted(CODES)
BALL = sphere((0.02, -0.01, 0.0), 0.05)

each_kind = pytest.mark.parametrize("kind", KINDS)


def shape_of(kind, rng):
    T = random_motion(rng, 0.02)
    return {
        "box": Box(T, rng.uniform(0.05, 0.12, 3)),
        "cylinder": Cylinder(T, rng.uniform(0.03, 0.05), rng.uniform(0.06, 0.12)),
        "sphere": Sphere(T, rng.uniform(0.03, 0.05)),
    }[kind]


def oriented(kind, seed, clutter=0.2, sigma=0.002):
    """Points of a shape, centred, with noise, turned normals and some clutter."""
    rng = np.random.default_rng(seed)
    points, normals = surface_points(shape_of(kind, rng), rng, eye=(0.0, 0.0, 1.5), sigma=sigma)
    stray = rng.uniform(-0.08, 0.08, (int(clutter * len(points)), 3))
    points = np.concatenate([points, stray])
    normals = np.concatenate([normals, rng.normal(size=stray.shape)])
    normals = transforms.unit(normals + 0.05 * rng.normal(size=normals.shape))
    order = rng.permutation(len(points))[:200]
    return points[order] - points[order].mean(axis=0), normals[order]


def pairs(points, count, seed):
    return np.random.default_rng(seed).integers(0, len(points), size=(count, 2))


def found(kind, points, normals, samples, config=CONFIG):
    settings = (config.threshold, config.trim, config.max_radius, config.max_extent, config.confidence)
    room = config.polish + 1
    R, centre, half, cost = np.empty((room, 3, 3)), np.empty((room, 3)), np.empty((room, 3)), np.empty(room)
    count = search(CODES[kind], points, normals, samples, settings, R, centre, half, cost)
    return R[:count], centre[:count], half[:count], cost[:count]


def ball_amid_clutter(inliers, outliers, sigma=0.0, seed=0):
    """Points of one ball, the first ones, amid points of no shape."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.15, 0.15, (inliers + outliers, 3))
    normals = transforms.unit(rng.normal(size=points.shape))
    reach = BALL.radius + sigma * rng.normal(size=(inliers, 1))
    points[:inliers] = BALL.T_world_object[:3, 3] + reach * normals[:inliers]
    return points, normals


# Hypotheses


@each_kind
@pytest.mark.parametrize("seed", range(3))
def test_hypotheses_are_those_of_the_reference(kind, seed):
    points, normals = oriented(kind, seed)
    config = replace(CONFIG, max_extent=0.17)
    samples = pairs(points, 300, seed)
    expected = reference.hypotheses(kind, samples, points, normals, config)
    assert 0.1 < expected.valid.mean() < 0.95
    R, centre, half = np.empty((3, 3)), np.empty(3), np.empty(3)
    for b, sample in enumerate(samples):
        limits = config.trim, config.max_radius, config.max_extent
        valid = hypothesis(CODES[kind], points, normals, sample, *limits, R, centre, half)
        assert valid == expected.valid[b]
        if valid:
            np.testing.assert_allclose(R, expected.R[b], atol=1e-12)
            np.testing.assert_allclose(centre, expected.centre[b], atol=1e-12)
            np.testing.assert_allclose(half, expected.half[b], atol=1e-12)


@each_kind
def test_two_exact_points_give_the_very_shape(kind):
    """But for the ends, which lie half a sample's spacing within."""
    shape = shape_of(kind, np.random.default_rng(0))
    points, normals = surface_points(shape, np.random.default_rng(0), spacing=0.004, sigma=0.0)
    R, centre, half = np.empty((3, 3)), np.empty(3), np.empty(3)
    made = 0
    for sample in pairs(points, 50, 1):
        if kind == "cylinder" and np.abs(normals[sample] @ shape.T_world_object[:3, 2]).max() > 0.5:
            continue
        if hypothesis(CODES[kind], points, normals, sample, 0.0, 0.15, 0.5, R, centre, half):
            made += 1
            assert np.abs(centre - shape.T_world_object[:3, 3]).max() < 1e-6
            np.testing.assert_allclose(np.sort(half), np.sort(shape.extents) / 2.0, atol=0.0021)
            np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
            assert np.linalg.det(R) > 0.0
    assert made > 5


@each_kind
def test_parallel_normals_determine_no_shape(kind):
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (40, 3))
    normals = np.tile((0.0, 0.0, 1.0), (40, 1))
    assert len(found(kind, points, normals, pairs(points, 100, 0))[0]) == 0


@pytest.mark.parametrize(
    ("kind", "limit"),
    [
        ("box", {"max_extent": 0.05}),
        ("cylinder", {"max_radius": 0.02}),
        ("cylinder", {"max_extent": 0.04}),
        ("sphere", {"max_radius": 0.02}),
    ],
)
def test_what_is_beyond_the_limits_is_not_returned(kind, limit):
    points, normals = oriented(kind, 0, clutter=0.0, sigma=0.0005)
    samples = pairs(points, 100, 0)
    within = found(kind, points, normals, samples)
    assert len(within[0]) == CONFIG.polish
    strict = found(kind, points, normals, samples, replace(CONFIG, **limit))
    for half in strict[2]:
        assert half[0] <= limit.get("max_radius", 1.0)
        assert 2.0 * half.max() <= limit.get("max_extent", 1.0)
    assert len(strict[3]) == 0 or strict[3][0] > within[3][0]


# Score


def test_the_cost_is_the_mean_of_truncated_squares():
    kind, *pose = arrays(sphere((0.0, 0.0, 0.0), 0.05))
    points = np.array([[r, 0.0, 0.0] for r in (0.05, -0.05, 0.055, 0.5)])
    total, inliers = msac(kind, *pose, points, 0.01, np.inf)
    assert total == pytest.approx(0.0 + 0.0 + 0.25 + 1.0)
    assert inliers == 3


@each_kind
def test_the_score_is_that_of_the_shapes_own_distances(kind):
    points, _ = oriented(kind, 0)
    shape = shape_of(kind, np.random.default_rng(0))
    off = np.abs(shape.signed_distance(points)) / CONFIG.threshold
    total, inliers = msac(*arrays(shape), points, CONFIG.threshold, np.inf)
    assert total == pytest.approx(np.minimum(off**2, 1.0).sum(), rel=1e-12)
    assert inliers == (off < 1.0).sum()


def test_scoring_ends_once_the_cost_exceeds_the_limit():
    points = ball_amid_clutter(50, 150)[0][::-1].copy()
    total, inliers = msac(*arrays(BALL), points, CONFIG.threshold, np.inf)
    assert msac(*arrays(BALL), points, CONFIG.threshold, total) == (total, inliers)
    cut, fewer = msac(*arrays(BALL), points, CONFIG.threshold, total / 2.0)
    assert total / 2.0 < cut <= total / 2.0 + 1.0
    assert fewer < inliers


def test_of_two_shapes_with_as_many_inliers_the_nearer_one_is_preferred():
    rng = np.random.default_rng(0)
    normals = transforms.unit(rng.normal(size=(30, 3)))
    points = np.where(np.arange(30)[:, None] < 24, 0.05, 0.059) * normals
    _, _, half, cost = found("sphere", points, normals, pairs(points, 100, 0))
    assert half[0, 0] == pytest.approx(0.05)
    assert cost[0] == pytest.approx(6 * 0.9**2 / 30)


def test_a_ball_is_found_amid_clutter():
    points, normals = ball_amid_clutter(60, 140)
    _, centre, half, cost = found("sphere", points, normals, pairs(points, 200, 0))
    np.testing.assert_allclose(centre[0], BALL.T_world_object[:3, 3], atol=1e-9)
    assert half[0, 0] == pytest.approx(BALL.radius)
    # The inliers cost nothing and each point of the clutter at most one.
    assert cost[0] <= 0.7


# The best ones


@each_kind
@pytest.mark.parametrize("seed", range(4))
def test_the_best_are_those_of_the_reference(kind, seed):
    points, normals = oriented(kind, seed, clutter=0.4)
    samples = pairs(points, 100, seed)
    expected, cost, _ = reference.search(kind, points, normals, samples, CONFIG)
    best = found(kind, points, normals, samples)
    assert len(cost) == CONFIG.polish
    np.testing.assert_allclose(best[3], cost, rtol=1e-9)
    for mine, theirs in zip(best, (expected.R, expected.centre, expected.half), strict=False):
        np.testing.assert_allclose(mine, theirs, atol=1e-12)


def test_the_best_come_first_and_no_more_than_asked_for():
    points, normals = oriented("box", 0)
    samples = pairs(points, BATCH, 0)
    seven = found("box", points, normals, samples, replace(CONFIG, polish=7))
    assert [len(part) for part in seven] == [7] * 4
    assert (np.diff(seven[3]) >= 0.0).all()
    assert seven[3][0] < seven[3][-1]
    one = found("box", points, normals, samples, replace(CONFIG, polish=1))
    np.testing.assert_array_equal(one[3], seven[3][:1])


def test_of_fewer_hypotheses_than_asked_for_all_are_returned():
    points, normals = oriented("sphere", 0)
    samples = pairs(points, 2, 0)
    assert len(found("sphere", points, normals, samples[:0])[0]) == 0
    expected = reference.search("sphere", points, normals, samples, CONFIG)[1]
    assert len(expected) == 2
    np.testing.assert_allclose(found("sphere", points, normals, samples)[3], expected)


# When to stop


def looked_at(points, normals, samples, better, config=CONFIG):
    """How many samples the search looks at: past those a better one is not found."""
    for count in range(BATCH, len(samples), BATCH):
        changed = samples.copy()
        changed[count:] = better
        cost = found("sphere", points, normals, changed, config)[3]
        if cost[0] == found("sphere", points, normals, samples[:count], config)[3][0]:
            return count
    return len(samples)


def noisy_ball(inliers, outliers, count):
    """Points, normals, samples, and a sample that is better than all of them."""
    points, normals = ball_amid_clutter(inliers, outliers, sigma=0.001)
    samples = pairs(points, 4 * count, 5)
    every = reference.hypotheses("sphere", samples, points, normals, CONFIG)
    off = [np.abs(s.signed_distance(points)) / CONFIG.threshold for s in every.shapes("sphere")]
    cost = np.where(every.valid, [np.minimum(o**2, 1.0).mean() for o in off], np.inf)
    best = int(np.argmin(cost))
    return points, normals, np.delete(samples, best, axis=0)[:count], samples[best]


def test_it_stops_as_soon_as_it_can_be_confident():
    assert looked_at(*noisy_ball(200, 0, 200)) == BATCH
    assert looked_at(*noisy_ball(5, 195, 200)) == 200


def test_more_confidence_takes_more_samples():
    scene = noisy_ball(60, 140, 1000)
    looked = [
        looked_at(*scene, replace(CONFIG, confidence=confidence)) for confidence in (0.5, 0.99, 0.999999)
    ]
    assert looked[0] < looked[1] < looked[2] < 1000


@pytest.mark.parametrize("inliers", [200, 100, 70, 50])
def test_it_stops_where_the_reference_does(inliers):
    points, normals, samples, better = noisy_ball(inliers, 200 - inliers, 300)
    _, _, expected = reference.search("sphere", points, normals, samples, CONFIG)
    assert looked_at(points, normals, samples, better) == expected


# Ends


@pytest.mark.parametrize("trim", [0.0, 0.02, 0.12, 0.7])
def test_the_trimmed_range_leaves_out_as_many_points_at_either_end(trim):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(61, 3))
    for direction in transforms.unit(rng.normal(size=(4, 3))):
        low, high = reference.ordered_ends(points @ direction, trim)
        np.testing.assert_allclose(trimmed_range(points, *direction, trim), (low, high))


def test_the_range_of_one_point_is_that_point():
    assert trimmed_range(np.array([[1.0, 2.0, 3.0]]), 0.0, 1.0, 0.0, 0.2) == (2.0, 2.0)


def test_points_and_samples_handed_in_stay_as_they_are():
    points, normals = oriented("box", 0)
    samples = pairs(points, 100, 0)
    kept = points.copy(), normals.copy(), samples.copy()
    for kind in KINDS:
        found(kind, points, normals, samples)
    for now, before in zip((points, normals, samples), kept, strict=True):
        np.testing.assert_array_equal(now, before)
