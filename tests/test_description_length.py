"""Description length, and what it decides: one object or two."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial import cKDTree
from synthetic import box, cylinder, seen_free, sphere, surface_points

from caryatid.config import Config, ExplanationConfig, FitConfig
from caryatid.geometry import transforms
from caryatid.objects.compounds import OpenBox, Revolution
from caryatid.objects.description_length import (
    Evidence,
    best_compound,
    best_explanation,
    explain,
    price,
)
from caryatid.objects.model_selection import best_merge, split
from caryatid.sensing.clouds import thin
from caryatid.sensing.views import Cloud
from caryatid.simulation import generation

CONFIG, COSTS, FIT = Config(), ExplanationConfig(), FitConfig()
EYE = (-1.2, -0.6, 1.0)
UP = np.array([0.0, 0.0, 1.0])


def gather(cloud, voxels=None):
    kept = cloud.select(thin(cloud.points_world, COSTS.spacing))
    weight = COSTS.spacing**2 / COSTS.reading
    return Evidence(kept.points_world, kept.normals_world, weight, 0.003, voxels, kept.rgb)


def alone_in(evidence):
    """The explanation of some points as one object."""
    return explain(evidence, COSTS, FIT, np.random.default_rng(0))


def groups_of(evidence):
    """Group of each point, or None where they are one object."""
    return split(evidence, alone_in(evidence), config=CONFIG, rng=np.random.default_rng(0))


def divided(points, normals):
    """Group of each point, before they are thinned."""
    evidence = gather(Cloud(points, normals))
    groups = groups_of(evidence)
    return None if groups is None else groups[cKDTree(evidence.points).query(points)[1]]


def pair_of(clouds, changed=None, apart=None, voxels=None, config=CONFIG):
    known = {k: (gather(c, voxels), alone_in(gather(c, voxels))) for k, c in clouds.items()}
    everything = set(clouds) if changed is None else changed
    return best_merge(known, everything, {} if apart is None else apart, config=config, seed=0)


def test_points_of_no_shape_are_left_without_one():
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-0.1, 0.1, (400, 3)), transforms.unit(rng.normal(size=(400, 3)))
    crumpled = Evidence(points, normals, 1.0, 0.003, None)
    few = crumpled.select(np.arange(FIT.min_points - 1))
    for evidence in (crumpled, few):
        best = explain(evidence, COSTS, FIT, rng)
        assert best.shape is None
        assert best.cost == pytest.approx(COSTS.irregular * len(evidence.points) + price(None, COSTS))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [1, 2, 60])
@pytest.mark.parametrize("spread", list(product((0.0, 0.05), repeat=3)))
def test_points_that_determine_nothing_have_a_finite_cost(spread, count):
    """On a spot, a line or a plane."""
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3)) * spread
    part = Evidence(points, np.tile(UP, (count, 1)), 1.0, 0.003, None)
    assert np.isfinite(alone_in(part).cost)
    whole = best_explanation([STACKED[0]], part, COSTS)
    groups = split(part, whole, config=CONFIG, rng=np.random.default_rng(0))
    assert groups is None or len(groups) == count


STACKED = (box((0.0, 0.0, 0.05), (0.16, 0.12, 0.1)), box((0.03, 0.0, 0.15), (0.06, 0.06, 0.1)))
SIDE_BY_SIDE = (box((0.0, -0.06, 0.05), (0.1, 0.12, 0.1)), box((0.0, 0.04, 0.1), (0.1, 0.08, 0.2)))
BRIDGE = (
    *(box((0.0, y, 0.05), (0.06, 0.06, 0.1)) for y in (-0.09, 0.09)),
    box((0.0, 0.0, 0.115), (0.06, 0.26, 0.03)),
)
CAN_ON_BOX = (box((0.0, 0.0, 0.04), (0.14, 0.14, 0.08)), cylinder((0.0, 0.0, 0.14), 0.03, 0.12))


def points_of(shapes, sigma=0.001, seed=0):
    rng = np.random.default_rng(seed)
    parts = [surface_points(s, rng, eye=EYE, spacing=0.006, sigma=sigma) for s in shapes]
    points = np.concatenate([p for p, _ in parts])
    normals = np.concatenate([n for _, n in parts])
    return points, normals, np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts])


@pytest.mark.parametrize(
    ("shapes", "least"),
    [(STACKED, 0.9), (SIDE_BY_SIDE, 0.9), (CAN_ON_BOX, 0.9), (BRIDGE, 0.85)],
    ids=["stacked", "beside", "can on box", "bridge"],
)
def test_shapes_are_parted_where_they_meet(shapes, least):
    points, normals, truth = points_of(shapes)
    groups = divided(points, normals)
    own = [np.bincount(groups[truth == k]).argmax() for k in range(len(shapes))]
    assert sorted(own) == sorted(set(groups)) == list(range(len(shapes)))
    assert np.mean([(groups[truth == k] == group).mean() for k, group in enumerate(own)]) > least


@pytest.mark.parametrize(
    "shape",
    [STACKED[0], cylinder((0.0, 0.0, 0.06), 0.04, 0.12), sphere((0.0, 0.0, 0.05), 0.05)],
    ids=["box", "cylinder", "sphere"],
)
@pytest.mark.parametrize("sigma", [0.0005, 0.004])
def test_one_shape_stays_one_whatever_the_noise(shape, sigma):
    points, normals, _ = points_of([shape], sigma)
    assert divided(points, normals) is None


def test_an_object_unlike_primitives_is_not_cut_into_primitives():
    rng = np.random.default_rng(0)
    azimuth, height = rng.uniform(-np.pi, np.pi, 4000), rng.uniform(0.0, 0.05, 4000)
    radius = 0.03 + height
    outward = np.stack([np.cos(azimuth), np.sin(azimuth), -np.ones(4000)], axis=1) / np.sqrt(2.0)
    bowl = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
    points = np.concatenate([bowl, bowl - 0.004 * outward]) + rng.normal(0.0, 0.001, (8000, 3))
    assert divided(points, np.concatenate([outward, -outward])) is None


@pytest.mark.slow
def test_a_view_that_is_off_leaves_a_layer_and_no_second_object():
    """By 3σ of registration in no case; a millimetre more is as good as two objects to some samples."""
    apart = {0.006: 0, 0.007: 0}
    for off, seed in product(apart, range(8)):
        points, normals, _ = points_of([STACKED[0]], seed=seed)
        top = normals[:, 2] > 0.9
        layer = points[top] + np.array([0.0, 0.0, off])
        groups = divided(np.concatenate([points, layer]), np.concatenate([normals, normals[top]]))
        apart[off] += groups is not None
    assert apart[0.006] == 0
    assert apart[0.007] <= 1


def cloud_of(shape, seed=0):
    points, normals, _ = points_of([shape], seed=seed)
    return Cloud(points, normals)


def halves(shape):
    """A box's points left and right of a gap, as something in front leaves them."""
    cloud = cloud_of(shape)
    y = cloud.points_world[:, 1]
    return cloud.select(y < -0.01), cloud.select(y > 0.01)


