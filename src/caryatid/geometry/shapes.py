"""Box, Cylinder and Sphere: a pose and named sizes, with their geometry; many shapes as arrays.

A new kind of shape derives from `Shape`; `from_size` then knows it by its name.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from caryatid.errors import InputError
from caryatid.geometry import BOX, CYLINDER, SPHERE, polygons, transforms
from caryatid.geometry.signed_distance import distances_and_gradients, sample_surface, signed_distances
from caryatid.geometry.transforms import Array
from caryatid.runtime import Pictured

_BOX_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""Corners (8, 3) of a box, in half extents."""
_CYLINDER_RIMS = np.array(
    [(math.cos(a), math.sin(a), end) for end in (1.0, -1.0) for a in 2.0 * np.pi * np.arange(24) / 24]
)
"""Points (48, 3) of a cylinder's rims, in radii and half heights."""
_ANGLES = 2.0 * np.pi * np.arange(64) / 64
_RING = np.stack([-np.sin(_ANGLES), np.cos(_ANGLES)], axis=-1)
"""Points (64, 2) of a ball's outline from above, in radii."""
_BOX_EDGES = np.array([(i, i + bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])
_CYLINDER_EDGES = np.concatenate(
    [[(i, i + 24), (i, (i + 1) % 24), (i + 24, (i + 1) % 24 + 24)] for i in range(24)]
)
"""Edges (E, 2) between the points of the outline of a box, and of the prism that stands for a cylinder."""

MOST_SAMPLES = 1e7
"""Maximum number of points on a surface [1]; with their normals they take 0.5 GB."""

KINDS: dict[str, type[Shape]] = {}
"""Every kind of shape by its name, as in graph.json."""


def _check_lengths(name: str, *lengths: float) -> None:
    """Reject lengths [m] that no solid has; plain comparisons, because fits make many shapes."""
    for length in lengths:
        if not 0.0 < length < math.inf:
            raise InputError(name, f"contains {length:g}", "give lengths above 0, in metres")


class Shape(Pictured):
    """A convex form whose pose is at its centre: a frozen dataclass of `T_world_object` and named sizes.

    A kind has to define `kind`, `extents` and `from_extents`, and an `outline` that spans it. Everything
    else follows. Compiled kernels, MuJoCo and URDF use the box around a shape whose `code` they do not know.
    A shape that is not convex is the union of its convex `parts`.

    Attributes:
        kind: Name of the kind, as in graph.json.
        code: Its kind for the compiled kernels.
        ties: Extents along x, y, z with equal entries here are one number.
        parameters: Numbers that determine the shape.
        fill: Share of the box around it that it fills [1]; None = that of its mesh.
        spread: Mean square of its points' coordinates along x, y, z, per squared extent [1].
        T_world_object: Pose (4, 4) of the centre.
    """

    __slots__ = ()

    kind: ClassVar[str]
    code: ClassVar[int] = BOX
    ties: ClassVar[tuple[int, int, int]] = (0, 1, 2)
    parameters: ClassVar[int] = 9
    fill: ClassVar[float | None] = None
    spread: ClassVar[tuple[float, float, float]] = (1.0 / 12.0, 1.0 / 12.0, 1.0 / 12.0)
    T_world_object: Array

    def __post_init__(self) -> None:
        if np.shape(self.T_world_object) != (4, 4):
            reason = f"has shape {np.shape(self.T_world_object)}"
            raise InputError("T_world_object", reason, "give a homogeneous rigid transform (4, 4)")

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        KINDS[cls.kind] = cls

    @property
    @abstractmethod
    def extents(self) -> Array:
        """Full extents (3,) [m] along the object's own axes."""

    @classmethod
    @abstractmethod
    def from_extents(cls, T_world_object: Array, extents: Array) -> Self:
        """Build the shape with a pose (4, 4) and full extents (3,) [m]; the first of tied ones counts."""

    @abstractmethod
    def outline(self) -> Array:
        """Points (N, 3) [m] whose convex hull is the shape (to 1 % for round ones)."""

    def footprint(self) -> Array:
        """Outline (M, 2) [m] of the shape projected to the ground: P_A of eq. 1."""
        return polygons.hull(self.outline())

    def cap(self, direction_world: Array, depth: float) -> Array:
        """Outline (M, 2) [m], on the ground, of the part near its end along a direction.

        By default that of the box around it.

        Args:
            direction_world: Unit vector (3,).
            depth: How far the part reaches from the outermost point [m].
        """
        return Box(self.T_world_object, self.extents).cap(direction_world, depth)

    def resized(self, T_world_object: Array, extents: Array) -> Self:
        """Return the shape with another pose (4, 4) and full extents (3,) [m]."""
        return self.from_extents(T_world_object, extents)

    @property
    def parts(self) -> tuple[Shape, ...]:
        """Convex shapes whose union it is; itself alone if it is convex."""
        return (self,)

    @property
    def row(self) -> tuple[int, Array, Array, Array]:
        """Code, axes (3, 3), centre (3,) [m] and half extents (3,) [m], for the compiled kernels."""
        T = self.T_world_object
        return self.code, np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), self.extents / 2.0

    @property
    def centre_of_mass(self) -> Array:
        """Centre of mass (3,) [m] in the world, of a uniform density."""
        return self.T_world_object[:3, 3]

    @classmethod
    def from_size(cls, T_world_object: Array, size: Any) -> Self:
        """Build the shape with a pose (4, 4) and sizes [m] as graph.json writes them.

        Raises:
            TypeError, ValueError, KeyError: The sizes do not fit the kind.
        """
        return cls(T_world_object, *(float(size[name]) for name in cls._size_names()))  # type: ignore[call-arg]

    @classmethod
    def _size_names(cls) -> list[str]:
        return [field.name for field in fields(cls) if field.name != "T_world_object"]  # type: ignore[arg-type]

    @classmethod
    def _size_format(cls) -> str:
        return f"{{{', '.join(cls._size_names())}}}"

    @property
    def size(self) -> dict[str, Any] | list[float]:
        """Sizes [m] as graph.json writes them."""
        return {name: float(getattr(self, name)) for name in self._size_names()}

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return float(self.mesh().volume if self.fill is None else self.fill * np.prod(self.extents))

    @property
    def moments(self) -> Array:
        """Moments of inertia (3,) [m²] about the object's axes, per mass; of the box around it by default."""
        squares: Array = np.multiply(self.spread, self.extents**2)
        return squares.sum() - squares

    def signed_distance(self, points_world: Array) -> Array:
        """Distance (N,) [m] of points (N, 3) to the surface, negative inside."""
        points = np.ascontiguousarray(points_world, np.float64)
        distances: Array = signed_distances(*self.row, points)
        return distances

    def support(self, directions_world: Array) -> Array:
        """Extent (N,) [m] from the centre along unit directions (N, 3): the shape's support function."""
        reach: Array = directions_world @ (self.outline() - self.T_world_object[:3, 3]).T
        return reach.max(axis=1)

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (N, 3) [m] about `spacing` metres apart all over the surface, and outward normals (N, 3).

        Raises:
            InputError: There would be more than `MOST_SAMPLES` points.
        """
        x, y, z = (self.extents / spacing).tolist()
        if not 2.0 * (x * y + y * z + z * x) <= MOST_SAMPLES:
            reason = f"is too fine for a {self.kind} of {max(self.extents):.3g} m"
            raise InputError(f"a spacing of {spacing:.3g} m", reason, "give a larger spacing")
        points, normals = sample_surface(*self.row, float(spacing))
        return points, normals

    def mesh(self, corners: int = 48) -> Any:
        """The shape as a `trimesh.Trimesh` in the object's frame; circles get this many corners."""
        import trimesh

        T_object_world = transforms.invert(self.T_world_object)
        return trimesh.convex.convex_hull(transforms.transform(T_object_world, self.outline()))

    def to_trimesh(self, corners: int = 48) -> Any:
        """The shape as a `trimesh.Trimesh` in the world frame [m]; circles get this many corners."""
        return self.mesh(corners).apply_transform(self.T_world_object)

    def lines(self, eye_world: Array) -> list[Array]:
        """Lines (M, 3) [m] that draw the shape: edges, rims, and the silhouette seen from a point (3,)."""
        eye = transforms.transform(transforms.invert(self.T_world_object), eye_world)
        drawn = self._drawn(eye)
        points_world = transforms.transform(self.T_world_object, np.concatenate(drawn))
        return np.split(points_world, np.cumsum([len(line) for line in drawn])[:-1])

    def _drawn(self, eye: Array) -> list[Array]:
        """What `lines` are in the object's frame."""
        start, end = np.swapaxes(self._edges(eye), 0, 1)
        return [*np.linspace(start, end, 33, axis=1)]

    def creases(self) -> Array:
        """Ends (E, 2, 3) [m] of the edges sharper than 30°."""
        return transforms.transform(self.T_world_object, self._edges(None))

    def _edges(self, eye: Array | None) -> Array:
        """Ends (E, 2, 3) [m] of the edges sharper than 30°, and of those on the outline an eye (3,) sees."""
        mesh = self.mesh()
        drawn = mesh.face_adjacency_angles > np.radians(30.0)
        if eye is not None:
            faces_eye = np.einsum("ij,ij->i", mesh.face_normals, eye - mesh.triangles_center) > 0.0
            drawn |= faces_eye[mesh.face_adjacency].sum(axis=1) == 1
        ends: Array = mesh.vertices[mesh.face_adjacency_edges[drawn]]
        return ends

    def moved(self, T: Array) -> Self:
        """Return the shape moved by a rigid transform (4, 4) of the world: T @ T_world_object."""
        return replace(self, T_world_object=T @ self.T_world_object)  # type: ignore[type-var]

    def __repr__(self) -> str:
        sizes = ", ".join(f"{name} {getattr(self, name):.3f} m" for name in self._size_names())
        return f"{type(self).__name__}({sizes} at {_place(self)})"


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Box(Shape):
    """A cuboid.

    Attributes:
        T_world_object: Pose (4, 4) of the centre; axes along the edges.
        extents: Full edge lengths (3,) [m] along the object's x, y, z.
    """

    T_world_object: Array
    extents: Array
    kind: ClassVar[str] = "box"
    fill: ClassVar[float] = 1.0

    def __post_init__(self) -> None:
        Shape.__post_init__(self)
        if np.shape(self.extents) != (3,):
            raise InputError("extents", f"has shape {np.shape(self.extents)}", "give three edge lengths [m]")
        object.__setattr__(self, "extents", np.asarray(self.extents, dtype=np.float64))
        _check_lengths("extents", *self.extents.tolist())

    @classmethod
    def from_extents(cls, T_world_object: Array, extents: Array) -> Box:
        """Build a box with a pose (4, 4) and edge lengths (3,) [m]."""
        return cls(T_world_object, extents)

    @classmethod
    def from_size(cls, T_world_object: Array, size: Any) -> Box:
        """Build a box with a pose (4, 4) and edge lengths [x, y, z] [m]."""
        if isinstance(size, Mapping):
            raise TypeError
        x, y, z = size
        return cls(T_world_object, np.array([float(x), float(y), float(z)]))

    @classmethod
    def _size_format(cls) -> str:
        return "[x, y, z]"

    @property
    def size(self) -> list[float]:
        """Edge lengths [x, y, z] [m]."""
        return [float(e) for e in self.extents]

    def support(self, directions_world: Array) -> Array:
        """Extent (N,) [m] from the centre along unit directions (N, 3)."""
        return np.abs(directions_world @ self.T_world_object[:3, :3]) @ (self.extents / 2.0)

    def outline(self) -> Array:
        """The eight corners (8, 3) [m]."""
        return transforms.transform(self.T_world_object, _BOX_CORNERS * self.extents / 2.0)

    def cap(self, direction_world: Array, depth: float) -> Array:
        """Outline (M, 2) [m] on the ground of the part within `depth` [m] of its end in a direction (3,)."""
        return polygons.cap(self.outline(), _BOX_EDGES, direction_world, depth)

    def mesh(self, corners: int = 48) -> Any:
        """The box as a `trimesh.Trimesh` in its own frame."""
        import trimesh

        return trimesh.creation.box(extents=self.extents)

    def __repr__(self) -> str:
        x, y, z = self.extents
        return f"Box({x:.3f} × {y:.3f} × {z:.3f} m at {_place(self)})"


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Cylinder(Shape):
    """A straight circular cylinder.

    Attributes:
        T_world_object: Pose (4, 4) of the centre; the axis is the object's z.
        radius: [m].
        height: Full length along the axis [m].
    """

    T_world_object: Array
    radius: float
    height: float
    kind: ClassVar[str] = "cylinder"
    code: ClassVar[int] = CYLINDER
    ties: ClassVar[tuple[int, int, int]] = (0, 0, 2)
    parameters: ClassVar[int] = 7
    fill: ClassVar[float] = np.pi / 4.0
    spread: ClassVar[tuple[float, float, float]] = (1.0 / 16.0, 1.0 / 16.0, 1.0 / 12.0)

    def __post_init__(self) -> None:
        Shape.__post_init__(self)
        _check_lengths("radius", self.radius)
        _check_lengths("height", self.height)

    @property
    def extents(self) -> Array:
        """Full extents (3,) [m] along the object's own axes."""
        return np.array([2.0 * self.radius, 2.0 * self.radius, self.height])

    @classmethod
    def from_extents(cls, T_world_object: Array, extents: Array) -> Cylinder:
        """Build a cylinder with a pose (4, 4) and full extents (3,) [m]: the first is its diameter."""
        return cls(T_world_object, float(extents[0]) / 2.0, float(extents[2]))

    def support(self, directions_world: Array) -> Array:
        """Extent (N,) [m] from the centre along unit directions (N, 3)."""
        d = directions_world @ self.T_world_object[:3, :3]
        return self.radius * np.hypot(d[:, 0], d[:, 1]) + self.height / 2.0 * np.abs(d[:, 2])

    def outline(self) -> Array:
        """Two regular 24-gons (48, 3) [m] around the ends."""
        size = (self.radius, self.radius, self.height / 2.0)
        return transforms.transform(self.T_world_object, _CYLINDER_RIMS * size)

    def cap(self, direction_world: Array, depth: float) -> Array:
        """Outline (M, 2) [m] on the ground of the part within `depth` [m] of its end in a direction (3,)."""
        return polygons.cap(self.outline(), _CYLINDER_EDGES, direction_world, depth)

    def mesh(self, corners: int = 48) -> Any:
        """The cylinder as a `trimesh.Trimesh` in its own frame."""
        import trimesh

        return trimesh.creation.cylinder(self.radius, self.height, sections=corners)

    def _drawn(self, eye: Array) -> list[Array]:
        """Both rims, and the sides of the mantle."""
        ends = np.array([[0.0, 0.0, -self.height / 2.0], [0.0, 0.0, self.height / 2.0]])
        found = [_circle(end, np.array([0.0, 0.0, 1.0]), self.radius) for end in ends]
        distance = float(np.hypot(eye[0], eye[1]))
        if distance > self.radius:
            towards, reach = np.arctan2(eye[1], eye[0]), np.arccos(self.radius / distance)
            for angle in (towards - reach, towards + reach):
                foot = self.radius * np.array([np.cos(angle), np.sin(angle), 0.0])
                found.append(np.linspace(ends[0] + foot, ends[1] + foot, 33))
        return found


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Sphere(Shape):
    """A ball.

    Attributes:
        T_world_object: Pose (4, 4) of the centre; its rotation means nothing.
        radius: [m].
    """

    T_world_object: Array
    radius: float
    kind: ClassVar[str] = "sphere"
    code: ClassVar[int] = SPHERE
    ties: ClassVar[tuple[int, int, int]] = (0, 0, 0)
    parameters: ClassVar[int] = 4
    fill: ClassVar[float] = np.pi / 6.0
    spread: ClassVar[tuple[float, float, float]] = (0.05, 0.05, 0.05)

    def __post_init__(self) -> None:
        Shape.__post_init__(self)
        _check_lengths("radius", self.radius)

    @property
    def extents(self) -> Array:
        """Full extents (3,) [m] along the object's own axes."""
        return np.full(3, 2.0 * self.radius)

    @classmethod
    def from_extents(cls, T_world_object: Array, extents: Array) -> Sphere:
        """Build a ball with a pose (4, 4) and full extents (3,) [m]: the first is its diameter."""
        return cls(T_world_object, float(extents[0]) / 2.0)

    def support(self, directions_world: Array) -> Array:
        """Extent (N,) [m] from the centre along unit directions (N, 3)."""
        return np.full(len(directions_world), self.radius)

    def outline(self) -> Array:
        """Points (400, 3) [m] on the sphere."""
        return self.T_world_object[:3, 3] + self.radius * fibonacci_sphere(400)

    def footprint(self) -> Array:
        """Outline (64, 2) [m] of the ball projected to the ground."""
        return polygons.hull(self.T_world_object[:2, 3] + self.radius * _RING)

    def cap(self, direction_world: Array, depth: float) -> Array:
        """Rim (64, 2) [m] on the ground of the part within `depth` [m] of its end in a direction (3,).

        That of a part deeper than the radius is a great circle.
        """
        depth = min(depth, self.radius)
        middle_world = self.T_world_object[:3, 3] + (self.radius - depth) * direction_world
        rim = math.sqrt(depth * (2.0 * self.radius - depth))
        return polygons.hull(_circle(middle_world, direction_world, rim)[:-1])

    def mesh(self, corners: int = 48) -> Any:
        """The ball as a `trimesh.Trimesh` in its own frame; its radius is right to 1 %."""
        import trimesh

        return trimesh.creation.icosphere(subdivisions=3, radius=self.radius)

    def _drawn(self, eye: Array) -> list[Array]:
        """Three great circles and the silhouette."""
        found = [_circle(np.zeros(3), axis, self.radius) for axis in np.eye(3)]
        distance = float(np.linalg.norm(eye))
        if distance > self.radius:
            share = self.radius / distance
            rim = self.radius * np.sqrt(1.0 - share**2)
            found.append(_circle(self.radius * share * eye / distance, eye / distance, rim))
        return found


