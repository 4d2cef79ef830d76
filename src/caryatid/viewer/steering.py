"""A planner that can be switched and a robot that can be sent elsewhere, while the loop goes on as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caryatid.errors import PlanningError
from caryatid.geometry.transforms import Array
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import ATTEMPTS, Decision, Planner, PlanningState, path_cost
from caryatid.robots import OwnViews, Posture, Robot, Unreachable, refusal_of, view_sphere_of
from caryatid.sensing.view_sphere import ViewSphere


class SwitchedPlanner:
    """Plans as another planner does, which may be put in its place at any time.

    It remembers what it planned from last, so that another planner, or a person, can plan anew from it.

    Attributes:
        planner: Who plans.
        state: What was planned from last, or None.
    """

    def __init__(self, planner: Planner) -> None:
        self.planner = planner
        self.state: PlanningState | None = None

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose one of the candidates as the planner in place does."""
        self.state = state
        return self.planner.plan(state, rng)


class SteeredRobot(OwnViews):
    """A robot that may be sent elsewhere than the loop sends it."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._elsewhere: Array | None = None

    @property
    def T_world_camera(self) -> Array:
        """Where the camera is now (4, 4)."""
        return self._robot.T_world_camera

    def go_instead(self, T_world_camera: Array | None) -> None:
        """Next time go to this view (4, 4), wherever the loop says; None takes that back."""
        self._elsewhere = T_world_camera

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Say how the robot would stand with its camera at a pose (4, 4), or why it cannot."""
        return self._robot.solve(T_world_camera)

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that can be reached."""
        return self._robot.candidates(sphere)

    def move_to(self, T_world_camera: Array) -> float:
        """Go there, or where a person says, and return the length of the way [m]."""
        target = T_world_camera if self._elsewhere is None else self._elsewhere
        self._elsewhere = None
        return self._robot.move_to(target)

    def view_sphere(self, proposed: ViewSphere) -> ViewSphere:
        """Say on which sphere the robot's views lie."""
        return view_sphere_of(self._robot, proposed)

    def confirm(self, T_world_camera: Array) -> Unreachable | None:
        """Say why a candidate (4, 4) that was chosen cannot be taken after all."""
        return refusal_of(self._robot, T_world_camera)


def planned_anew(state: PlanningState, planner: Planner, robot: Robot, seed: int) -> Decision:
    """Choose with another planner from the same state, as the loop would have.

    Args:
        state: What the planner is given.
        planner: The other planner.
        robot: May refuse a view.
        seed: Seed of its random choices.

    Raises:
        PlanningError: The robot can take none of the views.
    """
    rng = np.random.default_rng([seed, len(state.visited)])
    why = ""
    for _ in range(ATTEMPTS):
        decision = planner.plan(state, rng)
        refused = refusal_of(robot, decision.T_world_camera)
        if refused is None:
            return decision
        why = refused.reason
        state = replace(state, candidates=state.candidates.without(decision.index, why))
    raise PlanningError(f"the robot could take none of {ATTEMPTS} views: {why}")


def taken_by_hand(state: PlanningState, index: int, planned: Decision) -> Decision:
    """The decision of a person for a candidate, with the figures the planner gives it.

    Args:
        state: What was planned from.
        index: Which candidate.
        planned: What the planner chose from it.
    """
    rated = planned.candidate_saliency
    saliency = 0.0 if rated is None or index >= len(rated) else float(rated[index])
    cost = float(path_cost(state)[index])
    return replace(
        planned,
        T_world_camera=state.candidates.T_world_camera[index],
        index=index,
        saliency=saliency,
        cost=cost,
        score=saliency - cost,
        why="chosen by hand",
    )


def candidate_under(
    origin_world: Array, direction_world: Array, sphere: ViewSphere, candidates: Candidates, within: float
) -> int | None:
    """Which candidate a ray from the eye points at, where it first meets the sphere or else behind.

    Args:
        origin_world: The eye (3,) [m].
        direction_world: Where the ray goes (3,).
        sphere: The view sphere.
        candidates: The views on it that can be reached.
        within: How far off the candidate may be, at the sphere's centre [rad].
    """
    if len(candidates) == 0:
        return None
    ray = direction_world / np.linalg.norm(direction_world)
    offset = origin_world - sphere.centre_world
    along = float(offset @ ray)
    reach = along**2 - float(offset @ offset) + sphere.radius**2
    if reach < 0.0:
        return None
    for distance in (-along - np.sqrt(reach), -along + np.sqrt(reach)):
        if distance <= 0.0:
            continue
        met = (offset + distance * ray) / sphere.radius
        cosine = candidates.directions @ met
        best = int(np.argmax(cosine))
        if np.arccos(np.clip(cosine[best], -1.0, 1.0)) <= within:
            return best
    return None
