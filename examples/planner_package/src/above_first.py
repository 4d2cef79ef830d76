"""A planner for caryatid: first from above, then all around."""

import numpy as np

from caryatid.geometry import transforms
from caryatid.planning.decision import Decision, PlanningState, check_candidates, path_cost


class AboveFirst:
    """Looks down on the table from as high as it can, then from the side farthest from all earlier views."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the highest candidate for the second view, and for later ones the farthest one around.

        Args:
            state: What is known.
            rng: For random choices; this planner makes none.
        """
        check_candidates(state)
        directions = state.candidates.directions
        if len(state.visited) == 1:
            worth = directions[:, 2]
            best = int(np.argmax(worth))
            why = f"from above: {np.degrees(np.arcsin(worth[best])):.0f}° over the table"
        else:
            # The view from above is from no side.
            sides = np.delete(state.visited, 1, axis=0) * (1.0, 1.0, 0.0)
            around = transforms.angle_between((directions * (1.0, 1.0, 0.0))[:, None], sides[None])
            worth = around.min(axis=1) / np.pi
            best = int(np.argmax(worth))
            why = f"{np.degrees(np.pi * worth[best]):.0f}° around from the nearest earlier view"
        cost = path_cost(state)
        return Decision(
            T_world_camera=state.candidates.T_world_camera[best],
            index=best,
            saliency=float(worth[best]),
            cost=float(cost[best]),
            score=float(worth[best] - cost[best]),
            why=why,
            candidate_saliency=worth,
        )
