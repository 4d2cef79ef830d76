"""The voxel map: the space around the scene, seen free, seen occupied, or unseen.

Each voxel counts the views that hit it (a reading ends in it) and the views that looked through it (a ray
crosses it and none ends in it: within a view a hit wins). Over several views it is occupied while
log-odds of `config.hit` and `config.miss` sum to more than zero: with 0.7 and 0.4 one hit outweighs two
views that looked through. So a surface survives a registration error that puts it a voxel off in the next
views, and a stray reading disappears after three views. A ray ends `config.margin` short of its reading, so
noise in depth never carves the surface it hits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from caryatid.config import VoxelConfig
from caryatid.geometry import transforms
from caryatid.geometry.rays import room, traverse
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.signed_distance import contains, local
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import SHARES, for_each, inner, kernel
from caryatid.sensing.views import View

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""States of a voxel."""
AROUND = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]).astype(np.intp)
"""Steps (7, 3) to a voxel itself and to those that share a face with it [1]."""
FULLY = float(np.cos(np.deg2rad(60.0)))
"""Cosine of the angle to its normal up to which a point is shown fully [1]."""


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """A dense voxel grid in a bounded box.

    Attributes:
        origin_world: Corner (3,) [m] of voxel [0, 0, 0]; the grid's axes are the world's.
        hits: Number of views (X, Y, Z) with a reading in the voxel, at most 255.
        passes: Number of views (X, Y, Z) that looked through it, at most 255.
        config: Size and evidence.
    """

    origin_world: Array
    hits: NDArray[np.uint8]
    passes: NDArray[np.uint8]
    config: VoxelConfig

    @classmethod
    def around(cls, center_world: ArrayLike, config: VoxelConfig) -> VoxelMap:
        """Build an unknown map around the middle of the table top (3,) [m]."""
        extent = np.asarray(config.extent, dtype=np.float64)
        shape = tuple(int(n) for n in np.ceil(extent / config.size - 1e-9))
        corner = np.array([-extent[0] / 2.0, -extent[1] / 2.0, -config.below])
        empty = np.zeros(shape, dtype=np.uint8)
        return cls(np.asarray(center_world, dtype=np.float64) + corner, empty, empty, config)

    @property
    def states(self) -> NDArray[np.int8]:
        """State (X, Y, Z) of each voxel: 0 unknown, 1 free, 2 occupied."""
        return self._known[0]

    @property
    def space(self) -> tuple[NDArray[np.int8], Array, float]:
        """States (X, Y, Z), the corner (3,) [m] and the size [m] of the voxels, for the compiled kernels."""
        return self.states, self.origin_world, self.config.size

    @property
    def occupied(self) -> NDArray[np.intp]:
        """Indices x, y, z (3, N) of the occupied voxels."""
        return self._known[1]

    @cached_property
    def _known(self) -> tuple[NDArray[np.int8], NDArray[np.intp]]:
        """States of the voxels, and where they are occupied; few voxels have hits to weigh."""
        states = (self.passes.ravel() > 0).view(np.int8)
        hit = np.flatnonzero(self.hits.ravel() != 0)
        log_odds = _log_odds(self.config)[self.passes.ravel()[hit], self.hits.ravel()[hit]]
        states[hit] = np.where(log_odds > 0.0, OCCUPIED, FREE)
        occupied = np.unravel_index(hit[log_odds > 0.0], self.hits.shape)
        return states.reshape(self.hits.shape), np.stack(occupied)

    @property
    def occupancy(self) -> NDArray[np.float32]:
        """Probability (X, Y, Z) that a voxel is occupied: 0.5 if unknown, otherwise within the clamp.

        A view weighs as much as five images of a moving camera, for which the usual clamp is made: as many
        misses reach its lower end.
        """
        low, high = (np.log(p / (1.0 - p)) for p in (0.12, 0.97))
        log_odds = np.clip(5.0 * _log_odds(self.config), low, high)
        return (1.0 / (1.0 + np.exp(-log_odds))).astype(np.float32)[self.passes, self.hits]

    @property
    def end_world(self) -> Array:
        """Corner (3,) [m] opposite to the origin."""
        return self.origin_world + self.config.size * np.array(self.hits.shape)

    def integrate(self, view: View, max_depth: float) -> VoxelMap:
        """Return the map with one more view, which has a pose: free along its rays, occupied at their ends.

        Pixels without a reading have no effect; a reading beyond a depth [m] counts as free space up to it.
        """
        config, T_world_camera = self.config, np.ascontiguousarray(view.pose)
        hits, passes = np.zeros_like(self.hits), np.zeros_like(self.passes)
        depth, K = np.ascontiguousarray(view.depth), np.ascontiguousarray(view.K)
        camera = (depth, K, T_world_camera, config.stride, config.margin, float(max_depth))
        for_each(_mark_rays, SHARES, (*camera, self.origin_world, config.size, hits, passes))
        for_each(_count_marks, SHARES, (self.hits, self.passes, hits, passes))
        return VoxelMap(self.origin_world, hits, passes, config)

    def forgotten(self, which: NDArray[np.bool_]) -> VoxelMap:
        """Return the map with some of its voxels (X, Y, Z) unseen."""
        hits, passes = (np.where(which, np.uint8(0), counts) for counts in (self.hits, self.passes))
        return VoxelMap(self.origin_world, hits, passes, self.config)

    def lowered(self, z: float) -> VoxelMap:
        """Return the map with its lower end at least as far down as a height [m]; the new part is unknown."""
        more = int(np.ceil((self.origin_world[2] - z) / self.config.size))
        if more <= 0:
            return self
        hits, passes = (np.pad(counts, ((0, 0), (0, 0), (more, 0))) for counts in (self.hits, self.passes))
        origin = self.origin_world - (0.0, 0.0, more * self.config.size)
        return VoxelMap(origin, hits, passes, self.config)

    def closed_below(self, outline_world: Array, normal_world: Array, depth: float) -> VoxelMap:
        """Return the map with the space below a level surface free, to a depth [m]: no object is there.

        Args:
            outline_world: Corners (M, 3) [m] of the convex surface, counter-clockwise seen from above.
            normal_world: Its unit normal (3,), upwards.
            depth: How far.
        """
        x, y, z = (origin + self.config.size * (np.arange(count) + 0.5)
                   for origin, count in zip(self.origin_world, self.hits.shape, strict=True))  # fmt: skip
        inside = shapely.contains_xy(shapely.Polygon(outline_world[:, :2]), x[:, None], y)
        middle, layers = outline_world.mean(axis=0), int(np.searchsorted(z, outline_world[:, 2].max()))
        across = (x[:, None] - middle[0]) * normal_world[0] + (y - middle[1]) * normal_world[1]
        heights = across[..., None] + (z[:layers] - middle[2]) * normal_world[2]
        below = inside[..., None] & (heights < -self.config.size / 2.0) & (heights > -depth)
        hits, passes = self.hits.copy(), self.passes.copy()
        hits[..., :layers][below], passes[..., :layers][below] = 0, 1
        return VoxelMap(self.origin_world, hits, passes, self.config)

    def within(self, shape: Shape, points_world: Array) -> NDArray[np.bool_]:
        """Which voxels (X, Y, Z) a shape reaches into, or contain one of some points (N, 3) [m]."""
        which = np.zeros(self.hits.shape, dtype=np.bool_)
        size, outline = self.config.size, shape.surface(self.config.size)[0]
        low = np.floor((outline.min(axis=0) - self.origin_world) / size).astype(np.intp) - 1
        high = np.floor((outline.max(axis=0) - self.origin_world) / size).astype(np.intp) + 2
        low, high = (np.clip(corner, 0, which.shape) for corner in (low, high))
        index = _indices(low, high)
        touched = shape.signed_distance(self.centres_world(index)) < size
        held = np.floor((points_world - self.origin_world) / size).astype(np.intp)
        held = held[((held >= 0) & (held < which.shape)).all(axis=1)]
        which[tuple(np.concatenate([index[touched], held]).T)] = True
        return which

    def behind(self, view: View, pixels: NDArray[np.bool_], depth: float) -> NDArray[np.bool_]:
        """Which voxels (X, Y, Z) a view has behind the readings of some pixels (H, W), to a depth [m]."""
        which = np.zeros(self.hits.shape, dtype=np.bool_)
        index = np.stack(np.nonzero(self.passes), axis=-1)
        points = transforms.transform(transforms.invert(view.pose), self.centres_world(index))
        index, points = index[points[:, 2] > 0.0], points[points[:, 2] > 0.0]
        u, v = np.rint((points @ view.K.T)[:, :2] / points[:, 2:]).astype(np.intp).T
        height, width = view.depth.shape
        rows = np.flatnonzero((u >= 0) & (u < width) & (v >= 0) & (v < height))
        rows = rows[pixels[v[rows], u[rows]]]
        beyond = points[rows, 2] - view.depth[v[rows], u[rows]]
        rows = rows[(beyond > -self.config.size) & (beyond < depth)]
        which[tuple(index[rows].T)] = True
        return which

    def occluders(self, shapes: Sequence[Shape] = ()) -> Occluders:
        """What blocks lines of sight: voxels seen occupied, and all that is inside shapes in the world."""
        arrays, size = Primitives.of(shapes), self.config.size
        low, high = ((corner - self.origin_world) / size for corner in arrays.bounds())
        low = np.clip(np.floor(low).astype(np.int64), 0, self.hits.shape)
        high = np.clip(np.ceil(high).astype(np.int64), 0, self.hits.shape)
        some, index, most = (low < high).all(axis=1), self.occupied, max(self.hits.shape)
        lowest = np.minimum(low[some].min(axis=0, initial=most), index.min(axis=1, initial=most))
        highest = np.maximum(high[some].max(axis=0, initial=0), index.max(axis=1, initial=-1) + 1)
        window = tuple(slice(a, b) for a, b in zip(lowest, highest, strict=True))
        grid = (self.states[window] == OCCUPIED).view(np.uint8)
        origin_world = self.origin_world + size * lowest
        low, high = low - lowest, high - lowest
        for number, shape in enumerate(shapes):
            if isinstance(shape, Solid):  # Kernels see only the box around it.
                index = _indices(low[number], high[number])
                inside = shape.signed_distance(origin_world + size * (index + 0.5)) < 0.0
                grid[tuple(index[inside].T)] = 1
                high[number] = low[number]
        for_each(_fill, SHARES, (*arrays, low, high, grid, origin_world, size))
        return Occluders(origin_world, grid, self)

    def cut(self, low_world: Array, high_world: Array) -> VoxelMap:
        """Return the part of the map whose voxels lie, all or in part, between two corners (3,) [m]."""
        size, shape = self.config.size, self.hits.shape
        low = np.clip(np.floor((low_world - self.origin_world) / size + 1e-9).astype(int), 0, shape)
        high = np.clip(np.ceil((high_world - self.origin_world) / size - 1e-9).astype(int), low, shape)
        window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        hits, passes = (np.ascontiguousarray(counts[window]) for counts in (self.hits, self.passes))
        return VoxelMap(self.origin_world + size * low, hits, passes, self.config)

    def centres_world(self, index: NDArray[np.integer]) -> Array:
        """Centres (N, 3) [m] of the voxels with these indices (N, 3)."""
        return self.origin_world + (index + 0.5) * self.config.size

    def state_at(self, points_world: Array) -> NDArray[np.int8]:
        """State (N,) of the voxels that hold points (N, 3) [m]; 0 outside the map."""
        return _values_at(self.states, points_world, self.origin_world, self.config.size)

    def states_around(self, points_world: Array) -> NDArray[np.int8]:
        """States (N, 7) of the voxels that hold points (N, 3) [m] and of their six neighbours.

        All seven are 0 in the outermost voxels of the map and outside it.
        """
        index = np.floor((points_world - self.origin_world) / self.config.size).astype(np.intp)
        shape = self.states.shape
        inside = ((index > 0) & (index < np.subtract(shape, 1))).all(axis=1)
        place = index[inside] @ (shape[1] * shape[2], shape[2], 1)
        steps = AROUND @ (shape[1] * shape[2], shape[2], 1)
        states = np.zeros((len(index), len(AROUND)), dtype=np.int8)
        states[inside] = self.states.ravel()[place[:, None] + steps]
        return states

    def empty_at(self, points_world: Array) -> NDArray[np.bool_]:
        """Whether the voxels (N,) that hold points (N, 3) [m] were looked through and never hit.

        Views along a thin wall look through its voxels more often than they hit it.
        """
        passed, hit = (
            _values_at(counts.view(np.int8), points_world, self.origin_world, self.config.size)
            for counts in (self.passes, self.hits)
        )
        return (passed != 0) & (hit == 0)


