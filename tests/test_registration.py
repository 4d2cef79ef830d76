from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import TABLE_TOP, box, cylinder, moved, sphere, surface_points

from caryatid import frames
from caryatid.config import RegistrationConfig
from caryatid.frames import Array
from caryatid.registration import align, twist_transform
from caryatid.views import Cloud

CONFIG = RegistrationConfig()
PIVOT = np.array([0.0, 0.0, TABLE_TOP])


def cloud_of(
    *shapes, spacing=0.006, sigma=1e-4, seed=0, keep=lambda normals: np.ones(len(normals), dtype=bool)
):
    rng = np.random.default_rng(seed)
    points, normals, labels = [], [], []
    for label, shape in enumerate(shapes, start=1):
        p, n = surface_points(shape, rng, spacing=spacing, sigma=sigma)
        points.append(p[keep(n)])
        normals.append(n[keep(n)])
        labels.append(np.full(keep(n).sum(), label, dtype=np.int32))
    return Cloud(np.concatenate(points), np.concatenate(normals), np.concatenate(labels))


SCENE = (
    box((0.0, 0.0, TABLE_TOP + 0.05), (0.12, 0.09, 0.1), turn_deg=20.0),
    box((-0.12, 0.15, TABLE_TOP + 0.03), (0.06, 0.14, 0.06), turn_deg=-35.0),
    cylinder((0.1, -0.2, TABLE_TOP + 0.06), 0.04, 0.12),
    sphere((0.15, 0.15, TABLE_TOP + 0.04), 0.04),
)
KNOWN = cloud_of(*SCENE)
# The other sampling of the same surfaces: points have no exact partners.
NEW = cloud_of(*SCENE, spacing=0.0073, seed=1)


def motion(translation_mm=(0.0, 0.0, 0.0), rotation_deg=(0.0, 0.0, 0.0)) -> Array:
    twist = np.concatenate([np.array(translation_mm) / 1000.0, np.radians(rotation_deg)])
    return twist_transform(twist, PIVOT)


def worst_error(T: Array, points: Array) -> float:
    """How far the worst point is from where it belongs [m]."""
    return float(np.linalg.norm(frames.transform(T, points) - points, axis=1).max())


@pytest.mark.parametrize(
    "error",
    [
        motion(translation_mm=(6.0, -4.0, 5.0)),
        motion(rotation_deg=(0.3, -0.4, 0.5)),
        motion(translation_mm=(-5.0, 5.0, -3.0), rotation_deg=(0.4, 0.2, -0.6)),
    ],
)
def test_a_small_registration_error_is_undone(error):
    eager = replace(CONFIG, exact=0.0)
    found = align(moved(NEW, error), KNOWN, PIVOT, eager)
    before, after = worst_error(error, NEW.points_world), worst_error(found.T @ error, NEW.points_world)
    assert before > 0.002
    assert after < 0.5 * before
    assert found.residual_after < 0.5 * found.residual_before
    assert found.matched > 1000
    # What stays is the prior's share: it goes where points are trusted more.
    trusting = align(moved(NEW, error), KNOWN, PIVOT, replace(eager, noise=CONFIG.noise / 5.0))
    assert worst_error(trusting.T @ error, NEW.points_world) < 0.1 * before


def test_what_lies_right_stays_to_a_fraction_of_a_millimetre():
    found = align(NEW, KNOWN, PIVOT, CONFIG)
    assert worst_error(found.T, NEW.points_world) < 0.0003


def test_the_very_points_that_are_known_do_not_move_at_all():
    some = KNOWN.select(np.arange(0, len(KNOWN), 3))
    found = align(some, KNOWN, PIVOT, replace(CONFIG, exact=0.0))
    np.testing.assert_array_equal(found.T, np.eye(4))
    assert found.residual_after == 0.0


def test_a_plane_alone_leaves_what_it_does_not_show_as_reported():
    top = box((0.0, 0.0, TABLE_TOP - 0.02), (0.7, 1.0, 0.04))
    upper = {"keep": lambda normals: normals[:, 2] > 0.9}
    known = cloud_of(top, spacing=0.01, sigma=0.0, **upper)
    new = cloud_of(top, spacing=0.013, sigma=0.0, **upper)
    error = motion(translation_mm=(4.0, -3.0, 6.0), rotation_deg=(0.3, 0.3, 0.4))
    found = align(moved(new, error), known, PIVOT, CONFIG)
    # Height and tilt are seen; sliding on the plane and turning about its normal are not.
    np.testing.assert_allclose(
        found.twist[[2, 3, 4]], [-0.006, *-np.radians((0.3, 0.3))], rtol=0.1, atol=2e-4
    )
    np.testing.assert_allclose(found.twist[[0, 1]], 0.0, atol=2e-4)
    assert abs(found.twist[5]) < np.radians(0.02)


