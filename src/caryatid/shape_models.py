"""How RANSAC makes hypotheses of the three shapes from two oriented points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from caryatid import frames
from caryatid.frames import Array
from caryatid.kernels.fitting import BOX, CYLINDER, SPHERE
from caryatid.kernels.hypotheses import hypothesis_distances, trimmed_ranges
from caryatid.shapes import Box, Cylinder, Sphere


@dataclass(frozen=True, eq=False, slots=True)
class Hypotheses:
    """Many shapes of one kind.

    Attributes:
        R: Axes (B, 3, 3), columns = the object's x, y, z in the cloud's frame.
        centre: (B, 3) [m].
        extents: Full extents (B, 3) [m] along the axes.
        valid: (B,) within the limits.
    """

    R: Array
    centre: Array
    extents: Array
    valid: NDArray[np.bool_]


class ShapeModel(Protocol):
    """A RANSAC model whose hypotheses become shapes."""

    @property
    def sample_size(self) -> int:
        """Oriented points that determine a hypothesis."""
        ...

    def estimate(self, samples: NDArray[np.intp], points: Array, normals: Array) -> Hypotheses:
        """Make hypotheses from samples (B, sample_size) of indices into points (N, 3), normals (N, 3)."""
        ...

    def distances(self, hypotheses: Hypotheses, points: Array) -> Array:
        """Unsigned distance (B, N) [m] of points (N, 3) to each hypothesis; infinite for an invalid one."""
        ...

    def shape(self, hypotheses: Hypotheses, index: int) -> Box | Cylinder | Sphere:
        """One hypothesis as a shape."""
        ...


@dataclass(frozen=True, slots=True)
class BoxModel:
    """A box from two oriented points of adjacent faces; its extents from all the points.

    Attributes:
        max_extent: Longest edge [m].
        trim: Share of the points beyond each end of an extent that count as noise.
    """

    max_extent: float
    trim: float
    sample_size: int = 2

    def estimate(self, samples: NDArray[np.intp], points: Array, normals: Array) -> Hypotheses:
        """Axes from the two normals, made orthogonal; extents from the trimmed spread of all points."""
        first, second = normals[samples[:, 0]], normals[samples[:, 1]]
        ortho = second - np.sum(first * second, axis=1, keepdims=True) * first
        valid = np.linalg.norm(ortho, axis=1) > 0.5
        ortho = np.where(valid[:, None], ortho, frames.perpendicular(first))
        y = frames.unit(ortho)
        R = np.stack([np.cross(y, first), y, first], axis=-1)
        low, high = (
            end.reshape(-1, 3)
            for end in _trimmed_range(points, np.swapaxes(R, 1, 2).reshape(-1, 3), self.trim)
        )
        extents = np.maximum(high - low, 1e-4)
        centre = np.einsum("bij,bj->bi", R, (low + high) / 2.0)
        return Hypotheses(R, centre, extents, valid & (extents.max(axis=1) <= self.max_extent))

    def distances(self, hypotheses: Hypotheses, points: Array) -> Array:
        """Unsigned distance (B, N) [m] to the boxes' surfaces."""
        return _distances(BOX, hypotheses, points)

    def shape(self, hypotheses: Hypotheses, index: int) -> Box:
        """One hypothesis as a shape."""
        T = frames.rigid(hypotheses.R[index], hypotheses.centre[index])
        return Box(T, hypotheses.extents[index].copy())


