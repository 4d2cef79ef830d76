from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import motion_about_vertical

from caryatid.config import PlausibilityConfig
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.graph import SceneObject
from caryatid.support.contacts import find_contacts, find_gap
from caryatid.support.plausibility import closing, reconcile

CONFIG = PlausibilityConfig()
TABLE = SceneObject(
    "o0", 0, Box(transforms.rigid(np.eye(3), (0, 0, -0.02)), np.array([1.0, 1.0, 0.04])), "support_surface"
)


def unsure(sigma: float = 0.001, turn: float = 0.001, **sides: float) -> Uncertainty:
    """All sides this unsure [m], but for those named (`low_z` is −z, `high_z` +z)."""
    names = ("low_x", "high_x", "low_y", "high_y", "low_z", "high_z")
    each = np.array([sides.get(name, sigma) for name in names])
    pairs = each.reshape(3, 2)
    position = np.sqrt((pairs**2).sum(axis=1)) / 2.0
    return Uncertainty(position, np.full(3, turn), 2.0 * position, each)


def block(label: int, centre, size, known: Uncertainty | None) -> SceneObject:
    return SceneObject(
        f"o{label}", label, Box(transforms.rigid(np.eye(3), centre), np.array(size)), uncertainty=known
    )


def overlaps(objects) -> float:
    """Depth [m] of the deepest overlap."""
    return max((-c.distance for c in find_contacts([o.shape for o in objects], 0.0)), default=0.0)


def test_what_neither_overlaps_nor_floats_stays_as_it_is():
    scene = [
        TABLE,
        block(1, (0, 0, 0.05), (0.1, 0.1, 0.1), unsure()),
        block(2, (0.3, 0, 0.05), (0.1, 0.1, 0.1), unsure()),
    ]
    for before, after in zip(scene, reconcile(scene, CONFIG), strict=True):
        np.testing.assert_array_equal(before.shape.T_world_object, after.shape.T_world_object)
        np.testing.assert_array_equal(before.shape.extents, after.shape.extents)
        assert after.doubt == ""


def test_an_overlap_is_taken_from_the_side_nobody_saw():
    seen = block(1, (0.0, 0, 0.05), (0.1, 0.1, 0.1), unsure(0.0005))
    guessed = block(2, (0.092, 0, 0.05), (0.1, 0.1, 0.1), unsure(0.0005, low_x=0.02))
    _, first, second = reconcile([TABLE, seen, guessed], CONFIG)
    assert overlaps([first, second]) < 0.0015
    np.testing.assert_allclose(first.shape.extents, seen.shape.extents, atol=3e-4)
    assert second.shape.extents[0] == pytest.approx(0.092, abs=0.0015)
    high = second.centre_world[0] + second.shape.extents[0] / 2.0
    assert high == pytest.approx(0.142, abs=3e-4)
    assert not first.doubt
    assert not second.doubt


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
def test_what_hovers_is_let_down_onto_what_carries_it(kind):
    T = transforms.rigid(np.eye(3), (0.0, 0.0, 0.055))
    shape = {"box": Box(T, np.full(3, 0.1)), "cylinder": Cylinder(T, 0.03, 0.1), "sphere": Sphere(T, 0.05)}[
        kind
    ]
    hovering = SceneObject("o1", 1, shape, uncertainty=unsure(0.004))
    _, after = reconcile([TABLE, hovering], CONFIG)
    assert find_gap(TABLE.shape, after.shape) < 0.0012
    assert after.shape.kind == kind


def test_what_uncertainty_cannot_explain_is_left_and_said():
    first = block(1, (0.0, 0, 0.05), (0.1, 0.1, 0.1), unsure(0.0005))
    second = block(2, (0.06, 0, 0.05), (0.1, 0.1, 0.1), unsure(0.0005))
    for before, after in zip([first, second], reconcile([TABLE, first, second], CONFIG)[1:], strict=True):
        np.testing.assert_array_equal(before.shape.T_world_object, after.shape.T_world_object)
        other = "o2" if after.id == "o1" else "o1"
        assert f"overlaps {other} by 40 mm" in after.doubt


def test_without_uncertainty_or_rounds_nothing_moves():
    scene = [TABLE, block(1, (0, 0, 0.045), (0.1, 0.1, 0.1), None)]
    np.testing.assert_array_equal(reconcile(scene, CONFIG)[1].centre_world, scene[1].centre_world)
    sure = [TABLE, block(1, (0, 0, 0.048), (0.1, 0.1, 0.1), unsure(0.01))]
    off = replace(CONFIG, rounds=0)
    np.testing.assert_array_equal(reconcile(sure, off)[1].centre_world, sure[1].centre_world)


@pytest.mark.parametrize("count", [5, 60, 250])
def test_gaps_close_as_the_dense_filter_says(count):
    rng = np.random.default_rng(count)
    objects = count // 2 + 2
    first = rng.integers(0, objects - 1, count)
    pairs = np.stack([first, first + rng.integers(1, objects - first)], axis=1)
    rows, gaps = rng.normal(size=(count, 2, 9)), rng.normal(0.0, 0.003, count)
    variance = rng.uniform(0.0, 1e-5, (objects, 9))
    variance[0] = 0.0
    J = np.zeros((count, objects, 9))
    for k, pair in enumerate(pairs):
        J[k, pair] = rows[k]
    J = J.reshape(count, -1)
    scatter = (J * variance.ravel()) @ J.T + 1e-6 * np.eye(count)
    expected = variance * (J.T @ np.linalg.solve(scatter, gaps)).reshape(objects, 9)
    change = closing(pairs, rows, variance, gaps, 1e-6)
    np.testing.assert_allclose(change, expected, atol=1e-12)
    np.testing.assert_array_equal(change[0], 0.0)


def test_what_is_not_in_the_wrong_place_stays_the_object_it_is():
    aside = block(3, (0.4, 0.4, 0.05), (0.1, 0.1, 0.1), unsure())
    sunk = block(1, (0.0, 0.0, 0.048), (0.1, 0.1, 0.1), unsure(0.003))
    _, moved, same = reconcile([TABLE, sunk, aside], CONFIG)
    assert moved.shape is not sunk.shape
    assert same is aside


def test_the_correction_moves_with_the_scene():
    scene = [
        TABLE,
        block(1, (0.0, 0, 0.05), (0.1, 0.1, 0.1), unsure(0.002)),
        block(2, (0.097, 0.01, 0.052), (0.1, 0.1, 0.1), unsure(0.003)),
    ]
    T = motion_about_vertical(np.random.default_rng(5))
    moved = [replace(o, shape=o.shape.moved(T)) for o in scene]
    for here, there in zip(reconcile(scene, CONFIG), reconcile(moved, CONFIG), strict=True):
        np.testing.assert_allclose(T @ here.shape.T_world_object, there.shape.T_world_object, atol=2e-4)
        np.testing.assert_allclose(here.shape.extents, there.shape.extents, atol=2e-4)
