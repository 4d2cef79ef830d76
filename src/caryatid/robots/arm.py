"""An arm with a wrist camera: the reachable views of its view sphere, and their rolls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid.config import ArmConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import fibonacci_sphere
from caryatid.geometry.transforms import Array
from caryatid.planning.candidates import Candidates, Posture
from caryatid.robots import protocol
from caryatid.robots.floor import FloorGrid
from caryatid.robots.protocol import OwnViews, SimulatedRobot, Unreachable
from caryatid.robots.reachability import ReachabilityMap
from caryatid.sensing.view_sphere import ViewSphere

Reachable = Callable[[Array], NDArray[np.bool_]]
"""Function that tests which poses (N, 4, 4) of its camera or gripper an arm reaches: → (N,)."""

REASONS = (
    "the camera would be too low over the table",
    "a wall blocks the line of sight",
    "out of the hand's reach",
)
"""Reasons to reject a view; the first that applies counts."""

UNCONFIRMED = "rejected by the arm's confirm()"
"""Why `confirm` refuses a view."""

RADIUS_SHARE = 0.65
"""A larger sphere is taken with at least this share of the most views that any sphere has in reach [1]: from
farther away, a view shows more of the table."""


class ArmRobot(SimulatedRobot, OwnViews):
    """A fixed arm, in simulation or as the model of a real one.

    The views of its sphere look at the centre. Each is tried level and then with increasing roll about the
    optical axis, because a rolled image shows the same and few wrists hold a camera level everywhere. The
    candidate has the first roll that the hand reaches.

    The path to a view is the straight line between the camera's positions. Between two views of one sphere
    that is its diameter times sin(α/2), α the angle at the centre: the cost of eq. 3 of the paper.

    For a real arm: inherit, move the arm in `move_to`, and then call `move_to` of this class.

    Args:
        reachable: Which camera poses the hand reaches, in the frame of the arm's base: your own inverse
            kinematics, or a `ReachabilityMap`. It need not consider the table.
        T_world_base: Pose of the base (4, 4).
        config: Radii to choose among, rolls, clearance over the table.
        confirm: Says whether the arm can go to one pose (4, 4) in the frame of the base, for exact inverse
            kinematics or a motion planner behind a coarse map. It is called for a chosen view; on False or
            None another one is chosen. Instead of True it may return the joint positions (J,), which the
            waypoints then hold. Without it, `reachable` decides. `move_to` does not ask again for the pose
            that it accepted last.
        centre_world: Centre (3,) of its view sphere [m], or None for the middle of the table top.
        furniture: Walls that block views, or None.
        T_world_camera: Camera pose (4, 4), or None before the first move, which has path length 0.

    Raises:
        InputError: A pose is not a rigid transform, or a map is not of the camera in the frame of the base.
    """

    def __init__(
        self,
        reachable: Reachable,
        T_world_base: ArrayLike,
        config: ArmConfig | None = None,
        *,
        confirm: Callable[[Array], bool | Array | None] | None = None,
        centre_world: ArrayLike | None = None,
        furniture: FloorGrid | None = None,
        T_world_camera: ArrayLike | None = None,
    ) -> None:
        if isinstance(reachable, ReachabilityMap):
            reachable.check_use("reachable", "camera", "base")
        self._reachable = reachable
        self.T_world_base = transforms.as_rigid(T_world_base, "T_world_base")
        self._config = config or ArmConfig()
        self._centre = None if centre_world is None else np.array(centre_world, dtype=np.float64)
        self._confirm = confirm
        self._confirmed: tuple[Array, Array | None] = np.zeros((4, 4)), None
        self._furniture = furniture
        self._sphere: ViewSphere | None = None
        self._offer: tuple[ViewSphere, Candidates] | None = None
        if T_world_camera is not None:
            self._T_world_camera = transforms.as_rigid(T_world_camera, "T_world_camera").copy()

    def view_sphere(self, proposed: ViewSphere) -> ViewSphere:
        """Choose the largest radius with about as many views within reach as any other.

        Its points are spread evenly in the frame of the base, so the arm has the same views wherever it
        stands with its table.
        """
        centre = proposed.centre_world if self._centre is None else self._centre
        if self._sphere is None or not np.array_equal(self._sphere.centre_world, centre):
            radius, largest = self._config.radius
            if radius != largest:
                # Thirteen spheres, 5 cm apart with the default radii.
                radii = np.linspace(radius, largest, 13)
                spheres = [self._sphere_around(centre, float(r), self._config.radius_views) for r in radii]
                views = np.array([len(self._offered(sphere)) for sphere in spheres])
                radius = float(radii[views >= RADIUS_SHARE * views.max()][-1])
            self._sphere = self._sphere_around(centre, radius, self._config.sphere_points)
        return self._sphere

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Return the arm's posture with its camera at a pose (4, 4), roll included, or why there is none.

        The platform of the posture is the base; its yaw and pitch are the camera's. Joint positions are known
        if `confirm` returned them.
        """
        T = transforms.as_rigid(T_world_camera, "T_world_camera")
        if not self._reaches(T[None])[0]:
            distance = float(np.linalg.norm(T[:3, 3] - self.T_world_base[:3, 3]))
            return Unreachable(f"{REASONS[2]}, {distance:.2f} m from the base")
        here = self._T_world_camera
        is_there = here is not None and np.array_equal(T, here)
        # A sampling planner may reject at the second call what it accepted at the first.
        is_confirmed = is_there or np.array_equal(T, self._confirmed[0])
        if not is_confirmed and (refused := self.confirm(T)) is not None:
            return refused
        return self._posture if is_there and self._posture is not None else self._posture_of(T)

    def waypoints(self, T_world_camera: Array) -> tuple[Posture, ...]:
        """Return the postures here and at a pose (4, 4); the path between is up to the motion planner.

        Joint positions are known for a pose that was confirmed last, or reached.
        """
        there, here = self._posture_of(T_world_camera), self._T_world_camera
        return (there,) if here is None else (self._posture or self._posture_of(here), there)

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere within reach, clear of the table, that see its centre past walls.

        They are computed once for a sphere; later calls update only the path lengths.
        """
        if self._offer is None or self._offer[0] is not sphere:
            self._offer = sphere, self._offered(sphere)
        views = self._offer[1]
        return views.from_elsewhere(protocol.straight_lengths(self._T_world_camera, views.T_world_camera))

    def confirm(self, T_world_camera: Array) -> Unreachable | None:
        """Ask `confirm` whether the arm can go to a candidate (4, 4); None = it can."""
        T_base_camera = transforms.invert(self.T_world_base) @ T_world_camera
        answer = self._confirm is None or self._confirm(T_base_camera)
        joints = answer.copy() if isinstance(answer, np.ndarray) else None
        if joints is None and not answer:
            return Unreachable(UNCONFIRMED)
        self._confirmed = T_world_camera.copy(), joints
        return None

    def _go(self, posture: Posture, T_world_camera: Array) -> float:
        """Move there; what was confirmed held for the way from the previous pose."""
        self._confirmed = np.zeros((4, 4)), None
        return super()._go(posture, T_world_camera)

    def _posture_of(self, T_world_camera: Array) -> Posture:
        """The posture at a pose (4, 4), with the joint positions that `confirm` last returned for it."""
        base_yaw = float(np.arctan2(*self.T_world_base[[1, 0], 0]))
        posture = protocol.posture_at(T_world_camera, np.array([*self.T_world_base[:2, 3], base_yaw]))
        T_confirmed, joints = self._confirmed
        return replace(posture, joints=joints) if np.array_equal(T_confirmed, T_world_camera) else posture

    def _sphere_around(self, centre_world: Array, radius: float, count: int) -> ViewSphere:
        return ViewSphere(centre_world, radius, transforms.rotate(self.T_world_base, fibonacci_sphere(count)))

    def _offered(self, sphere: ViewSphere) -> Candidates:
        """The views of a sphere within reach, each rolled by the smallest sufficient angle."""
        poses = sphere.poses(sphere.directions)
        eyes = poses[:, :3, 3]
        code = np.full(len(poses), -1)
        if self._furniture is not None:
            code[self._furniture.hidden(eyes, sphere.centre_world)] = 1
        code[eyes[:, 2] < sphere.centre_world[2] + self._config.clearance] = 0
        left = np.flatnonzero(code < 0)
        held, reached = poses[left], np.zeros(len(left), dtype=np.bool_)
        turns = np.arange(self._config.rolls) * (2.0 * np.pi / self._config.rolls)
        turns = np.minimum(turns, 2.0 * np.pi - turns) * np.where(turns > np.pi, -1.0, 1.0)
        for turn in turns[np.argsort(np.abs(turns), kind="stable")]:
            rest = np.flatnonzero(~reached)
            R = transforms.rotation_from_vector((0.0, 0.0, turn))
            rolled = poses[left[rest]] @ transforms.rigid(R, np.zeros(3))
            found = self._reaches(rolled)
            held[rest[found]], reached[rest[found]] = rolled[found], True
        code[left[~reached]] = 2
        rejected, good = protocol.count_reasons(code, REASONS), left[reached]
        return Candidates(held[reached], sphere.directions[good], np.zeros(len(good)), rejected, good)

    def _reaches(self, T_world_camera: Array) -> NDArray[np.bool_]:
        """Ask which poses (N, 4, 4) the hand reaches (N,)."""
        answer = np.asarray(self._reachable(transforms.invert(self.T_world_base) @ T_world_camera))
        if answer.shape != (len(T_world_camera),) or answer.dtype != np.bool_:
            reason = f"returned {answer.dtype} of shape {answer.shape} for {len(T_world_camera)} poses"
            raise InputError("reachable", reason, f"return bool of shape ({len(T_world_camera)},)")
        return answer
