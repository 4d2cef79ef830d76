"""What a view says of a shape that it should show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raycast import TABLE, from_the_side, table_scene
from synthetic import box, sphere

from caryatid.geometry import transforms
from caryatid.objects.changes import PRIOR_ODDS, Sight, likelihood_ratio

EYE = from_the_side(azimuth=180.0)
CRATE = box((0.0, 0.0, TABLE + 0.06), (0.1, 0.1, 0.12))
BALL = sphere((0.0, 0.0, TABLE + 0.06), 0.06)


def view_of(*boxes, spheres=()):
    return table_scene(
        EYE,
        [(b.T_world_object[:3, 3], b.extents) for b in boxes],
        [(s.T_world_object[:3, 3], s.radius) for s in spheres],
    )


def screen(share):
    """A screen that hides this share of the crate's width."""
    return box((-0.3, 0.3 + 0.05 - 0.1 * share, TABLE + 0.25), (0.02, 0.6, 0.5))


def nearer(distance):
    """The crate as a wrong registration has it, nearer to the camera [m]."""
    return CRATE.moved(transforms.rigid(np.eye(3), -distance * EYE[:3, 2]))


EMPTY = view_of()
HALF = np.where(np.arange(640) % 2 == 0, 0.0, EMPTY.depth)


@pytest.mark.parametrize(
    ("shape", "view", "expected"),
    [
        pytest.param(CRATE, view_of(CRATE), False, id="a crate is there"),
        pytest.param(BALL, view_of(spheres=[BALL]), False, id="a ball is there"),
        pytest.param(CRATE, EMPTY, True, id="a crate is gone"),
        pytest.param(BALL, EMPTY, True, id="a ball is gone"),
        pytest.param(CRATE, view_of(screen(1.0)), False, id="hidden"),
        pytest.param(CRATE, view_of(screen(0.8)), False, id="most of it hidden"),
        pytest.param(CRATE, view_of(screen(0.2)), True, id="little of it hidden"),
        pytest.param(nearer(0.016), view_of(CRATE), False, id="an error of registration"),
        pytest.param(nearer(0.032), view_of(CRATE), True, id="more than an error of registration"),
        pytest.param(box((0.0, 3.0, TABLE), (0.1, 0.1, 0.1)), EMPTY, False, id="beside the image"),
        pytest.param(box((-3.0, 0.0, 2.5), (0.1, 0.1, 0.1)), EMPTY, False, id="behind the camera"),
        pytest.param(CRATE, replace(EMPTY, depth=0.0 * EMPTY.depth), False, id="no reading"),
        pytest.param(CRATE, replace(EMPTY, depth=HALF), True, id="every other reading"),
    ],
)
def test_a_shape_is_gone_where_readings_lie_behind_its_surface(shape, view, expected):
    through, there = Sight(view).cells(*shape.surface(0.01))
    assert (likelihood_ratio(through, there) > PRIOR_ODDS) == expected


def test_more_that_is_contradicted_and_less_that_is_confirmed_speak_for_a_change():
    assert likelihood_ratio(0, 0) == pytest.approx(0.0)
    ratios = np.array([[likelihood_ratio(n, m) for m in range(0, 400, 40)] for n in range(0, 400, 40)])
    assert np.isfinite(ratios).all()
    assert (np.diff(ratios, axis=0) > 0.0).all()
    assert (np.diff(ratios, axis=1) < 0.0).all()
