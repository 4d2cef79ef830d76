"""What is drawn of a step: the camera's image, the fused cloud, single shapes, the view sphere, and charts.

Every function returns a `Picture`, which keeps none of the images and clouds it was drawn from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.sensing.view_sphere import direction
from caryatid.sensing.views import MAX_LABEL, Cloud, View
from caryatid.viz import colours
from caryatid.viz.colours import object_colour
from caryatid.viz.pictures import (
    DOUBT,
    INK,
    LINE,
    SOFT,
    THEME,
    Picture,
    Tag,
    area,
    dot,
    draw_tags,
    group,
    line,
    raster,
    text,
)

if TYPE_CHECKING:
    from caryatid.exploration import Step

DARK, VISITED = "#111111", "#2d3748"
"""Rims and rays; views so far."""


@dataclass(frozen=True, eq=False, slots=True)
class Projection:
    """How a picture sees the world.

    Attributes:
        T_world_camera: Pose (4, 4) of the eye, OpenCV camera frame.
        K: (3, 3) [px]; for a parallel projection the focal lengths are the scale [px/m].
        depth: Distance (H, W) [m] along the eye's z of what the picture shows, 0 = nothing there.
        parallel: Parallel instead of central projection.
    """

    T_world_camera: Array
    K: Array
    depth: NDArray[np.float32]
    parallel: bool = False

    def project(self, points_world: Array) -> tuple[Array, Array]:
        """Return pixels (N, 2), NaN behind the eye, and distances (N,) [m] of points (N, 3)."""
        points_camera = transforms.transform(transforms.invert(self.T_world_camera), points_world)
        z = points_camera[:, 2]
        divisor = 1.0 if self.parallel else np.where(z > 0.0, z, np.nan)[:, None]
        return points_camera[:, :2] / divisor @ self.K[:2, :2].T + self.K[:2, 2], z

    def hidden(self, pixels: Array, z: Array) -> NDArray[np.bool_]:
        """Which pixels (N, 2) at distances z (N,) [m] are hidden: the picture shows something nearer by 2 cm.

        Less may be due to noise and registration.
        """
        height, width = self.depth.shape
        u, v = np.rint(np.nan_to_num(np.clip(pixels, -1.0, (width, height)), nan=-1.0)).astype(int).T
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        shown = np.where(inside, self.depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], 0.0)
        return (shown > 0.0) & (z > shown + 0.02)

    def tag(self, item: SceneObject) -> Tag:
        """The name of an object at its centre."""
        ((x, y),), _ = self.project(item.centre_world[None])
        return Tag(float(x), float(y), item.id, object_colour(item.label))


def named_objects(graph: SupportGraph) -> list[SceneObject]:
    """Find what pictures name: the objects, and the support surfaces if there are several."""
    several = len(graph.support_surfaces) > 1
    return [o for o in graph.objects if several or o.role == "object"]


def draw_shapes(objects: Sequence[SceneObject], projection: Projection) -> Element:
    """Draw the lines of shapes, support surfaces first: strong on a dark rim, thin and faint where hidden."""
    from scipy.ndimage import median_filter

    faint, rims, strong = [], [], []
    for item in sorted(objects, key=lambda o: o.role != "support_surface"):
        lines = item.shape.lines(projection.T_world_camera[:3, 3])
        pixels, z = projection.project(np.concatenate(lines))
        hidden = median_filter(projection.hidden(pixels, z), size=5, mode="nearest")
        ends = np.cumsum([*map(len, lines)])[:-1]
        seen = np.insert(np.where(hidden[:, None], np.nan, pixels), ends, np.nan, axis=0)
        colour, width = object_colour(item.label), 1.2 if item.role == "support_surface" else 2.2
        faint.append(line(np.insert(pixels, ends, np.nan, axis=0), colour, 1.0, opacity=0.6))
        rims.append(line(seen, DARK, width + 1.4, opacity=0.5))
        strong.append(line(seen, colour, width))
    return group([*faint, *rims, *strong], "shapes")


# The camera's image


def draw_image(
    view: View, labels: NDArray[np.int32], graph: SupportGraph, width: int, *, shapes: bool = True
) -> Picture:
    """Draw one view: its image (depth where it has no colour), its segments, and the shapes over it.

    Args:
        view: The view; without a pose the shapes are left out.
        labels: Object number of each pixel (H, W), 0 = nothing.
        graph: The shapes, in the world frame.
        width: Of the picture [px].
        shapes: Draw the shapes, and the names also of objects without a pixel.
    """
    found = named_objects(graph)
    step = max(1, view.depth.shape[1] // (4 * width))  # of what is shown, two pixels for each drawn
    if step > 1:
        view, labels = view.every(step), labels[::step, ::step]
    shown = left, top, right, bottom = window(labels)
    scale = width / (right - left)
    size = width, round((bottom - top) * scale)

    def resized(image: NDArray[Any], method: Image.Resampling = Image.Resampling.NEAREST) -> NDArray[Any]:
        return np.asarray(Image.fromarray(image).resize(size, method, shown))

    image, labels = resized(image_of(view), Image.Resampling.BOX), resized(labels)
    tags = []
    for item in found:
        v, u = np.nonzero(labels == item.label)
        if len(u):
            tags.append(Tag(float(np.median(u)), float(np.median(v)), item.id, object_colour(item.label)))
    parts = [raster(image, 0.0, 0.0, *size), raster(tint(image, labels), 0.0, 0.0, *size, "segments")]
    if shapes and view.T_world_camera is not None:
        K = np.array([[scale, 0.0, -scale * left], [0.0, scale, -scale * top], [0.0, 0.0, 1.0]]) @ view.K
        projection = Projection(view.T_world_camera, K, resized(view.depth))
        parts.append(draw_shapes(graph.objects, projection))
        unseen = [projection.tag(o)._replace(faint=True) for o in found if o.label not in labels]
        tags += [tag for tag in unseen if np.isfinite(tag.x)]
    what = "segments and fitted shapes" if shapes else "segments"
    parts += draw_tags(tags, *size, 15.0)
    return Picture(f"{view.name} with its {what}", *size, parts)


def image_of(view: View) -> NDArray[np.uint8]:
    """A view's image (H, W, 3): its colours, or its depth, near bright, black where there is no reading."""
    if view.rgb is not None or not view.valid.any():
        return np.zeros((*view.depth.shape, 3), dtype=np.uint8) if view.rgb is None else view.rgb
    near, far = np.percentile(view.depth[view.valid], (2.0, 98.0))
    share = (view.depth.astype(np.float64) - near) / max(far - near, 1e-6)
    return np.where(view.valid[..., None], colours.scale(share, colours.DEPTH_STOPS), np.uint8(0))


