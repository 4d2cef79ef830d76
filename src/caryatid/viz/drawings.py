"""What is drawn of a step: the camera's image, the fused cloud, single shapes, the view sphere, and charts.

Every function returns a `Picture`, which keeps none of the images and clouds it was drawn from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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


Strokes = Sequence[dict[str, Any]]
"""Lines as a picture shows them: arguments of matplotlib's `LineCollection`, in the order of drawing."""


def _strokes(objects: Sequence[SceneObject], projection: Projection) -> Strokes:
    """Lines of shapes, the support surface first: strong on a dark rim, thin and faint where hidden."""
    from scipy.ndimage import median_filter

    whole, seen, colour, width = [], [], [], []
    for item in sorted(objects, key=lambda o: o.role != "support_surface"):
        lines = item.shape.lines(projection.T_world_camera[:3, 3])
        pixels, z = projection.project(np.concatenate(lines))
        hidden = median_filter(projection.hidden(pixels, z), size=5, mode="nearest")
        ends = np.cumsum([len(line) for line in lines])[:-1]
        whole.append(np.insert(pixels, ends, np.nan, axis=0))
        seen.append(np.insert(np.where(hidden[:, None], np.nan, pixels), ends, np.nan, axis=0))
        colour.append(object_colour(item.label))
        width.append(1.2 if item.role == "support_surface" else 2.2)
    return [
        {"segments": whole, "colors": colour, "linewidths": 1.0, "alpha": 0.6},
        {"segments": seen, "colors": DARK, "linewidths": np.add(width, 1.4), "alpha": 0.5},
        {"segments": seen, "colors": colour, "linewidths": width},
    ]


def _put_strokes(axes: Axes, strokes: Strokes) -> None:
    from matplotlib.collections import LineCollection

    for stroke in strokes:
        lines = LineCollection(**stroke, capstyle="round", zorder=5.0, gid="shapes|")
        axes.add_collection(lines, autolim=False)


