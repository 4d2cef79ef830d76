"""Input and decision of a planner."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig
from caryatid.errors import PlanningError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.planning.candidates import Candidates, Looks, Posture
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.runtime import Pictured
from caryatid.runtime.parallel import one_blas_thread
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.voxel_map import VoxelMap


@dataclass(frozen=True, eq=False, slots=True)
class PlanningState:
    """Input of a planner.

    Attributes:
        graph: The fused support graph.
        sphere: The view sphere.
        voxels: The voxel map: free, occupied and unknown space.
        visited: Unit directions (V, 3) from the centre to the views so far; the last is the current one.
        candidates: The views that can be reached.
        config: Settings of section IV.
        goal: Id of the object to remove, which may not be known yet; None = all matter alike.
    """

    graph: SupportGraph
    sphere: ViewSphere
    voxels: VoxelMap
    visited: Array
    candidates: Candidates
    config: ActiveVisionConfig
    goal: str | None = None

    def __repr__(self) -> str:
        views, candidates = len(self.visited), len(self.candidates)
        return f"PlanningState(views={views}, candidates={candidates}, graph={self.graph})"


class PaintedLate:
    """A field that holds an array, or a function that is called for it at the first access."""

    def __get__(self, holder: object, owner: type | None = None) -> Array | None:
        if holder is None:
            return None
        value = holder.__dict__["painted"]
        if callable(value):
            value = holder.__dict__["painted"] = value()
        return value

    def __set__(self, holder: object, value: Array | Callable[[], Array] | None) -> None:
        holder.__dict__["painted"] = value


@dataclass(frozen=True, eq=False)
class Decision(Pictured):
    """The next best view and its reason.

    Attributes:
        T_world_camera: Pose (4, 4) to go to.
        index: Index among the candidates.
        saliency: s of eq. 3 there, with the inhibition of return [1].
        cost: h of eq. 3 there [1].
        score: c = s − h, eq. 3 [1].
        why: One sentence for a person to read.
        points_of_interest: The points that the planner considered.
        candidate_saliency: s (N,) of every candidate, or None.
        sphere_saliency: s (M,) of every point of the view sphere, for drawing, or None. It may be a function
            that returns the array, because most pictures are never drawn.
        waypoints: The path to the view: postures, from the current one to the one at the view, connected by
            straight lines. Only the last if the robot returns no others; empty without a robot.
        stop: Why another view may not be worth its path, or None; steps of the loop say it themselves.
    """

    T_world_camera: Array
    index: int
    saliency: float
    cost: float
    score: float
    why: str
    points_of_interest: tuple[PointOfInterest, ...] = ()
    candidate_saliency: Array | None = None
    sphere_saliency: PaintedLate = PaintedLate()
    waypoints: tuple[Posture, ...] = ()
    stop: str | None = None

    def with_fields(self, **fields: Any) -> Decision:
        """Return the same decision with other fields."""
        decision = copy.copy(self)
        for name, value in fields.items():
            object.__setattr__(decision, name, value)
        return decision

    def __repr__(self) -> str:
        stop = f"; stop: {self.stop}" if self.stop else ""
        return f"Decision(candidate {self.index}, score {self.score:.3f}: {self.why}{stop})"


class Planner(Protocol):
    """Chooses the next view."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose one of the candidates.

        Args:
            state: The state to plan from.
            rng: For every random choice.

        Raises:
            PlanningError: There is no candidate.
        """
        ...


def check_candidates(state: PlanningState) -> None:
    """Raise PlanningError, with the reasons, if no view can be reached.

    Raises:
        PlanningError: There is none.
    """
    if len(state.candidates) == 0:
        reasons = ", ".join(f"{reason} ({n})" for reason, n in state.candidates.rejected.items())
        raise PlanningError(f"no candidate views left: {reasons or 'the robot offers no candidates'}")


def path_cost(state: PlanningState) -> Array:
    """Path cost of each candidate, h(v) of eq. 3 (N,).

    `angle`: sin(α/2), α the angle at the sphere's centre between the current view and the candidate.
    `path`: the path length in diameters of the view sphere. `none`: nothing.
    """
    match state.config.path_cost:
        case "angle":
            return np.sin(transforms.angle_between(state.visited[-1], state.candidates.directions) / 2.0)
        case "path":
            return state.candidates.path_length / (2.0 * state.sphere.radius)
        case "none":
            return np.zeros(len(state.candidates))


def decide(
    candidates: Candidates,
    saliency: Array,
    cost: Array,
    why: Callable[[int], str],
    *,
    looks: Looks | None = None,
    points: tuple[PointOfInterest, ...] = (),
    elsewhere: Callable[[], Array],
) -> Decision:
    """Choose the view with the largest c = s − h, eq. 3; the first in case of a tie.

    Saliency s (C,), cost h (C,) and the reason are those of the candidates in `looks`, which represent the
    others; None = all. `elsewhere` returns s (M,) of the points of the view sphere, as a new array, without
    the candidates.
    """
    score = saliency - cost
    best = int(np.argmax(score))
    index = best if looks is None else int(looks.chosen[best])
    candidate_saliency = saliency if looks is None else saliency[looks.nearest]
    figures = (float(saliency[best]), float(cost[best]), float(score[best]), why(best))
    paint = partial(_paint, elsewhere, candidates.indices, candidate_saliency)
    return Decision(candidates.T_world_camera[index], index, *figures, points, candidate_saliency, paint)


@one_blas_thread
def _paint(elsewhere: Callable[[], Array], indices: NDArray[np.intp] | None, saliency: Array) -> Array:
    """Saliency (M,) of the view sphere with that of the candidates at their points."""
    sphere_saliency = elsewhere()
    if indices is not None:
        sphere_saliency[indices] = saliency
    return sphere_saliency


def go_to(state: PlanningState, index: int, why: str) -> Decision:
    """Choose a candidate by its index: for planners that do not use the scene."""
    cost = float(path_cost(state)[index])
    return Decision(state.candidates.T_world_camera[index], index, 0.0, cost, -cost, why)
