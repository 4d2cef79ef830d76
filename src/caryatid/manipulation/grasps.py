"""Grasps: poses in which a gripper holds an object, with a free straight path to them.

A parallel jaw grasps between two antipodal points: the line between them is within the friction cones of
both (Nguyen, 1988). A suction disc grasps where the surface is flat. The gripper moves straight along its
approach, and then lifts the object straight up. Its fingers and its hand keep clear of all known shapes on
both ways, and approach through space that was seen empty.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from caryatid.config import GripperConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import Grasp
from caryatid.robots.arm import Reachable
from caryatid.robots.reachability import ReachabilityMap
from caryatid.sensing.voxel_map import FREE, VoxelMap

POINTS = 200
"""Number of surface points at which grasps are tried [1]: 8 mm apart on a cube of 5 cm."""
TURNS = np.radians([0.0, 30.0, -30.0, 60.0, -60.0, 90.0, -90.0])
"""Turns of the approach about the closing direction [rad], the most downward first."""
FLAT = 0.002
"""Unevenness that the lip of a suction disc seals [m]."""


@dataclass(frozen=True, slots=True)
class Blocked:
    """Why a gripper cannot grasp an object.

    Attributes:
        by: Ids of the objects in the way of the least obstructed grasp; empty if nothing known is in the way.
        why: The reason, for a person to read.
    """

    by: tuple[str, ...]
    why: str


def find_grasp(
    shape: Shape,
    others: Mapping[str, Shape],
    gripper: GripperConfig,
    friction: float,
    *,
    voxels: VoxelMap | None = None,
    removed: Sequence[Shape] = (),
    reachable: Reachable | None = None,
) -> Grasp | Blocked:
    """Find the best grasp of an object that nothing obstructs, or say why there is none.

    Grasps nearer to the centre of mass and more downward are better.

    Args:
        shape: The object, in the world frame.
        others: Shapes that the gripper must not touch, by id, the support surface among them.
        gripper: The gripper.
        friction: Coefficient of friction between fingers and object [1].
        voxels: What was seen empty; None = only known shapes obstruct.
        removed: Shapes that were there when the space was seen, and are there no more.
        reachable: Which gripper poses (N, 4, 4), in the world frame, the arm reaches; None = all. The arm has
            to reach the grasp, the start of its approach, and the end of the lift.

    Raises:
        InputError: The map is not one of the gripper in the world frame.
    """
    if isinstance(reachable, ReachabilityMap):
        reachable.check_use("reachable", "gripper", "world")
    jaw = gripper.kind == "parallel"
    sides = list(_antipodal(shape, gripper, friction) if jaw else _flat(shape, gripper))
    widest = gripper.opening - 2.0 * gripper.clearance if jaw else np.inf
    found = [(T, width) for T, width in sides if width <= widest]
    if not sides:
        return Blocked(
            (), "no two opposite sides are within gripper.tilt" if jaw else "no side is flat enough"
        )
    if not found:
        lengths = min(width for _, width in sides), gripper.opening, gripper.clearance
        side, opening, spare = (f"{1e3 * length:.0f} mm" for length in lengths)
        fit = f"the gripper takes {opening} less 2 × {spare}"
        return Blocked((), f"no grip on it is narrower than {side}, and {fit}")
    poses, widths = np.array([T for T, _ in found]), np.array([width for _, width in found])
    turn = turn_of(gripper)
    if reachable is not None:
        turned = poses @ turn
        before, after = turned.copy(), turned.copy()
        before[:, :3, 3] -= gripper.travel * poses[:, :3, 2]
        after[:, 2, 3] += gripper.travel
        reached = reachable(turned) & reachable(before) & reachable(after)
        poses, widths = poses[reached], widths[reached]
        if not len(poses):
            return Blocked((), "every grasp is out of reach")
    arm = np.linalg.norm(poses[:, :3, 3] - shape.centre_of_mass, axis=1)
    lean = gripper.length * (1.0 + poses[:, 2, 2])  # how far the hand leans over, as a lever
    near = {i: o for i, o in others.items() if _near(o, shape, gripper)}
    fewest, most = dict[str, float](), -1.0
    for k in np.argsort(arm + lean, kind="stable").tolist():
        swept, risen = (
            transforms.transform(poses[k], _volume(gripper, widths[k], travel))
            for travel in (gripper.travel, 0.0)
        )
        # The heights [m] of the lift that the approach does not cover, 1 cm apart.
        top = 0.0 if -poses[k, 2, 2] > 1.0 - 1e-6 else gripper.travel + 1e-9
        path = np.concatenate([swept, *(risen + [0.0, 0.0, h] for h in np.arange(0.01, top, 0.01))])
        if ((own := shape.signed_distance(swept)) < 0.0).any():
            continue
        distances = {i: o.signed_distance(path) for i, o in near.items()}
        missing = {i: gripper.clearance - float(distance.min()) for i, distance in distances.items()}
        by = {i: distance for i, distance in missing.items() if distance > 0.0}
        if by and fewest and len(by) >= len(fewest):
            continue
        free = None
        if voxels is not None:
            # Next to known surfaces, their shapes decide: readings fill the voxels there.
            known = [own, *(distance[: len(swept)] for distance in distances.values())]
            away = np.min([*known, *(o.signed_distance(swept) for o in removed)], axis=0)
            asked = swept[away > np.sqrt(3.0) * voxels.config.size]
            free = float((voxels.state_at(asked) == FREE).mean()) if len(asked) else 1.0
            if free < gripper.seen:
                most = max(most, free)
                continue
        if not by:
            return Grasp(poses[k] @ turn, float(widths[k]), gripper.travel, free)
        fewest = by
    if fewest:
        told = (f"{i} is in the way by {1e3 * distance:.0f} mm" for i, distance in fewest.items())
        return Blocked(tuple(fewest), ", ".join(told))
    if most >= 0.0:
        seen = f"at most {100.0 * most // 1.0:.0f}% of the gripper's way was seen to be free"
        return Blocked((), f"{seen}, less than {gripper.seen:.0%}: look at the space around and above it")
    return Blocked((), "it is too large for the hand")


def turn_of(gripper: GripperConfig) -> Array:
    """Return the pose (4, 4) of a gripper's own frame in the one of `gripper_boxes`."""
    R = transforms.rotation_from_vector(np.radians([0.0, 0.0, gripper.turn]))
    return transforms.rigid(R, np.zeros(3))


