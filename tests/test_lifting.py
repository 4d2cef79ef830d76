from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caryatid.config import LiftConfig
from caryatid.simulation.lifting import ASIDE, CLEARANCE, Lifting
from caryatid.simulation.world import box, build_spec, scene_from_spec, sphere

CONFIG = LiftConfig(watch=1.0)
LOWER, UPPER, BESIDE = range(3)


def lifting(*solids) -> tuple[Lifting, np.ndarray]:
    """The solids at rest on a table."""
    scene = scene_from_spec(build_spec(solids, "test"), "test", "test")
    lift = Lifting(scene.spec, list(scene.object_bodies.values()))
    return lift, lift.rest(lift.start, (), 0.3)


@pytest.fixture(scope="module")
def stack():
    """A box on a box, and one beside them."""
    return lifting(
        box((0.1, 0.1, 0.06), (0.0, 0.0, 0.03)),
        box((0.08, 0.08, 0.06), (0.0, 0.0, 0.09)),
        box((0.05, 0.05, 0.05), (0.2, 0.0, 0.025)),
    )


def test_what_carries_nothing_is_lifted_without_harm(stack):
    lift, state = stack
    done = lift.lift(state, UPPER, CONFIG)
    assert not done.disturbed.any()
    assert done.distance.max() < 0.002
    assert done.state[UPPER, 2] > ASIDE / 2.0
    np.testing.assert_allclose(done.state[[LOWER, BESIDE]], state[[LOWER, BESIDE]], atol=0.002)


def test_the_one_below_disturbs_what_it_carries_and_nothing_else(stack):
    lift, state = stack
    done = lift.lift(state, LOWER, CONFIG)
    assert done.disturbed.tolist() == [False, True, False]
    assert done.distance[UPPER] > 0.05


def test_what_is_held_stays_and_what_is_not_falls(stack):
    lift, state = stack
    aloft = state.copy()
    aloft[UPPER, 2] += 0.3
    done = lift.lift(aloft, BESIDE, CONFIG, held=[UPPER])
    assert not done.disturbed.any()
    assert lift.lift(aloft, BESIDE, CONFIG).disturbed.tolist() == [False, True, False]


def test_an_object_goes_up_at_the_speed_asked_for_until_it_is_clear(stack):
    lift, state = stack
    done = lift.lift(state, BESIDE, CONFIG)
    heights = done.film[:, BESIDE, 2]
    rising = heights[heights < ASIDE / 2.0]
    clear = state[UPPER, 2] + 0.03 + CLEARANCE - (state[BESIDE, 2] - 0.025)
    assert rising[-1] - state[BESIDE, 2] == pytest.approx(clear, abs=0.003)
    slow = lift.lift(state, BESIDE, replace(CONFIG, speed=0.05))
    assert (slow.film[:, BESIDE, 2] < ASIDE / 2.0).sum() == pytest.approx(2 * len(rising), abs=1)


def test_what_has_been_taken_stays_away_and_counts_no_more(stack):
    lift, state = stack
    once = lift.lift(state, UPPER, CONFIG).state
    done = lift.lift(once, LOWER, CONFIG)
    assert not done.disturbed.any()
    np.testing.assert_allclose(done.state[UPPER, :3], once[UPPER, :3], atol=1e-3)


def test_a_ball_that_leans_is_disturbed_when_what_holds_it_goes():
    lift, state = lifting(
        box((0.06, 0.2, 0.12), (0.0, 0.0, 0.06)),
        box((0.06, 0.2, 0.12), (0.1, 0.0, 0.06)),
        sphere(0.035, (0.05, 0.0, 0.14)),
    )
    done = lift.lift(state, 0, CONFIG)
    assert done.disturbed[2]


def test_stopping_early_tells_the_same_verdict(stack):
    lift, state = stack
    for index in range(3):
        whole, early = (lift.lift(state, index, CONFIG, to_the_end=end) for end in (True, False))
        assert whole.disturbed.any() == early.disturbed.any()
        assert len(early.film) <= len(whole.film)


def test_lifts_leave_no_trace(stack):
    lift, state = stack
    before = state.copy()
    first, second = (lift.lift(state, LOWER, CONFIG) for _ in range(2))
    np.testing.assert_array_equal(state, before)
    np.testing.assert_array_equal(first.film, second.film)
