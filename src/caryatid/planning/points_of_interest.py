"""Points of interest from the support graph (Algorithm 1), their saliency (eq. 2) and how it spreads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.sensing.view_sphere import ViewSphere, spread
from caryatid.sensing.voxel_map import VoxelMap


@dataclass(frozen=True, eq=False, slots=True)
class PointOfInterest:
    """A point of interest in the scene.

    Attributes:
        position_world: (3,) [m].
        direction: Its projection on the view sphere (3,), unit, from the sphere's centre.
        saliency: Its value, −1 … 1 [1].
        subject: Ids of the objects it is about.
        why: For a person to read.
    """

    position_world: Array
    direction: Array
    saliency: float
    subject: tuple[str, ...]
    why: str


def points_of_interest(
    graph: SupportGraph, sphere: ViewSphere, visited: Array, config: ActiveVisionConfig
) -> list[PointOfInterest]:
    """Generate the points of interest of a support graph after views (V, 3), #views of eq. 2, by Algorithm 1.

    An object without a supporter gives the point where the line from the middle of the largest arc between
    earlier views to its centre meets its surface. Every support relation gives one point, at the place set
    by `config.edge_point`.
    """
    middle = largest_arc(visited)
    centres = {o.id: o.centre_world for o in graph.objects}
    points = []
    for supported in graph.objects:
        if supported.role == "support_surface":
            continue
        supports = graph.supporters(supported.id)
        if not supports:
            reason = f"the supporter of {supported.id} is unknown"
            points.append(_looked_at(supported, sphere, middle, reason))
        for support in supports:
            position = (centres[support.supporter] + centres[support.supported]) / 2.0
            if config.edge_point == "contact" and support.contact_world is not None:
                position = support.contact_world
            offset = position - sphere.centre_world
            length = math.sqrt(offset @ offset)
            direction = offset / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
            saliency = relation_saliency(support.occurrences, len(visited), config)
            found = f"found in {support.occurrences} of {len(visited)} views"
            why = f"{support.supporter} supports {support.supported}: {found}"
            points.append(PointOfInterest(position, direction, saliency, support.pair, why))
    return points


def points_of_doubt(graph: SupportGraph, sphere: ViewSphere, visited: Array) -> list[PointOfInterest]:
    """A point per implausible shape, to be seen from the largest arc of views (V, 3)."""
    middle = largest_arc(visited)
    return [_looked_at(o, sphere, middle, f"{o.id} {o.doubt}") for o in graph.objects if o.doubt]


def largest_arc(visited: Array) -> float:
    """Azimuth [rad] of the middle of the largest arc between views (V, 3), V ≥ 1, on the horizontal circle.

    With one earlier view it is the opposite side. Among arcs of equal size, the first from −π upwards counts.
    """
    azimuth = np.sort(np.arctan2(visited[:, 1], visited[:, 0]))
    arc = np.diff(np.append(azimuth, azimuth[0] + 2.0 * np.pi))
    first = int(np.argmax(arc > arc.max() - 1e-9))
    middle = azimuth[first] + arc[first] / 2.0
    return float((middle + np.pi) % (2.0 * np.pi) - np.pi)


def relation_saliency(occurrences: int, views: int, config: ActiveVisionConfig) -> float:
    """Saliency of a relation that was found in #occ(e) of #views, eq. 2.

    s = λ_s + (1 − λ_s) · cos(2π · #occ / #views) as printed (`paper`), or with π in place of 2π
    (`decreasing`), which falls from 1 for a relation never seen to 2λ_s − 1 for one always seen.
    """
    period = 2.0 * np.pi if config.saliency == "paper" else np.pi
    share = min(1.0, occurrences / max(1, views))
    return config.saliency_weight + (1.0 - config.saliency_weight) * math.cos(period * share)


def surface_point(shape: Shape, towards_world: Array) -> Array:
    """Point (3,) [m] where the line from a shape's centre to an outer point (3,) [m] leaves the shape."""
    centre = shape.T_world_object[:3, 3]
    inside, outside = 0.0, 1.0
    for _ in range(40):
        t = (inside + outside) / 2.0
        if shape.signed_distance((centre + t * (towards_world - centre))[None])[0] < 0.0:
            inside = t
        else:
            outside = t
    return centre + inside * (towards_world - centre)


def hidden_from(eyes_world: Array, points: Sequence[PointOfInterest], voxels: VoxelMap) -> NDArray[np.bool_]:
    """Which points (K,) something seen occupied hides from eyes (N, 3) [m]: (K, N)."""
    positions = np.array([p.position_world for p in points]).reshape(-1, 3)
    # The line of sight leaves the neighbourhood of its point first: 5 cm, half a common object.
    return voxels.occluders().blocked(positions, eyes_world, 0.05)


def painted(points: Sequence[PointOfInterest], directions: Array, sigma: float) -> Array:
    """Saliency (M, K) points give views in directions (M, 3): their own, falling off with σ [rad]."""
    tops = np.array([p.direction for p in points]).reshape(-1, 3)
    return spread(tops, directions, sigma) * np.array([p.saliency for p in points])


def inhibition_of_return(visited: Array, directions: Array, config: ActiveVisionConfig) -> Array:
    """The negative saliency (M,) of directions (M, 3) around earlier views (V, 3): they repel."""
    bumps = spread(visited, directions, float(np.deg2rad(config.spread)))
    return -config.inhibition * bumps.max(axis=1, initial=0.0)


def _looked_at(subject: SceneObject, sphere: ViewSphere, azimuth: float, reason: str) -> PointOfInterest:
    middle = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    position = surface_point(subject.shape, sphere.centre_world + sphere.radius * middle)
    gap = f"the largest gap between views is at {np.rad2deg(azimuth):.0f}°"
    # Its saliency is the largest eq. 2 can give.
    return PointOfInterest(position, middle, 1.0, (subject.id,), f"{reason}; {gap}")
