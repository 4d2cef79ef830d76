"""The paper's planner, Algorithm 2 with its formulas as printed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caryatid.planning.decision import Decision, PlanningState
from caryatid.planning.planners.attention import AttentionPlanner


class PaperPlanner:
    """Algorithm 2 as printed: the planner `attention` with the settings that are the paper's.

    Whatever the configuration says, it takes eq. 2 with 2π, midpoints, saliency that spreads, the occlusion
    test and h = sin(α/2); it shares λ_s, the spread and the depth of the inhibition with the other planners.
    """

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate with the largest c = s − h, eq. 3; of equal ones the first."""
        literal = replace(
            state.config,
            saliency="paper",
            edge_point="midpoint",
            path_cost="angle",
            occlusion="invert",
            propagation=True,
        )
        return AttentionPlanner().plan(replace(state, config=literal), rng)