@dataclass(frozen=True, eq=False, slots=True)
class Occluders:
    """The voxels that block lines of sight.

    Attributes:
        origin_world: Corner (3,) [m] of voxel [0, 0, 0] of the grid.
        grid: 1 for a voxel that blocks (X, Y, Z), 0 otherwise; nothing blocks outside.
        voxels: The map it comes from.
    """

    origin_world: Array
    grid: NDArray[np.uint8]
    voxels: VoxelMap

    def holds(self, points_world: Array) -> NDArray[np.bool_]:
        """Whether points (N, 3) [m] lie in such voxels (N,)."""
        occluders = self.grid.view(np.int8)
        return _values_at(occluders, points_world, self.origin_world, self.voxels.config.size) > 0

    def blocked(self, points_world: Array, targets_world: Array, clearance: float) -> NDArray[np.bool_]:
        """Whether something is between points (P, 3) and camera positions (T, 3) [m]: (P, T).

        Voxels within the clearance [m] of a point do not count: its own surface.
        """
        points, eyes = (np.asarray(x, dtype=np.float64) for x in (points_world, targets_world))
        anywhere, known, worth = np.zeros_like(points), np.zeros(len(points)), np.ones(len(points))
        free = self.shown(points, anywhere, known, worth, eyes, np.zeros_like(eyes), clearance, -1.0)
        return free == 0.0

    def shown(
        self,
        points_world: Array,
        normals_world: Array,
        before: Array,
        weights: Array,
        eyes_world: Array,
        axes_world: Array,
        clearance: float,
        cone: float,
    ) -> Array:
        """Value of what each camera shows of each point for the first time.

        A camera shows a point fully up to 60° from its normal, then as well as the cosine; not at all where
        the point lies outside its image or the line of sight is blocked.

        Args:
            points_world: (P, 3) [m].
            normals_world: Outward unit normals (P, 3); zero where a point looks the same from all sides.
            before: How well each has been shown (P,), from 0 to 1.
            weights: Value (P,) of showing each fully.
            eyes_world: Camera centres (C, 3) [m].
            axes_world: Optical axes (C, 3), unit.
            clearance: Length at the point's end of a line of sight that does not count [m].
            cone: Minimum cosine of the angle to the optical axis within the image.

        Returns:
            (P, C): weight · (how well it is shown − how well before), 0 where that is less.
        """
        occluders = (self.grid, self.origin_world, 1.0 / self.voxels.config.size)
        samples = (np.ascontiguousarray(points_world), normals_world, before, weights)
        cameras = (np.ascontiguousarray(eyes_world.T), np.ascontiguousarray(axes_world.T))
        worth = np.empty((len(points_world), len(eyes_world)))
        for_each(_show, SHARES, (*occluders, *samples, *cameras, float(clearance), cone, worth))
        return worth


