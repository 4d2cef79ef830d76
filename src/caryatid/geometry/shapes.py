"""Box, Cylinder and Sphere: a pose and named sizes, with what geometry asks of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.runtime.display import Pictured


class Shape(Protocol):
    """A convex solid whose pose is at its centre.

    Attributes:
        kind: `box`, `cylinder` or `sphere`, as in graph.json.
        T_world_object: Pose (4, 4) of the centre.
    """

    kind: ClassVar[str]

    @property
    def T_world_object(self) -> Array:
        """Pose (4, 4) of the centre."""
        ...

    @property
    def extents(self) -> Array:
        """Full extents (3,) [m] along the object's own axes."""
        ...

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        ...

    @property
    def size(self) -> dict[str, float] | list[float]:
        """Sizes [m] as graph.json writes them."""
        ...

    def signed_distance(self, points_world: Array) -> Array:
        """Distance (N,) [m] of points (N, 3) to the surface, negative inside."""
        ...

    def support(self, directions_world: Array) -> Array:
        """Extent (N,) [m] from the centre along unit directions (N, 3): the shape's support function."""
        ...

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (N, 3) [m] about `spacing` metres apart all over the surface, and outward normals (N, 3)."""
        ...

    def outline(self) -> Array:
        """Points (N, 3) [m] whose convex hull is the shape (to 1 % for round ones)."""
        ...

    def moved(self, T: Array) -> Self:
        """Return the shape moved by a rigid transform (4, 4) of the world: T @ T_world_object."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Box(Pictured):
    """A cuboid.

    Attributes:
        kind: `box`, as in graph.json.
        T_world_object: Pose (4, 4) of the centre; axes along the edges.
        extents: Full edge lengths (3,) [m] along the object's x, y, z.
    """

    T_world_object: Array
    extents: Array
    kind: ClassVar[str] = "box"

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return float(np.prod(self.extents))

    @property
    def size(self) -> list[float]:
        """Edge lengths [x, y, z] [m]."""
        return [float(e) for e in self.extents]

    def signed_distance(self, points_world: Array) -> Array:
        """Distance (N,) [m] of points (N, 3) to the surface, negative inside."""
        q = np.abs(_local(self, points_world)) - self.extents / 2.0
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=-1)
        return outside + np.minimum(q.max(axis=-1), 0.0)

    def support(self, directions_world: Array) -> Array:
        """Extent (N,) [m] from the centre along unit directions (N, 3)."""
        return np.abs(directions_world @ self.T_world_object[:3, :3]) @ (self.extents / 2.0)

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (N, 3) [m] about `spacing` apart on all six faces, and outward normals (N, 3)."""
        points, normals = [], []
        half = self.extents / 2.0
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            grid_u, grid_v = np.meshgrid(_cells(half[u], spacing), _cells(half[v], spacing), indexing="ij")
            for sign in (-1.0, 1.0):
                face = np.zeros((grid_u.size, 3))
                face[:, axis], face[:, u], face[:, v] = sign * half[axis], grid_u.ravel(), grid_v.ravel()
                normal = np.zeros((grid_u.size, 3))
                normal[:, axis] = sign
                points.append(face)
                normals.append(normal)
        return _to_world(self, np.concatenate(points), np.concatenate(normals))

    def outline(self) -> Array:
        """The eight corners (8, 3) [m]."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
        return transforms.transform(self.T_world_object, signs * self.extents / 2.0)

    def moved(self, T: Array) -> Box:
        """Return the box moved by a rigid transform (4, 4) of the world."""
        return Box(T @ self.T_world_object, self.extents)

    def __repr__(self) -> str:
        x, y, z = self.extents
        return f"Box({x:.3f} × {y:.3f} × {z:.3f} m at {_place(self)})"


