"""The support surface: the horizontal plane that carries the objects, found by RANSAC."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import SurfaceConfig
from caryatid.errors import NoSurfaceError
from caryatid.geometry import polygons, transforms
from caryatid.geometry.polygons import hull
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import SHARES, for_each, inner, kernel
from caryatid.sensing.views import MAX_LABEL, SUPPORT_LABEL, View

Mask = NDArray[np.bool_]

CELL = 0.03
"""Edge of the cells in which parts of a plane are told apart [m]; wider than the spacing of points at 3 m."""
ROOM = 0.1
"""Minimum room under a table no larger than an object [m]: what is lower is a lid, or a tray on something."""
OPEN = 0.3
"""Share of its border under which a table is open at least [1]; legs or uprights close the rest."""
SHOWN = 0.5
"""Minimum share of another surface than the main one that is seen [1]: noise beside a plane is scattered."""
BESIDE = 0.05
"""How far outside its outline, or below it, the middle of what stands on a surface may be [m]."""
MOST_PLANES = 6
"""Maximum number of planes, largest first, among which the surfaces of a first view are found [1]; in each
later one, two more."""
WIDEST = 200
"""Maximum width of the border by which a region grows [squares]: 4 m, farther than a view shows."""
MIDDLE = 5.0
"""Angle from the optical axis at which what an image shows counts 0.6 of what its middle does [deg]: a fifth
of the way to its border."""


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """Squares of a grid along the world's x and y axes.

    Attributes:
        corner: Numbers (2,) of the first square along x and y; square 0 begins at the origin.
        squares: Which squares (X, Y) belong to it.
        size: Edge of a square [m].
    """

    corner: NDArray[np.intp]
    squares: Mask
    size: float

    @classmethod
    def around(cls, points_world: Array, size: float) -> Region:
        """The squares that hold points (N, 3) [m], and single ones between them."""
        index = np.floor(points_world[:, :2] / size).astype(np.intp)
        low, high = index.min(axis=0) - 1, index.max(axis=0) + 2
        squares = np.zeros(high - low, dtype=np.bool_)
        squares[tuple((index - low).T)] = True
        # A point that registration moved leaves its square.
        return cls(low, ndimage.binary_closing(squares, np.ones((3, 3))), size)

    def holds(self, places: Array) -> Mask:
        """Whether places (N, 2) [m], or the x and y of points (N, 3), are in it."""
        return _held(np.ascontiguousarray(places), self.corner, self.squares, self.size)

    def places(self) -> Array:
        """Centres (N, 2) of its squares [m]."""
        return np.asarray(self.size * (np.argwhere(self.squares) + self.corner + 0.5), dtype=np.float64)

    def centres(self) -> Array:
        """Centres (X, Y, 2) of all squares of the grid [m]."""
        index = np.moveaxis(np.indices(self.squares.shape), 0, -1) + self.corner
        return np.asarray(self.size * (index + 0.5), dtype=np.float64)

    def grown(self, margin: float) -> Region:
        """The region and the squares within a margin [m] of it; if negative, without a border as wide."""
        return _grown(self, margin)

    def filled(self) -> Region:
        """The squares within the convex hull of the region: what stands on a surface hides it."""
        corners = hull(np.argwhere(self.squares).astype(np.float64))
        if len(corners) < 3:
            return self
        squares = self.squares.copy()
        polygons.fill(corners, squares)
        return replace(self, squares=squares)

    def trimmed(self) -> Region:
        """The same squares on the smallest grid that holds them."""
        x, y = (np.flatnonzero(self.squares.any(axis=k)) for k in (1, 0))
        part = np.ascontiguousarray(self.squares[x[0] : x[-1] + 1, y[0] : y[-1] + 1])
        return Region(self.corner + (x[0], y[0]), part, self.size)

    def joined(self, other: Region) -> Region:
        """The squares of either region."""
        low = np.minimum(self.corner, other.corner)
        high = np.maximum(self.corner + self.squares.shape, other.corner + other.squares.shape)
        squares = np.zeros(high - low, dtype=np.bool_)
        for part in (self, other):
            x, y = part.corner - low
            squares[x : x + part.squares.shape[0], y : y + part.squares.shape[1]] |= part.squares
        return Region(low, squares, self.size)


@dataclass(frozen=True, eq=False, slots=True)
class SupportSurface:
    """A level surface that carries objects, such as a table top.

    Attributes:
        normal_world: Unit normal (3,), upwards.
        point_world: Centroid of the inliers in the first view that shows it, moved onto the plane (3,) [m].
        outline_world: Convex hull (M, 3) of the inliers on the plane [m], counter-clockwise seen from above.
        shape: Thin box whose top face is the smallest rectangle around the outline; its z is the normal.
        core: Where it was seen; in a view, also what lies between.
        region: What lies within the hull of the core, and where something in front hides whether it goes on.
    """

    normal_world: Array
    point_world: Array
    outline_world: Array
    shape: Box
    core: Region
    region: Region

    @property
    def width(self) -> float:
        """Shorter side of the smallest rectangle around it [m]."""
        return float(self.shape.extents[:2].min())

    @property
    def outline_area(self) -> float:
        """Area within its outline, in plan [m²]."""
        return polygons.area(np.ascontiguousarray(self.outline_world[:, :2]))

    def height(self, points_world: Array) -> Array:
        """Signed height (...,) [m] of points (..., 3) over the surface."""
        return (points_world - self.point_world) @ self.normal_world

    def over(self, points_world: Array, low: float, high: float, margin: float) -> Mask:
        """Which points (N, 3) [m] are over the region, or no further than a margin [m] outside its sides.

        Their height is between low and high [m].
        """
        own = self.region.grown(margin)
        arrays = map(np.ascontiguousarray, (points_world, self.normal_world, self.point_world))
        over = np.zeros(len(points_world), dtype=np.bool_)
        for_each(_over, SHARES, (*arrays, float(low), float(high), own.corner, own.squares, own.size, over))
        return over

    def pixels_over(
        self, view: View, low: float, high: float, margin: float = np.inf, *, core: bool = False
    ) -> Mask:
        """Which pixels (H, W) of a view, which has a pose, show something between two heights [m] over it.

        The margin is as for `over`, beyond the region or its core; if it is infinite, anything above or below
        counts.
        """
        x, y = ((np.arange(n) - view.K[k, 2]) / view.K[k, k] for k, n in enumerate(view.depth.shape[::-1]))
        T, everywhere = np.ascontiguousarray(view.pose), margin == np.inf
        own = self.core if core else self.region
        own = own if everywhere else own.grown(margin)
        grid = own.squares, own.corner, own.size
        over = np.zeros(view.depth.shape, dtype=np.bool_)
        plane = np.append(self.normal_world, -self.normal_world @ self.point_world)
        data = view.depth, x, y, T, plane, everywhere, *grid, float(low), float(high), over
        for_each(_pixels_over, SHARES, data)
        return over

    def continued(self, view: View, config: SurfaceConfig) -> SupportSurface:
        """Return the surface with the region that a view leaves open.

        It goes on as far as a gap of the configuration where the view shows the surface, or something nearer
        in its place. Places without a reading belong to it if they are between those that do.
        """
        wide = self.core.grown(config.gap)
        if self.height(view.pose[:3, 3]) <= 0.0:
            return self
        feet = wide.centres()
        n, p = self.normal_world, self.point_world
        z = p[2] - ((feet - p[:2]) @ n[:2]) / n[2]
        points = transforms.transform(transforms.invert(view.pose), np.dstack([feet, z]).reshape(-1, 3))
        ahead = points[:, 2] > config.tolerance
        pixels = (points @ view.K.T)[:, :2] / np.where(ahead, points[:, 2], 1.0)[:, None]
        column, row = np.rint(pixels).astype(np.intp).T
        height, width = view.depth.shape
        inside = np.flatnonzero(ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height))
        z = view.depth[row[inside], column[inside]].astype(np.float64)
        # The line of sight to a square comes from above: a reading below it is seen past the surface.
        share = np.divide(z, points[inside, 2])
        eye = float(self.height(view.pose[:3, 3]))
        through, hidden = np.zeros((2, *wide.squares.shape), dtype=np.bool_)
        through.ravel()[inside] = (z > 0.0) & (eye * (1.0 - share) < -config.tolerance)
        hidden.ravel()[inside] = (z > 0.0) & (eye * (1.0 - share) > -config.tolerance)
        seen = np.pad(self.core.squares, (len(wide.squares) - len(self.core.squares)) // 2)
        part, _ = ndimage.label(seen | (hidden & wide.squares))
        main = np.argmax(np.bincount(part[seen]))
        whole = replace(wide, squares=seen & (part == main)).filled().squares & ~through
        region = replace(wide, squares=(part == main) | whole)
        # Its grid would grow with every view.
        return replace(self, core=replace(wide, squares=whole).trimmed(), region=region)

    def continues(self, other: SupportSurface, config: SurfaceConfig) -> bool:
        """Whether it is a part of another surface, which noise or a tilt sets off."""
        near = other.region.grown(config.gap).holds(self.region.places())
        return bool(near.any() and abs(other.height(self.point_world)) < config.search)

    def is_open_below(self, view: View, others: Sequence[SupportSurface], config: SurfaceConfig) -> bool:
        """Whether a view looks in under its border, above the next surface below; a box is closed there."""
        rooms = [h for s in others if (h := float(s.height(self.point_world))) > config.search]
        if rooms and min(rooms) < ROOM:
            return False
        corners, middle = self.outline_world, self.outline_world.mean(axis=0)
        step = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None, None]
        border = (corners + step * (np.roll(corners, -1, axis=0) - corners)).reshape(-1, 3)
        places = border + config.tolerance * transforms.unit(middle - border)
        places -= min(rooms, default=0.0) / 2.0 * self.normal_world
        points = transforms.transform(transforms.invert(view.pose), places)
        points = points[points[:, 2] > config.tolerance]
        column, row = np.rint((points @ view.K.T)[:, :2] / points[:, 2:]).astype(np.intp).T
        height, width = view.depth.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        z = view.depth[row[inside], column[inside]]
        behind = z - points[inside, 2]
        # What is nearer hides the border.
        known = (z > 0.0) & (behind > -config.search)
        return bool(np.mean(behind[known] > config.search) > OPEN) if rooms and known.any() else True

    def placed(self, point_world: Array) -> SupportSurface:
        """Return the surface with the point on it that is nearest to another (3,) [m]."""
        return replace(self, point_world=point_world - self.height(point_world) * self.normal_world)

    def moved(self, T: Array) -> SupportSurface:
        """Return the surface moved by a rigid transform (4, 4) of the world, by less than a square."""
        return replace(
            self,
            normal_world=transforms.rotate(T, self.normal_world),
            point_world=transforms.transform(T, self.point_world),
            outline_world=transforms.transform(T, self.outline_world),
            shape=self.shape.moved(T),
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
        inliers, area = self._main_part(normal, inliers, config.gap)
        return _Plane(normal, offset, inliers, area) if inliers.sum() >= config.min_points else None

    def parts(self, plane: _Plane, gap: float) -> list[_Plane]:
        """The parts of a plane that are further apart than a gap [m], largest first."""
        parts, left = list[_Plane](), plane.inliers
        while np.count_nonzero(left) >= self.config.min_points:
            inliers, area = self._main_part(plane.normal, left, gap)
            if np.count_nonzero(inliers) < self.config.min_points:
                break
            parts.append(_Plane(plane.normal, plane.offset, inliers, area))
            left = left & ~inliers
        return parts

    def _main_part(self, normal: Array, inliers: Mask, gap: float) -> tuple[Mask, float]:
        """Keep the largest part of a plane that is connected across gaps; say how much of it is seen [m²]."""
        index = np.flatnonzero(inliers)
        flat = _basis(normal) @ np.take(self.points, index, axis=0).T
        # If a cloud is not in metres, there are no more cells than memory holds.
        cell = max(CELL, float((flat.max(axis=1) - flat.min(axis=1)).max()) / 1000.0)
        cells = np.floor(flat / cell).astype(np.intp)
        cells -= cells.min(axis=1, keepdims=True)
        size = cells.max(axis=1) + 1
        owner = cells[0] * size[1] + cells[1]
        count = np.bincount(owner, minlength=int(size.prod())).reshape(size)
        reach = int(min(np.ceil(gap / cell / 2.0), size.max()))
        away = ndimage.distance_transform_edt(np.pad(count == 0, reach))
        near = away[reach : reach + size[0], reach : reach + size[1]] <= reach
        part, _ = ndimage.label(near, np.ones((3, 3)))
        main = int(np.argmax(np.bincount(part.ravel(), weights=count.ravel())))
        kept = np.zeros_like(inliers)
        kept[index[part.ravel()[owner] == main]] = True
        return kept, float(np.count_nonzero((count > 0) & (part == main))) * cell**2


def find_surface_below(surfaces: Sequence[SupportSurface], points_world: Array) -> NDArray[np.intp]:
    """Number (N,) of the highest surface below each point (N, 3) [m]; 0, the main one, if there is none.

    What stands on a surface hides it from view, so that all within its outline counts, and a little more; so
    does what is flat and, by an error of its fit, just below it.
    """
    least, below = np.full(len(points_world), np.inf), np.zeros(len(points_world), dtype=np.intp)
    for k, surface in enumerate(surfaces):
        height = surface.height(points_world)
        nearer = np.flatnonzero((height > -BESIDE) & (height < least))
        away = polygons.signed_distances(surface.outline_world, points_world[nearer])
        nearer = nearer[away < BESIDE]
        least[nearer], below[nearer] = height[nearer], k
    return below


def find_support_surfaces(
    cloud_points: Array,
    normals: Array,
    up: Array | None,
    config: SurfaceConfig,
    rng: np.random.Generator,
    *,
    known: Sequence[SupportSurface] = (),
    objects: Array | None = None,
    T_world_camera: Array | None = None,
) -> list[SupportSurface]:
    """Find the surfaces that may carry objects among the planes of a scene, the main one first.

    The planes across `up` are taken out one by one, largest first; parts of one that nothing connects are
    several. The camera looks at the main one: of those as large as furniture, it is the one that the middle
    of the image shows most of, with what stands on it. Others must be as large as that. Without `up`, the
    largest plane that faces the camera and has the rest of the scene in front of it gives the direction.

    Args:
        cloud_points: (N, 3) [m]; in the camera frame if `up` is None.
        normals: Unit normals (N, 3) towards the sensor.
        up: Upward direction (3,), or None if the camera's pose is unknown.
        config: Tolerances and sizes.
        rng: Draws the hypotheses.
        known: The surfaces known so far, which stay the first ones, in this order.
        objects: Points (M, 3) [m] of objects, which are on no surface but stand on some.
        T_world_camera: Reported camera pose (4, 4) in the frame of the points, or None for a cloud.

    Raises:
        NoSurfaceError: No surface is known, and no plane has enough points.
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
    if up is None:
        raise NoSurfaceError(f"no support surface: {_tried(scene, rng)}")
    up = transforms.unit(up)
    scene, left = scene._replace(up=up), normals @ up > np.cos(np.radians(config.max_deviation))
    surfaces = list[SupportSurface]()
    for surface in known:
        height, wide = surface.height(points), surface.region.grown(config.gap)
        near = left & (np.abs(height) < config.search) & wide.holds(points)
        some = _some(near, 1_000 if surfaces else 5_000)
        plane = scene.largest_plane(some, rng)
        same = None if plane is None else _surface(points, plane, config, surface)
        surfaces.append(surface if same is None else same.placed(surface.point_world))
        left &= ~near
    planes: list[_Plane] = []
    left, most = (_some(left, 5_000), 2) if known else (left, MOST_PLANES)
    while len(planes) < most and (plane := scene.largest_plane(left, rng)):
        planes.append(plane)
        left = left & (np.abs(points @ plane.normal - plane.offset) > 2.0 * config.tolerance)
    if not known and not planes:
        raise NoSurfaceError(f"no support surface: {_tried(scene, rng)}")
    if not known:
        weights, every = None, points if objects is None else np.concatenate([points, objects])
        if T_world_camera is not None:
            rays = transforms.unit(every - T_world_camera[:3, 3])
            away = np.degrees(np.arccos(np.clip(rays @ T_world_camera[:3, 2], -1.0, 1.0)))
            weights = np.exp(-0.5 * (away / MIDDLE) ** 2)
        main = _choose_table(planes, points, every, weights, config)
        surfaces.append(_surface(points, planes.pop(main), config))
    for plane in (part for whole in planes for part in scene.parts(whole, 0.0)):
        if len(surfaces) == SUPPORT_LABEL - MAX_LABEL:
            break
        if plane.area < SHOWN * config.min_width**2:
            continue
        with suppress(NoSurfaceError):  # The points may lie on a line.
            surface = _surface(points, plane, config)
            alone = not any(surface.continues(other, config) for other in surfaces)
            if alone and surface.width >= config.min_width and plane.area > SHOWN * surface.outline_area:
                surfaces.append(surface)
    return surfaces


