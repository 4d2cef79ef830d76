"""What is drawn of a step: the camera's image, the fused cloud, single shapes, the view sphere, and charts.

Every function returns a `Picture`, which keeps none of the images and clouds it was drawn from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.sensing.view_sphere import direction
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.viz import colours
from caryatid.viz.colours import object_colour
from caryatid.viz.pictures import SOFT, Picture, Tag, put_raster, put_tags

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from caryatid.exploration import Step

NEAR = 0.05
"""Lines nearer to the camera than this are left out [m]."""
HIDDEN = 0.02
"""A line further than this behind what is seen is drawn as hidden [m]: registration error and noise."""
DARK = "#111111"


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
        """Return pixels (N, 2) and distances (N,) [m] of points (N, 3)."""
        points_camera = transforms.transform(transforms.invert(self.T_world_camera), points_world)
        z = points_camera[:, 2]
        on_plane = points_camera[:, :2] / (1.0 if self.parallel else np.maximum(z, NEAR)[:, None])
        return on_plane @ self.K[:2, :2].T + self.K[:2, 2], z

    def hidden(self, pixels: Array, z: Array) -> NDArray[np.bool_]:
        """Say of pixels (N, 2) at distances z (N,) whether the picture shows something nearer."""
        height, width = self.depth.shape
        u, v = np.rint(np.clip(pixels, -1.0, (width, height))).astype(int).T
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        shown = np.where(inside, self.depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], 0.0)
        return (shown > 0.0) & (z > shown + HIDDEN)

    def tag(self, item: SceneObject, *, faint: bool = False) -> Tag:
        """The name of an object at its centre."""
        ((x, y),), _ = self.project(item.centre_world[None])
        return Tag(float(x), float(y), item.id, object_colour(item.label), faint)


def _parallel(T_world_eye: Array, scale: float, centre: tuple[float, float]) -> Projection:
    """A parallel projection with a given number of pixels per metre, in which nothing is hidden."""
    K = np.array([[scale, 0.0, centre[0]], [0.0, scale, centre[1]], [0.0, 0.0, 1.0]])
    return Projection(T_world_eye, K, np.zeros((1, 1), dtype=np.float32), parallel=True)


Outline = tuple[str, str, bool, list[Array], list[Array]]
"""An object's id and kind, colour, whether it is the surface; its lines that are seen and hidden [px]."""


def _outlines(objects: Sequence[SceneObject], projection: Projection) -> list[Outline]:
    """The lines of shapes as a picture shows them, the support surface first."""
    from scipy.ndimage import median_filter

    outlines = []
    for item in sorted(objects, key=lambda o: o.role != "support_surface"):
        runs: tuple[list[Array], list[Array]] = ([], [])
        for line in item.shape.lines(projection.T_world_camera[:3, 3]):
            pixels, z = projection.project(line)
            hidden = median_filter(projection.hidden(pixels, z), size=5, mode="nearest")
            cuts = [0, *(np.flatnonzero(np.diff(hidden)) + 1), len(line) - 1]
            for start, stop in pairwise(cuts):
                if stop > start and (z[start : stop + 1] > NEAR).all():
                    runs[int(hidden[start])].append(pixels[start : stop + 1])
        title = f"{item.id}, {item.shape.kind}"
        outlines.append((title, object_colour(item.label), item.role == "support_surface", *runs))
    return outlines


