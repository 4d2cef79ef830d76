"""The support surface: the horizontal plane that carries the objects, found by RANSAC."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import SurfaceConfig
from caryatid.errors import NoSurfaceError
from caryatid.geometry import transforms
from caryatid.geometry.polygons import hull
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import SHARES, for_each, kernel
from caryatid.sensing.views import View

Mask = NDArray[np.bool_]

GL = np.diag([1.0, -1.0, -1.0])
"""Axes (3, 3) of OpenCV's camera frame in OpenGL's."""
BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes (3, 3) of OpenCV's camera frame, the optical one, in the frame of a camera's body."""
GL_AXES = (
    "the camera axes are OpenGL's (y up, z backward) instead of OpenCV's (y down, z forward): give "
    "T_world_camera @ np.diag([1, -1, -1, 1])"
)
"""A cause of a wrong camera pose, and its remedy."""
BODY_AXES = (
    "the pose is that of the camera's body (x forward, z up) instead of its optical frame (x right, y down, "
    "z forward): give the pose of the optical frame"
)
"""A cause of a wrong camera pose, and its remedy."""
Z_UP = "rotate the world so that its z axis points up (on the command line: --level)"
"""Remedy for a world frame that is not level."""


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
        """Which points (N, 3) [m] are over the outline, or no further than a margin [m] outside its sides.

        Their height is between low and high [m].
        """
        return _points_over(np.ascontiguousarray(points_world), self._planes(margin), low, high)

    def pixels_over(self, view: View, low: float, high: float, margin: float = np.inf) -> Mask:
        """Which pixels (H, W) of a view show something between two heights [m] over the surface.

        The margin is as for `over`; if it is infinite, anything above or below counts. If the view has no
        pose, the surface is in the camera frame.
        """
        surface = self if view.T_world_camera is None else self.moved(transforms.invert(view.T_world_camera))
        x, y = ((np.arange(n) - view.K[k, 2]) / view.K[k, k] for k, n in enumerate(view.depth.shape[::-1]))
        return _pixels_over(view.depth, x, y, surface._planes(margin), low, high)

    def _planes(self, margin: float) -> Array:
        """Planes n·p + d (M, 4): the surface's own, and those beyond which points are too far outside."""
        up, corners = self.normal_world, self.outline_world
        own = np.append(up, -up @ self.point_world)[None]
        if margin == np.inf:
            return own
        outward = np.cross(transforms.unit(np.roll(corners, -1, axis=0) - corners), up)
        offsets = -np.einsum("ij,ij->i", outward, corners) - margin
        return np.concatenate([own, np.column_stack([outward, offsets])])

    def moved(self, T: Array) -> SupportSurface:
        """Return the surface moved by a rigid transform (4, 4) of the world."""
        return SupportSurface(
            transforms.rotate(T, self.normal_world),
            transforms.transform(T, self.point_world),
            transforms.transform(T, self.outline_world),
            self.shape.moved(T),
        )


class _Plane(NamedTuple):
    """A plane n·p = offset, the points on it, and how much of it is seen [m²]."""

    normal: Array
    offset: float
    inliers: Mask
    area: float