CRATE = box((0.0, 0.0, 0.05), (0.1, 0.2, 0.1))


def test_not_where_the_space_between_was_seen_free():
    left = cloud_of(box((0.0, -0.09, 0.05), (0.1, 0.12, 0.1)))
    right = cloud_of(box((0.0, 0.09, 0.05), (0.1, 0.12, 0.1)))
    free = seen_free(lambda p: np.abs(p[:, 1]) < 0.025)
    near = replace(CONFIG, explanation=replace(COSTS, reach=0.1))
    assert pair_of({1: left, 2: right}, voxels=free, config=near) is None


def test_a_few_points_of_an_object_are_given_to_it_and_neighbours_that_touch_stay_two():
    whole, again = cloud_of(CRATE), cloud_of(CRATE, seed=1)
    few = again.select(again.points_world[:, 1] > 0.05)
    assert pair_of({1: few, 2: whole}) == (2, 1)
    assert pair_of({1: whole, 2: few}) == (1, 2)
    can = cloud_of(cylinder((0.0, 0.0, 0.16), 0.03, 0.12))
    beside = cloud_of(box((0.0, 0.16, 0.03), (0.08, 0.12, 0.06)))
    assert pair_of({1: whole, 2: can, 3: beside}) is None


def test_what_something_in_front_cut_in_two_is_one_and_looked_at_again_when_it_has_grown():
    left, right = halves(CRATE)
    assert pair_of({1: left, 2: right}) in {(1, 2), (2, 1)}
    assert pair_of({1: left, 2: right}, changed=set()) is None
    assert pair_of({1: left, 2: right}, apart={(1, 2): 10 * len(left)}) is None
    assert pair_of({1: left, 2: right}, apart={(1, 2): 10}) is not None


def bowl(azimuths):
    """Outside of a lobed bowl that widens upwards, of the directions [rad] given: none of the shapes."""
    rng = np.random.default_rng(0)
    azimuth, height = rng.uniform(*azimuths, 2500), rng.uniform(0.0, 0.06, 2500)
    opening, turning = 1.0 + 0.5 * np.sin(4.0 * azimuth), 2.0 * height * np.cos(4.0 * azimuth)
    radius = 0.03 + height * opening
    away = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(2500)], axis=1)
    around = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(2500)], axis=1)
    normals = away - (turning / radius)[:, None] * around - opening[:, None] * UP
    return Cloud(radius[:, None] * away + height[:, None] * UP, transforms.unit(normals))


