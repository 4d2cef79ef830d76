from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from synthetic import box, cylinder, hausdorff, random_motion, sphere, surface_points, thing

from caryatid.config import FitConfig
from caryatid.fitting.primitives import Fit, fit
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder
from caryatid.graph import SceneObject
from caryatid.objects.fusion import axes_rotation, merged_sightings

ALL = (True,) * 6
NONE = (False,) * 6
LEVEL = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians(np.arange(0.0, 360.0, 5.0))])


def renamed(shape, turn):
    """The same solid, its axes named otherwise by a rotation (3, 3) of the cube."""
    T = shape.T_world_object @ transforms.rigid(turn, np.zeros(3))
    return Box(T, np.abs(turn.T @ shape.extents))


def fitted(shape, eye, seed) -> SceneObject:
    """What one view from an eye makes of a box or cylinder that stands alone."""
    rng = np.random.default_rng(seed)
    points, normals = surface_points(shape, rng, eye=eye, sigma=0.002)
    result = fit(points, normals, config=FitConfig(), rng=rng)
    assert isinstance(result, Fit)
    return thing(1, result.shape, residual=result.residual, seen=result.seen)


@pytest.mark.parametrize("seed", range(3))
def test_a_box_seen_from_two_sides_becomes_better_than_each(seed):
    truth = box((0.0, 0.0, 0.0), (0.08, 0.12, 0.1), turn_deg=10.0)
    one = fitted(truth, (-0.85, -0.7, 0.9), seed)
    two = fitted(truth, (0.7, 0.9, 0.9), seed + 10)
    merged = merged_sightings([one, two])
    errors = [hausdorff(o.shape, truth) for o in (one, two)]
    assert hausdorff(merged.shape, truth) < min(errors)
    # The bottom neither saw; around it each saw two of four walls, both together all of them.
    around = [hausdorff(s, truth, LEVEL) for s in (merged.shape, one.shape, two.shape)]
    assert around[0] < 0.5 * min(around[1:])
    assert sum(merged.seen) > max(sum(one.seen), sum(two.seen))


@pytest.mark.parametrize(
    ("seen", "bottom", "top"),
    [
        (((True, False), (False, True)), -0.05, 0.09),
        (((False, True), (False, True)), -0.05, 0.07),
        (((False, True), (True, False)), -0.03, 0.05),
    ],
)
def test_a_side_counts_from_those_that_saw_it_and_lies_farthest_out_where_none_did(seen, bottom, top):
    shapes = box((0.0, 0.0, 0.0), (0.1, 0.1, 0.10)), box((0.0, 0.0, 0.03), (0.1, 0.1, 0.12))
    ends = zip(shapes, seen, strict=True)
    merged = merged_sightings([thing(1, shape, seen=(True,) * 4 + sides) for shape, sides in ends])
    z, height = merged.centre_world[2], merged.shape.extents[2]
    assert (z - height / 2.0, z + height / 2.0) == pytest.approx((bottom, top))
    assert merged.seen == (*ALL[:4], *np.any(seen, axis=0))


def test_sides_are_found_again_whatever_the_axes_are_called():
    truth = box((0.02, 0.0, 0.0), (0.08, 0.12, 0.1), turn_deg=33.0)
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) @ np.diag([1.0, -1.0, -1.0])
    top_unseen = (True, True, True, True, True, False)
    first = thing(1, truth, seen=top_unseen)
    turned = renamed(truth, turn)
    up = turned.T_world_object[2, :3]
    axis = int(np.argmax(np.abs(up)))
    seen = [True] * 6
    seen[2 * axis + (up[axis] > 0.0)] = False
    merged = merged_sightings([first, thing(1, turned, seen=tuple(seen))])
    assert hausdorff(turned, truth) < 1e-12
    assert hausdorff(merged.shape, truth) < 1e-9
    assert sum(merged.seen) == 5


def test_noise_of_many_sightings_averages_out():
    rng = np.random.default_rng(0)
    truth = cylinder((0.0, 0.1, 0.2), 0.04, 0.1)
    sightings = []
    for _ in range(25):
        tilt = transforms.rotation_from_vector(0.04 * rng.normal(size=3))
        T = transforms.rigid(tilt, truth.T_world_object[:3, 3] + 0.004 * rng.normal(size=3))
        sightings.append(thing(1, Cylinder(T, 0.04 + 0.003 * rng.normal(), 0.1 + 0.005 * rng.normal())))
    errors = [hausdorff(o.shape, truth) for o in sightings]
    assert hausdorff(merged_sightings(sightings).shape, truth) < 0.4 * np.mean(errors)


def test_a_bad_fit_has_less_weight():
    good, bad = box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)), box((0.01, 0.0, 0.0), (0.1, 0.1, 0.1))
    merged = merged_sightings([thing(1, good, residual=0.001), thing(1, bad, residual=0.03)])
    assert 0.0 < merged.centre_world[0] < 0.002


def test_the_kind_with_most_evidence_wins():
    ball, crate = sphere((0.0, 0.0, 0.0), 0.05), box((0.0, 0.0, 0.0), (0.09, 0.09, 0.09))
    assert merged_sightings([thing(1, ball), thing(1, crate), thing(1, crate)]).shape.kind == "box"
    assert merged_sightings([thing(1, ball), thing(1, crate, seen=NONE)]).shape.kind == "sphere"
    balls = [thing(1, sphere((x, 0.0, 0.0), radius)) for x, radius in ((0.0, 0.04), (0.02, 0.05))]
    assert hausdorff(merged_sightings(balls).shape, sphere((0.01, 0.0, 0.0), 0.045)) < 1e-12


def test_merging_commutes_with_any_motion_and_any_order():
    sightings = [
        thing(1, box((0.0, 0.0, 0.0), (0.08, 0.12, 0.1), turn_deg=3.0 * k), seen=(True, k == 0) * 3)
        for k in range(3)
    ]
    T, merged = random_motion(np.random.default_rng(2)), merged_sightings(sightings)
    for order in permutations(sightings):
        there = [replace(o, shape=o.shape.moved(T)) for o in order]
        assert hausdorff(merged_sightings(there).shape, merged.shape.moved(T)) < 1e-12


def test_a_cylinder_has_an_axis_and_no_ends_to_tell_apart():
    upright = cylinder((0.0, 0.0, 0.0), 0.03, 0.1)
    for turn, expected in (((np.pi - 0.2, 0.0, 0.0), 0.2), ((0.0, 0.0, 1.0), 0.0)):
        turned = upright.moved(transforms.rigid(transforms.rotation_from_vector(turn), np.zeros(3)))
        assert axes_rotation(turned, upright)[1] == pytest.approx(expected)