def tint(image: NDArray[np.uint8], labels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Segments of an image (H, W, 3) in their objects' colours, lit as in the image; else clear (H, W, 4)."""
    v, u = np.mgrid[: labels.shape[0], : labels.shape[1]]
    lit = (image @ np.array([0.299, 0.587, 0.114]))[..., None]
    colour = 0.62 * colours.striped_colours(labels, u, v, 18.0) + 0.38 * lit
    segment = ((labels != 0) & (labels <= MAX_LABEL))[..., None]
    return np.where(segment, np.dstack([colour, np.full(labels.shape, 255.0)]), 0.0).astype(np.uint8)


def window(labels: NDArray[np.int32]) -> tuple[int, int, int, int]:
    """Part of an image (H, W) that is shown (left, top, right, bottom) [px]: its segments and a third around.

    It has the image's proportions and is half as wide at least.
    """
    size = np.array(labels.shape[::-1])
    found = np.argwhere((labels != 0) & (labels <= MAX_LABEL))[:, ::-1]
    low, high = (found.min(axis=0), found.max(axis=0)) if len(found) else (np.zeros(2), size)
    share = float(np.clip(1.35 * ((high - low) / size).max(), 0.5, 1.0))
    left, top = np.clip((low + high - share * size) / 2.0, 0.0, (1.0 - share) * size).astype(int)
    width, height = np.ceil(share * size).astype(int)
    return int(left), int(top), int(left + width), int(top + height)


# The fused cloud and single shapes


def draw_cloud(
    cloud: Cloud, graph: SupportGraph, azimuth: float, *, width: int = 720, point_size: float = 0.0075
) -> Picture:
    """Draw the labelled cloud and the shapes fitted to it, by parallel projection.

    Points are little squares lit from above the eye, pale where one sees a surface from behind.

    Args:
        cloud: The fused points, labelled.
        graph: The shapes.
        azimuth: Direction about the vertical the eye looks from [rad].
        width: Of the picture [px].
        point_size: Side of a point as drawn [m], the surface's twice that; half more than their spacing.
    """
    towards_eye = direction(azimuth, np.deg2rad(28.0))
    frame = _framed(cloud, graph, towards_eye, width)
    at, z = frame.project(cloud.points_world)
    pixels, projection = _splat(cloud, at, z, towards_eye, frame, max(1, round(point_size * frame.K[0, 0])))
    tags = [projection.tag(o) for o in named_objects(graph) if o.id]
    size = width, pixels.shape[0]
    parts = [raster(pixels, 0.0, 0.0, *size), draw_shapes(graph.objects, projection)]
    parts += draw_tags(tags, *size, 15.0)
    side = round(float(np.rad2deg(azimuth))) % 360
    return Picture(f"the fused cloud with the fitted shapes, from {side}°", *size, parts)


def draw_solid(shape: Shape, label: int = 1) -> Picture:
    """Draw one shape as it stands in the world, filling the picture, in the colour of an object's label."""
    spacing = max(float(shape.extents.max()), 1e-6) / 60.0
    points_world, normals_world = shape.surface(spacing)
    cloud = Cloud(points_world, normals_world, np.full(len(points_world), label, dtype=np.int32))
    graph = SupportGraph((SceneObject("", label, shape),))
    picture = draw_cloud(cloud, graph, np.pi + 0.54, width=200, point_size=2.0 * spacing)
    return replace(picture, name=f"a {shape.kind}")


def _framed(cloud: Cloud, graph: SupportGraph, towards_eye: Array, width: int) -> Projection:
    """Place the eye so that all shapes (without any: the middle 96 % of the points) fill the picture."""
    outlines = [o.shape.outline() for o in graph.objects]
    subject = np.concatenate(outlines or [cloud.points_world if len(cloud) else np.zeros((1, 3))])
    centre = subject.mean(axis=0)
    T_world_eye = transforms.look_at(centre + 10.0 * towards_eye, centre)
    seen = transforms.transform(transforms.invert(T_world_eye), subject)[:, :2]
    low, high = np.percentile(seen, (0.0, 100.0) if outlines else (2.0, 98.0), axis=0)
    extent = np.maximum(high - low, 1e-3) * 1.08
    size = np.array([width, round(width * float(np.clip(extent[1] / extent[0], 0.5, 0.8)))])
    scale = float((size / extent).min())
    x, y = (size - scale * (low + high)) / 2.0
    K = np.array([[scale, 0.0, x], [0.0, scale, y], [0.0, 0.0, 1.0]])
    return Projection(T_world_eye, K, np.zeros(size[::-1], dtype=np.float32), parallel=True)


def _splat(
    cloud: Cloud, at: Array, z: Array, towards_eye: Array, frame: Projection, side: int
) -> tuple[NDArray[np.uint8], Projection]:
    """Paint points as squares, `side` [px] wide; return pixels (H, W, 4), and the frame with their depth."""
    from scipy.ndimage import minimum_filter

    labels = np.zeros(len(cloud), dtype=np.int32) if cloud.labels is None else cloud.labels
    normals_world = np.nan_to_num(cloud.normals_world)
    light = np.abs(normals_world @ transforms.unit(towards_eye + (0.0, 0.0, 0.8)))
    colour = colours.striped_colours(labels, at[:, 0], at[:, 1], 15.0) * (0.5 + 0.5 * light)[:, None]
    colour = np.where(normals_world @ towards_eye[:, None] < 0.0, 0.7 * 255.0 + 0.3 * colour, colour)
    height, width = frame.depth.shape
    u, v = np.rint(at).astype(int).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    far_to_near = np.argsort(-z)
    rank = np.zeros((height, width), dtype=np.int64)  # The higher the nearer, 0 = nothing.
    for surface, wide in ((False, side), (True, 2 * side)):
        own = inside[far_to_near] & ((labels[far_to_near] > MAX_LABEL) == surface)
        ranked = np.zeros((height, width), dtype=np.int64)
        ranked[v[far_to_near[own]], u[far_to_near[own]]] = np.flatnonzero(own) + 1
        rank = np.maximum(rank, -minimum_filter(-ranked, size=wide, mode="constant"))
    painted = np.zeros((len(cloud) + 1, 4))
    painted[1:] = np.column_stack([colour, np.full(len(cloud), 255.0)])[far_to_near]
    depth = np.append(0.0, z[far_to_near])[rank].astype(np.float32)
    return painted.round().astype(np.uint8)[rank], replace(frame, depth=depth)


# From above: the view sphere, and where the robot stood


def _from_above(centre_world: Array, scale: float, width: float, height: float) -> Projection:
    """See the world from above by a scale [px/m], a centre (3,) in the middle, x to the right and y up."""
    T_world_eye = transforms.rigid(np.diag([1.0, -1.0, -1.0]), centre_world + (0.0, 0.0, 10.0))
    K = np.array([[scale, 0.0, width / 2.0], [0.0, scale, height / 2.0], [0.0, 0.0, 1.0]])
    return Projection(T_world_eye, K, np.zeros((1, 1), dtype=np.float32), parallel=True)


def draw_stands(steps: Sequence[Step], sides: Sequence[tuple[SceneObject, int]] = ()) -> Picture:
    """Draw from above where the robot stood for each view, where it looked, and the way it took.

    Args:
        steps: Steps, the last with objects; robots are drawn where they are known.
        sides: Objects, each with an azimuth [°] from where it should be looked at; shown by arrows.
    """
    held = [(step.index, step.robot) for step in steps if step.robot is not None]
    ways = [np.array([p.platform_world for p in s.decision.waypoints]) for s in steps[:-1] if s.decision]
    objects, reach = steps[-1].graph.objects, 0.2 + (held[0][1].footprint if held else 0.0)
    places = [np.stack([r.posture.platform_world, r.T_world_camera[:3, 3]])[:, :2] for _, r in held]
    ground = [item.shape.outline()[:, :2] for item in objects]
    aims = [item.centre_world + direction(np.deg2rad(side), 0.0) * [[0.6], [0.1]] for item, side in sides]
    there = np.concatenate([*(way[:, :2] for way in ways if len(way)), *places, *(a[:, :2] for a in aims)])
    extent = np.concatenate([there - reach, there + reach, *ground])
    low, high = extent.min(axis=0) - (0.0, 0.3), extent.max(axis=0)  # Below are the scale and the axes.
    width, height = 480.0, 480.0 * float(np.clip((high - low)[1] / (high - low)[0], 0.6, 1.2))
    scale = float(((width, height) / (high - low)).min())
    above = _from_above(np.append((low + high) / 2.0, 0.0), scale, width, height)

    def pixels(points: Array) -> Array:
        return above.project(np.column_stack([points[:, :2], np.zeros(len(points))]))[0]

    parts = [draw_shapes(objects, above)]
    parts += [line(pixels(way), VISITED, 1.6) for way in ways if len(way) > 1]
    tags = []
    for (number, robot), place in zip(held, places, strict=True):
        platform, eye = pixels(place)
        radius = scale * (0.08 if robot.arm else robot.footprint)
        parts.append(dot(platform, radius, VISITED, fill_opacity=0.1, stroke=VISITED))
        ahead = transforms.unit(robot.T_world_camera[:2, 2]) * (1.0, -1.0)
        aside = 0.58 * ahead[::-1] * (-1.0, 1.0)  # 30° to each side
        cone = eye + 0.27 * scale * np.array([(0.0, 0.0), ahead + aside, ahead - aside])
        parts += [area(cone, VISITED, opacity=0.35), dot(platform, 3.0, VISITED)]
        x, y = (eye if robot.arm else platform).tolist()
        tags.append(Tag(x, y - 15.0, str(number + 1), VISITED))
    alike: dict[int, list[tuple[str, int, Array]]] = {}
    for (item, side), aim in zip(sides, aims, strict=True):
        tail, tip = pixels(aim)
        aside = 5.0 * transforms.unit(tail - tip)[::-1] * (1.0, -1.0)
        parts.append(area(np.array([tip, tail + aside, tail - aside]), DOUBT, opacity=0.8))
        alike.setdefault(round(side / 20.0) % 18, []).append((item.id, side, tail))  # One label within 20°.
    for names, azimuths, tails in (zip(*arrows, strict=True) for arrows in alike.values()):
        x, y = np.mean(tails, axis=0).tolist()
        tags.append(Tag(x, y, f"{', '.join(names)} {azimuths[0]}°", THEME["doubt"]))
    parts += draw_tags(tags, width, height, 13.0)
    parts.append(text(width - 12.0, height - 14.0, "azimuth: x → 0°, y ↑ 90°", 11.0, SOFT, text_anchor="end"))
    parts.append(line(np.array([(12.0, height - 12.0), (12.0 + 0.5 * scale, height - 12.0)]), SOFT, 2.0))
    parts.append(text(12.0, height - 22.0, "0.5 m", 11.0, SOFT, text_anchor="start"))
    return Picture("the scene from above", width, height, parts)


def draw_sphere(step: Step) -> Picture:
    """Draw the view sphere (the paper's Fig. 4) from above: its saliency, the points of interest, the views.

    Full colour where the robot can bring its camera, washed out elsewhere. The scene is in the middle, north
    is the world's y, and the rim is the horizon.
    """
    sphere, decision, centre = step.sphere, step.decision, step.sphere.centre_world
    side, radius = 400.0, 165.0
    above = _from_above(centre, radius / sphere.radius, side, side)

    def places(directions: Array) -> Array:
        return above.project(centre + sphere.radius * np.reshape(directions, (-1, 3)))[0]

    saliency, dots = _painted(step)
    points = () if decision is None else sorted(decision.points_of_interest, key=lambda p: p.saliency)
    feet = above.project(np.reshape([p.position_world for p in points], (-1, 3)))[0]
    heads = places(np.array([p.direction for p in points]))
    rim = {"stroke": DARK}
    edge = side / 2.0 - radius
    parts = [raster(saliency, edge, edge, 2.0 * radius, 2.0 * radius)]
    parts.append(draw_shapes(step.graph.objects, above))
    for name, elevation in (("y", 0.0), ("30°", 30.0), ("60°", 60.0)):
        wide = radius * float(np.cos(np.deg2rad(elevation)))
        parts.append(dot(np.full(2, side / 2.0), wide, "none", stroke=SOFT, stroke_dasharray="1 2"))
        parts.append(text(side / 2.0, side / 2.0 - wide - 9.0, name, 11.0, SOFT))
    parts.append(text(side - edge + 10.0, side / 2.0, "x", 11.0, SOFT))
    parts += [line(np.stack(ends), DARK, 1.0, opacity=0.4) for ends in zip(feet, heads, strict=True)]
    for point, head in zip(points, heads, strict=True):
        title = f"{' – '.join(point.subject)}: saliency {point.saliency:.2f}; {point.why}"
        parts.append(group([dot(head, 4.0, colours.saliency_colour(point.saliency), **rim)], "point", title))
    parts += [dot(at, 3.2, "white", **rim) for at in places(dots)]
    visited = places(step.visited)
    parts += [line(visited, VISITED, 1.4), *(dot(at, 3.5, VISITED) for at in visited)]
    tags = [Tag(x, y - 15.0, str(k), VISITED) for k, (x, y) in enumerate(visited.tolist(), 1)]
    if decision is not None:
        (at,) = places(sphere.direction_of(decision.T_world_camera))
        parts.append(group([dot(at, 7.0, "white", **rim), dot(at, 3.5, DARK)], "chosen", "the next view"))
        tags.append(Tag(at[0], at[1] - 20.0, "next", DARK))
    parts += draw_tags(tags, side, side, 13.0)
    bar = colours.scale(np.tile(np.linspace(-1.0, 1.0, 150), (2, 1)), colours.SALIENCY_STOPS)
    parts.append(raster(bar, side - 115.0, side - 15.0, 84.0, 8.0))
    for left, name in ((-165.0, "saliency"), (-128.0, "−1"), (-18.0, "+1")):
        parts.append(text(side + left, side - 11.0, name, 11.0, SOFT))
    return Picture(f"view sphere with its saliency after view {step.index + 1}", side, side, parts)


def _painted(step: Step) -> tuple[NDArray[np.uint8], Array]:
    """The sphere's upper half from above in the colours of its saliency (H, W, 4), washed out beyond reach.

    Where few views can be reached, all is in full colour, and their directions (N, 3) are returned as well.
    """
    from scipy.spatial import KDTree

    sphere, decision, candidates = step.sphere, step.decision, step.candidates
    values, dots = np.zeros(len(sphere.directions)), np.zeros((0, 3))
    if decision is not None and decision.sphere_saliency is not None:
        values = decision.sphere_saliency
    colour = colours.scale(values, colours.SALIENCY_STOPS)
    if candidates is not None and (candidates.indices is None or len(candidates) < 200):
        dots = candidates.directions
    elif candidates is not None:
        beyond = np.ones(len(colour), dtype=np.bool_)
        beyond[candidates.indices] = False
        colour[beyond] = 0.72 * colours.scale(np.zeros(1), colours.SALIENCY_STOPS) + 0.28 * colour[beyond]
    y, x = np.mgrid[1.0:-1.0:260j, -1.0:1.0:260j]
    inside = np.hypot(x, y) < 1.0
    x, y = x[inside], y[inside]
    nearest = KDTree(sphere.directions).query(np.column_stack([x, y, np.sqrt(1.0 - x**2 - y**2)]))[1]
    pixels = np.zeros((*inside.shape, 4), dtype=np.uint8)
    pixels[inside] = np.append(colour[nearest], np.full((len(x), 1), 255, dtype=np.uint8), axis=1)
    return pixels, dots


def draw_chart(
    title: str, y_name: str, lines: Mapping[str, Sequence[float]], top: float | None = None
) -> Picture:
    """Draw lines over the numbers of views, the first on top and the others wider, so that all are visible.

    Args:
        title: What the chart shows.
        y_name: Name of the y axis.
        lines: Value after each view, 0 or more, by the name of each line.
        top: Upper end of the y axis; None = as high as the values.
    """
    width, height = 480.0, 240.0
    low, high = np.array([58.0, 168.0]), np.array([461.0, 34.0])  # corners of the axes
    count = max(map(len, lines.values()))
    most = top or max((float(v) for values in lines.values() for v in values if v > 0.0), default=1.0)
    steps = 10.0 ** np.floor(np.log10(most)) * np.array([0.1, 0.2, 0.5, 1.0, 2.0])
    step = steps[np.argmax(most / steps <= 5.0)]

    def places(x: Any, y: Any) -> Array:
        share = np.stack(np.broadcast_arrays((np.asarray(x) - 1.0) / max(count - 1, 1), np.divide(y, most)))
        return (low[:, None] + (high - low)[:, None] * share).T

    parts = [text(8.0, 16.0, title, 12.0, INK, text_anchor="start", font_weight="bold")]
    parts.append(text(260.0, 202.0, "view", 11.0, SOFT))
    parts.append(text(12.0, 101.0, y_name, 11.0, SOFT, transform="rotate(-90 12 101)"))
    for value in np.arange(0.0, most + 1e-6 * step, step):
        ends = places([1.0, max(count, 2)], value)
        parts += [line(ends, LINE, 1.0), text(50.0, ends[0, 1], f"{value:g}", 11.0, SOFT, text_anchor="end")]
    for number in range(1, count + 1, -(-count // 10)):
        parts.append(text(places(number, 0.0)[0, 0], 184.0, str(number), 11.0, SOFT))
    for k, (name, values) in reversed([*enumerate(lines.items())]):
        at, sample = places(np.arange(1, len(values) + 1), values), np.array([20.0 + 116.0 * k, 226.0])
        for course, marked in ((at, at), (sample + [(-14.0, 0.0), (14.0, 0.0)], [sample])):
            parts.append(line(course, colours.PALETTE[k], 2.0 + 3.5 * k))
            parts += [dot(p, 3.0 + 2.0 * k, colours.PALETTE[k]) for p in marked if np.isfinite(p).all()]
        parts.append(text(sample[0] + 20.0, sample[1], name, 11.0, SOFT, text_anchor="start"))
    return Picture(title, width, height, parts)
