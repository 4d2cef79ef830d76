"""Starts of a fit that need no luck: the main normal, and a box or a disc behind the face it belongs to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference_fits as reference
from synthetic import hausdorff, random_motion

from caryatid.config import FitConfig
from caryatid.fitting.least_squares import CODES, from_arrays
from caryatid.fitting.single_face import main_normal, of_one_face
from caryatid.geometry import transforms

CONFIG = FitConfig()
FLAT = ("box", "cylinder")

each_flat = pytest.mark.parametrize("kind", FLAT)


def start(kind, points, normals, config=CONFIG):
    """The start as a shape, or None."""
    R, centre, half = np.empty((3, 3)), np.empty(3), np.empty(3)
    limits = config.trim, config.min_extent, config.max_radius, config.max_extent
    if not of_one_face(CODES[kind], points, normals, *limits, R, centre, half):
        return None
    return from_arrays(kind, R, centre, half)


def face(seed, count=400, sides=(0.1, 0.14), turn_deg=30.0, sigma=0.001, others=0.0):
    """Points all over a rectangle in any attitude, and some of faces beside it, about their middle."""
    rng = np.random.default_rng(seed)
    R = transforms.rotation_from_vector((0.0, 0.0, np.radians(turn_deg)))
    points = rng.uniform(-0.5, 0.5, (count, 3)) * (*sides, 0.0)
    points[:, 2] = sigma * rng.normal(size=count)
    normals = np.tile((0.0, 0.0, 1.0), (count, 1)) + 0.1 * rng.normal(size=(count, 3))
    beside = rng.permutation(count)[: int(others * count)]
    points[beside, 0] = sides[0] / 2.0
    points[beside, 2] = -rng.uniform(0.0, 0.05, len(beside))
    normals[beside] = (1.0, 0.0, 0.0)
    T = random_motion(rng, 0.0) @ transforms.rigid(R, np.zeros(3))
    points, normals = transforms.transform(T, points), transforms.rotate(T, transforms.unit(normals))
    return points - points.mean(axis=0), normals


@pytest.mark.parametrize("seed", range(4))
def test_the_main_normal_is_that_of_the_reference(seed):
    rng = np.random.default_rng(seed)
    normals = transforms.unit(rng.normal(size=(70, 3)) + rng.integers(0, 2, (70, 1)) * (0.0, 1.5, 0.0))
    axis, on_face = main_normal(normals)
    expected, agree = reference.main_normal(normals)
    assert 3 < agree.sum() < 70
    np.testing.assert_array_equal(on_face, agree)
    np.testing.assert_allclose(axis, expected, atol=1e-12)


@each_flat
@pytest.mark.parametrize("seed", range(4))
def test_starts_are_those_of_the_reference(kind, seed):
    points, normals = face(seed, others=0.3)
    mine, expected = start(kind, points, normals), reference.of_one_face(kind, points, normals, CONFIG)
    assert mine.extents.min() > 0.04
    np.testing.assert_allclose(mine.T_world_object, expected.T_world_object, atol=1e-12)
    np.testing.assert_allclose(mine.extents, expected.extents, atol=1e-12)


@each_flat
@pytest.mark.parametrize("seed", range(4))
def test_ends_between_two_points_would_make_no_difference(kind, seed):
    """Sides lie at a point each; quantiles in proportion lie up to a gap of 0.3 mm further."""
    points, normals = face(seed)
    expected = reference.of_one_face(kind, points, normals, CONFIG, reference.interpolated_ends)
    assert hausdorff(start(kind, points, normals), expected) < 0.001


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 47.0, 88.0])
def test_a_flat_box_lies_along_the_sides_of_the_face(turn_deg):
    points, normals = face(3, turn_deg=turn_deg)
    shape = start("box", points, normals)
    # At worst half a step, 1.5°, off: 0.14 m · sin 1.5° = 3.7 mm, at either side.
    np.testing.assert_allclose(np.sort(shape.extents)[1:], (0.1, 0.14), atol=0.005)
    assert CONFIG.min_extent <= shape.extents[2] < CONFIG.min_extent + 0.006


def test_a_disc_reaches_as_far_as_the_points():
    rng = np.random.default_rng(0)
    angle, reach = rng.uniform(0.0, 2.0 * np.pi, 1000), 0.04 * np.sqrt(rng.uniform(size=1000))
    points = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.zeros(1000)], axis=1)
    disc = start("cylinder", points, np.tile((0.0, 0.0, 1.0), (1000, 1)))
    # Half a percent of a disc's area lies beyond 0.96 of its radius, at either end.
    assert disc.radius == pytest.approx(0.96 * 0.04, abs=0.001)
    assert disc.height == pytest.approx(CONFIG.min_extent)
    assert disc.T_world_object[2, 3] == pytest.approx(-CONFIG.min_extent / 2.0)


@each_flat
def test_a_start_moves_with_its_points(kind):
    points, normals = face(0, others=0.2)
    T = random_motion(np.random.default_rng(9), 0.0)
    here = start(kind, points, normals)
    there = start(kind, transforms.transform(T, points), transforms.rotate(T, normals))
    assert hausdorff(there, here.moved(T)) < 1e-9


@pytest.mark.parametrize(
    ("kind", "limit"),
    [
        ("box", {"max_extent": 0.1}),
        ("cylinder", {"max_extent": 0.04}),
        ("cylinder", {"max_radius": 0.04}),
    ],
)
def test_what_is_beyond_the_limits_is_no_start(kind, limit):
    points, normals = face(0, others=0.3)
    assert start(kind, points, normals) is not None
    assert start(kind, points, normals, replace(CONFIG, **limit)) is None


@each_flat
@pytest.mark.parametrize("degenerate", ["a spot", "along the normal", "one point"])
def test_points_without_extent_have_a_start_of_the_least_size_or_none(kind, degenerate):
    points = np.zeros((1 if degenerate == "one point" else 40, 3))
    if degenerate == "along the normal":
        points[:, 2] = np.linspace(-0.05, 0.05, 40)
    shape = start(kind, points, np.tile((0.0, 0.0, 1.0), (len(points), 1)))
    if kind == "cylinder":
        assert shape is None
        return
    R = shape.T_world_object[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R[:, 2], (0.0, 0.0, 1.0))
    assert shape.extents[:2].max() < 1e-12
    assert shape.extents[2] >= CONFIG.min_extent - 1e-12


@each_flat
def test_normals_that_agree_with_nothing_make_no_start(kind):
    points, _ = face(0)
    assert start(kind, points, np.zeros_like(points)) is None
