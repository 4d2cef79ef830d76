"""The paper's planner, Algorithm 2 with its formulas as printed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caryatid.interest import inhibition_of_return, painted, points_of_interest
from caryatid.planners.decision import Decision, PlanningState, check_candidates, path_cost


class PaperPlanner:
    """Saliency painted on the view sphere around projected points of interest.

    Whatever the configuration says, it takes eq. 2 with 2π, midpoints, the occlusion test and
    h = sin(α/2); it shares λ_s, the spread and the depth of the inhibition with the other planners.
    """

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate with the largest c = s − h, eq. 3; of equal ones the first.

        The saliency of each point of interest falls off with the angle from where it is projected to; it is
        negated for candidates from which the point is hidden; the largest counts where several overlap.
        """
        check_candidates(state)
        config = replace(state.config, saliency="paper", edge_point="midpoint", path_cost="angle")
        state = replace(state, config=config)
        candidates, sphere = state.candidates, state.sphere
        points = points_of_interest(state.graph, sphere, state.visited, len(state.visited), config)
        sigma = float(np.deg2rad(config.spread))

        saliency = np.zeros(len(candidates))
        sphere_saliency = np.zeros(len(sphere.directions))
        strongest = np.zeros(len(candidates), dtype=np.intp)
        if points:
            positions = np.stack([p.position_world for p in points])
            eyes_world = candidates.T_world_camera[:, :3, 3]
            hidden = state.voxels.blocked(positions, eyes_world, config.clearance).T
            signed = np.where(hidden, -1.0, 1.0) * painted(points, candidates.directions, sigma)
            strongest = signed.argmax(axis=1)
            saliency = signed.max(axis=1)
            sphere_saliency = painted(points, sphere.directions, sigma).max(axis=1)
        saliency = saliency + inhibition_of_return(state.visited, candidates.directions, config)
        sphere_saliency = sphere_saliency + inhibition_of_return(state.visited, sphere.directions, config)
        if candidates.indices is not None:
            sphere_saliency[candidates.indices] = saliency

        cost = path_cost(state)
        score = saliency - cost
        best = int(np.argmax(score))
        why = points[strongest[best]].why if points else "no point of interest is left; the nearest new view"
        return Decision(
            candidates.T_world_camera[best],
            best,
            float(saliency[best]),
            float(cost[best]),
            float(score[best]),
            why,
            tuple(points),
            saliency,
            sphere_saliency,
        )
