"""The view sphere (the paper's Fig. 4): saliency, points of interest with rays, views made and chosen."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ReportConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.viz import colours, svg
from caryatid.viz.wireframes import Projection, draw_shapes

if TYPE_CHECKING:
    from caryatid.exploration import Step
    from caryatid.planning.points_of_interest import PointOfInterest

Place = Callable[[Array], tuple[Array, NDArray[np.bool_]]]
"""Where directions (N, 3) are drawn: pixels (N, 2), and which of them are on the far side."""

SIDE = 400.0
"""Width and height of each of the two pictures [px]."""
RADIUS = 158.0
"""Radius of the drawn sphere [px]."""
ELEVATION = np.deg2rad(32.0)
"""How far above the horizon the sphere is looked at from."""
DENSE = 200
"""More candidates than this are painted as an area, fewer as dots."""
REACH = np.deg2rad(1.6)
"""A point of the sphere counts as reachable within this angle of a candidate [rad]; 1.5 cells of 40,000."""
VISITED_COLOUR, CHOSEN_COLOUR = "#2d3748", "#111111"
"""Plates of the views' numbers."""
WASHED = 0.72
"""Share of grey where no candidate is."""
TEXT = 12.5
"""Height of letters [px]."""
TAG_SIZE = 13.0
"""Height of letters of the views' numbers [px]."""


def draw_sphere(step: Step, config: ReportConfig) -> str:
    """Draw the view sphere twice as SVG: in space with the points of interest' rays, and unrolled from above.

    Full colour where the robot can bring its camera, washed out elsewhere. The picture from above holds the
    whole upper half, zenith in the middle and horizon on the rim.
    """
    chosen = None if step.decision is None else step.sphere.direction_of(step.decision.T_world_camera)
    T_world_eye = _eye(step.sphere, step.visited, chosen)
    left = _in_space(step, chosen, T_world_eye, config)
    right = _from_above(step, chosen, config)
    return svg.picture(
        2.0 * SIDE, SIDE, left, svg.element("g", right, transform=f"translate({SIDE:g} 0)"),
        name="view sphere with its saliency, in space and from above", text_size=TEXT,
    )  # fmt: skip


def _eye(sphere: ViewSphere, visited: Array, chosen: Array | None) -> Array:
    """Look from between the current and the chosen view, so that both are on the near side if they can."""
    current = visited[-1] if len(visited) else np.array([1.0, 0.0, 0.0])
    azimuth = float(np.arctan2(current[1], current[0]))
    if chosen is not None:
        turn = np.arctan2(chosen[1], chosen[0]) - azimuth
        azimuth += float(np.arctan2(np.sin(turn), np.cos(turn))) / 2.0
    towards = np.array(
        [np.cos(azimuth) * np.cos(ELEVATION), np.sin(azimuth) * np.cos(ELEVATION), np.sin(ELEVATION)]
    )
    return transforms.look_at(sphere.centre_world + 10.0 * sphere.radius * towards, sphere.centre_world)


def _in_space(step: Step, chosen: Array | None, T_world_eye: Array, config: ReportConfig) -> str:
    sphere = step.sphere
    scale = RADIUS / sphere.radius
    K = np.array([[scale, 0.0, SIDE / 2.0], [0.0, scale, SIDE / 2.0], [0.0, 0.0, 1.0]])
    projection = Projection(T_world_eye, K, np.zeros((1, 1), dtype=np.float32), parallel=True)
    x, y, inside = _disc(config.sphere_width)
    z = -np.sqrt(np.maximum(0.0, 1.0 - x**2 - y**2))
    directions = np.stack([x, y, z], axis=-1) @ T_world_eye[:3, :3].T
    pixels = _painted(step, directions, inside)
    lower = np.clip(1.0 + directions[..., 2] / 0.35, 0.12, 1.0)
    pixels[..., 3] = np.where(inside, 235.0 * np.where(directions[..., 2] < 0.0, lower, 1.0), 0.0).astype(
        np.uint8
    )

    def place(direction: Array) -> tuple[Array, NDArray[np.bool_]]:
        at, _ = projection.project(sphere.centre_world + sphere.radius * direction)
        return at, direction @ T_world_eye[:3, 2] > 0.0

    box = (SIDE / 2.0 - RADIUS, SIDE / 2.0 - RADIUS, 2.0 * RADIUS, 2.0 * RADIUS)
    parts = [
        svg.raster(pixels, *box),
        svg.element("circle", cx=SIDE / 2.0, cy=SIDE / 2.0, r=RADIUS, class_="rim"),
        _circle_of_latitude(place, 0.0),
        draw_shapes(step.graph.objects, projection, config.hidden),
        _rays(step, projection, place),
        _marks(step, chosen, place),
        svg.text(14, 22, "in space", class_="heading"),
    ]
    return "".join(parts)


