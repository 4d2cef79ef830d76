"""Random placement of the robot: the paper's baseline."""

from __future__ import annotations

import numpy as np

from caryatid.planners.decision import Decision, PlanningState, check_candidates, path_cost


class RandomPlanner:
    """Goes to any reachable view, all equally likely."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose one of the candidates at random."""
        check_candidates(state)
        index = int(rng.integers(len(state.candidates)))
        cost = float(path_cost(state)[index])
        why = f"one of {len(state.candidates)} reachable views, drawn at random"
        return Decision(state.candidates.T_world_camera[index], index, 0.0, cost, -cost, why)
