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


def test_one_sighting_is_kept_as_it_is():
    only = thing(4, box((0.1, 0.2, 0.3), (0.1, 0.2, 0.3)), seen=(True, False) * 3, residual=0.002)
    merged = merged_sightings([only])
    assert hausdorff(merged.shape, only.shape) == 0.0
    assert (merged.id, merged.seen, merged.residual) == ("o4", only.seen, 0.002)


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


def test_a_side_counts_from_those_that_saw_it():
    sees_low = thing(1, box((0.0, 0.0, 0.0), (0.1, 0.1, 0.10)), seen=(True, True, True, True, True, False))
    sees_high = thing(1, box((0.0, 0.0, 0.03), (0.1, 0.1, 0.12)), seen=(True, True, True, True, False, True))
    merged = merged_sightings([sees_low, sees_high])
    z, height = merged.centre_world[2], merged.shape.extents[2]
    assert z - height / 2.0 == pytest.approx(-0.05)
    assert z + height / 2.0 == pytest.approx(0.09)
    assert merged.seen == ALL


def test_a_side_nobody_saw_lies_farthest_out():
    short = thing(1, box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)), seen=(True, True, True, True, False, True))
    long = thing(1, box((0.0, 0.0, -0.02), (0.1, 0.1, 0.14)), seen=(True, True, True, True, False, True))
    merged = merged_sightings([short, long])
    assert merged.centre_world[2] - merged.shape.extents[2] / 2.0 == pytest.approx(-0.09)
    assert not merged.seen[4]


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


def test_the_order_of_sightings_makes_no_difference_but_for_rounding():
    rng = np.random.default_rng(1)
    truth = box((0.0, 0.0, 0.0), (0.08, 0.12, 0.1))
    sightings = [
        thing(
            1,
            truth.moved(transforms.rigid(np.eye(3), 0.004 * rng.normal(size=3))),
            residual=0.001 * k,
            seen=seen,
        )
        for k, seen in enumerate([ALL, (True, False) * 3, (False, True) * 3], start=1)
    ]
    merged = merged_sightings(sightings)
    for order in permutations(sightings):
        assert hausdorff(merged_sightings(list(order)).shape, merged.shape) < 1e-12


def test_merging_commutes_with_any_motion():
    rng = np.random.default_rng(2)
    T = random_motion(rng)
    sightings = [
        thing(1, box((0.0, 0.0, 0.0), (0.08, 0.12, 0.1), turn_deg=3.0 * k), seen=(True, k == 0) * 3)
        for k in range(3)
    ]
    there = [replace(o, shape=o.shape.moved(T)) for o in sightings]
    assert hausdorff(merged_sightings(there).shape, merged_sightings(sightings).shape.moved(T)) < 1e-12


@pytest.mark.parametrize("degrees", [0.0, 7.0, 40.0])
def test_the_angle_between_boxes_is_the_least_their_symmetry_allows(degrees):
    reference = box((0.0, 0.0, 0.0), (0.1, 0.2, 0.3))
    for quarter in range(4):
        turned = box((0.0, 0.0, 0.0), (0.1, 0.2, 0.3), turn_deg=degrees + 90.0 * quarter)
        turn, angle = axes_rotation(turned, reference)
        assert np.degrees(angle) == pytest.approx(degrees, abs=1e-5)
        aligned = turned.T_world_object[:3, :3] @ turn
        assert np.degrees(transforms.angle_between(aligned.T, np.eye(3))).max() <= degrees + 1e-5


def test_a_cylinder_has_an_axis_and_no_ends_to_tell_apart():
    upright = cylinder((0.0, 0.0, 0.0), 0.03, 0.1)
    over = upright.moved(
        transforms.rigid(transforms.rotation_from_vector((np.pi - 0.2, 0.0, 0.0)), np.zeros(3))
    )
    turn, angle = axes_rotation(over, upright)
    assert angle == pytest.approx(0.2)
    assert (over.T_world_object[:3, :3] @ turn)[2, 2] > 0.9
    spun = upright.moved(transforms.rigid(transforms.rotation_from_vector((0.0, 0.0, 1.0)), np.zeros(3)))
    assert axes_rotation(spun, upright)[1] == pytest.approx(0.0)
