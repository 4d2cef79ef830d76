"""Solid: a shape of any form, made of convex parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from caryatid.geometry import polygons, transforms
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import kernel

LEAST_VOLUME = 1e-9
"""Anything smaller is flat and not a part [m³]; a cubic millimetre."""


@dataclass(frozen=True, eq=False, slots=True)
class Polytope:
    """The convex hull of some points.

    Attributes:
        vertices: Its corners (V, 3) [m].
        triangles: Indices (F, 3) of the corners of its faces, cut into triangles.
        faces: Outward unit normal and offset of each triangle (F, 4): normal · x + offset ≤ 0 inside [m].
        edges: Indices (E, 2) of the ends of its edges, cuts across flat faces among them.
        volume: [m³].
    """

    vertices: Array
    triangles: NDArray[np.intp]
    faces: Array
    edges: NDArray[np.intp]
    volume: float

    @classmethod
    def around(cls, points: Array) -> Polytope | None:
        """The hull of points (N, 3) [m], or None if they have no volume."""
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError):
            return None
        if hull.volume < LEAST_VOLUME:
            return None
        number = np.full(len(points), -1)
        number[hull.vertices] = np.arange(len(hull.vertices))
        triangles = number[hull.simplices]
        vertices = np.ascontiguousarray(points[hull.vertices], dtype=np.float64)
        a, b, c = np.moveaxis(vertices[triangles], 1, 0)
        inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
        triangles[inward] = triangles[inward][:, ::-1]
        low, high = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).T
        # One number for each edge: rows take longer to sort.
        edges = np.stack(np.divmod(np.unique(low * len(vertices) + high), len(vertices)), axis=1)
        return cls(vertices, triangles, hull.equations.copy(), edges, float(hull.volume))

    @property
    def middle(self) -> Array:
        """Centre of mass (3,) [m]."""
        corners = self.vertices[self.triangles] - self.vertices[0]
        volumes = np.linalg.det(corners)
        middle: Array = self.vertices[0] + volumes @ corners.sum(axis=1) / (4.0 * volumes.sum())
        return middle

    def cut(self, normal: Array, offset: float) -> tuple[Polytope | None, Polytope | None]:
        """The parts where n · x, n a normal (3,), is at most and at least an offset [m]; None for no part."""
        height = self.vertices @ normal - offset
        if height.max() <= 0.0 or height.min() >= 0.0:
            return (self, None) if height.max() <= 0.0 else (None, self)
        low, high = height[self.edges[:, 0]], height[self.edges[:, 1]]
        crossing = (low < 0.0) != (high < 0.0)
        share = (low / (low - high + (low == high)))[crossing, None]
        ends = self.vertices[self.edges[crossing]]
        section = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
        below, above = (
            Polytope.around(np.concatenate([self.vertices[side], section]))
            for side in (height <= 0.0, height >= 0.0)
        )
        return below, above


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Solid(Shape):
    """The union of convex parts: anything that is not a box, a cylinder or a ball, and anything hollow.

    Its axes are the world's where it was first seen; its centre is that of the box around it.

    Attributes:
        T_world_object: Pose (4, 4) of its frame.
        polytopes: The parts, in the solid's frame.
    """

    T_world_object: Array
    polytopes: tuple[Polytope, ...]
    kind: ClassVar[str] = "solid"
    ties: ClassVar[tuple[int, int, int]] = (0, 0, 0)

    @classmethod
    def of(cls, polytopes: Sequence[Polytope]) -> Solid:
        """Build a solid of parts in the world frame."""
        vertices = np.concatenate([p.vertices for p in polytopes])
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        parts = []
        for p in polytopes:
            offsets = p.faces[:, 3] + p.faces[:, :3] @ centre
            faces = np.column_stack([p.faces[:, :3], offsets])
            parts.append(replace(p, vertices=p.vertices - centre, faces=faces))
        return cls(transforms.rigid(np.eye(3), centre), tuple(parts))

    @classmethod
    def from_extents(cls, T_world_object: Array, extents: Array) -> Solid:
        """Build a cuboid with a pose (4, 4) and edge lengths (3,) [m]."""
        return cls.from_size(T_world_object, {"parts": [Box(np.eye(4), extents).outline()]})

    @classmethod
    def from_size(cls, T_world_object: Array, size: Any) -> Solid:
        """Build a solid with a pose (4, 4) and `parts`, the corners [m] of each part in the solid's frame."""
        parts = [Polytope.around(np.array(part, dtype=np.float64).reshape(-1, 3)) for part in size["parts"]]
        if not parts or None in parts:
            raise ValueError("a part has no volume")
        return cls(T_world_object, tuple(part for part in parts if part is not None))

    @classmethod
    def _size_format(cls) -> str:
        return "{parts: [[[x, y, z], …], …]}"

    @property
    def size(self) -> dict[str, Any]:
        """Corners [m] of each part in the solid's frame."""
        return {"parts": [p.vertices.tolist() for p in self.polytopes]}

    @property
    def parts(self) -> tuple[Shape, ...]:
        """Its convex parts, each as a solid."""
        return tuple(Solid(self.T_world_object, (p,)) for p in self.polytopes)

    @property
    def extents(self) -> Array:
        """Full extents (3,) [m] of the box around it along its own axes."""
        return 2.0 * np.abs(np.concatenate([p.vertices for p in self.polytopes])).max(axis=0)

    @property
    def volume(self) -> float:
        """Volume [m³]; where parts overlap, each counts."""
        return float(sum(p.volume for p in self.polytopes))

    @property
    def centre_of_mass(self) -> Array:
        """Centre of mass (3,) [m] in the world, of a uniform density."""
        middles = np.array([p.middle for p in self.polytopes])
        weights = np.array([p.volume for p in self.polytopes])
        return transforms.transform(self.T_world_object, (weights @ middles / weights.sum())[None])[0]

    def resized(self, T_world_object: Array, extents: Array) -> Solid:
        """The same form with another pose (4, 4) and other lengths (3,) [m] along its axes."""
        scale = extents / self.extents
        if np.allclose(scale, 1.0, atol=1e-9):
            return replace(self, T_world_object=T_world_object)
        return Solid.from_size(T_world_object, {"parts": [p.vertices * scale for p in self.polytopes]})

    def lowest(self, direction: Array, depth: float) -> NDArray[np.bool_]:
        """Which corners of its outline (N,) lie within a depth [m] of its end along a direction (3,)."""
        reach = np.concatenate([p.vertices for p in self.polytopes]) @ direction
        return np.asarray(reach >= reach.max() - depth)

    def lengthened(self, direction: Array, depth: float, length: float) -> Solid:
        """Move the corners within a depth [m] of the solid's end by a length [m]; a negative one shortens it.

        The end and the move are along a unit vector (3,) in the solid's frame.
        """
        moving = np.split(self.lowest(direction, depth), np.cumsum([len(p.vertices) for p in self.polytopes]))
        moved = []
        for part, own in zip(self.polytopes, moving, strict=False):
            # A face that moves on leaves a prism behind.
            stays = part.vertices[~own] if length < 0.0 else part.vertices
            longer = Polytope.around(np.concatenate([stays, part.vertices[own] + length * direction]))
            moved.append(part if longer is None or not own.any() else longer)
        return Solid.of(moved).moved(self.T_world_object)

    def signed_distance(self, points_world: Array) -> Array:
        """Distance (N,) [m] of points (N, 3) to the surface, negative inside.

        Outside, where an edge or a corner is nearest, it is less: the distance to the farthest of the planes
        there, those of the box around the solid included.
        """
        points = transforms.transform(transforms.invert(self.T_world_object), points_world)
        faces = np.concatenate([p.faces for p in self.polytopes])
        ends = np.cumsum([len(p.faces) for p in self.polytopes])
        distances: Array = _distances(np.ascontiguousarray(points), faces, ends)
        # A thin edge has no plane that faces a point far beyond it.
        return np.maximum(distances, (np.abs(points) - self.extents / 2.0).max(axis=1))

    def outline(self) -> Array:
        """Corners (N, 3) [m] of all parts."""
        return transforms.transform(self.T_world_object, np.concatenate([p.vertices for p in self.polytopes]))

    def cap(self, direction_world: Array, depth: float) -> Array:
        """Outline (M, 2) [m] on the ground of the part within `depth` [m] of its end in a direction (3,).

        Of one convex part only.
        """
        return polygons.cap(self.outline(), self.polytopes[0].edges, direction_world, depth)

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (N, 3) [m] about `spacing` metres apart all over the surface, and outward normals (N, 3)."""
        points, normals = zip(*(_spread(p, spacing) for p in self.polytopes), strict=True)
        owner = np.repeat(np.arange(len(points)), [len(p) for p in points])
        local, outward = np.concatenate(points), np.concatenate(normals)
        inside = np.zeros(len(local), dtype=np.bool_)
        for number, part in enumerate(self.polytopes):
            # Parts that touch, to a tenth of a millimetre, have no surface there.
            depth = (local @ part.faces[:, :3].T + part.faces[:, 3]).max(axis=1)
            inside |= (depth < 1e-4) & (owner != number)
        R = self.T_world_object[:3, :3]
        return transforms.transform(self.T_world_object, local[~inside]), outward[~inside] @ R.T

    def mesh(self, corners: int = 48) -> Any:
        """All parts as one `trimesh.Trimesh` in the solid's frame."""
        import trimesh

        return trimesh.util.concatenate(
            [trimesh.Trimesh(p.vertices, p.triangles, process=False) for p in self.polytopes]
        )

    def _edges(self, eye: Array | None) -> Array:
        """Edges of the whole: none where parts touch or overlap."""
        import trimesh

        ends = Shape._edges(self, eye)
        middle, around = ends.mean(axis=1), trimesh.creation.icosphere(subdivisions=2).vertices
        nearby = (middle[:, None] + 2e-3 * around).reshape(-1, 3)
        filled = Solid(np.eye(4), self.polytopes).signed_distance(nearby).reshape(len(ends), -1) < 0.0
        # Half of the space around a point on a flat face is filled, a quarter of that around one on a box's
        # edge.
        share = filled.mean(axis=1)
        kept = (np.abs(share - 0.5) > 0.1) & (share < 0.9)
        if eye is not None:  # across the line of sight
            inward, sight = transforms.unit(filled @ around), transforms.unit(eye - middle)
            kept |= (np.abs(np.einsum("ij,ij->i", inward, sight)) < 0.3) & (share < 0.9)
        return ends[kept]

    def __repr__(self) -> str:
        x, y, z = self.T_world_object[:3, 3]
        return f"Solid({len(self.polytopes)} parts at ({x:.3f}, {y:.3f}, {z:.3f}))"


