"""Saliency painted on the view sphere: Algorithms 1 and 2 as printed, or as the settings read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig
from caryatid.geometry.transforms import Array
from caryatid.planning import points_of_interest as interest
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision, PlanningState, check_candidates, decide, path_cost
from caryatid.planning.points_of_interest import PointOfInterest, inhibition_of_return, painted


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
        points = interest.points_of_interest(state.graph, state.sphere, visited, config)
        hidden = None
        if points and config.occlusion != "ignore":
            hidden = interest.hidden_from(state.candidates.T_world_camera[:, :3, 3], points, state.voxels).T
        given = _given(points, directions, config, hidden)

        def why(best: int) -> str:
            if given[best].max(initial=-np.inf) == -np.inf:
                return "no point of interest is left; the nearest new view"
            return points[given[best].argmax()].why

        return decide(
            state.candidates,
            _largest(given) + inhibition_of_return(visited, directions, config),
            path_cost(state),
            why,
            points=tuple(points),
            elsewhere=partial(_on_sphere, tuple(points), visited, state.sphere.directions, config),
        )


def _on_sphere(
    points: Sequence[PointOfInterest], visited: Array, directions: Array, config: ActiveVisionConfig
) -> Array:
    """Saliency (M,) of views without a test whether points are hidden from them."""
    return _largest(_given(points, directions, config)) + inhibition_of_return(visited, directions, config)


def _given(
    points: Sequence[PointOfInterest],
    directions: Array,
    config: ActiveVisionConfig,
    hidden: NDArray[np.bool_] | None = None,
) -> Array:
    """Saliency (M, K) that points give views in directions (M, 3), −∞ where none reaches.

    A point reaches all views, or its nearest one alone where saliency does not spread. `hidden` says which
    points are hidden from which views (M, K).
    """
    if config.propagation:
        given = painted(points, directions, float(np.deg2rad(config.spread)))
    else:
        tops = np.array([p.direction for p in points]).reshape(-1, 3)
        given = np.full((len(directions), len(points)), np.nan)
        given[np.argmax(directions @ tops.T, axis=0), np.arange(len(points))] = [p.saliency for p in points]
    if hidden is not None:
        given = np.where(hidden, -given, given)
    return np.where(np.isnan(given), -np.inf, given)


def _largest(given: Array) -> Array:
    """Largest saliency (M,) among those that reach each view (M, K); 0 where none does."""
    largest = given.max(axis=1, initial=-np.inf)
    return np.where(largest > -np.inf, largest, 0.0)


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
        points = interest.points_of_interest(state.graph, state.sphere, state.visited, config)
        points = [_at_reachable_height(point, state.candidates) for point in points]
        added = [p for p in points if _reachable(p.direction, state)]
        ends = np.array([p.direction for p in added]).reshape(-1, 3)
        eyes_world = state.sphere.centre_world + state.sphere.radius * ends
        hidden = np.diag(interest.hidden_from(eyes_world, added, state.voxels))
        directions = state.candidates.directions

        def why(best: int) -> str:
            given = painted(added, directions, float(np.deg2rad(config.spread)))[best]
            raised = np.where(hidden, 0.0, given)
            if raised.max(initial=0.0) <= 0.0:
                return "no point of interest is reachable; the nearest new view"
            return added[raised.argmax()].why

        saliency = partial(_as_printed, added, hidden, state.visited, config)
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


def _as_printed(
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
