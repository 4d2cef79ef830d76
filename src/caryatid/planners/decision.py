"""What a planner is given and what it decides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from caryatid import frames
from caryatid.config import ActiveVisionConfig
from caryatid.errors import PlanningError
from caryatid.frames import Array
from caryatid.graph import SupportGraph
from caryatid.interest import PointOfInterest
from caryatid.robot import Candidates
from caryatid.shapes import fibonacci_sphere
from caryatid.view_sphere import ViewSphere
from caryatid.voxels import VoxelMap


@dataclass(frozen=True, eq=False, slots=True)
class PlanningState:
    """Everything a planner may look at.

    Attributes:
        graph: The fused support graph.
        sphere: The view sphere.
        voxels: Space seen free, occupied, or not at all.
        visited: Unit directions (V, 3) from the centre to the views so far; the last is the current one.
        candidates: The views that can be reached.
        config: Settings of section IV.
    """

    graph: SupportGraph
    sphere: ViewSphere
    voxels: VoxelMap
    visited: Array
    candidates: Candidates
    config: ActiveVisionConfig


@dataclass(frozen=True, eq=False, slots=True)
class Decision:
    """The next best view and why.

    Attributes:
        T_world_camera: Pose (4, 4) to go to.
        index: Which of the candidates it is.
        saliency: s of eq. 3 there, with the inhibition of return.
        cost: h of eq. 3 there.
        score: c = s − h, eq. 3.
        why: One sentence for a person to read.
        points_of_interest: What the planner took into account.
        candidate_saliency: s (N,) of every candidate, or None.
        sphere_saliency: s (M,) of every point of the view sphere, for drawing, or None.
    """

    T_world_camera: Array
    index: int
    saliency: float
    cost: float
    score: float
    why: str
    points_of_interest: tuple[PointOfInterest, ...] = ()
    candidate_saliency: Array | None = None
    sphere_saliency: Array | None = None


class Planner(Protocol):
    """Chooses where to look next."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose one of the candidates.

        Args:
            state: What is known.
            rng: For every random choice.

        Raises:
            PlanningError: There is no candidate.
        """
        ...


def check_candidates(state: PlanningState) -> None:
    """Raise PlanningError, with the reasons, where no view can be reached."""
    if len(state.candidates) == 0:
        reasons = ", ".join(f"{reason} ({n})" for reason, n in state.candidates.rejected.items())
        raise PlanningError(f"no view is left to go to: {reasons or 'the robot offers no candidates'}")


def path_cost(state: PlanningState) -> Array:
    """What it costs to go to each candidate, h(v) of eq. 3 (N,).

    `angle`: sin(α/2), α the angle at the sphere's centre between the current view and the candidate.
    `path`: the way over the floor in diameters of the view sphere. `none`: nothing.
    """
    match state.config.path_cost:
        case "angle":
            alpha = frames.angle_between(state.visited[-1], state.candidates.directions)
            return np.sin(alpha / 2.0)
        case "path":
            return state.candidates.path_length / (2.0 * state.sphere.radius)
        case "none":
            return np.zeros(len(state.candidates))


def thin(directions: Array, count: int) -> NDArray[np.intp]:
    """Pick the candidates nearest to those of `count` directions all over the sphere that have one near."""
    if len(directions) <= count // 8:
        return np.arange(len(directions))
    distance, nearest = KDTree(directions).query(fibonacci_sphere(count))
    near = distance < np.sqrt(4.0 * np.pi / count)
    return np.unique(nearest[near]) if near.any() else np.unique(nearest)