def test_halves_of_what_goes_around_an_axis_are_one():
    assert pair_of({1: bowl((-np.pi, 0.3)), 2: bowl((0.3, np.pi))}) is not None


@pytest.mark.parametrize(
    ("left", "right", "merged"),
    [((200, 30, 30), (30, 60, 190), False), ((200, 30, 30), (120, 18, 18), True), (None, None, True)],
    ids=["red beside blue", "shaded", "printed"],
)
def test_flush_boxes_are_two_where_a_view_showed_each_in_a_colour_of_its_own(left, right, merged):
    points, normals, _ = points_of([box((0.0, 0.0, 0.03), (0.06, 0.12, 0.06))])
    rng, on_left = np.random.default_rng(2), points[:, 1] < 0.0
    rgb = np.zeros((len(points), 3), dtype=np.uint8)
    for own, colour in ((on_left, left), (~on_left, right)):
        prints = rng.choice([(230, 200, 20), (200, 20, 20), (30, 30, 120)], own.sum())
        rgb[own] = np.clip((colour or prints) + rng.normal(0.0, 3.0, (own.sum(), 3)), 0, 255)
    clouds = {k: Cloud(points[own], normals[own], rgb=rgb[own]) for k, own in ((1, on_left), (2, ~on_left))}
    assert (pair_of(clouds) is not None) == merged
    whole = gather(Cloud(points, normals, rgb=rgb))
    shown = 1 + (whole.points[None, :, 1] < 0.0).astype(np.int32)
    for segments, divided in ((shown, not merged), (None, False)):
        assert (groups_of(replace(whole, segments=segments)) is not None) == divided


def test_a_row_of_flush_boxes_is_divided_where_a_view_showed_each_in_a_colour_of_its_own():
    points, normals, _ = points_of([box((0.0, 0.0, 0.03), (0.06, 0.24, 0.06))])
    rng, place = np.random.default_rng(2), np.clip(np.floor(points[:, 1] / 0.06).astype(int) + 2, 0, 3)
    colours = np.array([(200, 30, 30), (30, 60, 190), (30, 160, 40), (200, 180, 30)])
    rgb = np.clip(colours[place] + rng.normal(0.0, 3.0, (len(points), 3)), 0, 255).astype(np.uint8)
    whole = gather(Cloud(points, normals, rgb=rgb))
    place = np.clip(np.floor(whole.points[:, 1] / 0.06).astype(int) + 2, 0, 3)
    groups = groups_of(replace(whole, segments=(place[None] + 1).astype(np.int32)))
    sides = [place == k for k in range(4)]
    assert [np.mean(groups == np.bincount(groups[own]).argmax()) for own in sides] == pytest.approx(
        [own.mean() for own in sides], abs=0.02
    )


@pytest.mark.parametrize(
    ("views", "parts"), [([], 2), ([(1, 1)], 1), ([(1, 2)], 2), ([(1, 1), (2, 3), (4, 5)], 2)]
)
def test_boxes_side_by_side_are_one_object_where_most_views_show_one(views, parts):
    """A low box beside a high one, such as the body and the handle of a tool."""
    low, high = box((0.0, 0.0, 0.03), (0.06, 0.1, 0.06)), box((0.06, 0.0, 0.06), (0.06, 0.1, 0.12))
    points, normals, _ = points_of([low, high])
    evidence = gather(Cloud(points, normals))
    left, count = evidence.points[:, 0] < 0.03, len(evidence)
    segments = np.array([np.where(left, *labels) for labels in views], dtype=np.int32).reshape(-1, count)
    groups = groups_of(replace(evidence, segments=segments))
    assert (1 if groups is None else len(np.unique(groups))) == parts


@pytest.mark.parametrize(("back", "merged"), [((200, 30, 30), True), ((30, 60, 190), False)])
def test_opposite_sides_of_one_colour_are_one_where_a_shape_explains_both(back, merged):
    points, normals = box((0.0, 0.0, 0.03), (0.06, 0.08, 0.06)).surface(0.003)
    clouds = {}
    for label, (side, colour) in enumerate(((-0.03, (200, 30, 30)), (0.03, back)), 1):
        own = np.isclose(points[:, 0], side)
        rgb = np.full((own.sum(), 3), colour, dtype=np.uint8)
        clouds[label] = Cloud(points[own], normals[own], rgb=rgb)
    assert (pair_of(clouds) is not None) == merged
    assert pair_of({k: replace(cloud, rgb=None) for k, cloud in clouds.items()}) is None