def _put_outlines(axes: Axes, outlines: Sequence[Outline]) -> None:
    """Draw shapes as lines in their objects' colours on a dark rim; what is hidden thin and faint."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for title, colour, surface, visible, hidden in outlines:
        width, rim = (1.2, 0.3) if surface else (2.2, 0.55)
        layers = (
            (hidden, colour, 1.0, 0.6),
            (visible, DARK, width + 1.4, rim),
            (visible, colour, width, 1.0),
        )
        for lines, paint, thick, alpha in layers:
            if lines:
                look = {"edgecolor": paint, "linewidth": thick, "alpha": alpha, "gid": f"shapes|{title}"}
                path = Path.make_compound_path(*map(Path, lines))
                axes.add_artist(
                    PathPatch(path, fill=False, capstyle="round", joinstyle="round", zorder=5.0, **look)
                )


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
    found = [o for o in graph.objects if o.role != "support_surface"]
    left, top, right, bottom = _window(found, view)
    scale = width / (right - left)
    height = round((bottom - top) * scale)
    columns = (left + (np.arange(width) + 0.5) / scale).astype(int)
    rows = (top + (np.arange(height) + 0.5) / scale).astype(int).clip(max=bottom - 1)
    labels = labels[rows][:, columns]
    window = (left, top, right, bottom)
    image = np.asarray(Image.fromarray(image_of(view)).resize((width, height), Image.Resampling.BOX, window))
    layers = [image, _tint(image, labels)]
    tags = []
    for item in found:
        v, u = np.nonzero(labels == item.label)
        if len(u):
            tags.append(Tag(float(np.median(u)), float(np.median(v)), item.id, object_colour(item.label)))
    outlines: list[Outline] = []
    if shapes and view.T_world_camera is not None:
        K = np.array([[scale, 0.0, -scale * left], [0.0, scale, -scale * top], [0.0, 0.0, 1.0]]) @ view.K
        projection = Projection(view.T_world_camera, K, view.depth[rows][:, columns])
        outlines = _outlines(graph.objects, projection)
        named = {tag.text for tag in tags}
        tags += [projection.tag(o, faint=True) for o in found if o.id not in named]

    def draw(axes: Axes) -> None:
        for layer in layers:
            put_raster(axes, layer, 0.0, 0.0, width, height)
        _put_outlines(axes, outlines)
        put_tags(axes, tags, 15.0)

    what = "segments and fitted shapes" if shapes else "segments"
    return Picture(f"{view.name} with its {what}", width, height, draw)


def image_of(view: View) -> NDArray[np.uint8]:
    """A view's image (H, W, 3): its colours, or its depth, near bright, black where there is no reading."""
    if view.rgb is not None or not view.valid.any():
        return np.zeros((*view.depth.shape, 3), dtype=np.uint8) if view.rgb is None else view.rgb
    near, far = np.percentile(view.depth[view.valid], (2.0, 98.0))
    share = (view.depth.astype(np.float64) - near) / max(far - near, 1e-6)
    return np.where(view.valid[..., None], colours.scale(share, colours.DEPTH_STOPS), np.uint8(0))