@dataclass(frozen=True, eq=False, slots=True)
class Cylinder(Pictured):
    """A straight circular cylinder.

    Attributes:
        kind: `cylinder`, as in graph.json.
        T_world_object: Pose (4, 4) of the centre; the axis is the object's z.
        radius: [m].
        height: Full length along the axis [m].
    """

    T_world_object: Array
    radius: float
    height: float
    kind: ClassVar[str] = "cylinder"

    @property
    def extents(self) -> Array:
        """Full extents (3,) [m] along the object's own axes."""
        return np.array([2.0 * self.radius, 2.0 * self.radius, self.height])

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return float(np.pi * self.radius**2 * self.height)

    @property
    def size(self) -> dict[str, float]:
        """Radius and height [m]."""
        return {"radius": float(self.radius), "height": float(self.height)}

    def signed_distance(self, points_world: Array) -> Array:
        """Distance (N,) [m] of points (N, 3) to the surface, negative inside."""
        p = _local(self, points_world)
        q = np.stack([np.hypot(p[:, 0], p[:, 1]) - self.radius, np.abs(p[:, 2]) - self.height / 2.0], axis=-1)
        return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)

    def support(self, directions_world: Array) -> Array:
        """Extent (N,) [m] from the centre along unit directions (N, 3)."""
        d = directions_world @ self.T_world_object[:3, :3]
        return self.radius * np.hypot(d[:, 0], d[:, 1]) + self.height / 2.0 * np.abs(d[:, 2])

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (N, 3) [m] about `spacing` apart on mantle and both ends, and outward normals (N, 3)."""
        count = max(8, round(2.0 * np.pi * self.radius / spacing))
        angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
        z = _cells(self.height / 2.0, spacing)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=-1)
        mantle_normals = np.tile(ring, (len(z), 1))
        mantle = self.radius * mantle_normals
        mantle[:, 2] = np.repeat(z, count)
        grid = _cells(self.radius, spacing)
        x, y = (g.ravel() for g in np.meshgrid(grid, grid, indexing="ij"))
        inside = np.hypot(x, y) <= self.radius
        cap = np.stack([x[inside], y[inside], np.full(inside.sum(), self.height / 2.0)], axis=-1)
        up = np.tile((0.0, 0.0, 1.0), (len(cap), 1))
        points = np.concatenate([mantle, cap, cap * (1.0, 1.0, -1.0)])
        return _to_world(self, points, np.concatenate([mantle_normals, up, -up]))

    def outline(self) -> Array:
        """Two regular 24-gons (48, 3) [m] around the ends."""
        angle = 2.0 * np.pi * np.arange(24) / 24
        ring = np.stack([self.radius * np.cos(angle), self.radius * np.sin(angle), np.zeros(24)], axis=-1)
        end = np.array([0.0, 0.0, self.height / 2.0])
        return transforms.transform(self.T_world_object, np.concatenate([ring + end, ring - end]))

    def moved(self, T: Array) -> Cylinder:
        """Return the cylinder moved by a rigid transform (4, 4) of the world."""
        return Cylinder(T @ self.T_world_object, self.radius, self.height)

    def __repr__(self) -> str:
        return f"Cylinder(radius {self.radius:.3f} m, height {self.height:.3f} m at {_place(self)})"


@dataclass(frozen=True, eq=False, slots=True)
class Sphere(Pictured):
    """A ball.

    Attributes:
        kind: `sphere`, as in graph.json.
        T_world_object: Pose (4, 4) of the centre; its rotation means nothing.
        radius: [m].
    """

    T_world_object: Array
    radius: float
    kind: ClassVar[str] = "sphere"

    @property
    def extents(self) -> Array:
        """Full extents (3,) [m] along the object's own axes."""
        return np.full(3, 2.0 * self.radius)

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return float(4.0 / 3.0 * np.pi * self.radius**3)

    @property
    def size(self) -> dict[str, float]:
        """Radius [m]."""
        return {"radius": float(self.radius)}

    def signed_distance(self, points_world: Array) -> Array:
        """Distance (N,) [m] of points (N, 3) to the surface, negative inside."""
        return np.linalg.norm(points_world - self.T_world_object[:3, 3], axis=-1) - self.radius

    def support(self, directions_world: Array) -> Array:
        """Extent (N,) [m] from the centre along unit directions (N, 3)."""
        return np.full(len(directions_world), self.radius)

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (N, 3) [m] about `spacing` apart, and outward normals (N, 3)."""
        count = max(20, round(4.0 * np.pi * (self.radius / spacing) ** 2))
        normals = fibonacci_sphere(count)
        return _to_world(self, self.radius * normals, normals)

    def outline(self) -> Array:
        """Points (400, 3) [m] on the sphere."""
        return self.T_world_object[:3, 3] + self.radius * fibonacci_sphere(400)

    def moved(self, T: Array) -> Sphere:
        """Return the sphere moved by a rigid transform (4, 4) of the world."""
        return Sphere(T @ self.T_world_object, self.radius)

    def __repr__(self) -> str:
        return f"Sphere(radius {self.radius:.3f} m at {_place(self)})"


def from_size(
    kind: str, T_world_object: Array, size: Mapping[str, float] | list[float], source: str
) -> Box | Cylinder | Sphere:
    """Build a shape from its name and sizes [m] as graph.json writes them.

    Args:
        kind: `box`, `cylinder` or `sphere`.
        T_world_object: Pose (4, 4) of its centre.
        size: Full extents of a box, radius and height of a cylinder, radius of a sphere.
        source: What to call it in the error.

    Raises:
        InputError: The name is not one of the three, or the sizes do not fit it.
    """
    T = transforms.as_rigid(T_world_object, f"{source}: T_world_object")
    try:
        match kind, size:
            case "box", [x, y, z]:
                return Box(T, np.array([float(x), float(y), float(z)]))
            case "cylinder", {"radius": radius, "height": height}:
                return Cylinder(T, float(radius), float(height))
            case "sphere", {"radius": radius}:
                return Sphere(T, float(radius))
    except (TypeError, ValueError):
        pass
    raise InputError(
        source,
        f"no shape '{kind}' with size {size}",
        "a box has [x, y, z], a cylinder {radius, height}, a sphere {radius}",
    )


def fibonacci_sphere(count: int) -> Array:
    """Spread `count` = N unit vectors (N, 3) evenly over the sphere by the golden angle."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=-1)


def _place(shape: Shape) -> str:
    x, y, z = shape.T_world_object[:3, 3]
    return f"({x:.3f}, {y:.3f}, {z:.3f})"


def _local(shape: Shape, points_world: Array) -> Array:
    T = shape.T_world_object
    return (points_world - T[:3, 3]) @ T[:3, :3]


def _to_world(shape: Shape, points: Array, normals: Array) -> tuple[Array, Array]:
    T = shape.T_world_object
    return transforms.transform(T, points), transforms.rotate(T, normals)


def _cells(half: float, spacing: float) -> NDArray[np.float64]:
    """Centres of equal cells that cover [-half, half]."""
    count = max(2, int(np.ceil(2.0 * half / spacing)))
    return half * (2.0 * (np.arange(count) + 0.5) / count - 1.0)
