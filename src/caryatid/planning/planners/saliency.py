"""Algorithm 2: saliency on the view sphere, as the settings read it (`attention`) or as printed (`paper`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig
from caryatid.geometry.transforms import Array
from caryatid.planning.decision import Decision, PlanningState, check_candidates, decide, path_cost
from caryatid.planning.points_of_interest import (
    PointOfInterest,
    inhibition_of_return,
    painted,
    points_of_interest,
)

CLEARANCE = 0.05
"""Neighbourhood of a point of interest that its line of sight leaves first [m]; half a common object."""


class AttentionPlanner:
    """Saliency painted on the view sphere around projected points of interest.

    Eq. 2 (`saliency`, `saliency_weight`), where a relation's point lies (`edge_point`), how far its saliency
    spreads (`propagation`, `spread`), what a hidden point is worth (`occlusion`), how much earlier views
    repel (`inhibition`) and what going there costs (`path_cost`) are as `PlanningState.config` says.
    """

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate with the largest c = s − h, eq. 3; of equal ones the first.

        Of several points of interest that reach a candidate the one with the largest saliency there counts,
        after that of the hidden ones is negated; a candidate that none reaches has none.
        """
        check_candidates(state)
        config, candidates, sphere = state.config, state.candidates, state.sphere
        points = points_of_interest(state.graph, sphere, state.visited, len(state.visited), config)

        saliency, strongest = np.zeros(len(candidates)), np.full(len(candidates), -1)
        if points:
            given, reached = _given(points, candidates.directions, config)
            signed = np.where(_hidden(points, state), -1.0, 1.0) * given
            saliency, strongest = _largest(signed, reached)
        saliency = saliency + inhibition_of_return(state.visited, candidates.directions, config)

        def why(best: int) -> str:
            if strongest[best] < 0:
                return "no point of interest is left; the nearest new view"
            return points[strongest[best]].why

        return decide(
            candidates,
            saliency,
            path_cost(state),
            why,
            points=tuple(points),
            elsewhere=partial(_on_sphere, tuple(points), state.visited, sphere.directions, config),
        )


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


def _on_sphere(
    points: Sequence[PointOfInterest], visited: Array, directions: Array, config: ActiveVisionConfig
) -> Array:
    """Saliency (M,) of views that are not asked whether points are hidden from them."""
    inhibition = inhibition_of_return(visited, directions, config)
    return _largest(*_given(points, directions, config))[0] + inhibition if points else inhibition


def _given(
    points: Sequence[PointOfInterest], directions: Array, config: ActiveVisionConfig
) -> tuple[Array, NDArray[np.bool_]]:
    """Saliency each point gives each view (M, K), and where it reaches: all, or the nearest alone."""
    if config.propagation:
        given = painted(points, directions, float(np.deg2rad(config.spread)))
        return given, np.ones(given.shape, dtype=np.bool_)
    tops = np.stack([p.direction for p in points])
    reached = np.zeros((len(directions), len(points)), dtype=np.bool_)
    reached[np.argmax(directions @ tops.T, axis=0), np.arange(len(points))] = True
    return np.where(reached, [p.saliency for p in points], 0.0), reached


def _hidden(points: Sequence[PointOfInterest], state: PlanningState) -> NDArray[np.bool_]:
    """Which points are hidden from which candidates (N, K); none where `config.occlusion` ignores it."""
    if state.config.occlusion == "ignore":
        return np.zeros((len(state.candidates), len(points)), dtype=np.bool_)
    positions = np.stack([p.position_world for p in points])
    eyes_world = state.candidates.T_world_camera[:, :3, 3]
    return state.voxels.solid().blocked(positions, eyes_world, CLEARANCE).T


def _largest(given: Array, reached: NDArray[np.bool_]) -> tuple[Array, NDArray[np.intp]]:
    """Largest saliency (M,) that reaches each view, 0 where none does, and whose it is (M,), −1 for none."""
    counted = np.where(reached, given, -np.inf)
    strongest = np.where(reached.any(axis=1), counted.argmax(axis=1), -1)
    return np.where(strongest < 0, 0.0, counted.max(axis=1)), strongest
