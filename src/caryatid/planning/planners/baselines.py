"""Planners that do not use the scene: random placement (the paper's baseline), a ring, farthest point."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import transforms
from caryatid.planning.decision import Decision, PlanningState, check_candidates, go_to
from caryatid.sensing.view_sphere import direction

STOPS = 5
"""Stops of the planner `ring` in a round [1]; two rounds are the ten views of the paper, 36° apart."""


class RandomPlanner:
    """Chooses a reachable view at random, with equal probability."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose one of the candidates at random."""
        check_candidates(state)
        index = int(rng.integers(len(state.candidates)))
        return go_to(state, index, f"random choice among {len(state.candidates)} reachable views")


class FarthestPlanner:
    """Maximises the smallest angle to any earlier view, to cover the view sphere."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the farthest candidate; of equal ones the first."""
        check_candidates(state)
        directions = state.candidates.directions
        nearest = (directions @ state.visited.T).max(axis=1)
        index = int(np.argmin(nearest))
        angle = np.rad2deg(transforms.angle_between(state.visited, directions[index]).min())
        return go_to(state, index, f"farthest from earlier views: {angle:.0f}° from the nearest")


class RingPlanner:
    """Goes around the scene in `STOPS` equal steps of azimuth, at the first view's elevation.

    Each further round fills the gaps of those before: by a half, a quarter, three quarters of a
    step, and so on.
    """

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate nearest to the next stop; of equal ones the first."""
        check_candidates(state)
        rounds, stop = divmod(len(state.visited), STOPS)
        first = state.visited[0]
        turned = 2.0 * np.pi * (stop + _halving(rounds)) / STOPS
        azimuth = float(np.arctan2(first[1], first[0]) + turned)
        wanted = direction(azimuth, float(np.arcsin(np.clip(first[2], -1.0, 1.0))))
        index = int(np.argmax(state.candidates.directions @ wanted))
        why = f"stop {stop + 1} of {STOPS} around the scene, {np.rad2deg(turned):.0f}° from the first view"
        return go_to(state, index, why)


def _halving(n: int) -> float:
    """The sequence 0, 1/2, 1/4, 3/4, 1/8, …, each in a largest gap of those before (van der Corput)."""
    digits = f"{n:b}"[::-1]
    return int(digits, 2) / 2.0 ** len(digits)