class _Scene(NamedTuple):
    """Points (N, 3) [m] and normals (N, 3) to search for planes, the up direction (3,), and limits."""

    points: Array
    normals: Array
    up: Array | None
    config: SurfaceConfig

    def largest_plane(self, among: Mask, rng: np.random.Generator) -> _Plane | None:
        """MSAC over three-point hypotheses, and with `up` also one-point ones; refined on all the points.

        400 hypotheses find a plane of a fifth of the points with confidence 0.96; 4000 points score them.
        """
        points, normals, up, config = self
        index = np.flatnonzero(among)
        if len(index) < config.min_points:
            return None
        sample = index[np.linspace(0, len(index) - 1, min(4000, len(index))).astype(np.intp)]
        p, n = points[sample], normals[sample]
        triples = p[rng.integers(0, len(p), size=(400, 3))]
        directions = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
        proper = np.linalg.norm(directions, axis=-1) > 1e-9
        directions, anchors = transforms.unit(directions[proper]), triples[proper, 0]
        down = np.einsum("ij,ij->i", directions, anchors) > 0.0 if up is None else directions @ up < 0.0
        directions = np.where(down[:, None], -directions, directions)
        if up is None:
            upright = directions[:, 1] < np.sin(np.radians(config.max_tilt))
        else:
            upright = directions @ up > np.cos(np.radians(config.max_tilt))
        directions, anchors = directions[upright], anchors[upright]
        if up is not None:
            anchors = np.concatenate([anchors, p[rng.integers(0, len(p), size=100)]])
            directions = np.concatenate([directions, np.tile(up, (100, 1))])
        if len(directions) == 0:
            return None
        offsets = np.einsum("ij,ij->i", directions, anchors)
        planes, gains = np.ascontiguousarray(np.column_stack([directions, offsets]).T), np.zeros(len(offsets))
        agree, behind = np.cos(np.radians(config.max_deviation)), 0.0 if up is not None else 1.0
        for_each(_score_planes, SHARES, (p, n, planes, config.tolerance, agree, behind, gains))
        best = int(np.argmax(gains))
        return self.refined(among, directions[best], float(offsets[best]))

    def refined(self, among: Mask, normal: Array, offset: float) -> _Plane | None:
        """Least squares on the inliers, a few times over; None if too few remain or the plane has tilted."""
        points, normals, up, config = self
        least_cosine = np.cos(np.radians(config.max_deviation))
        inliers = np.zeros_like(among)
        for _ in range(4):
            before = inliers
            inliers = among & (np.abs(points @ normal - offset) <= config.tolerance)
            inliers &= normals @ normal > least_cosine
            if np.count_nonzero(inliers) < max(config.min_points, 3):
                return None
            if np.array_equal(inliers, before):
                break
            on_plane = np.compress(inliers, points, axis=0)
            centre = on_plane.mean(axis=0)
            refined = np.linalg.eigh(np.cov(on_plane.T))[1][:, 0]
            normal = refined if refined @ normal > 0 else -refined
            offset = float(normal @ centre)
        if up is not None and normal @ up < np.cos(np.radians(config.max_tilt)):
            return None
        inliers, area = self._main_part(normal, inliers)
        return _Plane(normal, offset, inliers, area) if inliers.sum() >= config.min_points else None

    def _main_part(self, normal: Array, inliers: Mask) -> tuple[Mask, float]:
        """Keep the largest part of a plane that is connected across gaps; say how much of it is seen [m²]."""
        index = np.flatnonzero(inliers)
        flat = _basis(normal) @ np.take(self.points, index, axis=0).T
        # Cells are wider than the points' spacing at 3 m; if a cloud is not in metres, there are no more
        # than memory holds.
        cell = max(0.03, float((flat.max(axis=1) - flat.min(axis=1)).max()) / 1000.0)
        cells = np.floor(flat / cell).astype(np.intp)
        cells -= cells.min(axis=1, keepdims=True)
        size = cells.max(axis=1) + 1
        owner = cells[0] * size[1] + cells[1]
        count = np.bincount(owner, minlength=int(size.prod())).reshape(size)
        reach = int(min(np.ceil(self.config.gap / cell / 2.0), size.max()))
        near = ndimage.distance_transform_edt(np.pad(count == 0, reach))[reach:-reach, reach:-reach] <= reach
        part, _ = ndimage.label(near)
        main = int(np.argmax(np.bincount(part.ravel(), weights=count.ravel())))
        kept = np.zeros_like(inliers)
        kept[index[part.ravel()[owner] == main]] = True
        return kept, float(np.count_nonzero((count > 0) & (part == main))) * cell**2


