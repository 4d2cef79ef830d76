from __future__ import annotations

import numpy as np
import pytest
from planning_states import CONFIG, CUBE, HOME, OPEN, candidates, state

from caryatid.geometry import transforms
from caryatid.planning.candidates import Candidates
from caryatid.planning.planners import make_planner


def tour(name: str, views: int, offered: Candidates = OPEN, **settings: object) -> np.ndarray:
    """Directions (views, 3) a planner visits, from HOME on."""
    rng, visited = np.random.default_rng(0), HOME[None]
    while len(visited) < views:
        decision = make_planner(name).plan(state([CUBE], visited=visited, offered=offered, **settings), rng)
        visited = np.vstack([visited, offered.directions[decision.index]])
    return visited


def azimuths(directions: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arctan2(directions[:, 1], directions[:, 0]))


@pytest.mark.parametrize("stops", [3, 5, 8])
def test_a_ring_goes_around_in_equal_steps_at_one_elevation(stops: int):
    visited = tour("ring", stops, ring_views=stops)
    steps = np.diff(azimuths(visited)) % 360.0
    np.testing.assert_allclose(steps, 360.0 / stops, atol=3.0)
    np.testing.assert_allclose(np.rad2deg(np.arcsin(visited[:, 2])), 35.0, atol=2.0)


def test_further_rounds_of_a_ring_fill_the_gaps():
    visited = tour("ring", 4 * CONFIG.ring_views)
    for rounds in (1, 2, 4):
        part = np.sort(azimuths(visited[: rounds * CONFIG.ring_views]))
        gaps = np.diff(np.append(part, part[0] + 360.0))
        np.testing.assert_allclose(gaps, 72.0 / rounds, atol=4.0)


def test_a_stop_that_cannot_be_reached_is_replaced_by_the_nearest_view():
    wall = ((0.62, 0.0, 1.0), (0.03, 1.6, 1.0))
    offered = candidates(wall)
    visited = tour("ring", 3, offered, ring_views=4)
    opposite = -HOME * (1.0, 1.0, -1.0)
    nearest = transforms.angle_between(offered.directions, opposite).min()
    assert nearest > np.deg2rad(10.0), "the wall leaves the stop open"
    assert transforms.angle_between(visited[2], opposite) == pytest.approx(nearest)


def test_farthest_is_farthest():
    visited = tour("farthest", 6)
    for n in range(1, len(visited)):
        smallest = np.array([transforms.angle_between(visited[:n], d).min() for d in OPEN.directions])
        assert transforms.angle_between(visited[:n], visited[n]).min() == pytest.approx(
            smallest.max(), abs=1e-6
        )


def test_of_equally_far_candidates_the_first_is_taken():
    directions = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    poses = np.tile(np.eye(4), (3, 1, 1))
    offered = Candidates(poses, directions, np.zeros(3), {})
    situation = state([CUBE], visited=np.array([[-1.0, 0.0, 0.0]]), offered=offered)
    assert make_planner("farthest").plan(situation, np.random.default_rng(0)).index == 0