def _indices(low: NDArray[np.intp], high: NDArray[np.intp]) -> NDArray[np.intp]:
    """Indices (N, 3) of all voxels from one (3,) up to another (3,), which is left out."""
    return np.argwhere(np.ones(high - low, dtype=np.bool_)) + low


def _values_at(grid: NDArray[np.int8], points: Array, origin: Array, size: float) -> NDArray[np.int8]:
    """Values (N,) that the voxels of a grid (X, Y, Z) hold at points (N, 3) [m]; 0 outside."""
    i, j, k = np.floor((points - origin).T / size).astype(np.intp)
    x, y, z = grid.shape
    inside = (i >= 0) & (i < x) & (j >= 0) & (j < y) & (k >= 0) & (k < z)
    values = np.zeros(len(points), dtype=np.int8)
    values[inside] = grid.reshape(-1)[((i * y + j) * z + k)[inside]]
    return values


@cache
def _log_odds(config: VoxelConfig) -> Array:
    """Log-odds of being occupied (256, 256) by how many views looked through and how many hit."""
    hit = np.log(config.hit / (1.0 - config.hit))
    miss = np.log(config.miss / (1.0 - config.miss))
    return np.arange(256) * hit + np.arange(256)[:, None] * miss


@kernel
def _mark_rays(share, data):  # type: ignore[no-untyped-def]
    """Mark the voxels that the rays of a share of the image's tiles pass, and those in which they end.

    A tile is 8 × 8 rays: neighbours meet the same voxels.
    """
    depth_image, K, T, stride, margin, max_depth, origin, size, hits, passes = data
    rows, columns = (len(depth_image) + stride - 1) // stride, (depth_image.shape[1] + stride - 1) // stride
    across = (columns + 7) // 8
    shape, passed = hits.shape, passes.reshape(-1)
    start = ((T[0, 3] - origin[0]) / size, (T[1, 3] - origin[1]) / size, (T[2, 3] - origin[2]) / size)
    found = room(shape)
    for tile in range(share, (rows + 7) // 8 * across, SHARES):
        top, left = tile // across * 8, tile % across * 8
        for row in range(top, min(top + 8, rows)):
            for column in range(left, min(left + 8, columns)):
                (x, y, z), length, depth = _ray(depth_image, K, T, column * stride, row * stride)
                if depth <= 0.0:
                    continue
                t_to = max_depth / depth if depth > max_depth else 1.0 - margin / length
                slabs = traverse(found, shape, start, (x / size, y / size, z / size), 0.0, t_to)
                for n in range(slabs):
                    passed[np.uint32(found[0, n])] = 1
                    passed[np.uint32(found[1, n])] = 1
                    passed[np.uint32(found[2, n])] = 1
                i = int(np.floor((T[0, 3] + x - origin[0]) / size))
                j = int(np.floor((T[1, 3] + y - origin[1]) / size))
                k = int(np.floor((T[2, 3] + z - origin[2]) / size))
                inside = 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]
                if inside and depth <= max_depth:
                    hits[i, j, k] = 1


