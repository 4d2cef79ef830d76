"""The support surface: the horizontal plane that carries the objects, found by RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import SurfaceConfig
from caryatid.errors import PerceptionError
from caryatid.geometry import transforms
from caryatid.geometry.polygons import hull
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array

Mask = NDArray[np.bool_]

HYPOTHESES = 400
"""RANSAC hypotheses a plane [1]; they find a plane of 20 % of the points with confidence 0.96."""
SAMPLE = 4000
"""Points the hypotheses are scored on [1]; spread evenly over the cloud."""
PLANES = 6
"""Horizontal planes looked at where the table is not known [1]."""
REFINEMENTS = 4
"""Least-squares fits of a plane to its inliers, one after the other [1]."""
CELL = 0.03
"""Grid on a plane by which its area is measured [m]; above the points' spacing at 3 m."""
MAX_CELLS = 1000
"""Most cells along a plane's grid [1]; bounds memory where a cloud is not in metres."""
STOREY_SHARE = 0.05
"""Least share of a floor's points that the table above it has [1]; less is a shelf behind."""
THICKNESS = 0.04
"""Thickness of the box the table top is modelled by [m]; only its top counts."""


@dataclass(frozen=True, eq=False, slots=True)
class SupportSurface:
    """The table top.

    Attributes:
        normal_world: Unit normal (3,), upwards.
        point_world: Centroid of the inliers, moved onto the plane (3,) [m].
        outline_world: Convex hull (M, 3) of the inliers on the plane [m], counter-clockwise seen from above.
        shape: Thin box whose top face is the smallest rectangle around the outline; its z is the normal.
    """

    normal_world: Array
    point_world: Array
    outline_world: Array
    shape: Box

    def height(self, points_world: Array) -> Array:
        """Signed height (...,) [m] of points (..., 3) over the surface."""
        return (points_world - self.point_world) @ self.normal_world

    def over(self, points_world: Array, low: float, high: float, margin: float) -> Mask:
        """Which points (N, 3) [m] are over the outline, or no further than the margin [m] outside it.

        Args:
            points_world: (N, 3) [m].
            low: Least height [m].
            high: Greatest height [m].
            margin: Distance outside the lines of all sides within which points still count [m].
        """
        axes = np.concatenate([_basis(self.normal_world), self.normal_world[None]])
        points, over = np.ascontiguousarray(points_world), np.zeros(len(points_world), dtype=np.bool_)
        _find_over(points, self.point_world, axes, self._sides(), low, high, margin, over)
        return over

    def _sides(self) -> Array:
        """Outward unit normal, in the plane's coordinates, and offset [m] of each side (M, 3)."""
        corners = (self.outline_world - self.point_world) @ _basis(self.normal_world).T
        edges = transforms.unit(np.roll(corners, -1, axis=0) - corners)
        outward = np.stack([edges[:, 1], -edges[:, 0]], axis=-1)
        return np.concatenate([outward, np.einsum("ij,ij->i", outward, corners)[:, None]], axis=-1)

    def moved(self, T: Array) -> SupportSurface:
        """Return the surface moved by a rigid transform (4, 4) of the world."""
        return SupportSurface(
            transforms.rotate(T, self.normal_world),
            transforms.transform(T, self.point_world),
            transforms.transform(T, self.outline_world),
            self.shape.moved(T),
        )


@dataclass(frozen=True, eq=False, slots=True)
class _Plane:
    """A plane n·p = offset, the points on it, and how much of it is seen [m²]."""

    normal: Array
    offset: float
    inliers: Mask
    area: float

    def height(self, up: Array) -> float:
        """Where the plane cuts the line along `up` through the origin [m]."""
        return float(self.offset / (self.normal @ up))


