"""Candidate views that a robot can reach, a subset that represents them, and its postures there."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from caryatid.geometry.shapes import fibonacci_sphere
from caryatid.geometry.transforms import Array

SAME_POSE = 1e-6
"""Largest difference between the entries of two equal poses [1, m], after a way through float32 or JSON."""


@dataclass(frozen=True, eq=False, slots=True)
class Looks:
    """Some of N views, which represent all.

    Attributes:
        chosen: Indices (C,) of the views, ascending.
        nearest: Which of the chosen is nearest to each view (N,).
    """

    chosen: NDArray[np.intp]
    nearest: NDArray[np.intp]

    @classmethod
    def of(cls, chosen: NDArray[np.intp], directions: Array) -> Looks:
        """Let each view, of directions (N, 3), be represented by the nearest of the chosen (C,)."""
        return cls(chosen, KDTree(directions[chosen]).query(directions)[1])


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate views that a robot can reach.

    Attributes:
        T_world_camera: Camera poses (N, 4, 4).
        directions: Unit vectors (N, 3) from the view sphere's centre.
        path_length: Path length (N,) [m] from where the robot is: over the floor, or of its hand.
        rejected: Reason → number of views of the sphere refused for it.
        indices: Point of the view sphere of each candidate (N,), or None if they lie elsewhere.
    """

    T_world_camera: Array
    directions: Array
    path_length: Array
    rejected: dict[str, int]
    indices: NDArray[np.intp] | None = None
    _looks: dict[int, Looks] = field(default_factory=dict, init=False, repr=False)

    def __len__(self) -> int:
        return len(self.directions)

    def looks(self, count: int) -> Looks:
        """Pick the views nearest to `count` directions spread over the sphere.

        If there are fewer than an eighth of that, all are picked. Cached for the same views.
        """
        if len(self) <= count // 8:
            return Looks(np.arange(len(self)), np.arange(len(self)))
        if count not in self._looks:
            distance, nearest = KDTree(self.directions).query(fibonacci_sphere(count))
            near = distance < np.sqrt(4.0 * np.pi / count)
            chosen = np.unique(nearest[near] if near.any() else nearest)
            self._looks[count] = Looks.of(chosen, self.directions)
        return self._looks[count]

    def without(self, T_world_camera: Array, reason: str) -> Candidates:
        """Return the views without those at a pose (4, 4), which are rejected for a reason."""
        away = np.abs(self.T_world_camera - T_world_camera).max(axis=(1, 2), initial=0.0)
        index = np.flatnonzero(away < SAME_POSE)
        fields = (self.T_world_camera, self.directions, self.path_length)
        poses, directions, lengths = (np.delete(of_each, index, axis=0) for of_each in fields)
        indices = None if self.indices is None else np.delete(self.indices, index)
        rejected = self.rejected | {reason: self.rejected.get(reason, 0) + len(index)}
        return Candidates(poses, directions, lengths, rejected, indices)

    def from_elsewhere(self, path_length: Array) -> Candidates:
        """Return the same views for another robot position, with a path length (N,) [m] to each."""
        others = replace(self, path_length=path_length)
        object.__setattr__(others, "_looks", self._looks)
        return others

    def __repr__(self) -> str:
        refused = ", ".join(f"{count} {reason}" for reason, count in self.rejected.items())
        return f"Candidates({len(self)}{f'; refused: {refused}' if refused else ''})"


@dataclass(frozen=True, eq=False, slots=True)
class Posture:
    """Posture of a robot at a camera pose.

    Attributes:
        platform_world: Platform (3,): x, y, yaw [m, m, rad].
        camera_height: Height of the camera centre over the floor [m], set by the torso lift.
        head_yaw: Relative to the platform, to the left [rad].
        head_pitch: Upwards [rad].
        joints: Joint positions (J,) of an arm [rad, or m], or None if unknown.
    """

    platform_world: Array
    camera_height: float
    head_yaw: float
    head_pitch: float
    joints: Array | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as in `session next`, the service and view.json."""
        return {
            "platform": self.platform_world.tolist(),
            "camera_height": self.camera_height,
            "gaze": {"yaw": self.head_yaw, "pitch": self.head_pitch},
            "joints": None if self.joints is None else self.joints.tolist(),
        }