def in_hull(corners: Array, points: Array) -> NDArray[np.bool_]:
    """Which points (M, 3) lie inside the convex hull of corners (N, 3): (M,) bool."""
    faces = ConvexHull(corners).equations
    inside: NDArray[np.bool_] = (points @ faces[:, :3].T + faces[:, 3] <= 1e-9).all(axis=-1)
    return inside


def hollowed(part: Polytope, cavity: Sequence[tuple[Array, float]]) -> list[Polytope]:
    """The rest of a part without a convex cavity, in convex pieces that do not overlap.

    Args:
        part: The part.
        cavity: Its planes, unit normal (3,) into the cavity and offset [m]: the points before all of them.

    Returns:
        The pieces; the part itself if the cavity does not reach it.
    """
    if any((part.vertices @ normal).max() <= offset for normal, offset in cavity):
        return [part]
    pieces, rest = [], part
    for normal, offset in cavity:
        behind, before = rest.cut(normal, offset)
        if behind is not None:
            pieces.append(behind)
        if before is None:
            return [part]
        rest = before
    return pieces


def _spread(polytope: Polytope, spacing: float) -> tuple[Array, Array]:
    """Points (N, 3) [m] evenly over a polytope's faces, and their normals (N, 3)."""
    a, b, c = np.moveaxis(polytope.vertices[polytope.triangles], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    number = max(20, int(areas.sum() / spacing**2))
    place = (np.arange(number) + 0.5) / number
    face = np.searchsorted(np.cumsum(areas) / areas.sum(), place).clip(max=len(areas) - 1)
    # The first two coordinates of the additive recurrence that fills a square most evenly.
    u, v = (np.arange(number)[:, None] * (0.7548776662466927, 0.5698402909980532) % 1.0).T
    u, v = np.where(u + v > 1.0, 1.0 - u, u)[:, None], np.where(u + v > 1.0, 1.0 - v, v)[:, None]
    return a[face] + u * (b - a)[face] + v * (c - a)[face], polytope.faces[face, :3]


@kernel
def _distances(points, faces, ends):  # type: ignore[no-untyped-def]
    """Distances (N,) [m] of points (N, 3) to the nearest of several parts, by the planes (F, 4) of each."""
    found = np.empty(len(points))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        least, start = np.inf, 0
        for end in ends:
            most = -np.inf
            for f in range(start, end):
                most = max(most, faces[f, 0] * x + faces[f, 1] * y + faces[f, 2] * z + faces[f, 3])
                if most >= least:
                    break
            least, start = min(least, most), end
        found[i] = least
    return found