def test_a_view_that_fits_as_reported_is_not_moved():
    new = moved(NEW, motion(translation_mm=(2.0, 0.0, 1.0)))
    eager = align(new, KNOWN, PIVOT, replace(CONFIG, exact=0.0))
    assert (eager.twist != 0.0).any()
    fits = eager.residual_before
    assert_refused(align(new, KNOWN, PIVOT, replace(CONFIG, exact=1.1 * fits)))
    assert (align(new, KNOWN, PIVOT, replace(CONFIG, exact=0.9 * fits)).twist == eager.twist).all()


def test_the_more_a_reported_pose_is_trusted_the_less_it_is_moved():
    error = motion(translation_mm=(6.0, -4.0, 5.0))
    stay = []
    for sigma in (0.01, 0.001, 0.0001):
        sure = replace(CONFIG, translation=sigma, rotation=np.degrees(10.0 * sigma))
        found = align(moved(NEW, error), KNOWN, PIVOT, sure)
        stay.append(worst_error(found.T @ error, NEW.points_world) / worst_error(error, NEW.points_world))
    # As often as it is matched anew, the prior pulls towards the reported pose, not towards the last one.
    assert stay[0] < 0.2 < stay[1] < 0.8 < stay[2]


def assert_refused(found):
    np.testing.assert_array_equal(found.T, np.eye(4))
    assert found.residual_after == found.residual_before


def test_too_few_points_determine_nothing():
    few = moved(NEW, motion(translation_mm=(5.0, 0.0, 0.0))).select(np.arange(CONFIG.min_points - 1))
    found = align(few, KNOWN, PIVOT, CONFIG)
    assert_refused(found)
    assert found.matched < CONFIG.min_points


def test_what_lies_elsewhere_does_not_match():
    found = align(moved(NEW, motion(translation_mm=(0.0, 900.0, 0.0))), KNOWN, PIVOT, CONFIG)
    assert_refused(found)


def test_a_move_beyond_the_limits_is_refused():
    error = motion(translation_mm=(8.0, 0.0, 0.0))
    strict = replace(CONFIG, max_translation=0.004)
    assert np.linalg.norm(align(moved(NEW, error), KNOWN, PIVOT, CONFIG).twist[:3]) > 0.004
    assert_refused(align(moved(NEW, error), KNOWN, PIVOT, strict))
    turned = motion(rotation_deg=(0.0, 0.0, 0.8))
    assert align(moved(NEW, turned), KNOWN, PIVOT, CONFIG).twist[5] != 0.0
    assert_refused(align(moved(NEW, turned), KNOWN, PIVOT, replace(CONFIG, max_rotation=0.3)))


def test_equal_labels_are_matched_and_no_others():
    error = motion(translation_mm=(6.0, -4.0, 5.0))
    new = moved(NEW, error)
    strangers = replace(new, labels=new.labels + 10)
    assert_refused(align(strangers, KNOWN, PIVOT, CONFIG))
    unlabelled = align(replace(new, labels=None), KNOWN, PIVOT, CONFIG)
    assert worst_error(unlabelled.T @ error, NEW.points_world) < 0.15 * worst_error(error, NEW.points_world)


def test_surfaces_that_face_away_are_no_partners():
    inside_out = replace(NEW, normals_world=-NEW.normals_world)
    assert_refused(align(inside_out, KNOWN, PIVOT, CONFIG))


def test_a_twist_turns_about_its_pivot():
    T = twist_transform(np.array([0.01, 0.02, 0.03, 0.0, 0.0, 0.5]), PIVOT)
    np.testing.assert_allclose(frames.transform(T, PIVOT), PIVOT + (0.01, 0.02, 0.03))
    np.testing.assert_allclose(T[:3, :3], frames.rotation_from_vector((0.0, 0.0, 0.5)))