@inner(fastmath={"contract"})
def _ray(depth_image, K, R, u, v):  # type: ignore[no-untyped-def]
    """Vector (3) [m] in the world from the camera to a pixel's reading, its length and its depth."""
    z = float(depth_image[v, u])
    x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
    ray = (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )
    return ray, np.sqrt(x * x + y * y + z * z), z


@kernel
def _count_marks(share, data):  # type: ignore[no-untyped-def]
    """Turn the marks in a share of the map into counts, at most 255; no ray passes where one ends."""
    hits, passes, new_hits, new_passes = data
    low, high = share * hits.size // SHARES, (share + 1) * hits.size // SHARES
    # Separate slices let the compiler count many voxels at once.
    hits, passes = hits.reshape(-1)[low:high], passes.reshape(-1)[low:high]
    new_hits, new_passes = new_hits.reshape(-1)[low:high], new_passes.reshape(-1)[low:high]
    for n in range(len(hits)):
        hit, passed = new_hits[n], new_passes[n]
        new_hits[n] = hits[n] + np.uint8((hit > 0) & (hits[n] < 255))
        new_passes[n] = passes[n] + np.uint8((passed > hit) & (passes[n] < 255))


@kernel
def _fill(share, data):  # type: ignore[no-untyped-def]
    """Mark a share of the voxels whose centres are inside one of N shapes, if low ≤ index < high (N, 3)."""
    kinds, R, centres, half, low, high, grid, origin, size = data
    centre = np.empty((1, 3))
    for s in range(len(kinds)):
        for i in range(low[s, 0] + share, high[s, 0], SHARES):
            centre[0, 0] = origin[0] + (i + 0.5) * size
            for j in range(low[s, 1], high[s, 1]):
                centre[0, 1] = origin[1] + (j + 0.5) * size
                for k in range(low[s, 2], high[s, 2]):
                    centre[0, 2] = origin[2] + (k + 0.5) * size
                    x, y, z = local(R[s], centres[s], centre, 0)
                    if contains(kinds[s], x, y, z, half[s, 0], half[s, 1], half[s, 2]):
                        grid[i, j, k] = 1