@dataclass(frozen=True, eq=False, slots=True)
class Uncertainty:
    """Standard deviations of a fitted shape, along and about the object's own axes.

    Attributes:
        position: Of the centre (3,) [m].
        rotation: (3,) [rad]; large about an axis of symmetry.
        sizes: Of the full extents (3,) [m] along x, y, z.
        sides: Of the position of the sides -x, +x, -y, +y, -z, +z (6,) [m] along their normals.
    """

    position: Array
    rotation: Array
    sizes: Array
    sides: Array

    def widened(self, side: int, variance: float) -> Uncertainty:
        """Add a variance [m²] to the position of one side, 0 to 5, of six independent ones."""
        position, sizes, sides = self.position**2, self.sizes**2, self.sides**2
        position[side // 2] += variance / 4.0
        sizes[side // 2] += variance
        sides[side] += variance
        return Uncertainty(np.sqrt(position), self.rotation, np.sqrt(sizes), np.sqrt(sides))


class Primitives(NamedTuple):
    """N shapes in the world frame, for the compiled kernels.

    Attributes:
        kinds: Codes (N,).
        R: Axes (N, 3, 3), columns = x, y, z of the object.
        centres: (N, 3) [m].
        half: Half extents (N, 3) [m] along the axes.
    """

    kinds: NDArray[np.int64]
    R: Array
    centres: Array
    half: Array

    @classmethod
    def of(cls, shapes: Sequence[Shape]) -> Primitives:
        """Gather shapes into arrays."""
        T = np.array([s.T_world_object for s in shapes]).reshape(-1, 4, 4)
        return cls(
            np.array([s.code for s in shapes], dtype=np.int64),
            np.ascontiguousarray(T[:, :3, :3]),
            np.ascontiguousarray(T[:, :3, 3]),
            np.array([s.extents for s in shapes]).reshape(-1, 3) / 2.0,
        )

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest corner (N, 3) [m] of the upright box around each shape."""
        along = np.abs(self.R) * self.half[:, None]
        reach = along.sum(axis=2)
        round_, balls = self.kinds == CYLINDER, self.kinds == SPHERE
        reach[round_] = np.hypot(along[round_, :, 0], along[round_, :, 1]) + along[round_, :, 2]
        reach[balls] = self.half[balls]
        return self.centres - reach, self.centres + reach

    def gradient(self, index: int, points_world: Array) -> tuple[Array, Array]:
        """Signed distances (M,) [m] of points (M, 3) to one shape, and their outward directions (M, 3)."""
        points = np.ascontiguousarray(points_world, np.float64)
        distances, outward = distances_and_gradients(*self.row(index), points)
        return distances, outward @ self.R[index].T

    def row(self, index: int) -> tuple[int, Array, Array, Array]:
        """Code, axes (3, 3), centre (3,) [m] and half extents (3,) [m] of one shape."""
        return int(self.kinds[index]), self.R[index], self.centres[index], self.half[index]


def from_size(kind: str, T_world_object: Array, size: Any, source: str) -> Shape:
    """Build a shape from its name and sizes [m] as graph.json writes them.

    Args:
        kind: Name of a kind of shape: `box`, `cylinder`, `sphere`.
        T_world_object: Pose (4, 4) of its centre.
        size: Full extents of a box, radius and height of a cylinder, radius of a sphere.
        source: What to call it in the error.

    Raises:
        InputError: There is no kind of that name, or the sizes do not fit it.
    """
    T = transforms.as_rigid(T_world_object, f"{source}: T_world_object")
    try:
        return KINDS[kind].from_size(T, size)
    except (TypeError, ValueError, KeyError):
        known = ", ".join(f"a {name} {one._size_format()}" for name, one in KINDS.items())
        raise InputError(source, f"no shape '{kind}' with size {size}", f"known sizes: {known}") from None


def fibonacci_sphere(count: int) -> Array:
    """Spread `count` = N unit vectors (N, 3) evenly over the sphere by the golden angle."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=-1)


def _place(shape: Shape) -> str:
    x, y, z = shape.T_world_object[:3, 3]
    return f"({x:.3f}, {y:.3f}, {z:.3f})"


def _circle(centre: Array, axis: Array, radius: float) -> Array:
    u = transforms.perpendicular(axis)
    v = np.cross(axis, u)
    angle = np.linspace(0.0, 2.0 * np.pi, 65)[:, None]
    return centre + radius * (np.cos(angle) * u + np.sin(angle) * v)