def _from_above(step: Step, chosen: Array | None, config: ReportConfig) -> str:
    x, y, inside = _disc(config.sphere_width)
    polar = np.hypot(x, y) * np.pi / 2.0
    azimuth = np.arctan2(-y, x)
    directions = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    pixels = _painted(step, directions, inside)
    middle = SIDE / 2.0

    def place(direction: Array) -> tuple[Array, NDArray[np.bool_]]:
        polar = np.arccos(np.clip(direction[:, 2], -1.0, 1.0)) / (np.pi / 2.0)
        azimuth = np.arctan2(direction[:, 1], direction[:, 0])
        shown = np.minimum(polar, 1.0)[:, None] * np.stack([np.cos(azimuth), -np.sin(azimuth)], axis=-1)
        return middle + RADIUS * shown, polar > 1.02

    rings = [
        svg.element("circle", cx=middle, cy=middle, r=RADIUS * (90.0 - e) / 90.0, class_="graticule")
        for e in (30, 60)
    ]
    degrees = [
        svg.text(middle, middle - RADIUS * (90.0 - e) / 90.0 + 4.0, f"{e}°", class_="small halo")
        for e in (30, 60)
    ]
    axes = [
        svg.text(middle + RADIUS + 14, middle + 4, "x", class_="axis"),
        svg.text(middle, middle - RADIUS - 9, "y", class_="axis"),
    ]
    track, _ = place(step.visited) if len(step.visited) else (np.empty((0, 2)), None)
    parts = [
        svg.raster(pixels, middle - RADIUS, middle - RADIUS, 2.0 * RADIUS, 2.0 * RADIUS),
        svg.element("circle", cx=middle, cy=middle, r=RADIUS, class_="rim"),
        *rings,
        *degrees,
        *axes,
        svg.element("path", d=svg.path(track), class_="track") if len(track) > 1 else "",
        _projected_points(step, place),
        _marks(step, chosen, place),
        svg.text(14, 22, "from above", class_="heading"),
        _scale_bar(),
    ]
    return "".join(parts)


def _disc(width: int) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Centres of pixels (W, W) as x to the right and y down in radii, and which lie in the disc."""
    axis = (np.arange(width) + 0.5) / width * 2.0 - 1.0
    x, y = np.meshgrid(axis, axis)
    return x, y, np.hypot(x, y) <= 1.0


def _painted(step: Step, directions: Array, inside: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Colours (H, W, 4) of directions (H, W, 3): saliency of the nearest point, washed out beyond reach."""
    from scipy.spatial import cKDTree

    queried = directions[inside]
    saliency = None if step.decision is None else step.decision.sphere_saliency
    _, nearest = cKDTree(step.sphere.directions).query(queried)
    values = np.zeros(len(queried)) if saliency is None else saliency[nearest]
    colour = colours.scale(values, colours.SALIENCY_STOPS).astype(np.float64)
    candidates = step.candidates
    if candidates is not None and len(candidates) > DENSE:
        if candidates.indices is not None:
            reachable = np.isin(np.arange(len(step.sphere.directions)), candidates.indices)[nearest]
        else:
            reachable = cKDTree(candidates.directions).query(queried)[0] <= 2.0 * np.sin(REACH / 2.0)
        grey = np.array(colours.rgb(colours.saliency_colour(0.0)), dtype=np.float64)
        colour = np.where(reachable[:, None], colour, WASHED * grey + (1.0 - WASHED) * colour)
    pixels = np.zeros((*inside.shape, 4), dtype=np.uint8)
    pixels[inside, :3] = colour.round()
    pixels[inside, 3] = 255
    return pixels


