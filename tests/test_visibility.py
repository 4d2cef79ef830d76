from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raycast import TABLE, from_the_side, table_scene
from synthetic import box, sphere

from caryatid.geometry import transforms
from caryatid.sensing.views import seen_through

EYE = from_the_side(azimuth=180.0)
CRATE = box((0.0, 0.0, TABLE + 0.06), (0.1, 0.1, 0.12))
BALL = sphere((0.0, 0.0, TABLE + 0.06), 0.06)


def view_of(*boxes, spheres=()):
    return table_scene(
        EYE,
        [(b.T_world_object[:3, 3], b.extents) for b in boxes],
        [(s.T_world_object[:3, 3], s.radius) for s in spheres],
    )


EMPTY = view_of()


def test_what_is_there_is_not_seen_through():
    assert not seen_through(CRATE, view_of(CRATE))
    assert not seen_through(BALL, view_of(spheres=[BALL]))


@pytest.mark.parametrize("shape", [CRATE, BALL], ids=lambda s: s.kind)
def test_what_is_gone_is_seen_through(shape):
    assert seen_through(shape, EMPTY)


def test_what_is_hidden_may_be_there_all_the_same():
    screen = box((-0.25, 0.0, TABLE + 0.25), (0.02, 0.5, 0.5))
    assert not seen_through(CRATE, view_of(screen))


def test_half_hidden_and_half_gone_is_decided_by_the_larger_part():
    def screen(share):
        """A screen that hides this share of the crate's width."""
        return box((-0.3, 0.3 + 0.05 - 0.1 * share, TABLE + 0.25), (0.02, 0.6, 0.5))

    assert seen_through(CRATE, view_of(screen(0.2)))
    assert not seen_through(CRATE, view_of(screen(0.8)))


def test_an_error_of_registration_is_no_contradiction():
    view = view_of(CRATE)
    forward = EYE[:3, 2]
    for share, contradicted in ((0.8, False), (1.6, True)):
        nearer = CRATE.moved(transforms.rigid(np.eye(3), -share * 0.02 * forward))
        assert seen_through(nearer, view) == contradicted


def test_what_is_out_of_the_image_is_not_judged():
    aside = box((0.0, 3.0, TABLE), (0.1, 0.1, 0.1))
    behind = box((-3.0, 0.0, 2.5), (0.1, 0.1, 0.1))
    assert not seen_through(aside, EMPTY)
    assert not seen_through(behind, EMPTY)


def test_pixels_without_a_reading_say_nothing():
    assert not seen_through(CRATE, replace(EMPTY, depth=np.zeros_like(EMPTY.depth)))
    half = EMPTY.depth.copy()
    half[:, ::2] = 0.0
    assert seen_through(CRATE, replace(EMPTY, depth=half))