@dataclass(frozen=True, slots=True)
class CylinderModel:
    """A cylinder from two oriented points of its mantle; its height from all the points.

    Attributes:
        max_radius: [m].
        max_extent: Greatest height [m].
        trim: Share of the points beyond each end that count as noise.
    """

    max_radius: float
    max_extent: float
    trim: float
    sample_size: int = 2

    def estimate(self, samples: NDArray[np.intp], points: Array, normals: Array) -> Hypotheses:
        """Axis along the cross product of the normals, through where the normal lines come closest."""
        n1, n2 = normals[samples[:, 0]], normals[samples[:, 1]]
        p1, p2 = points[samples[:, 0]], points[samples[:, 1]]
        cross = np.cross(n1, n2)
        valid = np.linalg.norm(cross, axis=1) > 0.3
        axis = frames.unit(np.where(valid[:, None], cross, frames.perpendicular(n1)))
        radius, on_axis = _meeting_of_normals(p1, n1, p2, n2, axis)
        R = _axes(axis, n1)
        low, high = _trimmed_range(points, axis, self.trim)
        height = np.maximum(high - low, 1e-4)
        along = (low + high) / 2.0 - np.sum(on_axis * axis, axis=1)
        valid &= (radius > 1e-3) & (radius <= self.max_radius) & (height <= self.max_extent)
        return Hypotheses(
            R, on_axis + along[:, None] * axis, np.stack([2 * radius, 2 * radius, height], axis=-1), valid
        )

    def distances(self, hypotheses: Hypotheses, points: Array) -> Array:
        """Unsigned distance (B, N) [m] to the capped cylinders' surfaces."""
        return _distances(CYLINDER, hypotheses, points)

    def shape(self, hypotheses: Hypotheses, index: int) -> Cylinder:
        """One hypothesis as a shape."""
        T = frames.rigid(hypotheses.R[index], hypotheses.centre[index])
        return Cylinder(T, float(hypotheses.extents[index, 0] / 2.0), float(hypotheses.extents[index, 2]))


@dataclass(frozen=True, slots=True)
class SphereModel:
    """A sphere from two oriented points.

    Attributes:
        max_radius: [m].
    """

    max_radius: float
    sample_size: int = 2

    def estimate(self, samples: NDArray[np.intp], points: Array, normals: Array) -> Hypotheses:
        """Centre where the lines along the two normals come closest."""
        n1, n2 = normals[samples[:, 0]], normals[samples[:, 1]]
        p1, p2 = points[samples[:, 0]], points[samples[:, 1]]
        axis = np.cross(n1, n2)
        valid = np.linalg.norm(axis, axis=1) > 0.1
        axis = frames.unit(np.where(valid[:, None], axis, frames.perpendicular(n1)))
        radius, centre = _meeting_of_normals(p1, n1, p2, n2, axis)
        centre = centre + 0.5 * np.sum((p1 + p2 - 2.0 * centre) * axis, axis=1, keepdims=True) * axis
        valid &= (radius > 1e-3) & (radius <= self.max_radius)
        return Hypotheses(_axes(axis, n1), centre, np.repeat(2.0 * radius[:, None], 3, axis=1), valid)

    def distances(self, hypotheses: Hypotheses, points: Array) -> Array:
        """Unsigned distance (B, N) [m] to the spheres."""
        return _distances(SPHERE, hypotheses, points)

    def shape(self, hypotheses: Hypotheses, index: int) -> Sphere:
        """One hypothesis as a shape."""
        T = frames.rigid(hypotheses.R[index], hypotheses.centre[index])
        return Sphere(T, float(hypotheses.extents[index, 0] / 2.0))


def _meeting_of_normals(p1: Array, n1: Array, p2: Array, n2: Array, axis: Array) -> tuple[Array, Array]:
    """Radius (B,) and point (B, 3) where the inward normals meet, seen along the axis (least squares)."""
    gap = p2 - p1
    gap = gap - np.sum(gap * axis, axis=1, keepdims=True) * axis
    turn = n1 - n2
    radius = np.sum(gap * -turn, axis=1) / np.maximum(np.sum(turn * turn, axis=1), 1e-12)
    meeting = (p1 - radius[:, None] * n1 + p2 - radius[:, None] * n2) / 2.0
    return radius, meeting


def _axes(z: Array, towards: Array) -> Array:
    """Axes (B, 3, 3) with this z (B, 3) and x on the side of `towards`, so that they turn with the points."""
    across = towards - np.sum(towards * z, axis=1, keepdims=True) * z
    short = np.linalg.norm(across, axis=1, keepdims=True) < 1e-6
    x = frames.unit(np.where(short, frames.perpendicular(z), across))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _distances(kind: int, hypotheses: Hypotheses, points: Array) -> Array:
    return hypothesis_distances(
        kind, hypotheses.R, hypotheses.centre, hypotheses.extents / 2.0, hypotheses.valid, points
    )


def _trimmed_range(points: Array, directions: Array, trim: float) -> tuple[Array, Array]:
    """Trimmed least and greatest coordinate (B,) [m] of points (N, 3) along each direction (B, 3)."""
    return trimmed_ranges(
        points, np.ascontiguousarray(directions), min(int(trim * len(points)), (len(points) - 1) // 2)
    )