def draw_layers(
    name: str, layers: Sequence[NDArray[np.uint8]], strokes: Strokes = (), tags: Sequence[Tag] = ()
) -> Picture:
    """Draw images (H, W, C) of one size above each other, shapes over them, and names on top."""
    height, width = layers[0].shape[:2]

    def draw(axes: Axes) -> None:
        for layer in layers:
            put_raster(axes, layer, 0.0, 0.0, width, height)
        _put_strokes(axes, strokes)
        put_tags(axes, tags, 15.0)

    return Picture(name, width, height, draw)


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
    step = max(1, view.depth.shape[1] // (4 * width))  # of what is shown, two pixels for each drawn
    if step > 1:
        view, labels = view.every(step), labels[::step, ::step]
    window = left, top, right, bottom = _window(labels)
    scale = width / (right - left)
    size = width, round((bottom - top) * scale)

    def resized(image: NDArray[Any], method: Image.Resampling = Image.Resampling.NEAREST) -> NDArray[Any]:
        return np.asarray(Image.fromarray(image).resize(size, method, window))

    image, labels = resized(image_of(view), Image.Resampling.BOX), resized(labels)
    tags = []
    for item in found:
        v, u = np.nonzero(labels == item.label)
        if len(u):
            tags.append(Tag(float(np.median(u)), float(np.median(v)), item.id, object_colour(item.label)))
    strokes: Strokes = ()
    if shapes and view.T_world_camera is not None:
        K = np.array([[scale, 0.0, -scale * left], [0.0, scale, -scale * top], [0.0, 0.0, 1.0]]) @ view.K
        projection = Projection(view.T_world_camera, K, resized(view.depth))
        strokes = _strokes(graph.objects, projection)
        unseen = [projection.tag(o)._replace(faint=True) for o in found if o.label not in labels]
        tags += [tag for tag in unseen if np.isfinite(tag.x)]
    what = "segments and fitted shapes" if shapes else "segments"
    return draw_layers(f"{view.name} with its {what}", [image, _tint(image, labels)], strokes, tags)


def image_of(view: View) -> NDArray[np.uint8]:
    """A view's image (H, W, 3): its colours, or its depth, near bright, black where there is no reading."""
    if view.rgb is not None or not view.valid.any():
        return np.zeros((*view.depth.shape, 3), dtype=np.uint8) if view.rgb is None else view.rgb
    near, far = np.percentile(view.depth[view.valid], (2.0, 98.0))
    share = (view.depth.astype(np.float64) - near) / max(far - near, 1e-6)
    return np.where(view.valid[..., None], colours.scale(share, colours.DEPTH_STOPS), np.uint8(0))


def _tint(image: NDArray[np.uint8], labels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Segments of an image (H, W, 3) in their objects' colours, lit as in the image; else clear (H, W, 4)."""
    v, u = np.mgrid[: labels.shape[0], : labels.shape[1]]
    lit = (image @ np.array([0.299, 0.587, 0.114]))[..., None]
    colour = 0.62 * colours.striped_colours(labels, u, v, 18.0) + 0.38 * lit
    segment = ((labels != 0) & (labels != SUPPORT_LABEL))[..., None]
    return np.where(segment, np.dstack([colour, np.full(labels.shape, 255.0)]), 0.0).astype(np.uint8)


def _window(labels: NDArray[np.int32]) -> tuple[int, int, int, int]:
    """Part of an image (H, W) that is shown (left, top, right, bottom) [px]: its segments and a third around.

    It has the image's proportions and is half as wide at least.
    """
    size = np.array(labels.shape[::-1])
    found = np.argwhere((labels != 0) & (labels != SUPPORT_LABEL))[:, ::-1]
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
    strokes = _strokes(graph.objects, projection)
    tags = [projection.tag(o) for o in graph.objects if o.role != "support_surface" and o.id]
    side = round(float(np.rad2deg(azimuth))) % 360
    return draw_layers(f"the fused cloud with the fitted shapes, from {side}°", [pixels], strokes, tags)


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
        own = inside[far_to_near] & ((labels[far_to_near] == SUPPORT_LABEL) == surface)
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


def draw_stands(steps: Sequence[Step]) -> Picture:
    """Draw from above where the robot stood for each view, where it looked, and the way it took.

    Args:
        steps: Steps of which one at least knows its robot.
    """
    held = [(step.index, step.robot) for step in steps if step.robot is not None]
    decisions = [step.decision for step in steps[:-1] if step.decision is not None]
    ways = [np.array([p.platform_world for p in decision.waypoints]) for decision in decisions]
    objects, reach = steps[-1].graph.objects, 0.2 + held[0][1].footprint
    places = [np.stack([r.posture.platform_world, r.T_world_camera[:3, 3]])[:, :2] for _, r in held]
    ground = [item.shape.outline()[:, :2] for item in objects]
    there = np.concatenate([*(way[:, :2] for way in ways if len(way)), *places])
    extent = np.concatenate([there - reach, there + reach, *ground])
    low, high = extent.min(axis=0), extent.max(axis=0)
    width, height = 480.0, 480.0 * float(np.clip((high - low)[1] / (high - low)[0], 0.6, 1.2))
    scale = float(((width, height) / (high - low)).min())
    above = _from_above(np.append((low + high) / 2.0, 0.0), scale, width, height)
    strokes = _strokes(objects, above)

    def pixels(points: Array) -> Array:
        return above.project(np.column_stack([points[:, :2], np.zeros(len(points))]))[0]

    def draw(axes: Axes) -> None:
        from matplotlib.patches import Circle, Wedge

        _put_strokes(axes, strokes)
        for way in ways:
            if len(way) > 1:
                axes.plot(*pixels(way).T, color=VISITED, linewidth=1.6, zorder=6.0)
        tags = []
        for (number, robot), place in zip(held, places, strict=True):
            platform, eye = pixels(place)
            forward = robot.T_world_camera[:2, 2]
            gaze = float(np.rad2deg(np.arctan2(-forward[1], forward[0])))
            radius = scale * (0.08 if robot.arm else robot.footprint)
            axes.add_patch(Circle(platform, radius, facecolor=VISITED + "1a", edgecolor=VISITED, zorder=5.9))
            cone = Wedge(eye, 0.3 * scale, gaze - 30.0, gaze + 30.0, color=VISITED, alpha=0.35, zorder=6.0)
            axes.add_patch(cone)
            axes.plot(*platform, "o", markersize=6.0, color=VISITED, zorder=6.5)
            x, y = (eye if robot.arm else platform).tolist()
            tags.append(Tag(x, y - 15.0, str(number + 1), VISITED))
        put_tags(axes, tags, 13.0)
        axes.plot([12.0, 12.0 + 0.5 * scale], [height - 12.0] * 2, color=SOFT, linewidth=2.0)
        axes.text(12.0, height - 18.0, "0.5 m", fontsize=11.0, color=SOFT)

    return Picture("where the robot stood", width, height, draw)


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
    strokes = _strokes(step.graph.objects, above)
    points = () if decision is None else sorted(decision.points_of_interest, key=lambda p: p.saliency)
    feet = above.project(np.reshape([p.position_world for p in points], (-1, 3)))[0]
    rays = np.stack([feet, places(np.array([p.direction for p in points]))], axis=1)
    look: dict[str, Any] = {"fontsize": 11.0, "color": SOFT, "ha": "center"}
    rim: dict[str, Any] = {"markeredgecolor": DARK, "markeredgewidth": 1.0}

    def draw(axes: Axes) -> None:
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Circle

        put_raster(axes, saliency, side / 2.0 - radius, side / 2.0 - radius, 2.0 * radius, 2.0 * radius)
        _put_strokes(axes, strokes)
        for name, elevation in (("y", 0.0), ("30°", 30.0), ("60°", 60.0)):
            wide = radius * np.cos(np.deg2rad(elevation))
            axes.add_patch(Circle((side / 2.0, side / 2.0), wide, fill=False, color=SOFT, linestyle=":"))
            axes.text(side / 2.0, side / 2.0 - wide - 5.0, name, **look)
        axes.text(side / 2.0 + radius + 10.0, side / 2.0 + 4.0, "x", **look)
        axes.add_collection(LineCollection([*rays], colors=DARK, alpha=0.4, linewidths=1.0, zorder=5.5))
        for point, ray in zip(points, rays, strict=True):
            title = f"{' – '.join(point.subject)}: saliency {point.saliency:.2f}; {point.why}"
            colour = colours.saliency_colour(point.saliency)
            axes.plot(*ray[1], "o", markersize=8.0, color=colour, zorder=6.0, gid=f"point|{title}", **rim)
        axes.plot(*places(dots).T, "o", markersize=6.4, color="white", zorder=6.5, **rim)
        axes.plot(*places(step.visited).T, "o-", markersize=7.0, color=VISITED, linewidth=1.4, zorder=6.5)
        tags = [
            Tag(x, y - 15.0, str(k), VISITED) for k, (x, y) in enumerate(places(step.visited).tolist(), 1)
        ]
        if decision is not None:
            ((x, y),) = places(sphere.direction_of(decision.T_world_camera)).tolist()
            axes.plot(x, y, "o", markersize=14.0, color="white", zorder=6.5, **rim)
            axes.plot(x, y, "o", markersize=7.0, color=DARK, zorder=6.6, gid="chosen|the next view")
            tags.append(Tag(x, y - 20.0, "next", DARK))
        put_tags(axes, tags, 13.0)
        bar = colours.scale(np.tile(np.linspace(-1.0, 1.0, 150), (2, 1)), colours.SALIENCY_STOPS)
        put_raster(axes, bar, side - 115.0, side - 15.0, 84.0, 8.0)
        for left, text in ((-165.0, "saliency"), (-128.0, "−1"), (-18.0, "+1")):
            axes.text(side + left, side - 7.0, text, **look)

    return Picture(f"view sphere with its saliency after view {step.index + 1}", side, side, draw)


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
    """Draw lines over the numbers of views, the first on top and the others' marks larger.

    Args:
        title: What the chart shows.
        y_name: Name of the y axis.
        lines: Value after each view, 0 or more, by the name of each line.
        top: Upper end of the y axis; None = as high as the values.
    """

    def draw(axes: Axes) -> None:
        from matplotlib.ticker import MaxNLocator

        chart = axes.inset_axes((0.12, 0.3, 0.84, 0.56))
        chart.spines[:].set_visible(False)
        chart.grid(axis="y")
        chart.xaxis.set_major_locator(MaxNLocator(10, integer=True))
        chart.tick_params(labelsize=11.0, pad=6.0)
        for k, (name, values) in enumerate(lines.items()):
            form = ("o-", "s--", "D:", "^-.")[k]
            look: dict[str, Any] = {"color": colours.PALETTE[k], "label": name, "zorder": 3.0 - 0.1 * k}
            chart.plot(
                range(1, len(values) + 1),
                values,
                form,
                linewidth=2.0,
                markersize=5.0 + 2.0 * k,
                clip_on=False,
                **look,
            )
        chart.set_xlim(1.0, max(len(values), 2))
        chart.set_ylim(0.0, top)
        chart.set_xlabel("view", fontsize=11.0)
        chart.set_ylabel(y_name, fontsize=11.0)
        chart.set_title(title, fontsize=12.0, fontweight="bold", loc="left", x=-0.12)
        chart.legend(loc="upper left", bbox_to_anchor=(-0.14, -0.25), ncols=4, fontsize=11.0)

    return Picture(title, 480.0, 240.0, draw)
