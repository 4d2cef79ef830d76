"""The default planner: look where the most hidden surface becomes visible.

As in Algorithm 2, it maximises c = s − h with inhibition of return over the reachable part of the view
sphere. s is what a candidate would show for the first time: the surface of the fitted objects, the least
seen ones first; the unseen space on the table that may hold a supporter, most of it among the objects; and
the points of Algorithm 1. A point counts when its line of sight is free of what was seen occupied and of the
fitted shapes. With a goal, only what its removal depends on counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from caryatid.config import ActiveVisionConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.planning import expected_visibility as targets
from caryatid.planning import points_of_interest as interest
from caryatid.planning.decision import Decision, PlanningState, check_candidates, decide, path_cost
from caryatid.planning.expected_visibility import SPACE, Samples
from caryatid.planning.points_of_interest import PointOfInterest, inhibition_of_return, painted

WORTH_SAYING = 0.05
"""Shares of the whole below this are not mentioned."""


class SupportPlanner:
    """Chooses the candidate that is expected to show the most hidden surface at low path cost."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate with the largest c = s − h, eq. 3; the first of equal ones.

        s is the worth of what a candidate shows for the first time. The cost h of going there is
        `config.effort` times that of eq. 3, and so is the inhibition of return: both only decide where views
        show about as much.
        """
        check_candidates(state)
        config, sphere, candidates = state.config, state.sphere, state.candidates
        looks = candidates.looks(config.look_directions)
        relations = interest.points_of_interest(state.graph, sphere, state.visited, config)
        relations += interest.points_of_doubt(state.graph, sphere, state.visited)
        samples, gain = _expected_gain(state, relations, candidates.T_world_camera[looks.chosen])
        inhibition = inhibition_of_return(state.visited, candidates.directions[looks.chosen], config)
        points = (*relations, *_hidden_points(state, samples, gain))
        return decide(
            candidates,
            gain.sum(axis=0) + config.effort * inhibition,
            config.effort * path_cost(state)[looks.chosen],
            lambda best: _why(samples, gain[:, best], state.graph),
            looks=looks,
            points=points,
            elsewhere=partial(_on_sphere, points, state.visited, sphere.directions, config),
        )


def _expected_gain(
    state: PlanningState, relations: list[PointOfInterest], T_world_camera: Array
) -> tuple[Samples, Array]:
    """Samples of what is still hidden, and what cameras (C, 4, 4) show of them for the first time (K, C)."""
    config = state.config
    occluders = state.voxels.occluders([o.shape for o in state.graph.objects])
    surfaces, points = targets.surface_samples(state.graph, occluders), targets.relation_samples(relations)
    T_world_visited = state.sphere.poses(state.visited)
    known = targets.join([surfaces, points])
    seen = targets.visibility(known, T_world_visited, occluders, config).max(axis=1, initial=0.0)
    shares = targets.unseen_shares(surfaces, seen[: len(surfaces.weights)])
    surfaces = replace(surfaces, weights=surfaces.weights * shares)
    # All relations' points of interest weigh a tenth of all the objects' surfaces.
    points = replace(points, weights=0.1 * points.weights)
    space = targets.space_samples(state.graph, occluders)
    samples = targets.join([surfaces, points, space])
    samples = replace(samples, weights=samples.weights * targets.matter(samples, state.graph, state.goal))
    before = np.concatenate([seen, np.zeros(len(space.weights))])
    new = samples.weights * (1.0 - before) > 0.0
    samples = samples.select(new)
    return samples, targets.newly_visible(samples, before[new], T_world_camera, occluders, config)


def _on_sphere(
    points: Sequence[PointOfInterest], visited: Array, directions: Array, config: ActiveVisionConfig
) -> Array:
    """Saliency (M,) the points and the earlier views alone give directions (M, 3)."""
    own = painted(points, directions, float(np.deg2rad(config.spread))).max(axis=1, initial=0.0)
    return own + inhibition_of_return(visited, directions, config)


def _hidden_points(state: PlanningState, samples: Samples, gain: Array) -> list[PointOfInterest]:
    """One point of interest per object and for the unseen space: the middle of its unseen part.

    Its saliency is the size of that part, relative to the largest one.
    """
    left = gain.max(axis=1, initial=0.0)
    sums = np.zeros((len(samples.names), 8))
    columns = (left, left > 0.0, left[:, None] * samples.points_world, left[:, None] * samples.normals_world)
    np.add.at(sums, samples.subjects, np.column_stack(columns))
    worth, shown, most = sums[:, 0], sums[:, 1], sums[:, 0].max(initial=0.0)
    large = np.flatnonzero((worth > WORTH_SAYING * most) & (shown > 1))
    middles, outward = sums[large, 2:5] / worth[large, None], sums[large, 5:]
    nowhere = np.linalg.norm(outward, axis=1, keepdims=True) < 1e-9
    outward = transforms.unit(np.where(nowhere, middles - state.sphere.centre_world, outward))
    points, place = [], "the table" if len(state.graph.support_surfaces) < 2 else "the support surfaces"
    for i, middle, direction in zip(large, middles, outward, strict=True):
        name, saliency = samples.names[i], float(worth[i] / most)
        subject = () if name == SPACE else (name,)
        why = f"{name} on {place}" if name == SPACE else f"part of {name} is unseen"
        points.append(PointOfInterest(middle, direction, saliency, subject, why))
    return points


def _why(samples: Samples, gain: Array, graph: SupportGraph) -> str:
    """One sentence: which objects a view shows more of, and near which one it shows the most unseen space."""
    total = float(gain.sum())
    if total <= 0.0:
        return "no view is expected to show anything hidden; this one is the cheapest"
    worth: dict[str, float] = {}
    shares = np.bincount(samples.subjects, weights=gain, minlength=len(samples.names))
    names = [_placed(samples, gain, graph) if name == SPACE else name for name in samples.names]
    for name, share in zip(names, shares, strict=True):
        worth[name] = worth.get(name, 0.0) + float(share)
    ranked = sorted(worth.items(), key=lambda item: -item[1])[:3]
    parts = [f"{name} ({share / total:.0%})" for name, share in ranked if share > WORTH_SAYING * total]
    return "expected to reveal the most: " + ", ".join(parts)


def _placed(samples: Samples, gain: Array, graph: SupportGraph) -> str:
    """Name the object nearest, seen from above, to the most of the unseen space that a view shows."""
    objects = graph.movable
    space = np.isin(samples.names, [SPACE])[samples.subjects]
    offsets = samples.points_world[space, None] - np.array([o.centre_world for o in objects])
    nearest = np.linalg.norm(offsets[:, :, :2], axis=2).argmin(axis=1)
    most = np.bincount(nearest, weights=gain[space], minlength=len(objects)).argmax()
    return f"{SPACE} near {objects[most].id}"