def find_support_surface(
    cloud_points: Array,
    normals: Array,
    up: Array | None,
    config: SurfaceConfig,
    rng: np.random.Generator,
    max_planes: int = PLANES,
) -> SupportSurface:
    """Find the table among the planes of a scene.

    The planes across `up` are taken out one by one, largest first. Those that have a table-sized plane a
    storey above them are floors; of the rest the one with most points, what the camera looks at, is the
    table. Without `up`, the largest plane that faces the camera and has the rest of the scene in front of it
    gives the direction.

    Args:
        cloud_points: (N, 3) [m]; in the camera frame if `up` is None.
        normals: Unit normals (N, 3) towards the sensor.
        up: Upward direction (3,), or None where the camera's pose is not known.
        config: Tolerances and sizes.
        rng: Draws the hypotheses.
        max_planes: Horizontal planes looked at, largest first, before the table is chosen.

    Raises:
        PerceptionError: No plane has enough points.
    """
    points, normals = np.asarray(cloud_points, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    if up is None:
        everywhere = np.ones(len(points), dtype=bool)
        largest = _largest_plane(points, normals, everywhere, None, config, rng)
        if largest is None:
            raise PerceptionError(_nothing_found(len(points), config))
        up = largest.normal
    candidates = _horizontal_planes(points, normals, transforms.unit(up), config, rng, max_planes)
    if not candidates:
        raise PerceptionError(_nothing_found(len(points), config))
    return _surface(points, _choose_table(candidates, transforms.unit(up), config), config)


def refitted(
    surface: SupportSurface, points: Array, normals: Array, up: Array, config: SurfaceConfig
) -> SupportSurface | None:
    """Fit a support surface that is known well anew, to more points; None where too few are near it.

    Args:
        surface: What is known: within the tolerance nearly everywhere.
        points: (N, 3) [m].
        normals: Unit normals (N, 3) towards the sensor.
        up: Upward direction (3,).
        config: Tolerances.
    """
    normal = surface.normal_world
    offset = float(normal @ surface.point_world)
    plane = _refine(points, normals, np.ones(len(points), dtype=bool), normal, offset, up, config)
    return None if plane is None else _surface(points, plane, config)


def _horizontal_planes(
    points: Array,
    normals: Array,
    up: Array,
    config: SurfaceConfig,
    rng: np.random.Generator,
    max_planes: int,
) -> list[_Plane]:
    left = normals @ up > np.cos(np.radians(config.max_deviation))
    planes: list[_Plane] = []
    while len(planes) < max_planes:
        plane = _largest_plane(points, normals, left, up, config, rng)
        if plane is None:
            break
        planes.append(plane)
        left = left & (np.abs(points @ plane.normal - plane.offset) > 2.0 * config.tolerance)
    return planes


def _choose_table(planes: list[_Plane], up: Array, config: SurfaceConfig) -> _Plane:
    def is_floor(plane: _Plane) -> bool:
        return any(
            other.area >= config.min_area
            and other.height(up) > plane.height(up) + config.storey
            and other.inliers.sum() >= STOREY_SHARE * plane.inliers.sum()
            for other in planes
        )

    standing = [plane for plane in planes if not is_floor(plane)]
    sizeable = [plane for plane in standing if plane.area >= config.min_area]
    return max(sizeable or standing, key=lambda plane: int(plane.inliers.sum()))


def _largest_plane(
    points: Array,
    normals: Array,
    among: Mask,
    up: Array | None,
    config: SurfaceConfig,
    rng: np.random.Generator,
) -> _Plane | None:
    """MSAC over three-point hypotheses, and with `up` also one-point ones; refined on all the points."""
    index = np.flatnonzero(among)
    if len(index) < config.min_points:
        return None
    sample = index[np.linspace(0, len(index) - 1, min(SAMPLE, len(index))).astype(np.intp)]
    p, n = points[sample], normals[sample]
    triples = p[rng.integers(0, len(p), size=(HYPOTHESES, 3))]
    directions = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    proper = np.linalg.norm(directions, axis=-1) > 1e-9
    directions, anchors = transforms.unit(directions[proper]), triples[proper, 0]
    if up is None:
        directions = np.where(
            (np.einsum("ij,ij->i", directions, anchors) > 0)[:, None], -directions, directions
        )
        upright = directions[:, 1] < np.sin(np.radians(config.max_tilt))
    else:
        directions = np.where((directions @ up < 0)[:, None], -directions, directions)
        upright = directions @ up > np.cos(np.radians(config.max_tilt))
    directions, anchors = directions[upright], anchors[upright]
    if up is not None:
        anchors = np.concatenate([anchors, p[rng.integers(0, len(p), size=HYPOTHESES // 4)]])
        directions = np.concatenate([directions, np.tile(up, (len(anchors) - len(directions), 1))])
    if len(directions) == 0:
        return None
    offsets = np.einsum("ij,ij->i", directions, anchors)
    agree, behind = np.cos(np.radians(config.max_deviation)), 0.0 if up is not None else 1.0
    best = int(np.argmax(_plane_gains(p, n, directions, offsets, config.tolerance, agree, behind)))
    return _refine(points, normals, among, directions[best], float(offsets[best]), up, config)


def _refine(
    points: Array,
    normals: Array,
    among: Mask,
    normal: Array,
    offset: float,
    up: Array | None,
    config: SurfaceConfig,
) -> _Plane | None:
    """Least squares on the inliers, a few times over; None if too few remain or the plane has tilted."""
    least_cosine = np.cos(np.radians(config.max_deviation))
    inliers = among
    for _ in range(REFINEMENTS):
        inliers = among & (np.abs(points @ normal - offset) <= config.tolerance)
        inliers &= normals @ normal > least_cosine
        if np.count_nonzero(inliers) < max(config.min_points, 3):
            return None
        on_plane = np.compress(inliers, points, axis=0)
        centre = on_plane.mean(axis=0)
        refined = np.linalg.eigh(np.cov(on_plane.T))[1][:, 0]
        normal = refined if refined @ normal > 0 else -refined
        offset = float(normal @ centre)
    if up is not None and normal @ up < np.cos(np.radians(config.max_tilt)):
        return None
    inliers, area = _main_part(points, normal, inliers, config)
    return _Plane(normal, offset, inliers, area) if inliers.sum() >= config.min_points else None


def _main_part(points: Array, normal: Array, inliers: Mask, config: SurfaceConfig) -> tuple[Mask, float]:
    """Keep the largest part of a plane that holds together over gaps, and say how much of it is seen [m²]."""
    index = np.flatnonzero(inliers)
    flat = _basis(normal) @ np.take(points, index, axis=0).T
    cell = max(CELL, float((flat.max(axis=1) - flat.min(axis=1)).max()) / MAX_CELLS)
    cells = np.floor(flat / cell).astype(np.intp)
    cells -= cells.min(axis=1, keepdims=True)
    size = cells.max(axis=1) + 1
    owner = cells[0] * size[1] + cells[1]
    count = np.bincount(owner, minlength=int(size.prod())).reshape(size)
    reach = int(np.ceil(config.gap / cell / 2.0))
    near = ndimage.distance_transform_edt(np.pad(count == 0, reach))[reach:-reach, reach:-reach] <= reach
    part, _ = ndimage.label(near)
    main = int(np.argmax(np.bincount(part.ravel(), weights=count.ravel())))
    kept = np.zeros_like(inliers)
    kept[index[part.ravel()[owner] == main]] = True
    return kept, float(np.count_nonzero((count > 0) & (part == main))) * cell**2


def _surface(points: Array, plane: _Plane, config: SurfaceConfig) -> SupportSurface:
    on_plane = np.compress(plane.inliers, points, axis=0)
    centroid = np.array([x.mean() for x in on_plane.T])
    centroid = centroid - (plane.normal @ centroid - plane.offset) * plane.normal
    basis = _basis(plane.normal)
    flat = (on_plane - centroid) @ basis.T
    corners = hull(np.ascontiguousarray(flat))
    if len(corners) < 3:
        raise PerceptionError("the points of the support surface lie on one line")
    outline = centroid + corners @ basis
    return SupportSurface(plane.normal, centroid, outline, _top_box(corners, centroid, basis, THICKNESS))


def _top_box(corners: Array, origin: Array, basis: Array, thickness: float) -> Box:
    """Box under the smallest rectangle around a convex polygon (M, 2) [m] in the plane's coordinates."""
    edges = transforms.unit(np.roll(corners, -1, axis=0) - corners)
    along = corners @ edges.T
    across = corners @ np.stack([-edges[:, 1], edges[:, 0]])
    sizes = np.stack([np.ptp(along, axis=0), np.ptp(across, axis=0)])
    best = int(np.argmin(sizes[0] * sizes[1]))
    x, y = edges[best], np.array([-edges[best, 1], edges[best, 0]])
    middle = np.array(
        [
            np.ptp(along[:, best]) / 2 + along[:, best].min(),
            np.ptp(across[:, best]) / 2 + across[:, best].min(),
        ]
    )
    centre_flat = middle[0] * x + middle[1] * y
    normal = np.cross(basis[0], basis[1])
    R = np.stack([x @ basis, y @ basis, normal], axis=1)
    centre = origin + centre_flat @ basis - thickness / 2.0 * normal
    return Box(transforms.rigid(R, centre), np.array([sizes[0, best], sizes[1, best], thickness]))


def _basis(normal: Array) -> Array:
    """Two unit vectors (2, 3) that span the plane, right-handed with the normal."""
    x = transforms.perpendicular(normal)
    return np.stack([x, np.cross(normal, x)])


def _nothing_found(count: int, config: SurfaceConfig) -> str:
    return (
        f"no support surface: no level plane holds {config.min_points} of the {count} points; "
        "the table top must be in view"
    )


@njit(cache=True, error_model="numpy")
def _plane_gains(points, normals, directions, offsets, tolerance, least_cosine, penalty):  # type: ignore[no-untyped-def]
    """Score (B,) planes n·p = offset by points: 1 − (distance/tolerance)² each where their normals agree.

    A point further than three tolerances behind a plane costs it the penalty.
    """
    gains = np.zeros(len(offsets))
    for k in range(len(offsets)):
        nx, ny, nz = directions[k]
        for i in range(len(points)):
            signed = nx * points[i, 0] + ny * points[i, 1] + nz * points[i, 2] - offsets[k]
            if signed < -3.0 * tolerance:
                gains[k] -= penalty
                continue
            cosine = nx * normals[i, 0] + ny * normals[i, 1] + nz * normals[i, 2]
            if abs(signed) < tolerance and cosine > least_cosine:
                gains[k] += 1.0 - (signed / tolerance) ** 2
    return gains


@njit(cache=True)
def _find_over(points, origin, axes, sides, low, high, margin, over):  # type: ignore[no-untyped-def]
    """Mark the points (N,) that are within."""
    for i in range(len(points)):
        u, v, w = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        z = axes[2, 0] * u + axes[2, 1] * v + axes[2, 2] * w
        if not low < z < high:
            continue
        x = axes[0, 0] * u + axes[0, 1] * v + axes[0, 2] * w
        y = axes[1, 0] * u + axes[1, 1] * v + axes[1, 2] * w
        k = 0
        while k < len(sides) and sides[k, 0] * x + sides[k, 1] * y - sides[k, 2] <= margin:
            k += 1
        over[i] = k == len(sides)
