"""Saliency on the view sphere, Algorithm 2 as the settings read it (`attention`)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig
from caryatid.geometry.transforms import Array
from caryatid.planning.decision import Decision, PlanningState, check_candidates, decide, path_cost
from caryatid.planning.points_of_interest import (
    PointOfInterest,
    hidden_from,
    inhibition_of_return,
    painted,
    points_of_interest,
)


class AttentionPlanner:
    """Saliency painted on the view sphere around projected points of interest.

    Eq. 2 (`saliency`, `saliency_weight`), where a relation's point lies (`edge_point`), how far its saliency
    spreads (`propagation`, `spread`), what a hidden point is worth (`occlusion`), how much earlier views
    repel (`inhibition`) and what going there costs (`path_cost`) are as `PlanningState.config` says.
    """

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate with the largest c = s − h, eq. 3; the first of equal ones.

        If several points of interest reach a candidate, the one with the largest saliency there counts,
        after that of the hidden ones is negated; a candidate that none reaches has none.
        """
        check_candidates(state)
        config, directions, visited = state.config, state.candidates.directions, state.visited
        points = points_of_interest(state.graph, state.sphere, visited, config)
        hidden = None
        if points and config.occlusion != "ignore":
            hidden = hidden_from(state.candidates.T_world_camera[:, :3, 3], points, state.voxels).T
        saliency, strongest = _largest(points, directions, config, hidden)

        def why(best: int) -> str:
            if strongest[best] < 0:
                return "no point of interest is left; the nearest new view"
            return points[strongest[best]].why

        return decide(
            state.candidates,
            saliency + inhibition_of_return(visited, directions, config),
            path_cost(state),
            why,
            points=tuple(points),
            elsewhere=partial(_on_sphere, tuple(points), visited, state.sphere.directions, config),
        )


def _on_sphere(
    points: Sequence[PointOfInterest], visited: Array, directions: Array, config: ActiveVisionConfig
) -> Array:
    """Saliency (M,) of views without a test whether points are hidden from them."""
    return _largest(points, directions, config)[0] + inhibition_of_return(visited, directions, config)


def _largest(
    points: Sequence[PointOfInterest],
    directions: Array,
    config: ActiveVisionConfig,
    hidden: NDArray[np.bool_] | None = None,
) -> tuple[Array, NDArray[np.intp]]:
    """Largest saliency (M,) that reaches each view, 0 where none does, and whose it is (M,), −1 for none.

    A point reaches all views, or its nearest one alone where saliency does not spread. `hidden` says which
    points are hidden from which views (M, K).
    """
    if not points:
        return np.zeros(len(directions)), np.full(len(directions), -1)
    if config.propagation:
        given = painted(points, directions, float(np.deg2rad(config.spread)))
    else:
        tops = np.stack([p.direction for p in points])
        given = np.full((len(directions), len(points)), np.nan)
        given[np.argmax(directions @ tops.T, axis=0), np.arange(len(points))] = [p.saliency for p in points]
    if hidden is not None:
        given = np.where(hidden, -given, given)
    counted = np.where(np.isnan(given), -np.inf, given)
    largest = counted.max(axis=1)
    strongest = np.where(largest > -np.inf, counted.argmax(axis=1), -1)
    return np.where(strongest < 0, 0.0, largest), strongest
