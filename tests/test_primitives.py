from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import box, cylinder, hausdorff, random_motion, sphere, surface_points

from caryatid.config import FitConfig
from caryatid.fitting.primitives import Fit, FitFailure, Oriented, candidates, fit, fit_many
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder

CONFIG = FitConfig()
EYE = (-1.1, 0.35, 0.95)
"""40° up and 1.5 m away, turned so that two walls and the top of an upright box are seen."""
SHAPES = [
    box((0.0, 0.0, 0.0), (0.06, 0.1, 0.14), turn_deg=20.0),
    box((0.02, 0.0, 0.0), (0.12, 0.11, 0.05)),
    cylinder((0.0, 0.0, 0.0), 0.04, 0.12),
    cylinder((0.0, 0.03, 0.0), 0.03, 0.08),
    sphere((0.0, 0.0, 0.0), 0.04),
    sphere((0.01, 0.0, 0.0), 0.03),
]

each = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: f"{s.kind} {s.extents.max():.2f}")


def fit_of(points, normals, config=CONFIG, seed=0):
    result = fit(points, normals, config=config, rng=np.random.default_rng(seed))
    assert isinstance(result, Fit)
    return result


def candidates_of(points, normals, config=CONFIG, seed=0):
    (found,) = candidates([Oriented(points, normals)], config=config, rngs=[np.random.default_rng(seed)])
    return found


def noisy_normals(normals, rng, degrees=5.0):
    return transforms.unit(normals + np.radians(degrees) * rng.normal(size=normals.shape))


@each
@pytest.mark.parametrize("seed", range(2))
def test_sizes_are_recovered_from_half_a_view_with_a_sensors_noise(shape, seed):
    rng = np.random.default_rng(seed)
    points, normals = surface_points(shape, rng, eye=EYE, sigma=0.002)
    result = fit_of(points, noisy_normals(normals, rng), seed=seed)
    assert result.shape.kind == shape.kind
    # Points stop up to half their spacing (2.5 mm) and 2σ (4 mm) from the ends of unseen sides.
    tolerance = 0.008 if shape.kind != "sphere" else 0.002
    assert hausdorff(result.shape, shape) < tolerance
    # σ · √(2/π) is the mean distance to the true surface.
    assert result.residual == pytest.approx(0.002 * np.sqrt(2.0 / np.pi), rel=0.15)
    assert result.inliers > 0.98
    assert not result.poor


@each
def test_all_of_the_surface_gives_the_size_to_a_fraction_of_the_noise(shape):
    rng = np.random.default_rng(0)
    points, normals = surface_points(shape, rng, sigma=0.002)
    assert hausdorff(fit_of(points, normals).shape, shape) < 0.0015


@each
def test_hundreds_of_points_do_not_hide_an_outlier_or_two(shape):
    rng = np.random.default_rng(0)
    points, normals = surface_points(shape, rng, eye=EYE, sigma=0.001)
    count = len(points) // 20
    stray = rng.uniform(-0.12, 0.12, (count, 3))
    points = np.concatenate([points, stray])
    normals = np.concatenate([normals, transforms.unit(rng.normal(size=(count, 3)))])
    assert fit_of(points, normals).shape.kind == shape.kind


def test_the_sides_that_points_bear_out_are_the_ones_seen():
    shape = box((0.0, 0.0, 0.0), (0.08, 0.1, 0.12))
    points, normals = surface_points(shape, np.random.default_rng(0), eye=EYE, sigma=0.001)
    result = fit_of(points, normals)
    R = result.shape.T_world_object[:3, :3]
    seen = {
        tuple(np.round(sign * R[:, axis]).astype(int))
        for axis in range(3)
        for k, sign in enumerate((-1.0, 1.0))
        if result.seen[2 * axis + k]
    }
    assert seen == {(-1, 0, 0), (0, 1, 0), (0, 0, 1)}


def test_one_face_alone_makes_a_slab_behind_it():
    shape = box((0.0, 0.0, 0.0), (0.08, 0.12, 0.1), turn_deg=30.0)
    points, normals = surface_points(shape, np.random.default_rng(0), sigma=0.001)
    top = normals[:, 2] > 0.9
    result = fit_of(points[top], normals[top])
    assert isinstance(result.shape, Box)
    np.testing.assert_allclose(np.sort(result.shape.extents)[1:], (0.08, 0.12), atol=0.006)
    assert np.sort(result.shape.extents)[0] < 0.02
    height = result.shape.T_world_object[2, 3] + result.shape.support(np.array([[0.0, 0.0, 1.0]]))[0]
    assert height == pytest.approx(0.05, abs=0.001)
    assert sum(result.seen) == 1


