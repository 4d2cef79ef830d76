"""The candidate farthest from all earlier views: coverage of the view sphere without a look at the scene."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import transforms
from caryatid.planning.decision import Decision, PlanningState, check_candidates, go_to


class FarthestPlanner:
    """Goes where the smallest angle to any earlier view is largest."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the farthest candidate; of equal ones the first."""
        check_candidates(state)
        directions = state.candidates.directions
        nearest = (directions @ state.visited.T).max(axis=1)
        index = int(np.argmin(nearest))
        angle = np.rad2deg(transforms.angle_between(state.visited, directions[index]).min())
        return go_to(state, index, f"{angle:.0f}° from the nearest earlier view, farther than any other")