@kernel
def _show(share, data):  # type: ignore[no-untyped-def]
    """Write the values of a share of the work: each piece is one point and 128 of the cameras."""
    occluders, worth = data[0], data[-1]
    found, count = room(occluders.shape), worth.shape[1]
    across = (count + 127) // 128
    for piece in range(share, len(worth) * across, SHARES):
        p, first = piece // across, piece % across * 128
        end = min(first + 128, count)
        _face(data, p, first, end)
        _hide(data, found, p, first, end)


@inner(fastmath={"contract"})
def _face(data, p, first, end):  # type: ignore[no-untyped-def]
    """Write what each camera shows of one point for the first time, where nothing is in between."""
    _, _, _, points, normals, befores, weights, eyes, axes, _, cone, worths = data
    x, y, z = points[p, 0], points[p, 1], points[p, 2]
    a, b, c = normals[p, 0], normals[p, 1], normals[p, 2]
    before, weight = befores[p], weights[p]
    around = a == 0.0 and b == 0.0 and c == 0.0
    # Separate slices let the compiler treat many cameras at once.
    eye_x, eye_y, eye_z = eyes[0, first:end], eyes[1, first:end], eyes[2, first:end]
    axis_x, axis_y, axis_z = axes[0, first:end], axes[1, first:end], axes[2, first:end]
    worth = worths[p, first:end]
    for n in range(len(worth)):
        dx, dy, dz = eye_x[n] - x, eye_y[n] - y, eye_z[n] - z
        distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
        facing = 1.0 if around else min((a * dx + b * dy + c * dz) / (distance * FULLY), 1.0)
        along = -(axis_x[n] * dx + axis_y[n] * dy + axis_z[n] * dz)
        new = facing - before
        worth[n] = weight * new if new > 0.0 and along >= cone * distance else 0.0


@inner(fastmath={"contract"})
def _hide(data, found, p, first, end):  # type: ignore[no-untyped-def]
    """Set to zero what something in between hides of one point."""
    occluders, origin, per_metre, points, _, _, _, eyes, _, clearance, _, worths = data
    shape, flat, worth = occluders.shape, occluders.reshape(-1), worths[p]
    x, y, z = points[p, 0], points[p, 1], points[p, 2]
    start = ((x - origin[0]) * per_metre, (y - origin[1]) * per_metre, (z - origin[2]) * per_metre)
    for n in range(first, end):
        if worth[n] == 0.0:
            continue
        dx, dy, dz = eyes[0, n] - x, eyes[1, n] - y, eyes[2, n] - z
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= clearance:
            continue
        ray = (dx * per_metre, dy * per_metre, dz * per_metre)
        slabs = traverse(found, shape, start, ray, clearance / length, 1.0)
        for m in range(slabs):
            blocked = flat[np.uint32(found[0, m])] | flat[np.uint32(found[1, m])]
            if blocked | flat[np.uint32(found[2, m])]:
                worth[n] = 0.0
                break