def _tint(image: NDArray[np.uint8], labels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Segments of an image (H, W, 3) in their objects' colours, lit as in the image; else clear (H, W, 4)."""
    v, u = (np.arange(n, dtype=np.float64) for n in labels.shape)
    colour = colours.striped_colours(labels, u, v[:, None], 18.0)
    lit = 0.62 * colour + 0.38 * (image @ np.array([0.299, 0.587, 0.114]))[..., None]
    segment = (labels != 0) & (labels != SUPPORT_LABEL)
    tint = np.concatenate([lit, np.full((*labels.shape, 1), 255.0)], axis=-1) * segment[..., None]
    return tint.astype(np.uint8)


def _window(objects: Sequence[SceneObject], view: View) -> tuple[int, int, int, int]:
    """Part of the image that is shown (left, top, right, bottom) [px]: the objects with a third around them.

    It has the image's proportions and is half as wide at least.
    """
    height, width = view.depth.shape
    if view.T_world_camera is None or not objects:
        return 0, 0, width, height
    projection = Projection(view.T_world_camera, view.K, view.depth)
    pixels, z = projection.project(np.concatenate([o.shape.outline() for o in objects]))
    size = np.array([width, height])
    inside = np.clip(pixels[z > 0.0], 0.0, size) if (z > 0.0).any() else np.array([[0.0, 0.0], size])
    low, high = inside.min(axis=0), inside.max(axis=0)
    share = float(np.clip(1.35 * ((high - low) / size).max(), 0.5, 1.0))
    corner = np.clip((low + high - share * size) / 2.0, 0.0, (1.0 - share) * size)
    left, top = corner.astype(int)
    right, bottom = np.ceil(corner + share * size).astype(int)
    return int(left), int(top), int(right), int(bottom)


# The fused cloud and single shapes

POINT_SIZE = 0.0075
"""Side of a point of the cloud as drawn [m], the surface's twice that; half more than the spacing."""


def draw_cloud(
    cloud: Cloud, graph: SupportGraph, azimuth: float, *, width: int = 720, point_size: float = POINT_SIZE
) -> Picture:
    """Draw the labelled cloud and the shapes fitted to it, by parallel projection.

    Points are little squares lit from above the eye, pale where one sees a surface from behind.

    Args:
        cloud: The fused points, labelled; of more than 200,000 some are picked evenly.
        graph: The shapes.
        azimuth: Direction about the vertical the eye looks from [rad].
        width: Of the picture [px].
        point_size: Side of a point as drawn [m].
    """
    towards_eye = direction(azimuth, np.deg2rad(28.0))
    frame = _framed(cloud, graph, towards_eye, width)
    labels = np.zeros(len(cloud), dtype=np.int32) if cloud.labels is None else cloud.labels
    pixels, depth = _splat(cloud, labels != SUPPORT_LABEL, frame, towards_eye, point_size)
    below, depth_below = _splat(cloud, labels == SUPPORT_LABEL, frame, towards_eye, 2.0 * point_size)
    nearer = (depth_below > 0.0) & ((depth == 0.0) | (depth_below < depth))
    pixels, depth = np.where(nearer[..., None], below, pixels), np.where(nearer, depth_below, depth)
    projection = replace(frame, depth=depth)
    outlines = _outlines(graph.objects, projection)
    tags = [projection.tag(o) for o in graph.objects if o.role != "support_surface" and o.id]
    height = len(depth)

    def draw(axes: Axes) -> None:
        put_raster(axes, pixels, 0.0, 0.0, width, height)
        _put_outlines(axes, outlines)
        put_tags(axes, tags, 15.0)

    side = round(float(np.rad2deg(azimuth))) % 360
    return Picture(f"the fused cloud with the fitted shapes, from {side}°", width, height, draw)


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
    subject = np.concatenate(outlines) if outlines else cloud.points_world
    if len(subject) == 0:
        subject = np.zeros((1, 3))
    centre = subject.mean(axis=0)
    T_world_eye = transforms.look_at(centre + 10.0 * towards_eye, centre)
    seen = transforms.transform(transforms.invert(T_world_eye), subject)[:, :2]
    low, high = (seen.min(axis=0), seen.max(axis=0)) if outlines else np.percentile(seen, (2.0, 98.0), axis=0)
    extent = np.maximum(high - low, 1e-3) * 1.08
    height = round(width * float(np.clip(extent[1] / extent[0], 0.5, 0.8)))
    scale = float(min(width / extent[0], height / extent[1]))
    x, y = np.array([width, height]) / 2.0 - scale * (low + high) / 2.0
    projection = _parallel(T_world_eye, scale, (x, y))
    return replace(projection, depth=np.zeros((height, width), dtype=np.float32))


def _splat(
    cloud: Cloud, picked: NDArray[np.bool_], projection: Projection, towards_eye: Array, size: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Paint points far to near, `size` [m] wide; return pixels (H, W, 4) and distances (H, W) [m]."""
    index = np.flatnonzero(picked)
    index = index[:: max(1, -(-len(index) // 200_000))]
    at, z = projection.project(cloud.points_world[index])
    order = np.argsort(-z)
    index, at, z = index[order], at[order], z[order]
    labels = np.zeros(len(index), dtype=np.int32) if cloud.labels is None else cloud.labels[index]
    normals_world = np.nan_to_num(cloud.normals_world[index])
    light = np.abs(normals_world @ transforms.unit(towards_eye + (0.0, 0.0, 0.8)))
    colour = colours.striped_colours(labels, at[:, 0], at[:, 1], 15.0) * (0.5 + 0.5 * light)[:, None]
    colour = np.where(normals_world @ towards_eye[:, None] < 0.0, 0.7 * 255.0 + 0.3 * colour, colour)
    height, width = projection.depth.shape
    half = max(1, round(size * projection.K[0, 0] / 2.0))
    dv, du = (offset.ravel() for offset in np.mgrid[-half:half, -half:half])
    u, v = np.rint(at).astype(int).T[:, :, None] + np.stack([du, dv])[:, None]
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    source = np.broadcast_to(np.arange(len(index))[:, None], u.shape)[inside]
    nearest = np.full((height, width), -1)
    nearest[v[inside], u[inside]] = source
    pixels = np.append(colour.round(), np.zeros((1, 3)), axis=0)[nearest]
    shown = nearest >= 0
    painted = np.concatenate([pixels, 255.0 * shown[..., None]], axis=-1).astype(np.uint8)
    return painted, np.where(shown, np.append(z, 0.0)[nearest], 0.0).astype(np.float32)


# The view sphere

SIDE, RADIUS = 400.0, 158.0
"""Width of each of the two pictures of the view sphere, and radius of the sphere in them [px]."""
DENSE = 200
"""More candidates than this are painted as an area, fewer as dots."""
VISITED_COLOUR = "#2d3748"
"""Plates of the views' numbers."""

Place = Callable[[Array], tuple[Array, NDArray[np.bool_]]]
"""Where directions (N, 3) are drawn: pixels (N, 2), and which of them are on the far side."""


def draw_sphere(step: Step) -> Picture:
    """Draw the view sphere (the paper's Fig. 4): in space with the points of interest's rays, and from above.

    Full colour where the robot can bring its camera, washed out elsewhere. The picture from above holds the
    whole upper half, zenith in the middle and horizon on the rim.
    """
    sphere, visited, decision = step.sphere, step.visited, step.decision
    chosen = None if decision is None else sphere.direction_of(decision.T_world_camera)
    points = () if decision is None else sorted(decision.points_of_interest, key=lambda p: p.saliency)
    # From between the current and the chosen view both are on the near side, if they can be.
    aim_x, aim_y, _ = visited[-1:].sum(axis=0) + (0.0 if chosen is None else chosen)
    towards_eye = direction(float(np.arctan2(aim_y, aim_x)), np.deg2rad(32.0))
    T_world_eye = transforms.look_at(
        sphere.centre_world + 10.0 * sphere.radius * towards_eye, sphere.centre_world
    )
    space = _parallel(T_world_eye, RADIUS / sphere.radius, (SIDE / 2.0, SIDE / 2.0))
    outlines = _outlines(step.graph.objects, space)

    def in_space(directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        at, _ = space.project(sphere.centre_world + sphere.radius * directions)
        return at, directions @ T_world_eye[:3, 2] > 0.0

    def from_above(directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        polar = np.arccos(np.clip(directions[:, 2], -1.0, 1.0)) / (np.pi / 2.0)
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        shown = np.minimum(polar, 1.0) * np.stack([np.cos(azimuth), -np.sin(azimuth)])
        return (1.5 * SIDE, SIDE / 2.0) + RADIUS * shown.T, polar > 1.02

    y, x = np.mgrid[-1.0:1.0:260j, -1.0:1.0:260j]
    r = np.minimum(np.hypot(x, y), 1.0)
    ball = np.stack([x, y, -np.sqrt(1.0 - r**2)], axis=-1) @ T_world_eye[:3, :3].T
    ring = np.sin(r * np.pi / 2.0) / np.maximum(r, 1e-9)
    disc = np.stack([ring * x, -ring * y, np.cos(r * np.pi / 2.0)], axis=-1)
    rasters = [_painted(step, directions, r < 1.0) for directions in (ball, disc)]
    dots = np.zeros((0, 3))
    if step.candidates is not None and (len(step.candidates) <= DENSE or step.candidates.indices is None):
        dots = step.candidates.directions
    rays = [space.project(p.position_world[None])[0][0] for p in points]
    circle = np.linspace(-np.pi, np.pi, 181)

    def draw(axes: Axes) -> None:
        for middle, raster in zip((0.5 * SIDE, 1.5 * SIDE), rasters, strict=True):
            put_raster(axes, raster, middle - RADIUS, SIDE / 2.0 - RADIUS, 2.0 * RADIUS, 2.0 * RADIUS)
            rim = RADIUS * np.array([np.cos(circle), np.sin(circle)])
            axes.plot(middle + rim[0], SIDE / 2.0 + rim[1], color=SOFT, linewidth=1.0)
        small: dict[str, Any] = {"fontsize": 11.0, "color": SOFT, "ha": "center"}
        for place, elevation in ((in_space, 0.0), (from_above, 30.0), (from_above, 60.0)):
            at, behind = place(np.array([direction(a, np.deg2rad(elevation)) for a in circle]))
            at[behind] = np.nan
            axes.plot(*at.T, color="#444444", alpha=0.35, linewidth=1.0, linestyle=(0, (2, 3)))
            if elevation:
                axes.text(at[135, 0], at[135, 1] + 4.0, f"{elevation:.0f}°", **small)
        _put_outlines(axes, outlines)
        axes.plot(*from_above(visited)[0].T, color=VISITED_COLOUR, alpha=0.75, linewidth=1.4)
        for end, start in zip(points, rays, strict=True):
            (at,), (behind,) = in_space(end.direction[None])
            alpha = 0.15 if behind else 0.5
            axes.plot(*np.array([start, at]).T, color=DARK, alpha=alpha, linewidth=1.0, zorder=5.5)
        for place in (in_space, from_above):
            _put_directions(axes, place, points, dots, visited, chosen)
        for text, left in (("in space", 14.0), ("from above", SIDE + 14.0)):
            axes.text(left, 22.0, text, fontsize=12.5, fontweight="bold")
        axes.text(1.5 * SIDE + RADIUS + 12.0, SIDE / 2.0 + 4.0, "x", style="italic", **small)
        axes.text(1.5 * SIDE, SIDE / 2.0 - RADIUS - 8.0, "y", style="italic", **small)
        left, top = 2.0 * SIDE - 166.0, SIDE - 20.0
        bar = colours.scale(np.tile(np.linspace(-1.0, 1.0, 150), (2, 1)), colours.SALIENCY_STOPS)
        put_raster(axes, bar, left, top, 150.0, 9.0)
        for shift, text in ((-38.0, "saliency"), (0.0, "−1"), (75.0, "0"), (150.0, "+1")):
            axes.text(left + shift, top + 8.0 if shift < 0.0 else top - 5.0, text, **small)

    return Picture(f"view sphere with its saliency after view {step.index}", 2.0 * SIDE, SIDE, draw)


def _painted(step: Step, directions: Array, inside: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Colours (H, W, 4) of directions (H, W, 3): saliency of the nearest point, washed out beyond reach.

    What is below the horizon fades.
    """
    from scipy.spatial import KDTree

    directions = directions[inside]
    saliency = None if step.decision is None else step.decision.sphere_saliency
    nearest = KDTree(step.sphere.directions).query(directions)[1]
    values = np.zeros(len(nearest)) if saliency is None else saliency[nearest]
    colour = colours.scale(values, colours.SALIENCY_STOPS).astype(np.float64)
    candidates = step.candidates
    if candidates is not None and candidates.indices is not None and len(candidates) > DENSE:
        reachable = np.zeros(len(step.sphere.directions), dtype=np.bool_)
        reachable[candidates.indices] = True
        grey = colours.scale(np.zeros(1), colours.SALIENCY_STOPS)
        colour = np.where(reachable[nearest, None], colour, 0.72 * grey + 0.28 * colour)
    pixels = np.zeros((*inside.shape, 4), dtype=np.uint8)
    pixels[inside, :3] = colour.round()
    pixels[inside, 3] = 255.0 * np.clip(1.0 + directions[:, 2] / 0.35, 0.12, 1.0)
    return pixels


def _put_directions(
    axes: Axes, place: Place, points: Sequence[Any], dots: Array, visited: Array, chosen: Array | None
) -> None:
    """Mark points of interest, the most salient on top, single candidates, views so far and the next view."""
    rim: dict[str, Any] = {"markeredgecolor": DARK, "markeredgewidth": 1.0}

    def mark(at: Array, behind: bool, size: float, colour: str, **look: Any) -> None:
        alpha = 0.3 if behind else 1.0
        axes.plot(*at, "o", markersize=size, color=colour, alpha=alpha, **({"zorder": 6.5} | look))

    for point in points:
        (at,), (behind,) = place(point.direction[None])
        title = f"{' – '.join(point.subject)}: saliency {point.saliency:.2f}; {point.why}"
        mark(
            at, behind, 8.0, colours.saliency_colour(point.saliency), zorder=6.0, gid=f"point|{title}", **rim
        )
    for at, behind in zip(*place(dots), strict=True):
        mark(at, behind, 6.4, "white", **rim)
    tags = []
    for number, (at, behind) in enumerate(zip(*place(visited), strict=True)):
        mark(at, behind, 7.0, VISITED_COLOUR)
        tags.append(Tag(float(at[0]), float(at[1]) - 15.0, str(number), VISITED_COLOUR, bool(behind)))
    if chosen is not None:
        (at,), (behind,) = place(chosen[None])
        mark(at, behind, 17.0, "#8a8f96", **(rim | {"markeredgewidth": 2.0}))
        mark(at, behind, 6.0, DARK, gid="chosen|the next view")
        tags.append(Tag(float(at[0]), float(at[1]) - 20.0, "next", DARK, bool(behind)))
    put_tags(axes, tags, 13.0)


# Charts

DASHES, MARKS = ("-", (0, (4, 2)), (0, (1, 1.6)), (0, (6, 2, 1, 2))), "osD^"
"""Styles of lines and of their points: what tells lines apart beside their colours."""


def line_chart(
    title: str, x_name: str, x: Sequence[float], lines: Mapping[str, Sequence[float]], y_name: str
) -> Picture:
    """Draw lines over x, the first on top and the others' points wider, so that all are seen where they meet.

    Args:
        title: What the chart shows.
        x_name: Name and unit of the x axis.
        x: Abscissae, ascending.
        lines: Ordinates, 0 or more, of each line by its name; NaN leaves a gap.
        y_name: Name and unit of the y axis.
    """

    def plot(axes: Axes) -> None:
        for k, (name, values) in enumerate(lines.items()):
            look: dict[str, Any] = {"color": colours.SERIES[k], "zorder": 3.0 - 0.1 * k, "clip_on": False}
            axes.plot(x, values, linewidth=2.0, linestyle=DASHES[k], label=name, **look)
            for at, value in zip(x, values, strict=True):
                if np.isfinite(value):
                    look |= {"markersize": 6.0 + 2.0 * k, "gid": f"note|{name} {value:.3g}"}
                    axes.plot([at], [value], MARKS[k], markeredgewidth=0.0, **look)
        axes.set_xlim(x[0], max(x[-1], x[0] + 1e-3))
        axes.set_ylim(bottom=0.0)

    return _chart(plot, title, x_name, y_name, whole=all(float(value).is_integer() for value in x))


def bar_chart(title: str, x_name: str, bars: Sequence[Mapping[str, float]], y_name: str) -> Picture:
    """Draw stacked bars, one for each mapping of part to height, numbered from 0.

    Args:
        title: What the chart shows.
        x_name: What the numbers count.
        bars: Part → height, bar by bar.
        y_name: Name and unit of the heights.
    """

    def plot(axes: Axes) -> None:
        base = np.zeros(len(bars))
        for k, name in enumerate(dict.fromkeys(name for bar in bars for name in bar)):
            heights = np.array([bar.get(name, 0.0) for bar in bars])
            look: dict[str, Any] = {
                "color": colours.SERIES[k % len(colours.SERIES)],
                "edgecolor": "white",
                "linewidth": 0.5,
            }
            drawn = axes.bar(range(len(bars)), heights, 0.2 * min(3, len(bars)), base, label=name, **look)
            for patch, height in zip(drawn, heights, strict=True):
                patch.set_gid(f"note|{name} {height:.3g}")
            base += heights
        axes.set_xlim(-0.5, len(bars) - 0.5)

    return _chart(plot, title, x_name, y_name, whole=True)


def _chart(plot: Callable[[Axes], None], title: str, x_name: str, y_name: str, *, whole: bool) -> Picture:
    def draw(axes: Axes) -> None:
        from matplotlib.ticker import MaxNLocator

        inset = axes.inset_axes((0.17, 0.3, 0.79, 0.57))
        inset.spines[:].set_visible(False)
        inset.grid(axis="y")
        inset.xaxis.set_major_locator(MaxNLocator(10 if whole else 5, integer=whole, min_n_ticks=1))
        inset.tick_params(labelsize=11.0, pad=6.0)
        inset.margins(y=0.08)
        plot(inset)
        inset.set_xlabel(x_name, fontsize=11.0)
        inset.set_ylabel(y_name, fontsize=11.0)
        inset.set_title(title, fontsize=12.0, fontweight="bold", loc="left", x=-0.2)
        if len(inset.get_legend_handles_labels()[1]) > 1:
            inset.legend(loc="upper left", bbox_to_anchor=(-0.24, -0.2), ncols=4, fontsize=9.0)

    return Picture(title, 320.0, 260.0, draw)