def test_irregular_neighbours_stay_two_also_where_the_surface_goes_on():
    rng = np.random.default_rng(1)
    xy = rng.uniform(-0.15, 0.15, (6000, 2))
    xy = xy[np.hypot(*xy.T) > 0.035]
    crumpled = np.column_stack([xy, 0.02 * np.sin(70.0 * xy[:, 0]) * np.sin(50.0 * xy[:, 1]) - 0.02])
    paper = Cloud(crumpled, np.tile((0.0, 0.0, 1.0), (len(xy), 1)))
    standing = bowl((-np.pi, np.pi))
    for cloud in (paper, standing):
        assert alone_in(gather(cloud)).shape is None
    assert pair_of({1: standing, 2: paper}) is None


def visible(shape):
    """Noisy points of a shape that an eye sees past the shape itself, with normals."""
    points, normals = shape.surface(0.005)
    way = (0.9, 0.3, 0.9) - points
    seen = np.einsum("ni,ni->n", way, normals) > 0.0
    for far in np.linspace(0.006, 0.3, 40):
        seen &= shape.signed_distance(points + far * transforms.unit(way)) > -1e-4
    noise = np.random.default_rng(0).normal(0.0, 0.001, (int(seen.sum()), 3))
    return gather(Cloud(points[seen] + noise, normals[seen]))


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (generation._tray, OpenBox),
        (generation._open_box, OpenBox),
        (generation._bowl, Revolution),
        (generation._mug, Revolution),
        (generation._bottle, Revolution),
    ],
)
def test_a_compound_explains_what_no_primitive_does(make, kind):
    evidence = visible(make(np.random.default_rng(1)))
    primitive = alone_in(evidence)
    compound = best_compound(evidence, CONFIG, primitive.cost)
    assert isinstance(compound.shape, kind)
    assert compound.cost < primitive.cost


def test_stray_points_do_not_move_the_walls_of_an_open_box():
    clean = visible(generation._tray(np.random.default_rng(1)))
    rng, number = np.random.default_rng(2), len(clean) // 25
    places = clean.points.max(axis=0) + rng.uniform((0.0, -0.3, -0.03), (0.05, 0.0, 0.0), (number, 3))
    strays = replace(clean, points=places, normals=transforms.unit(rng.normal(size=(number, 3))))
    cost = best_compound(clean, CONFIG, np.inf).cost
    strayed = best_compound(clean.joined(strays), CONFIG, np.inf)
    assert isinstance(strayed.shape, OpenBox)
    assert strayed.cost < cost + 1.1 * COSTS.outlier * number * clean.weight


def test_two_things_that_share_no_axis_are_no_compound():
    for second in (box((0.03, 0.05, 0.025), (0.06, 0.08, 0.05)), sphere((0.0, 0.07, 0.03), 0.03)):
        first = visible(cylinder((0.0, 0.0, 0.05), 0.04, 0.1))
        other = visible(second)
        apart = alone_in(first).cost + alone_in(other).cost
        assert best_compound(first.joined(other), CONFIG, apart).shape is None


def test_a_plate_costs_by_the_space_seen_free_in_it():
    """Two strips side by side, seen from above: a clamp is no plate where the camera looked between them."""
    points, normals, _ = points_of([box((0.0, y, 0.035), (0.2, 0.03, 0.01)) for y in (-0.1, 0.1)])
    above = normals[:, 2] > 0.9
    strips = gather(Cloud(points[above], normals[above]))
    plate = box((0.0, 0.0, 0.036), (0.2, 0.23, 0.008))
    between = seen_free(lambda p: (np.abs(p[:, 1]) < 0.08) & (np.abs(p[:, 0]) < 0.1) & (p[:, 2] > 0.0))
    assert best_explanation([plate], strips, COSTS).shape is plate
    assert best_explanation([plate], replace(strips, voxels=between), COSTS).shape is None


def test_a_compound_costs_by_the_space_seen_free_in_it():
    """A ring that would hold two plates side by side is not there between them."""
    plates = [visible(cylinder((x, 0.0, 0.01), 0.06, 0.02)) for x in (-0.1, 0.1)]
    both = plates[0].joined(plates[1])
    apart = sum(alone_in(plate).cost for plate in plates)

    def beside(places):
        return np.min([np.hypot(places[:, 0] - x, places[:, 1]) for x in (-0.1, 0.1)], axis=0) > 0.07

    unknown = best_compound(both, CONFIG, np.inf)
    seen = replace(both, voxels=seen_free(beside))
    assert best_compound(seen, CONFIG, np.inf).cost > unknown.cost + 30.0
    assert best_compound(seen, CONFIG, apart).shape is None
