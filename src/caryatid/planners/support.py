"""The default planner: look where most of what is hidden would come into sight.

It keeps the frame of Algorithm 2, c = s − h with inhibition of return over the reachable part of the view
sphere, and asks of each candidate what it would show that no earlier view has: the surface of the fitted
objects, most of those of which least has been seen; the unseen space on the table in which a supporter may
stand, most of it among the objects; and the points of Algorithm 1. A point counts when its line of sight is
free of what was seen occupied and of the fitted shapes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from caryatid import frames
from caryatid.frames import Array
from caryatid.interest import (
    PointOfInterest,
    inhibition_of_return,
    painted,
    points_of_doubt,
    points_of_interest,
)
from caryatid.planners.decision import Decision, PlanningState, check_candidates, path_cost, thin
from caryatid.planners.hidden import (
    SPACE,
    Samples,
    join,
    relation_samples,
    space_samples,
    surface_samples,
    unseen_shares,
    visibility,
    weighted,
)

WORTH_SAYING = 0.05
"""Shares of the whole below this are not mentioned."""


class SupportPlanner:
    """Takes the candidate that promises to show most of what is hidden, at little cost."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate with the largest c = s − h, eq. 3; of equal ones the first.

        s is the worth of what a candidate shows anew, h the cost of going there, `config.effort` times that
        of eq. 3, and so is the inhibition of return: both only decide where views show about as much.
        """
        check_candidates(state)
        config, sphere, candidates = state.config, state.sphere, state.candidates
        relations = points_of_interest(state.graph, sphere, state.visited, len(state.visited), config)
        relations += points_of_doubt(state.graph, sphere, state.visited)
        samples, gain, chosen = _expected_gain(state, relations)

        inhibition = inhibition_of_return(state.visited, candidates.directions[chosen], config)
        saliency = gain.sum(axis=0) + config.effort * inhibition
        cost = config.effort * path_cost(state)
        score = saliency - cost[chosen]
        best = int(np.argmax(score))
        index = int(chosen[best])

        points = (*relations, *_hidden_points(state, samples, gain))
        nearest = KDTree(candidates.directions[chosen]).query(candidates.directions)[1]
        candidate_saliency = saliency[nearest]
        sphere_saliency = painted(points, sphere.directions, float(np.deg2rad(config.spread))).max(
            axis=1, initial=0.0
        ) + inhibition_of_return(state.visited, sphere.directions, config)
        if candidates.indices is not None:
            sphere_saliency[candidates.indices] = candidate_saliency
        return Decision(
            candidates.T_world_camera[index],
            index,
            float(saliency[best]),
            float(cost[index]),
            float(score[best]),
            _why(samples, gain[:, best]),
            points,
            candidate_saliency,
            sphere_saliency,
        )


def _expected_gain(
    state: PlanningState, relations: list[PointOfInterest]
) -> tuple[Samples, Array, NDArray[np.intp]]:
    """Samples, what some candidates show of them anew (K, C), and which candidates those are (C,)."""
    config, sphere, candidates = state.config, state.sphere, state.candidates
    solid = state.voxels.with_shapes([o.shape for o in state.graph.objects])
    T_world_visited = sphere.poses(state.visited)
    surfaces = surface_samples(state.graph, solid, config)
    points = relation_samples(relations)
    seen = visibility(join([surfaces, points]), T_world_visited, solid, config).max(axis=1, initial=0.0)
    surfaces = weighted(surfaces, unseen_shares(surfaces, seen[: len(surfaces.weights)]))
    space = space_samples(state.graph, solid, config)
    samples = join([surfaces, weighted(points, config.relation_weight), space])
    before = np.concatenate([seen, np.zeros(len(space.weights))])
    chosen = thin(candidates.directions, config.look_directions)
    now = visibility(samples, candidates.T_world_camera[chosen], solid, config)
    return samples, samples.weights[:, None] * np.maximum(now - before[:, None], 0.0), chosen


def _hidden_points(state: PlanningState, samples: Samples, gain: Array) -> list[PointOfInterest]:
    """One point of interest per object and for the unseen space: the middle of what is left to be seen of it.

    Its saliency is how much of that there is, in shares of the subject with most of it.
    """
    left = gain.max(axis=1, initial=0.0)
    worth = np.bincount(samples.subjects, weights=left, minlength=len(samples.names))
    points = []
    for i, name in enumerate(samples.names):
        share = left * (samples.subjects == i)
        if worth[i] <= WORTH_SAYING * worth.max() or np.count_nonzero(share) < 2:
            continue
        middle = np.average(samples.points_world, axis=0, weights=share)
        outward = share @ samples.normals_world
        if np.linalg.norm(outward) < 1e-9:
            outward = middle - state.sphere.centre_world
        subject = () if name == SPACE else (name,)
        why = f"{name} on the table" if name == SPACE else f"part of {name} has not been seen"
        saliency = float(worth[i] / worth.max())
        points.append(PointOfInterest(middle, frames.unit(outward), saliency, subject, why))
    return points


def _why(samples: Samples, gain: Array) -> str:
    """One sentence: which objects a view shows more of."""
    total = float(gain.sum())
    if total <= 0.0:
        return "nothing hidden is expected to come into sight; the cheapest new view"
    worth: dict[str, float] = {}
    for i, name in enumerate(samples.names):
        worth[name] = worth.get(name, 0.0) + float(gain[samples.subjects == i].sum())
    ranked = sorted(worth.items(), key=lambda item: -item[1])[:3]
    parts = [f"{name} ({share / total:.0%})" for name, share in ranked if share > WORTH_SAYING * total]
    return "shows most of what is still hidden: " + ", ".join(parts)
