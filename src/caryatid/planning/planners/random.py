"""Random placement of the robot: the paper's baseline."""

from __future__ import annotations

import numpy as np

from caryatid.planning.decision import Decision, PlanningState, check_candidates, go_to


class RandomPlanner:
    """Goes to any reachable view, all equally likely."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose one of the candidates at random."""
        check_candidates(state)
        index = int(rng.integers(len(state.candidates)))
        return go_to(state, index, f"one of {len(state.candidates)} reachable views, drawn at random")