def find_support_surface(
    cloud_points: Array,
    normals: Array,
    up: Array | None,
    config: SurfaceConfig,
    rng: np.random.Generator,
    max_planes: int = 6,
    *,
    T_world_camera: Array | None = None,
) -> SupportSurface:
    """Find the table among the planes of a scene.

    The planes across `up` are taken out one by one, largest first. Those with a table-sized plane a storey
    above them are floors; of the rest, the one with most points, at which the camera looks, is the table.
    Without `up`, the largest plane that faces the camera and has the rest of the scene in front of it gives
    the direction.

    Args:
        cloud_points: (N, 3) [m]; in the camera frame if `up` is None.
        normals: Unit normals (N, 3) towards the sensor.
        up: Upward direction (3,), or None if the camera's pose is unknown.
        config: Tolerances and sizes.
        rng: Draws the hypotheses.
        max_planes: Maximum number of horizontal planes, largest first, among which the table is chosen.
        T_world_camera: Reported camera pose (4, 4), with which an error says what is wrong with it; or None.

    Raises:
        NoSurfaceError: No plane has enough points.
    """
    points, normals = np.asarray(cloud_points, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    scene = _Scene(points, normals, up, config)
    if up is None:
        everywhere, turned = np.ones(len(points), dtype=bool), np.array([-1.0, -1.0, 1.0])
        if (plane := scene.largest_plane(everywhere, rng)) is not None:
            up = plane.normal
        # The camera may be upside down.
        elif plane := _Scene(points * turned, normals * turned, None, config).largest_plane(everywhere, rng):
            up = plane.normal * turned
    planes: list[_Plane] = []
    if up is not None:
        up = transforms.unit(up)
        scene, left = scene._replace(up=up), normals @ up > np.cos(np.radians(config.max_deviation))
        while len(planes) < max_planes and (plane := scene.largest_plane(left, rng)):
            planes.append(plane)
            left = left & (np.abs(points @ plane.normal - plane.offset) > 2.0 * config.tolerance)
    if up is None or not planes:
        raise NoSurfaceError(f"no support surface: {_tried(scene, rng, T_world_camera)}")
    return _surface(points, _choose_table(planes, up, config))


def _tried(scene: _Scene, rng: np.random.Generator, T_world_camera: Array | None) -> str:
    """Say why no support surface was found, and what may help."""
    points, normals, up, config = scene
    if len(points) < config.min_points:
        few = f"only {len(points)} points are on a surface, fewer than {config.min_points}"
        return f"{few}; show more of the table top, or give a larger image"
    level = "plane" if up is None else "level plane"
    tried = f"fewer than {config.min_points} of {len(points)} points lie on one {level}"
    facing = scene._replace(up=transforms.unit(normals.mean(axis=0)), config=replace(config, max_tilt=180.0))
    plane = facing.largest_plane(np.ones(len(points), dtype=bool), rng)
    if up is None or plane is None:
        return f"{tried}; show the table top"
    share, tilt = plane.inliers.mean(), np.degrees(transforms.angle_between(plane.normal, up))
    tried += f"; the largest plane, {share:.0%} of them, is tilted by {tilt:.0f}°"
    causes = [] if T_world_camera is None else _misread(T_world_camera, plane.normal, config)
    return f"{tried}; show the table top or, if that plane is the table, {' or '.join(causes) or Z_UP}"


def _misread(T_world_camera: Array, normal_world: Array, config: SurfaceConfig) -> list[str]:
    """Conventions of a camera pose (4, 4) other than ours in which a plane's normal (3,) points up."""
    R = T_world_camera[:3, :3]
    normal_camera = R.T @ normal_world
    y_up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    readings = {
        GL_AXES: R @ GL,
        BODY_AXES: R @ BODY,
        "T_world_camera is the inverse, world to camera: invert it": R.T,
        f"the world's y axis points up: {Z_UP}": y_up @ R,
        f"{GL_AXES}, and the world's y axis points up: {Z_UP}": y_up @ R @ GL,
    }
    upright = np.cos(np.radians(config.max_tilt))
    return [cause for cause, turn in readings.items() if (turn @ normal_camera)[2] > upright]


def refitted(
    surface: SupportSurface, points: Array, normals: Array, up: Array, config: SurfaceConfig
) -> SupportSurface | None:
    """Refit a known support surface to points (N, 3) [m] with normals (N, 3); None if few are near it."""
    normal, everywhere = surface.normal_world, np.ones(len(points), dtype=bool)
    scene = _Scene(points, normals, up, config)
    plane = scene.refined(everywhere, normal, float(normal @ surface.point_world))
    return None if plane is None else _surface(points, plane)


def _choose_table(planes: list[_Plane], up: Array, config: SurfaceConfig) -> _Plane:
    """The plane with most points among those that have no table a storey above them."""
    # Where each cuts the line along `up` through the origin. A shelf behind has too few points for a table.
    heights = [plane.offset / (plane.normal @ up) for plane in planes]
    counts = [np.count_nonzero(plane.inliers) for plane in planes]
    sizeable = [plane.area >= config.min_area for plane in planes]
    tables = np.argwhere(sizeable)[:, 0]

    def is_floor(k: int) -> bool:
        return any(heights[j] > heights[k] + config.storey and counts[j] >= 0.05 * counts[k] for j in tables)

    return planes[max(range(len(planes)), key=lambda k: (not is_floor(k), sizeable[k], counts[k]))]


def _surface(points: Array, plane: _Plane) -> SupportSurface:
    """The surface of a plane: the hull of its points, and a box under the smallest rectangle around that."""
    on_plane = np.compress(plane.inliers, points, axis=0)
    centroid = np.array([x.mean() for x in on_plane.T])
    centroid = centroid - (plane.normal @ centroid - plane.offset) * plane.normal
    basis, thickness = _basis(plane.normal), 0.04
    corners = hull(np.ascontiguousarray((on_plane - centroid) @ basis.T))
    if len(corners) < 3:
        raise NoSurfaceError("no support surface: the points of the plane are collinear")
    edges = transforms.unit(np.roll(corners, -1, axis=0) - corners)
    along, across = corners @ edges.T, corners @ np.stack([-edges[:, 1], edges[:, 0]])
    sizes = np.stack([np.ptp(along, axis=0), np.ptp(across, axis=0)])
    best = int(np.argmin(sizes[0] * sizes[1]))
    x, y = edges[best], np.array([-edges[best, 1], edges[best, 0]])
    middle = sizes[:, best] / 2 + (along[:, best].min(), across[:, best].min())
    normal = np.cross(basis[0], basis[1])
    R = np.stack([x @ basis, y @ basis, normal], axis=1)
    centre = centroid + (middle[0] * x + middle[1] * y) @ basis - thickness / 2.0 * normal
    box = Box(transforms.rigid(R, centre), np.array([*sizes[:, best], thickness]))
    return SupportSurface(plane.normal, centroid, centroid + corners @ basis, box)


def _basis(normal: Array) -> Array:
    """Two unit vectors (2, 3) that span the plane, right-handed with the normal."""
    x = transforms.perpendicular(normal)
    return np.stack([x, np.cross(normal, x)])


@kernel
def _score_planes(share, data):  # type: ignore[no-untyped-def]
    """Score a share of the planes (4, B), n·p = offset: 1 − (distance/tolerance)² for each point that fits.

    A point further than three tolerances behind a plane costs it the penalty.
    """
    points, normals, planes, tolerance, least_cosine, penalty, all_gains = data
    mine = slice(share * len(all_gains) // SHARES, (share + 1) * len(all_gains) // SHARES)
    nx, ny, nz, offset = planes[0, mine], planes[1, mine], planes[2, mine], planes[3, mine]
    gains = all_gains[mine]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u, v, w = normals[i, 0], normals[i, 1], normals[i, 2]
        # The innermost loop has no branch, so that several planes are scored at a time.
        for k in range(len(gains)):
            signed = nx[k] * x + ny[k] * y + nz[k] * z - offset[k]
            gain = 1.0 - (signed / tolerance) ** 2
            agrees = nx[k] * u + ny[k] * v + nz[k] * w > least_cosine and gain > 0.0
            gains[k] += gain if agrees else 0.0
            gains[k] -= penalty if signed < -3.0 * tolerance else 0.0


@kernel(inline="always")
def _is_over(planes, x, y, z, low, high):  # type: ignore[no-untyped-def]
    """Whether a point lies between two heights over the first plane, and on the inner side of the others."""
    over = low < planes[0, 0] * x + planes[0, 1] * y + planes[0, 2] * z + planes[0, 3] < high
    k = 1
    while over and k < len(planes):
        over = planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] * z + planes[k, 3] <= 0.0
        k += 1
    return over


@kernel
def _points_over(points, planes, low, high):  # type: ignore[no-untyped-def]
    over = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        over[i] = _is_over(planes, points[i, 0], points[i, 1], points[i, 2], low, high)
    return over


@kernel
def _pixels_over(depth, x, y, planes, low, high):  # type: ignore[no-untyped-def]
    over = np.zeros(depth.shape, np.bool_)
    for row in range(len(y)):
        for col in range(len(x)):
            z = float(depth[row, col])
            over[row, col] = z > 0.0 and _is_over(planes, x[col] * z, y[row] * z, z, low, high)
    return over