def _some(which: Mask, count: int) -> Mask:
    """Evenly spread ones among some points (N,), at least `count` of them if there are as many."""
    index, some = np.flatnonzero(which), np.zeros_like(which)
    some[index[:: max(1, len(index) // count)]] = True
    return some


def _tried(scene: _Scene, rng: np.random.Generator) -> str:
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
    return f"{tried}; the largest plane, {share:.0%} of them, is tilted by {tilt:.0f}°; show the table top"


def refitted(
    surface: SupportSurface, points: Array, normals: Array, up: Array, config: SurfaceConfig
) -> SupportSurface | None:
    """Refit a known support surface to points (N, 3) [m] with normals (N, 3); None if few are near it."""
    normal, everywhere = surface.normal_world, np.ones(len(points), dtype=bool)
    scene = _Scene(points, normals, up, config)
    plane = scene.refined(everywhere, normal, float(normal @ surface.point_world))
    return None if plane is None else _surface(points, plane, config).placed(surface.point_world)


def _choose_table(
    planes: list[_Plane], points: Array, every: Array, weights: Array | None, config: SurfaceConfig
) -> int:
    """The number of the plane of some points that most of all (N, 3), by their weights (N,), are on or over.

    A point belongs to the highest plane below it. Without weights, only what stands on a plane counts, unless
    it is below another, as legs are: a floor is larger than a table. Planes as large as furniture come first.
    A plane with little room above a larger one around it is the tops of objects on that.
    """
    heights, below = np.full((len(planes), len(every)), np.inf), np.zeros(len(every), dtype=np.bool_)
    stands_on = np.arange(len(planes))
    shown = [np.compress(plane.inliers, points, axis=0) for plane in planes]
    for k, plane in enumerate(planes):
        basis = _basis(plane.normal)
        region = Region.around(shown[k] @ basis.T, CELL)
        around = region.filled().grown(2.0 * CELL)
        own = (around if weights is None else region.grown(2.0 * CELL)).holds(every @ basis.T)
        height = every @ plane.normal - plane.offset
        heights[k] = np.where(own & (height > -config.tolerance), height, np.inf)
        below |= own & (height < -config.tolerance)
        for n, other in enumerate(planes):
            room = shown[n] @ plane.normal - plane.offset
            inside = around.holds(shown[n] @ basis.T) & (room > 0.0) & (room < ROOM)
            if other.area < plane.area and inside.mean() > SHOWN:
                stands_on[n] = k
    least = heights.min(axis=0)
    if weights is None:
        weights = np.where((least > config.search) & ~below, 1.0, 0.01)
    over = np.isfinite(least)
    for _ in planes:
        stands_on = stands_on[stands_on]
    looked_at = np.bincount(stands_on[heights[:, over].argmin(axis=0)], weights[over], minlength=len(planes))
    return max(range(len(planes)), key=lambda k: (planes[k].area >= config.min_width**2, looked_at[k]))


def _surface(
    points: Array, plane: _Plane, config: SurfaceConfig, known: SupportSurface | None = None
) -> SupportSurface:
    """The surface of a plane: the hull of its points, and a box under the smallest rectangle around that.

    It holds all that is known of it.
    """
    on_plane = np.compress(plane.inliers, points, axis=0)
    centroid = np.array([x.mean() for x in on_plane.T])
    centroid = centroid - (plane.normal @ centroid - plane.offset) * plane.normal
    basis, thickness = _basis(plane.normal), 0.04
    around = on_plane if known is None else np.concatenate([on_plane, known.outline_world])
    corners = hull(np.ascontiguousarray((around - centroid) @ basis.T))
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
    # If a cloud is not in metres, there are no more squares than memory holds.
    size = max(config.spacing, float(np.ptp(on_plane[:, :2], axis=0).max()) / 500.0)
    core = Region.around(on_plane, size if known is None else known.core.size)
    core = core if known is None else core.joined(known.core)
    return SupportSurface(plane.normal, centroid, centroid + corners @ basis, box, core, core.filled())


def _basis(normal: Array) -> Array:
    """Two unit vectors (2, 3) that span the plane, right-handed with the normal."""
    x = transforms.perpendicular(normal)
    return np.stack([x, np.cross(normal, x)])


@lru_cache(maxsize=16)  # a view asks for the same ones several times
def _grown(region: Region, margin: float) -> Region:
    """See `Region.grown`."""
    squares, size = region.squares, region.size
    if margin < 0.0:
        depth = ndimage.distance_transform_edt(np.pad(squares, 1))[1:-1, 1:-1]
        return replace(region, squares=np.ascontiguousarray(depth * size > size / 2.0 - margin))
    border = min(int(np.ceil(margin / size)), WIDEST)
    squares = np.pad(squares, border)
    if border:
        squares = ndimage.distance_transform_edt(~squares) <= margin / size
    return Region(region.corner - border, squares, size)


@inner
def _is_held(x, y, corner, squares, size):  # type: ignore[no-untyped-def]
    """Whether a place is in a square."""
    i, j = int(np.floor(x / size)) - corner[0], int(np.floor(y / size)) - corner[1]
    return 0 <= i < squares.shape[0] and 0 <= j < squares.shape[1] and squares[i, j]


@kernel
def _held(places, corner, squares, size):  # type: ignore[no-untyped-def]
    """See `Region.holds`."""
    held = np.zeros(len(places), np.bool_)
    for k in range(len(places)):
        held[k] = _is_held(places[k, 0], places[k, 1], corner, squares, size)
    return held


@kernel
def _over(share, data):  # type: ignore[no-untyped-def]
    """Write which points of a share are over a surface, see `SupportSurface.over`."""
    points, normal, origin, low, high, corner, squares, size, over = data
    for k in range(share * len(points) // SHARES, (share + 1) * len(points) // SHARES):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        height = (x - origin[0]) * normal[0] + (y - origin[1]) * normal[1] + (z - origin[2]) * normal[2]
        over[k] = low < height < high and _is_held(x, y, corner, squares, size)


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


@kernel
def _pixels_over(share, data):  # type: ignore[no-untyped-def]
    """Write which pixels of every 16th row are over a surface, see `SupportSurface.pixels_over`."""
    depth, x, y, T, plane, everywhere, squares, corner, size, low, high, over = data
    a = plane[0] * T[0, 0] + plane[1] * T[1, 0] + plane[2] * T[2, 0]
    b = plane[0] * T[0, 1] + plane[1] * T[1, 1] + plane[2] * T[2, 1]
    c = plane[0] * T[0, 2] + plane[1] * T[1, 2] + plane[2] * T[2, 2]
    d = plane[0] * T[0, 3] + plane[1] * T[1, 3] + plane[2] * T[2, 3] + plane[3]
    for row in range(share, len(y), SHARES):
        for col in range(len(x)):
            z = float(depth[row, col])
            if z <= 0.0 or not low < (a * x[col] + b * y[row] + c) * z + d < high:
                continue
            u = (T[0, 0] * x[col] + T[0, 1] * y[row] + T[0, 2]) * z + T[0, 3]
            v = (T[1, 0] * x[col] + T[1, 1] * y[row] + T[1, 2]) * z + T[1, 3]
            i, j = int(np.floor(u / size)) - corner[0], int(np.floor(v / size)) - corner[1]
            inside = 0 <= i < squares.shape[0] and 0 <= j < squares.shape[1]
            over[row, col] = everywhere or (inside and squares[i, j])
