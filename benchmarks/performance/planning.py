"""One decision over the whole view sphere: the default planner against the field's volumetric one."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from caryatid import Config, Scene, SceneObject, Support, SupportGraph
from caryatid.geometry.transforms import Array
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision, PlanningState
from caryatid.planning.expected_visibility import SURFACE_SAMPLES
from caryatid.planning.planners import make_planner
from caryatid.planning.points_of_interest import points_of_interest
from caryatid.runtime.threads import one_blas_thread
from caryatid.sensing.view_sphere import ViewSphere
from performance import limits
from performance.clock import in_turns
from performance.effort import FULL, Effort
from performance.frames import fresh, record, table_of
from performance.rows import Median, Row, Target, timed_row

OBJECTS = 36
"""On the table [1]: each has one point of interest at least, so there are enough."""
VIEWS = 2
"""Views before the decision."""
POINTS = 30
"""Points of interest of Algorithm 1 the decision is about."""
OURS, THEIRS = "support", "occlusion-aware"
EVERY = 1_000_000
"""Directions no thinning leaves one out of [1]."""
TARGET = Target(1.0 / 20.0)


def measure_decision(effort: Effort = FULL) -> list[Row]:
    """Rows of one decision."""
    state, candidates = decision_state()
    every = replace(state, config=replace(state.config, look_directions=EVERY))
    calls = {name: _plan(name, state) for name in (OURS, THEIRS)}
    found = in_turns({**calls, "every": _plan(THEIRS, every), "reach": candidates}, effort.runs)
    decided = calls[OURS]()
    active = state.config
    bound = limits.plan_limit(
        state.voxels.hits.size, len(state.candidates), SURFACE_SAMPLES, active.look_directions
    )
    note = (
        f"{len(state.sphere.directions):,} views, {len(state.candidates):,} within reach; {POINTS} points of "
        f"interest of relations, {len(decided.points_of_interest) - POINTS} of what is hidden. The planner "
        f"beside it looks from one in {active.look_directions:,} directions all around; the other volumetric "
        "planners gather all formulations in the same pass and take as long"
    )
    what = f"one decision, {POINTS} points of interest"
    limit = limits.machine().limit(*bound)
    return [
        timed_row(
            "decision", what, Median.of(found[OURS]), peer=f"the planner {THEIRS}",
            theirs=Median.of(found[THEIRS]), limit=limit, target=TARGET, note=note,
        ),
        timed_row(
            "decision.every", what, Median.of(found[OURS]), peer=f"{THEIRS}, from every view",
            theirs=Median.of(found["every"]), limit=limit,
            note="ours scores every view in reach; the planner beside it casts rays from all of them here",
        ),
        timed_row(
            "decision.reach", "which views the robot reaches, before it", Median.of(found["reach"]),
            limit=limits.machine().limit(152.0 * len(state.sphere.directions)),
        ),
    ]  # fmt: skip


def decision_state() -> tuple[PlanningState, Callable[[], Candidates]]:
    """What is known of a table after some views, and what asks which views can be reached."""
    recording = record(table_of(OBJECTS), VIEWS)
    scene = Scene(recording.config, segmentation="labels")
    for view in recording.views:
        scene.update(fresh(view))
    sphere, voxels, robot = scene.sphere, scene.voxels, recording.robot
    assert sphere is not None
    assert voxels is not None
    robot.move_to(recording.poses[-1])
    visited = sphere.direction_of(recording.poses)
    graph = with_points(scene.graph, sphere, visited, recording.config)
    active = recording.config.active
    asked_for_none = copy.copy(robot)
    state = PlanningState(graph, sphere, voxels, visited, robot.candidates(sphere), active)
    return state, lambda: copy.copy(asked_for_none).candidates(sphere)


def with_points(
    graph: SupportGraph, sphere: ViewSphere, visited: Array, config: Config, count: int = POINTS
) -> SupportGraph:
    """Return the part of a graph that has exactly so many points of interest of Algorithm 1.

    An object has as many as it has supporters, and one where it has none. Objects are left out from the last
    one on, supports of what is left where that is too much.

    Raises:
        ValueError: The graph has fewer.
    """

    def points(part: SupportGraph) -> int:
        return len(points_of_interest(part, sphere, visited, len(visited), config.active))

    if points(graph) < count:
        raise ValueError(f"the graph has {points(graph)} points of interest, fewer than {count}")
    objects, supports = list(graph.objects), list(graph.supports)
    while points(_part(objects[:-1], supports)) >= count:
        objects.pop()
    while points(_part(objects, supports)) > count:
        ends = [s.supported for s in _part(objects, supports).supports]
        again = next(e for e in reversed(ends) if ends.count(e) > 1)
        supports.remove(next(s for s in reversed(supports) if s.supported == again))
    return _part(objects, supports)


def _part(objects: list[SceneObject], supports: list[Support]) -> SupportGraph:
    """The graph of these objects and of the supports among them."""
    ids = {o.id for o in objects}
    return SupportGraph(tuple(objects), tuple(s for s in supports if {*s.pair} <= ids))


def _plan(name: str, state: PlanningState) -> Callable[[], Decision]:
    """A planner's decision, with BLAS on one thread as `next_best_view` has it."""
    planner = make_planner(name)
    return one_blas_thread(lambda: planner.plan(state, np.random.default_rng(0)))