def _antipodal(shape: Shape, gripper: GripperConfig, friction: float) -> Iterator[tuple[Array, float]]:
    """Poses (4, 4) of a parallel jaw of any opening, and the object's width [m] between its fingers."""
    spacing = _spacing(shape)
    points, normals = shape.surface(spacing)
    cone = np.cos(np.arctan(friction))
    for point, closing in zip(points, -normals, strict=True):
        way = points - point
        along = way @ closing
        beside = np.linalg.norm(way - along[:, None] * closing, axis=1)
        faces = (along > 1e-3) & (beside <= spacing) & (normals @ closing >= cone)
        # The nearest face ends the wall that the finger is at.
        if np.isfinite(width := float(along[faces].min(initial=np.inf))):
            for approach in _approaches(closing, gripper):
                R = np.column_stack([closing, np.cross(approach, closing), approach])
                yield transforms.rigid(R, point + 0.5 * width * closing), width


def _approaches(closing: Array, gripper: GripperConfig) -> Iterator[Array]:
    """Directions (3,) across a closing direction that lean from straight down by no more than the tilt."""
    down = np.array([0.0, 0.0, -1.0])
    downward = down - (down @ closing) * closing
    if np.linalg.norm(downward) < 1e-6:
        return
    downward = transforms.unit(downward)
    sideways = np.cross(closing, downward)
    for turn in TURNS:
        approach = np.cos(turn) * downward + np.sin(turn) * sideways
        if -approach[2] >= np.cos(np.radians(gripper.tilt)) - 1e-9:
            yield approach


def _flat(shape: Shape, gripper: GripperConfig) -> Iterator[tuple[Array, float]]:
    """Poses (4, 4) of a suction disc on flat parts of a shape, and widths of 0."""
    turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rim = gripper.disc * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(12)])
    for point, normal in zip(*shape.surface(_spacing(shape)), strict=True):
        x = transforms.perpendicular(normal)
        T = transforms.rigid(np.column_stack([x, np.cross(-normal, x), -normal]), point)
        steep = normal[2] < np.cos(np.radians(gripper.tilt))
        if not steep and (np.abs(shape.signed_distance(transforms.transform(T, rim))) <= FLAT).all():
            yield T, 0.0


def _spacing(shape: Shape) -> float:
    """Distance [m] between the surface points at which grasps are tried."""
    return max(float(np.sqrt(shape.mesh().area / POINTS)), 0.002)


def gripper_boxes(gripper: GripperConfig, width: float) -> list[tuple[Array, Array]]:
    """Corners (3,), (3,) [m] of the boxes that a gripper consists of, in its frame, open around a width [m].

    The frame has z along the approach, x along the closing direction (before `gripper.turn`), and its origin
    between the fingertips or at the middle of the disc.
    """
    hand, back = gripper.hand / 2.0, -gripper.length
    if gripper.kind == "suction":
        boxes = [
            ((-gripper.disc, -gripper.disc, back), (gripper.disc, gripper.disc, -0.001)),  # the lip touches
            ((-hand, -hand, back - gripper.hand), (hand, hand, back)),
        ]
    else:
        inner, side, end = width / 2.0 + gripper.clearance, gripper.finger, gripper.finger / 2.0
        outer = inner + gripper.finger
        broad = max(gripper.breadth / 2.0, gripper.opening / 2.0 + gripper.finger)
        boxes = [
            ((inner, -side, back), (outer, side, end)),
            ((-outer, -side, back), (-inner, side, end)),
            ((-broad, -hand, back - gripper.hand), (broad, hand, back)),
        ]
    return [(np.array(low), np.array(high)) for low, high in boxes]


@lru_cache(maxsize=256)
def _volume(gripper: GripperConfig, width: float, travel: float) -> Array:
    """Points (N, 3) [m] all over a gripper that moves along its approach, in its frame at the grasp."""
    points = []
    for low, high in gripper_boxes(gripper, width):
        low[2] -= travel
        # No farther apart than the clearance, or four to the smallest side of a large part.
        spacing = max(float((high - low).min()) / 4.0, gripper.clearance)
        axes = [
            np.linspace(a, b, int(np.ceil((b - a) / spacing)) + 1) for a, b in zip(low, high, strict=True)
        ]
        points.append(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
    return np.concatenate(points)


def _near(other: Shape, shape: Shape, gripper: GripperConfig) -> bool:
    """Whether a gripper around one shape may come near another."""
    reach = gripper.travel + gripper.length + gripper.opening + gripper.breadth + 2.0 * gripper.hand
    between = np.linalg.norm(other.T_world_object[:3, 3] - shape.T_world_object[:3, 3])
    return bool(between <= reach + (np.linalg.norm(other.extents) + np.linalg.norm(shape.extents)) / 2.0)