def _points(step: Step) -> list[PointOfInterest]:
    """Points of interest, the most salient last, so that they lie on top."""
    return [] if step.decision is None else sorted(step.decision.points_of_interest, key=lambda p: p.saliency)


def _rays(step: Step, projection: Projection, place: Place) -> str:
    drawn = []
    for point in _points(step):
        start, _ = projection.project(point.position_world[None, :])
        end, behind = place(point.direction[None, :])
        kind = "ray behind" if behind[0] else "ray"
        line = svg.element("path", d=svg.path(np.concatenate([start, end])))
        drawn.append(svg.element("g", svg.tooltip(_said(point)), line, _dot(end[0], point), class_=kind))
    return "".join(drawn)


def _projected_points(step: Step, place: Place) -> str:
    drawn = []
    for point in _points(step):
        at, behind = place(point.direction[None, :])
        kind = "ray behind" if behind[0] else "ray"
        drawn.append(svg.element("g", svg.tooltip(_said(point)), _dot(at[0], point), class_=kind))
    return "".join(drawn)


def _dot(at: Array, point: PointOfInterest) -> str:
    return svg.element("circle", cx=at[0], cy=at[1], r=4.0, fill=colours.saliency_colour(point.saliency))


def _said(point: PointOfInterest) -> str:
    return f"{' – '.join(point.subject)}: saliency {point.saliency:.2f}; {point.why}"


def _marks(step: Step, chosen: Array | None, place: Place) -> str:
    """Mark single candidates, the numbered views made so far and the chosen next view."""
    drawn = []
    if step.candidates is not None and len(step.candidates) <= DENSE:
        spots, behind = place(step.candidates.directions)
        for (x, y), far in zip(spots, behind, strict=True):
            drawn.append(
                svg.element("circle", cx=x, cy=y, r=3.2, class_="candidate behind" if far else "candidate")
            )
    names = []
    spots, behind = place(step.visited)
    for number, ((x, y), far) in enumerate(zip(spots, behind, strict=True)):
        kind = "visited behind" if far else "visited"
        drawn.append(svg.element("circle", cx=x, cy=y, r=3.5, class_=kind))
        names.append(svg.Tag(float(x), float(y) - 15.0, str(number), VISITED_COLOUR, faint=bool(far)))
    if chosen is not None:
        (spot,), (far,) = place(chosen[None, :])
        drawn.append(
            svg.element(
                "g",
                svg.tooltip("the next view"),
                svg.element("circle", cx=spot[0], cy=spot[1], r=8.5, class_="plate"),
                svg.element("circle", cx=spot[0], cy=spot[1], r=3.0, class_="core"),
                class_="chosen behind" if far else "chosen",
            )
        )
        names.append(svg.Tag(float(spot[0]), float(spot[1]) - 20.0, "next", CHOSEN_COLOUR, faint=bool(far)))
    return "".join(drawn) + svg.tags(names, (0.0, 0.0, SIDE, SIDE), TAG_SIZE)


def _circle_of_latitude(place: Place, elevation: float) -> str:
    """Draw the near half of a circle of equal elevation [rad]."""
    azimuth = np.linspace(-np.pi, np.pi, 181)
    ring = np.stack(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.full(181, np.sin(elevation)),
        ],
        axis=-1,
    )
    at, behind = place(ring)
    start = int(np.argmax(behind))
    near = np.roll(at, -start, axis=0)[~np.roll(behind, -start)]
    return svg.element("path", d=svg.path(near), class_="graticule") if len(near) > 1 else ""


def _scale_bar() -> str:
    width, height = 150, 9
    left, top = SIDE - width - 16.0, SIDE - 20.0
    values = np.tile(np.linspace(-1.0, 1.0, width), (2, 1))
    ticks = [
        svg.text(left + width * (v + 1.0) / 2.0, top - 5.0, name, class_="small middle")
        for v, name in ((-1.0, "−1"), (0.0, "0"), (1.0, "+1"))
    ]
    bar = svg.raster(colours.scale(values, colours.SALIENCY_STOPS), left, top, width, height)
    return bar + "".join(ticks) + svg.text(left - 8.0, top + 8.0, "saliency", class_="small end")