@pytest.mark.parametrize("columns", [16, 24, 30, 40])
def test_that_points_come_in_rows_does_not_show(columns):
    """Every second, third or fourth point of a face would leave out its last columns."""
    u, v = np.meshgrid(np.linspace(-0.06, 0.06, columns), np.linspace(-0.05, 0.05, 20))
    for seed in range(5):
        rng = np.random.default_rng(seed)
        rows = np.stack([u.ravel(), v.ravel(), 0.0005 * rng.normal(size=u.size)], axis=1)
        up = noisy_normals(np.tile((0.0, 0.0, 1.0), (u.size, 1)), rng)
        boxes = [f for f in candidates_of(rows, up, seed=seed) if f.shape.kind == "box"]
        np.testing.assert_allclose(np.sort(boxes[0].shape.extents)[1:], (0.1, 0.12), atol=0.002)


def test_a_round_end_alone_makes_a_disc_more_often_than_not():
    """A square slab costs hardly more: what tells them apart is in the twelfth of the points at the rim."""
    shape = cylinder((0.0, 0.0, 0.0), 0.05, 0.1)
    discs = []
    for seed in range(12):
        points, normals = surface_points(shape, np.random.default_rng(seed), spacing=0.003, sigma=0.001)
        top = normals[:, 2] > 0.9
        found = fit_of(points[top], normals[top], seed=seed).shape
        assert found.extents[2] == pytest.approx(CONFIG.min_extent, abs=0.002)
        if isinstance(found, Cylinder):
            assert found.radius == pytest.approx(0.05, abs=0.003)
            assert abs(found.T_world_object[2, 2]) > 0.999
            discs.append(seed)
    assert len(discs) > 6


def test_a_small_box_is_preferred_to_a_big_one_that_explains_no_more():
    shape = SHAPES[0]
    points, normals = surface_points(shape, np.random.default_rng(0), eye=EYE, sigma=0.001)
    assert fit_of(points, normals).shape.volume <= 1.05 * shape.volume


def test_the_candidates_are_one_of_each_kind_the_cheapest_first():
    points, normals = surface_points(SHAPES[0], np.random.default_rng(0), eye=EYE, sigma=0.001)
    fits = candidates_of(points, normals)
    assert [f.cost for f in fits] == sorted(f.cost for f in fits)
    assert len({f.shape.kind for f in fits}) == len(fits) >= 2
    assert fits[0].shape.kind == "box"


def test_what_is_no_single_shape_is_called_a_poor_fit():
    rng = np.random.default_rng(0)
    bars = [box((0.0, 0.0, 0.0), (0.2, 0.02, 0.02)), box((0.09, 0.09, 0.06), (0.02, 0.2, 0.02))]
    parts = [surface_points(b, rng, sigma=0.001) for b in bars]
    result = fit_of(np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts]))
    strict = replace(CONFIG, max_residual=result.residual / 2.0)
    assert fit_of(*map(np.concatenate, zip(*parts, strict=True)), config=strict).poor
    assert result.residual > 0.002
    one = surface_points(bars[0], rng, sigma=0.001)
    assert fit_of(*one).residual < 0.0015


@pytest.mark.parametrize("count", [0, 3, CONFIG.min_points - 1])
def test_too_few_points_are_a_failure_that_says_so(count):
    points, normals = surface_points(SHAPES[0], np.random.default_rng(0))
    result = fit(points[:count], normals[:count], config=CONFIG, rng=np.random.default_rng(0))
    assert isinstance(result, FitFailure)
    assert result.reason == f"{count} points are fewer than the {CONFIG.min_points} a shape needs"


def test_nothing_is_bigger_than_what_stands_on_a_table():
    points, normals = surface_points(box((0, 0, 0), (0.9, 0.8, 0.7)), np.random.default_rng(0), spacing=0.03)
    result = fit(points, normals, config=CONFIG, rng=np.random.default_rng(0))
    assert isinstance(result, FitFailure)
    assert "0.5 m" in result.reason


def test_points_that_are_no_numbers_are_passed_over():
    points, normals = surface_points(SHAPES[2], np.random.default_rng(0), eye=EYE, sigma=0.001)
    clean = fit_of(points, normals).shape
    spoilt = np.concatenate([points, np.full((30, 3), np.nan)])
    result = fit_of(spoilt, np.concatenate([normals, np.full((30, 3), np.nan)]))
    assert hausdorff(result.shape, clean) == 0.0


def test_the_same_seed_gives_the_same_shape_to_the_last_bit():
    points, normals = surface_points(SHAPES[0], np.random.default_rng(0), eye=EYE, sigma=0.003, spacing=0.003)
    assert len(points) > CONFIG.max_points
    first, again, other = (fit_of(points, normals, seed=s).shape for s in (4, 4, 5))
    np.testing.assert_array_equal(first.T_world_object, again.T_world_object)
    np.testing.assert_array_equal(first.extents, again.extents)
    assert not np.array_equal(first.extents, other.extents)


def test_points_handed_in_stay_as_they_are():
    points, normals = surface_points(SHAPES[0], np.random.default_rng(0), eye=EYE)
    kept = points.copy(), normals.copy()
    fit_of(points, normals)
    np.testing.assert_array_equal(points, kept[0])
    np.testing.assert_array_equal(normals, kept[1])


