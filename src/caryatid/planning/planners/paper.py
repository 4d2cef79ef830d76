"""Algorithms 1 and 2 as printed (`paper`)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig
from caryatid.geometry.transforms import Array
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision, PlanningState, check_candidates, decide, path_cost
from caryatid.planning.points_of_interest import (
    PointOfInterest,
    hidden_from,
    inhibition_of_return,
    painted,
    points_of_interest,
)


class PaperPlanner:
    """Next best view selection, Algorithm 2 line by line.

    Whatever the configuration says, relations are rated by eq. 2 with 2π at the midpoint of their objects
    and a view costs h = sin(α/2). λ_s, the spread and the depth of the inhibition are the configuration's.
    """

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate with the largest c = s − h, eq. 3; the first of equal ones.

        A point of interest counts where the robot reaches its projection on the view sphere. It raises the
        saliency of the views around it, or lowers it where something stands in the line of sight.
        """
        check_candidates(state)
        config = replace(state.config, saliency="paper", edge_point="midpoint", path_cost="angle")
        state = replace(state, config=config)
        points = points_of_interest(state.graph, state.sphere, state.visited, config)
        points = [_at_reachable_height(point, state.candidates) for point in points]
        added = [p for p in points if _reachable(p.direction, state)]
        ends = np.array([p.direction for p in added]).reshape(-1, 3)
        eyes_world = state.sphere.centre_world + state.sphere.radius * ends
        hidden = np.diag(hidden_from(eyes_world, added, state.voxels))
        directions = state.candidates.directions

        def why(best: int) -> str:
            given = painted(added, directions, float(np.deg2rad(config.spread)))[best]
            raised = np.where(hidden, 0.0, given)
            if raised.max(initial=0.0) <= 0.0:
                return "no point of interest is reachable; the nearest new view"
            return added[raised.argmax()].why

        saliency = partial(_saliency, added, hidden, state.visited, config)
        return decide(
            state.candidates,
            saliency(directions),
            path_cost(state),
            why,
            points=tuple(points),
            elsewhere=partial(saliency, state.sphere.directions),
        )


def _at_reachable_height(point: PointOfInterest, candidates: Candidates) -> PointOfInterest:
    """An object without support asks only for an azimuth: look from the middle of the reachable heights."""
    if len(point.subject) > 1:
        return point
    height = float(np.median(candidates.directions[:, 2]))
    across = point.direction[:2] * np.sqrt(1.0 - height**2)
    return replace(point, direction=np.append(across, height))


def _reachable(direction: Array, state: PlanningState) -> bool:
    """Whether the point of the view sphere nearest to a direction (3,) is a candidate."""
    candidates = state.candidates
    nearest = int(np.argmax(candidates.directions @ direction))
    if candidates.indices is not None:
        return int(np.argmax(state.sphere.directions @ direction)) == int(candidates.indices[nearest])
    # Off its points: within their mean spacing.
    angle = np.arccos(np.clip(candidates.directions[nearest] @ direction, -1.0, 1.0))
    return bool(angle <= np.sqrt(4.0 * np.pi / len(state.sphere.directions)))


def _saliency(
    points: list[PointOfInterest],
    hidden: NDArray[np.bool_],
    visited: Array,
    config: ActiveVisionConfig,
    directions: Array,
) -> Array:
    """Saliency (M,) of views in directions (M, 3)."""
    given = painted(points, directions, float(np.deg2rad(config.spread)))
    raised = np.where(hidden, 0.0, given).max(axis=1, initial=0.0)
    lowered = np.where(hidden, given, 0.0).max(axis=1, initial=0.0)
    return raised + np.minimum(-lowered, inhibition_of_return(visited, directions, config))