# The compiled fit beside its reference


# Many objects at once


def heap():
    """Objects of all kinds and numbers of points, one of which has too few and one none."""
    objects = []
    for k in range(7):
        rng = np.random.default_rng(k)
        shape = SHAPES[k % len(SHAPES)].moved(random_motion(rng, 1.0))
        eye = shape.T_world_object[:3, 3] + rng.normal(size=3)
        points, normals = surface_points(
            shape, rng, eye=eye, spacing=(0.004, 0.008, 0.02)[k % 3], sigma=0.001
        )
        objects.append(Oriented(points, noisy_normals(normals, rng)))
    objects[3] = objects[3].select(np.arange(5))
    objects[5] = objects[5].select(np.arange(0))
    return objects


def same(a, b):
    """Whether two results are the same to the last bit."""
    if isinstance(a, FitFailure) or isinstance(b, FitFailure):
        return a == b
    return (
        a.shape.kind == b.shape.kind
        and np.array_equal(a.shape.T_world_object, b.shape.T_world_object)
        and np.array_equal(a.shape.extents, b.shape.extents)
        and np.array_equal(a.uncertainty.sides, b.uncertainty.sides)
        and (a.residual, a.inliers, a.seen, a.cost) == (b.residual, b.inliers, b.seen, b.cost)
    )


def fits_of(objects, seeds, config=CONFIG):
    return fit_many(objects, config=config, rngs=[np.random.default_rng(s) for s in seeds])


def test_each_of_many_objects_is_fitted_as_it_would_be_alone():
    objects = heap()
    together = fits_of(objects, range(7))
    assert [isinstance(r, Fit) for r in together] == [True, True, True, False, True, False, True]
    for k, o in enumerate(objects):
        alone = fit(o.points, o.normals, config=CONFIG, rng=np.random.default_rng(k))
        assert same(together[k], alone)


@pytest.mark.parametrize("seed", range(3))
def test_their_order_and_company_make_no_difference(seed):
    objects = heap()
    together = fits_of(objects, range(7))
    order = np.random.default_rng(seed).permutation(7)[: 5 + seed]
    for k, result in zip(order, fits_of([objects[k] for k in order], order), strict=True):
        assert same(result, together[k])


def test_no_objects_have_no_fits():
    assert fit_many([], config=CONFIG, rngs=[]) == []
    assert candidates([], config=CONFIG, rngs=[]) == []
    nothing = Oriented(np.zeros((0, 3)), np.zeros((0, 3)))
    assert candidates([nothing, nothing], config=CONFIG, rngs=[np.random.default_rng(0)] * 2) == [[], []]


# Only some of the shapes


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
@each
def test_only_the_shapes_that_are_asked_for_are_tried(kind, shape):
    points, normals = surface_points(shape, np.random.default_rng(0), eye=EYE, sigma=0.001)
    only = replace(CONFIG, shapes=(kind,))
    assert [f.shape.kind for f in candidates_of(points, normals, only)] == [kind]
    assert fit_of(points, normals, only).shape.kind == kind


def test_the_order_in_which_shapes_are_named_decides_nothing_but_the_samples():
    points, normals = surface_points(SHAPES[0], np.random.default_rng(0), eye=EYE, sigma=0.001)
    two = replace(CONFIG, shapes=("sphere", "box"))
    assert sorted(f.shape.kind for f in candidates_of(points, normals, two)) == ["box", "sphere"]
    assert fit_of(points, normals, two).shape.kind == "box"


# Other frames and layouts


@each
def test_a_kilometre_away_it_is_the_same_shape(shape):
    """Coordinates have 1e-13 m of rounding there, and the shape moves with them."""
    rng = np.random.default_rng(0)
    points, normals = surface_points(shape, rng, eye=EYE, sigma=0.002)
    normals = noisy_normals(normals, rng)
    far = transforms.rigid(np.eye(3), (1000.0, -1000.0, 1000.0))
    here, there = fit_of(points, normals).shape, fit_of(transforms.transform(far, points), normals).shape
    assert there.kind == here.kind
    assert hausdorff(there, here.moved(far)) < 1e-6


def test_arrays_of_any_layout_give_the_same_fit():
    points, normals = surface_points(SHAPES[2], np.random.default_rng(0), eye=EYE, sigma=0.001)
    expected = fit_of(points, normals)
    points.flags.writeable = normals.flags.writeable = False
    strided = np.repeat(points, 2, axis=0)[::2]
    for p, n in (
        (points, normals),
        (np.asfortranarray(points), np.asfortranarray(normals)),
        (strided, normals),
    ):
        assert same(fit_of(p, n), expected)
    single = fit_of(points.astype(np.float32), normals.astype(np.float32))
    assert hausdorff(single.shape, expected.shape) < 0.0005
