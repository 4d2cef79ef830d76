"""One vocabulary of drawing, in matplotlib: for the report, its PDF, notebook cells and the docs.

Every function returns a `Picture`, which can be put into any matplotlib figure. No display is needed, the
user's own matplotlib settings have no effect, and the same picture gives the same bytes.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.viz import colours
from caryatid.viz.colours import object_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from caryatid.exploration import Step
    from caryatid.planning.points_of_interest import PointOfInterest

THEME = {
    "ink": "#1d2126", "soft": "#5d666f", "line": "#dcdfe2", "doubt": "#b4480b", "panel": "#f7f7f5",
}  # fmt: skip
"""Colours that a page may replace by its own, so that drawings can be read on light and dark."""
INK, SOFT, LINE, DOUBT, PANEL = THEME.values()
STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "text.color": INK,
    "text.parse_math": False,
    "axes.axisbelow": True,
    "axes.labelcolor": SOFT,
    "axes.xmargin": 0.0,
    "axes.ymargin": 0.0,
    "grid.color": LINE,
    "grid.linewidth": 0.8,
    "xtick.labelcolor": SOFT,
    "ytick.labelcolor": SOFT,
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "legend.frameon": False,
    "legend.labelcolor": SOFT,
    "image.composite_image": False,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
"""matplotlib's settings that differ from its defaults."""
NEAR = 0.05
"""Lines nearer to the camera than this are left out [m]."""
HIDDEN = 0.02
"""A line further than this behind what is seen is drawn as hidden [m]: registration error and noise."""

Rectangle = tuple[float, float, float, float]
"""Left, bottom, width and height, in shares of a figure."""


@dataclass(frozen=True, eq=False, slots=True)
class Picture:
    """A drawing that can be put into any matplotlib figure.

    Attributes:
        name: What it shows, for those who cannot see it; no two pictures of a page share a name.
        width: Its natural width [px].
        height: Its natural height [px].
        draw: Draws it into a rectangle of a figure.
    """

    name: str
    width: float
    height: float
    draw: Callable[[Any, Rectangle], None]


@contextmanager
def own_style(salt: str = "caryatid") -> Iterator[None]:
    """Draw with caryatid's settings of matplotlib, whatever the user's are."""
    from matplotlib import style

    with style.context(["default", STYLE | {"svg.hashsalt": salt}]):
        yield


def picture_svg(picture: Picture) -> str:
    """Return a picture as an SVG element that stands inside an HTML page and loads nothing.

    The colours of `THEME` become `var(--ink, …)` and so on. Groups drawn with a gid `class|title` get that
    class and that tooltip; rasters get the classes `raster0`, `raster1`, …
    """
    from matplotlib.figure import Figure

    with own_style(picture.name):
        figure = Figure(figsize=(picture.width / 72.0, picture.height / 72.0))
        picture.draw(figure, (0.0, 0.0, 1.0, 1.0))
        markup = io.BytesIO()
        figure.savefig(markup, format="svg", transparent=True, metadata={"Date": None})
    return _inline(markup.getvalue(), picture.name)


def picture_png(picture: Picture) -> bytes:
    """Return a picture as the bytes of a PNG."""
    from matplotlib.figure import Figure

    with own_style():
        figure = Figure(figsize=(picture.width / 72.0, picture.height / 72.0))
        picture.draw(figure, (0.0, 0.0, 1.0, 1.0))
        content = io.BytesIO()
        figure.savefig(content, format="png", dpi=72, metadata={"Software": None})
    return content.getvalue()


def _inline(markup: bytes, name: str) -> str:
    root = ElementTree.fromstring(markup)
    for child in list(root):
        if child.tag.endswith("metadata") or child.find(".//{*}style") is not None:
            root.remove(child)
    size = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib |= {"viewBox": size, "role": "img", "aria-label": name}
    rasters = 0
    for node in root.iter():
        node.tag = node.tag.rpartition("}")[2]
        node.attrib = {key.rpartition("}")[2]: " ".join(text.split()) for key, text in node.attrib.items()}
        node.tail = None
        if node.tag == "image":
            node.attrib = _as_webp(node.attrib) | {"class": f"raster{rasters}"}
            rasters += 1
        elif node.tag == "path":
            node.set("d", re.sub(r"(\.\d)\d+", r"\1", node.attrib["d"]))
        elif node.tag == "g":
            node.text = None
            kind, found, title = node.attrib.pop("id", "").partition("|")
            if found and kind:
                node.set("class", kind)
            if title:
                element = ElementTree.Element("title")
                element.text = title
                node.insert(0, element)
    text = ElementTree.tostring(root, encoding="unicode")
    for variable, colour in THEME.items():
        text = text.replace(colour, f"var(--{variable}, {colour})")
    return text


def _as_webp(attributes: dict[str, str]) -> dict[str, str]:
    """The attributes of an image element with its PNG made several times smaller."""
    data = base64.b64decode(attributes["href"].partition(",")[2])
    buffer = io.BytesIO()
    Image.open(io.BytesIO(data)).save(buffer, "WEBP", quality=82, method=3)
    encoded = base64.b64encode(buffer.getvalue()).decode("ascii")
    kept = {key: value for key, value in attributes.items() if key != "id"}
    return kept | {"href": f"data:image/webp;base64,{encoded}", "preserveAspectRatio": "none"}


def stage(
    figure: Any, where: Rectangle, size: tuple[float, float], corner: tuple[float, float] = (0.0, 0.0)
) -> tuple[Axes, float]:
    """Make axes in pixels, y down, that fill a rectangle; return them and the points [1/72 in] per pixel."""
    axes: Axes = figure.add_axes(where)
    axes.set_axis_off()
    axes.set_xlim(corner[0], corner[0] + size[0])
    axes.set_ylim(corner[1] + size[1], corner[1])
    return axes, where[2] * figure.get_figure().get_size_inches()[0] * 72.0 / size[0]


def _raster(axes: Axes, pixels: NDArray[np.uint8], box: Rectangle, zorder: float = 0.0) -> None:
    """Put pixels (H, W, 3 or 4) into axes, at left, top, width and height [px]."""
    left, top, width, height = box
    extent = (left, left + width, top + height, top)
    x, y = axes.get_xlim(), axes.get_ylim()
    axes.imshow(
        pixels,
        extent=extent,
        aspect="auto",
        interpolation="none",
        zorder=zorder,
        clip_on=False,
        resample=False,
    )
    axes.set_xlim(x)
    axes.set_ylim(y)


# Names


@dataclass(frozen=True, slots=True)
class Tag:
    """A short name on a coloured plate.

    Attributes:
        x: Where it belongs [px].
        y: Where it belongs [px].
        text: The name.
        colour: Colour of the plate, `#rrggbb`.
        faint: What it names cannot be seen here.
    """

    x: float
    y: float
    text: str
    colour: str
    faint: bool = False


def _draw_tags(axes: Axes, tags: Sequence[Tag], size: float, unit: float) -> None:
    """Write tags, letters `size` [px] high, moved until they cover neither each other nor the edge."""
    if not tags:
        return
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    anchors = np.array([[tag.x, tag.y] for tag in tags])
    plates = np.array([[(0.62 * len(tag.text) + 0.7) * size, 1.45 * size] for tag in tags])
    centres = keep_apart(anchors, plates + 2.0, (left, min(top, bottom), right, max(top, bottom)))
    for tag, anchor, (x, y), (_, height) in zip(tags, anchors, centres, plates, strict=True):
        alpha = 0.6 if tag.faint else 1.0
        if np.hypot(*(anchor - (x, y))) > height:
            axes.plot(
                [anchor[0], x], [anchor[1], y], color="white", linewidth=1.4 * unit, zorder=7.0, gid="shapes|"
            )
        plate = {
            "boxstyle": "round,pad=0.22", "facecolor": tag.colour, "edgecolor": "white", "linewidth": unit,
            "alpha": alpha, "gid": "shapes|",
        }  # fmt: skip
        axes.text(
            x, y, tag.text, color=colours.ink_on(tag.colour), fontsize=size * unit, fontweight="bold",
            horizontalalignment="center", verticalalignment="center_baseline", bbox=plate, alpha=alpha,
            zorder=8.0, gid="shapes|",
        )  # fmt: skip


def keep_apart(anchors: Array, sizes: Array, bounds: tuple[float, float, float, float]) -> Array:
    """Move the centres (N, 2) of plates of `sizes` (N, 2) as little as it takes for none to overlap.

    Pairs that overlap are pushed apart along the axis on which they overlap least, for a fixed number of
    rounds.

    Args:
        anchors: Where the plates belong (N, 2) [px].
        sizes: Their widths and heights (N, 2) [px].
        bounds: Left, top, right and bottom of where they may be [px].
    """
    rounds = 200
    centres = anchors.astype(np.float64).copy()
    reach = (sizes[:, None] + sizes[None, :]) / 2.0
    first, second = np.triu_indices(len(centres), 1)
    low = np.asarray(bounds[:2]) + sizes / 2.0
    high = np.maximum(np.asarray(bounds[2:]) - sizes / 2.0, low)
    for _ in range(rounds):
        centres = np.clip(centres, low, high)
        moved = False
        for i, j in zip(first, second, strict=True):
            gap = centres[j] - centres[i]
            overlap = reach[i, j] - np.abs(gap)
            if (overlap > 1e-6).all():
                axis = int(np.argmin(overlap))
                push = 0.5 * overlap[axis] * (1.0 if gap[axis] >= 0.0 else -1.0)
                centres[i, axis] -= push
                centres[j, axis] += push
                moved = True
        if not moved:
            break
    return np.clip(centres, low, high)


# Shapes as lines


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


def parallel_projection(T_world_eye: Array, scale: float, centre: tuple[float, float]) -> Projection:
    """A parallel projection from a pose (4, 4), of so many pixels a metre, in which nothing is hidden."""
    K = np.array([[scale, 0.0, centre[0]], [0.0, scale, centre[1]], [0.0, 0.0, 1.0]])
    return Projection(T_world_eye, K, np.zeros((1, 1), dtype=np.float32), parallel=True)


def _runs(values: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Begin and end of each run of equal values; an end is the next one's begin."""
    cuts = (np.flatnonzero(np.diff(values)) + 1).tolist()
    return list(zip([0, *cuts], [*cuts, len(values)], strict=True))


def _shape_lines(shape: Shape, projection: Projection) -> tuple[list[Array], list[Array]]:
    """A shape's lines as they are seen: what is visible, and what is hidden (M, 2) [px]."""
    from scipy.ndimage import median_filter

    runs: tuple[list[Array], list[Array]] = ([], [])
    for line in shape.lines(projection.T_world_camera[:3, 3]):
        pixels, z = projection.project(line)
        hidden = median_filter(projection.hidden(pixels, z), size=5, mode="nearest")
        for start, stop in _runs(hidden):
            run = slice(start, min(stop + 1, len(line)))
            if (z[run] > NEAR).all() and len(pixels[run]) > 1:
                runs[int(hidden[start])].append(_thinned(pixels[run]))
    return runs


def _draw_shapes(axes: Axes, objects: Sequence[SceneObject], projection: Projection, unit: float) -> None:
    """Draw fitted shapes as lines in their objects' colours; what is hidden thin and faint."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for item in sorted(objects, key=lambda o: o.role != "support_surface"):
        surface = item.role == "support_surface"
        visible, hidden = _shape_lines(item.shape, projection)
        colour, width = object_colour(item.label), (1.2 if surface else 2.2)
        layers = (
            (hidden, colour, 1.0, 0.6),
            (visible, "#111111", width + (1.0 if surface else 1.8), 0.3 if surface else 0.55),
            (visible, colour, width, 1.0),
        )
        for lines, paint, thick, alpha in layers:
            if lines:
                axes.add_artist(
                    PathPatch(
                        Path.make_compound_path(*(Path(line) for line in lines)),
                        fill=False,
                        edgecolor=paint,
                        linewidth=thick * unit,
                        alpha=alpha,
                        capstyle="round",
                        joinstyle="round",
                        zorder=5.0,
                        gid=f"shapes|{item.id}, {item.shape.kind}",
                    )
                )


def _thinned(pixels: Array) -> Array:
    """The ends alone where a line (N, 2) is as good as straight [px]."""
    along = transforms.unit(np.append(pixels[-1] - pixels[0], 0.0))[:2]
    offset = pixels - pixels[0]
    straight = np.abs(offset[:, 0] * along[1] - offset[:, 1] * along[0]).max() <= 0.4
    return pixels[[0, -1]] if straight and not np.allclose(pixels[0], pixels[-1], atol=0.4) else pixels


# The camera's image

TINT = 0.62
"""Share of its object's colour in the colour of a segment; the rest is the image's grey."""
GREY = np.array([0.299, 0.587, 0.114])
"""Shares of red, green and blue in the grey of an image."""
ROOM, LEAST_SHARE = 1.35, 0.5
"""The part shown is this much larger than the objects in it, and this share of the image at least."""


def draw_image(
    view: View, labels: NDArray[np.int32], graph: SupportGraph, width: int, *, small: bool = False
) -> Picture:
    """Draw one view: its image (depth where it has no colour), its segments, and the shapes over it.

    Args:
        view: The view; without a pose the shapes are left out.
        labels: Object number of each pixel (H, W), 0 = nothing.
        graph: The shapes, in the world frame.
        width: Width the image is reduced to [px].
        small: For a contact sheet: larger names, and no shapes.
    """
    found = [o for o in graph.objects if o.role != "support_surface"]
    window = _window(found, view)
    left, top, shown_width, shown_height = window
    box = (
        slice(int(top), int(np.ceil(top + shown_height))),
        slice(int(left), int(np.ceil(left + shown_width))),
    )
    base = view.rgb if view.rgb is not None else _depth_colours(view.depth)
    layers = [_reduced(tinted(base, labels, shown_width)[box], width)]
    if not small:
        layers.insert(0, _reduced(base[box], width))
    projection = None
    if view.T_world_camera is not None and not small:
        projection = Projection(view.T_world_camera, view.K, view.depth)
    tags = [tag for o in found if (tag := name_on(o, labels, projection)) is not None]

    def draw(figure: Any, where: Rectangle) -> None:
        axes, unit = stage(figure, where, (shown_width, shown_height), (left, top))
        scale = shown_width / 640.0
        for number, layer in enumerate(layers):
            _raster(axes, layer, window, zorder=0.1 * number)
        if projection is not None:
            _draw_shapes(axes, graph.objects, projection, unit * scale)
        _draw_tags(axes, tags, (28.0 if small else 15.0) * scale, unit)

    what = "segments" if small else "segments and fitted shapes"
    return Picture(f"{view.name} with its {what}", 640.0, 640.0 * shown_height / shown_width, draw)


def draw_pixels(pixels: NDArray[np.uint8], tags: Sequence[Tag], name: str) -> Picture:
    """Draw an image (H, W, 3) with names on it."""
    height, width = pixels.shape[:2]

    def draw(figure: Any, where: Rectangle) -> None:
        axes, unit = stage(figure, where, (width, height))
        _raster(axes, pixels, (0.0, 0.0, width, height))
        _draw_tags(axes, tags, 28.0 * width / 640.0, unit)

    return Picture(name, 640.0, 640.0 * height / width, draw)


def tinted(image: NDArray[np.uint8], labels: NDArray[np.int32], width: float) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) whose segments have their objects' colours, lit as they are in the image.

    Args:
        image: The image (H, W, 3).
        labels: Object number of each pixel (H, W), 0 = nothing.
        width: Of what is shown of it [px]; stripes keep their size in what is shown.
    """
    segment = (labels != 0) & (labels != SUPPORT_LABEL)
    v, u = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in labels.shape), indexing="ij")
    colour = colours.striped_colours(labels, u, v, 18.0 * width / 640.0)
    tint = TINT * colour + (1.0 - TINT) * (image @ GREY)[..., None]
    return np.where(segment[..., None], tint.round(), image).astype(np.uint8)


def name_on(item: SceneObject, labels: NDArray[np.int32], projection: Projection | None = None) -> Tag | None:
    """Put an object's id on its pixels, or faint on its projected centre where it has none.

    Args:
        item: The object.
        labels: Object number of each pixel (H, W).
        projection: Of the picture; without one an object without pixels has no name there.
    """
    height, width = labels.shape
    v, u = np.nonzero(labels == item.label)
    colour = object_colour(item.label)
    if len(u):
        return Tag(float(np.median(u)), float(np.median(v)), item.id, colour)
    if projection is None:
        return None
    (pixel,), (z,) = projection.project(item.centre_world[None, :])
    if z <= 0.0 or not (0.0 <= pixel[0] < width and 0.0 <= pixel[1] < height):
        return None
    return Tag(float(pixel[0]), float(pixel[1]), item.id, colour, faint=True)


def _window(objects: Sequence[SceneObject], view: View) -> Rectangle:
    """Part of the image that is shown (x, y, width, height) [px]: the objects with room around them."""
    height, width = view.depth.shape
    whole = (0.0, 0.0, float(width), float(height))
    if view.T_world_camera is None:
        return whole
    projection = Projection(view.T_world_camera, view.K, view.depth)
    pixels = [at[z > 0.0] for at, z in (projection.project(o.shape.outline()) for o in objects)]
    inside = np.clip(np.concatenate([*pixels, np.empty((0, 2))]), 0.0, (width, height))
    if len(inside) == 0:
        return whole
    low, high = inside.min(axis=0), inside.max(axis=0)
    share = float(np.clip(((high - low) / (width, height)).max() * ROOM, LEAST_SHARE, 1.0))
    size = share * np.array([width, height], dtype=np.float64)
    corner = np.clip((low + high - size) / 2.0, 0.0, (width, height) - size)
    return float(corner[0]), float(corner[1]), float(size[0]), float(size[1])


def _reduced(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    return np.asarray(Image.fromarray(image).reduce(max(1, round(image.shape[1] / width))))


def _depth_colours(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours (H, W, 3) of a depth image [m], near bright, black where there is no reading."""
    valid = depth > 0.0
    if not valid.any():
        return np.zeros((*depth.shape, 3), dtype=np.uint8)
    near, far = np.percentile(depth[valid], (2.0, 98.0))
    share = (depth.astype(np.float64) - near) / max(far - near, 1e-6)
    return np.where(valid[..., None], colours.scale(share, colours.DEPTH_STOPS), np.uint8(0))


# The fused cloud

CLOUD_WIDTH, CLOUD_POINTS = 720, 200_000
"""Width of a picture of the cloud [px], and points drawn at most, evenly picked (0.1 s)."""
POINT_SIZE = 0.0075
"""Side of a point as drawn [m], the surface's twice that; half more than the spacing leaves no gaps."""
LAMP = np.array([0.0, 0.0, 0.8])
"""What is added to the direction to the eye to get the direction to the lamp."""


def draw_cloud(cloud: Cloud, graph: SupportGraph, azimuth: float) -> Picture:
    """Draw the labelled cloud and the shapes fitted to it, by parallel projection.

    Points are little squares lit from above the eye, pale where one sees a surface from behind.

    Args:
        cloud: The fused points, labelled.
        graph: The shapes.
        azimuth: Direction about the vertical the eye looks from [rad].
    """
    towards_eye = _direction(azimuth, np.deg2rad(28.0))
    frame = _framed(cloud, graph, towards_eye)
    height, width = frame.depth.shape
    labels = np.zeros(len(cloud)) if cloud.labels is None else cloud.labels
    surface = labels == SUPPORT_LABEL
    pixels, depth = _splat(cloud.select(~surface), frame, towards_eye, POINT_SIZE)
    below, depth_below = _splat(cloud.select(surface), frame, towards_eye, 2.0 * POINT_SIZE)
    nearer = (depth_below > 0.0) & ((depth == 0.0) | (depth_below < depth))
    pixels, depth = np.where(nearer[..., None], below, pixels), np.where(nearer, depth_below, depth)
    projection = replace(frame, depth=depth)
    tags = []
    for item in graph.objects:
        if item.role != "support_surface":
            (pixel,), _ = projection.project(item.centre_world[None, :])
            tags.append(Tag(float(pixel[0]), float(pixel[1]), item.id, object_colour(item.label)))

    def draw(figure: Any, where: Rectangle) -> None:
        axes, unit = stage(figure, where, (width, height))
        _raster(axes, pixels, (0.0, 0.0, width, height))
        _draw_shapes(axes, graph.objects, projection, unit)
        _draw_tags(axes, tags, 15.0, unit)

    side = round(float(np.rad2deg(azimuth))) % 360
    return Picture(f"the fused cloud with the fitted shapes, from {side}°", width, height, draw)


def _direction(azimuth: float, elevation: float) -> Array:
    across = np.cos(elevation)
    return np.array([np.cos(azimuth) * across, np.sin(azimuth) * across, np.sin(elevation)])


def _framed(cloud: Cloud, graph: SupportGraph, towards_eye: Array) -> Projection:
    """Place the eye so that all shapes (without any: the middle 96 % of the points) fill the picture."""
    outlines = [o.shape.outline() for o in graph.objects]
    subject = np.concatenate(outlines) if outlines else cloud.points_world
    if len(subject) == 0:
        subject = np.zeros((1, 3))
    centre = subject.mean(axis=0)
    T_world_eye = transforms.look_at(centre + 10.0 * towards_eye, centre)
    seen = transforms.transform(transforms.invert(T_world_eye), subject)[:, :2]
    low, high = (seen.min(axis=0), seen.max(axis=0)) if outlines else np.percentile(seen, (2.0, 98.0), axis=0)
    extent = np.maximum(high - low, 0.05) * 1.08
    height = round(CLOUD_WIDTH * float(np.clip(extent[1] / extent[0], 0.5, 0.8)))
    scale = min(CLOUD_WIDTH / extent[0], height / extent[1])
    middle = (low + high) / 2.0
    corner = (CLOUD_WIDTH / 2.0 - scale * middle[0], height / 2.0 - scale * middle[1])
    projection = parallel_projection(T_world_eye, float(scale), corner)
    return replace(projection, depth=np.zeros((height, CLOUD_WIDTH), dtype=np.float32))


def _splat(
    cloud: Cloud, projection: Projection, towards_eye: Array, size: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Paint the points far to near, `size` [m] wide; return pixels (H, W, 4) and distances (H, W) [m]."""
    stride = max(1, -(-len(cloud) // CLOUD_POINTS))
    points_world, normals_world = cloud.points_world[::stride], cloud.normals_world[::stride]
    labels = np.zeros(len(points_world), dtype=np.int32) if cloud.labels is None else cloud.labels[::stride]
    facing = np.nan_to_num(normals_world @ towards_eye)
    light = np.nan_to_num(normals_world @ transforms.unit(towards_eye + LAMP))
    at, z = projection.project(points_world)
    colour = colours.striped_colours(labels, at[:, 0], at[:, 1], 15.0) * (0.5 + 0.5 * np.abs(light))[:, None]
    colour = np.where(facing[:, None] < 0.0, 0.7 * 255.0 + 0.3 * colour, colour)
    order = np.argsort(-z)
    height, width = projection.depth.shape
    half = max(1, round(size * projection.K[0, 0] / 2.0))
    offset = np.arange(-half, half)
    u = np.rint(at[order, 0]).astype(int)[:, None, None] + offset[None, None, :]
    v = np.rint(at[order, 1]).astype(int)[:, None, None] + offset[None, :, None]
    u, v = np.broadcast_arrays(u, v)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    target = (v * width + u)[inside]
    source = np.broadcast_to(order[:, None, None], u.shape)[inside]
    pixels = np.zeros((height * width, 4), dtype=np.uint8)
    pixels[target, :3] = colour[source].round()
    pixels[target, 3] = 255
    depth = np.zeros(height * width, dtype=np.float32)
    depth[target] = z[source]
    return pixels.reshape(height, width, 4), depth.reshape(height, width)


def draw_solid(shape: Shape, colour: str) -> Picture:
    """Draw one shape as it stands in the world, filling the picture.

    Args:
        shape: What to draw.
        colour: Of its surface, `#rrggbb`.
    """
    from scipy.spatial import ConvexHull

    side = 150.0
    towards_eye = transforms.unit(np.array([-1.0, -0.6, 0.7]))
    centre_world = shape.T_world_object[:3, 3]
    eye_world = centre_world + 10.0 * towards_eye
    outline = shape.outline()
    reach = max(float(np.linalg.norm(outline - centre_world, axis=1).max()), 1e-9)
    scale = (side / 2.0 - 8.0) / reach
    view = parallel_projection(transforms.look_at(eye_world, centre_world), scale, (side / 2.0, side / 2.0))
    rim = view.project(outline)[0]
    rim = rim[ConvexHull(rim).vertices]
    lines = shape.lines(eye_world)

    def draw(figure: Any, where: Rectangle) -> None:
        axes, unit = stage(figure, where, (side, side))
        axes.fill(*rim.T, facecolor=colour, alpha=0.4)
        for line in lines:
            pixels, _ = view.project(line)
            # From a point on the near side of a convex solid a step towards the eye leads out of it.
            near = shape.signed_distance(line + 1e-3 * reach * towards_eye) > 0.0
            for start, stop in _runs(near):
                look = (INK, "-", 1.6) if near[start] else (SOFT, (0, (3, 3)), 1.0)
                paint, dash, width = look
                axes.plot(*pixels[start : stop + 1].T, color=paint, linestyle=dash, linewidth=width * unit)

    return Picture(f"a {shape.kind}", side, side, draw)


# The view sphere

SIDE, RADIUS = 400.0, 158.0
"""Width of each of the two pictures of the view sphere, and radius of the sphere in them [px]."""
PAINTED_WIDTH = 260
"""Width of the painted sphere [px]; one cell of 40,000 is 2 px."""
DENSE = 200
"""More candidates than this are painted as an area, fewer as dots."""
REACH = np.deg2rad(1.6)
"""A point of the sphere counts as reachable within this angle of a candidate [rad]; 1.5 cells of 40,000."""
VISITED_COLOUR, CHOSEN_COLOUR = "#2d3748", "#111111"
"""Plates of the views' numbers."""

Place = Callable[[Array], tuple[Array, NDArray[np.bool_]]]
"""Where directions (N, 3) are drawn: pixels (N, 2), and which of them are on the far side."""


def draw_sphere(step: Step) -> Picture:
    """Draw the view sphere (the paper's Fig. 4): in space with the points of interest's rays, and from above.

    Full colour where the robot can bring its camera, washed out elsewhere. The picture from above holds the
    whole upper half, zenith in the middle and horizon on the rim.
    """
    sphere, visited = step.sphere, step.visited
    chosen = None if step.decision is None else sphere.direction_of(step.decision.T_world_camera)
    points = (
        [] if step.decision is None else sorted(step.decision.points_of_interest, key=lambda p: p.saliency)
    )
    T_world_eye = _sphere_eye(step, chosen)
    space = parallel_projection(T_world_eye, RADIUS / sphere.radius, (SIDE / 2.0, SIDE / 2.0))

    def in_space(directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        at, _ = space.project(sphere.centre_world + sphere.radius * directions)
        return at, directions @ T_world_eye[:3, 2] > 0.0

    def from_above(directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        polar = np.arccos(np.clip(directions[:, 2], -1.0, 1.0)) / (np.pi / 2.0)
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        shown = np.minimum(polar, 1.0)[:, None] * np.stack([np.cos(azimuth), -np.sin(azimuth)], axis=-1)
        return (1.5 * SIDE, SIDE / 2.0) + RADIUS * shown, polar > 1.02

    axis = (np.arange(PAINTED_WIDTH) + 0.5) / PAINTED_WIDTH * 2.0 - 1.0
    x, y = np.meshgrid(axis, axis)
    inside = np.hypot(x, y) <= 1.0
    z = -np.sqrt(np.maximum(0.0, 1.0 - x**2 - y**2))
    directions = np.stack([x, y, z], axis=-1) @ T_world_eye[:3, :3].T
    ball = _painted(step, directions, inside)
    fading = np.clip(1.0 + directions[..., 2] / 0.35, 0.12, 1.0)
    ball[..., 3] = np.where(inside, 235.0 * fading, 0.0).astype(np.uint8)
    polar, azimuth = np.hypot(x, y) * np.pi / 2.0, np.arctan2(-y, x)
    across = np.sin(polar)
    disc = _painted(
        step, np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(polar)], -1), inside
    )
    circle = np.linspace(-np.pi, np.pi, 181)

    def draw(figure: Any, where: Rectangle) -> None:
        axes, unit = stage(figure, where, (2.0 * SIDE, SIDE))
        for middle, pixels in ((SIDE / 2.0, ball), (1.5 * SIDE, disc)):
            corner = (middle - RADIUS, SIDE / 2.0 - RADIUS, 2.0 * RADIUS, 2.0 * RADIUS)
            _raster(axes, pixels, corner)
            ring = np.array([middle, SIDE / 2.0])[:, None] + RADIUS * np.array(
                [np.cos(circle), np.sin(circle)]
            )
            axes.plot(*ring, color=SOFT, linewidth=unit)
        faint: dict[str, Any] = {
            "color": "#444444",
            "alpha": 0.35,
            "linewidth": unit,
            "linestyle": (0, (2, 3)),
        }
        for place, elevations in ((in_space, (0.0,)), (from_above, (30.0, 60.0))):
            for elevation in elevations:
                at, behind = place(np.array([_direction(a, np.deg2rad(elevation)) for a in circle]))
                axes.plot(*np.where(behind[:, None], np.nan, at).T, **faint)
                if elevation:
                    axes.text(
                        at[135, 0], at[135, 1] + 4.0, f"{elevation:.0f}°", fontsize=11.0 * unit, ha="center"
                    )
        _draw_shapes(axes, step.graph.objects, space, unit)
        track, _ = from_above(visited)
        axes.plot(*track.T, color=VISITED_COLOUR, alpha=0.75, linewidth=1.4 * unit)
        for place in (in_space, from_above):
            _draw_points_of_interest(axes, points, place, space if place is in_space else None, unit)
            _draw_views(axes, step, chosen, place, unit)
        for text, left in (("in space", 14.0), ("from above", SIDE + 14.0)):
            axes.text(left, 22.0, text, fontsize=12.5 * unit, fontweight="bold")
        for text, x, y in (("x", RADIUS + 12.0, 4.0), ("y", 0.0, -RADIUS - 8.0)):
            axes.text(
                1.5 * SIDE + x,
                SIDE / 2.0 + y,
                text,
                fontsize=12.5 * unit,
                style="italic",
                color=SOFT,
                ha="center",
            )
        bar = np.tile(np.linspace(-1.0, 1.0, 150), (2, 1))
        _raster(
            axes, colours.scale(bar, colours.SALIENCY_STOPS), (2.0 * SIDE - 166.0, SIDE - 20.0, 150.0, 9.0)
        )
        for shift, text in ((0.0, "−1"), (75.0, "0"), (150.0, "+1")):
            axes.text(
                2.0 * SIDE - 166.0 + shift, SIDE - 25.0, text, fontsize=11.0 * unit, color=SOFT, ha="center"
            )
        axes.text(2.0 * SIDE - 174.0, SIDE - 12.0, "saliency", fontsize=11.0 * unit, color=SOFT, ha="right")

    return Picture(f"view sphere with its saliency after view {step.index}", 2.0 * SIDE, SIDE, draw)


def _sphere_eye(step: Step, chosen: Array | None) -> Array:
    """Look from between the current and the chosen view, so that both are on the near side if they can."""
    current = step.visited[-1] if len(step.visited) else np.array([1.0, 0.0, 0.0])
    azimuth = float(np.arctan2(current[1], current[0]))
    if chosen is not None:
        turn = np.arctan2(chosen[1], chosen[0]) - azimuth
        azimuth += float(np.arctan2(np.sin(turn), np.cos(turn))) / 2.0
    centre = step.sphere.centre_world
    return transforms.look_at(
        centre + 10.0 * step.sphere.radius * _direction(azimuth, np.deg2rad(32.0)), centre
    )


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
        colour = np.where(reachable[:, None], colour, 0.72 * grey + 0.28 * colour)
    pixels = np.zeros((*inside.shape, 4), dtype=np.uint8)
    pixels[inside, :3] = colour.round()
    pixels[inside, 3] = 255
    return pixels


def _draw_points_of_interest(
    axes: Axes, points: Sequence[PointOfInterest], place: Place, space: Projection | None, unit: float
) -> None:
    """Draw points of interest on the sphere, the most salient on top; in space with their rays."""
    for point in points:
        (end,), (behind,) = place(point.direction[None, :])
        alpha = 0.3 if behind else 1.0
        if space is not None:
            (start,), _ = space.project(point.position_world[None, :])
            axes.plot(
                *np.array([start, end]).T, color="#111111", alpha=0.5 * alpha, linewidth=unit, zorder=5.5
            )
        title = f"{' – '.join(point.subject)}: saliency {point.saliency:.2f}; {point.why}"
        axes.plot(
            *end, "o", markersize=8.0 * unit, markerfacecolor=colours.saliency_colour(point.saliency),
            markeredgecolor="#111111", markeredgewidth=0.9 * unit, alpha=alpha, zorder=6.0,
            gid=f"point|{title}",
        )  # fmt: skip


def _draw_views(axes: Axes, step: Step, chosen: Array | None, place: Place, unit: float) -> None:
    """Mark single candidates, the numbered views made so far and the next view."""
    ring: dict[str, Any] = {"markeredgecolor": "#111111", "zorder": 6.5}
    if step.candidates is not None and len(step.candidates) <= DENSE:
        for at, behind in zip(*place(step.candidates.directions), strict=True):
            look: dict[str, Any] = {
                "markerfacecolor": "white",
                "markeredgewidth": unit,
                "alpha": 0.3 if behind else 1.0,
            }
            axes.plot(*at, "o", markersize=6.4 * unit, **look, **ring)
    tags = []
    for number, (at, behind) in enumerate(zip(*place(step.visited), strict=True)):
        axes.plot(
            *at, "o", color=VISITED_COLOUR, markersize=7.0 * unit, alpha=0.3 if behind else 1.0, zorder=6.5
        )
        tags.append(Tag(float(at[0]), float(at[1]) - 15.0, str(number), VISITED_COLOUR, faint=bool(behind)))
    if chosen is not None:
        (at,), (behind,) = place(chosen[None, :])
        alpha = 0.3 if behind else 1.0
        axes.plot(
            *at, "o", color="#8a8f96", markersize=17.0 * unit, markeredgewidth=2.0 * unit, alpha=alpha, **ring
        )
        axes.plot(
            *at,
            "o",
            color="#111111",
            markersize=6.0 * unit,
            alpha=alpha,
            zorder=6.6,
            gid="chosen|the next view",
        )
        tags.append(Tag(float(at[0]), float(at[1]) - 20.0, "next", CHOSEN_COLOUR, faint=bool(behind)))
    _draw_tags(axes, tags, 13.0, unit)


# Charts

DASHES, MARKS = ("-", (0, (4, 2)), (0, (1, 1.6)), (0, (6, 2, 1, 2))), "osD^"
"""Styles of lines and of their points: what tells lines apart beside their colours."""


def line_chart(
    title: str,
    x_name: str,
    x: Sequence[float],
    lines: Mapping[str, Sequence[float]],
    y_name: str,
    y_range: tuple[float, float] | None = None,
) -> Picture:
    """Draw lines over x, the first on top and the others' points wider, so that all are seen where they meet.

    Args:
        title: What the chart shows.
        x_name: Name and unit of the x axis.
        x: Abscissae, ascending.
        lines: Ordinates of each line by its name; NaN leaves a gap.
        y_name: Name and unit of the y axis.
        y_range: Ends of the y axis; None to begin at 0.
    """

    def plot(axes: Axes) -> None:
        for k, (name, values) in enumerate(lines.items()):
            look: dict[str, Any] = {"color": colours.SERIES[k], "zorder": 3.0 - 0.1 * k, "clip_on": False}
            axes.plot(x, values, linewidth=2.0, linestyle=DASHES[k], label=name, **look)
            for at, value in zip(x, values, strict=True):
                if np.isfinite(value):
                    gid, size = f"note|{name} {value:.3g}", 6.0 + 2.0 * k
                    axes.plot([at], [value], MARKS[k], markersize=size, markeredgewidth=0, gid=gid, **look)
        axes.set_xlim(x[0], x[-1] if x[-1] > x[0] else x[0] + 1.0)
        axes.set_ylim(*(y_range or (0.0, None)))

    return _chart(plot, title, x_name, y_name, whole=all(float(value).is_integer() for value in x))


def bar_chart(title: str, x_name: str, bars: Sequence[Mapping[str, float]], y_name: str) -> Picture:
    """Draw stacked bars, one for each mapping of part to height, numbered from 0.

    Args:
        title: What the chart shows.
        x_name: What the numbers count.
        bars: Part → height, bar by bar.
        y_name: Name and unit of the heights.
    """
    parts = list(dict.fromkeys(name for bar in bars for name in bar))

    def plot(axes: Axes) -> None:
        base, width = np.zeros(len(bars)), 0.66 * min(1.0, len(bars) / 3.0)
        for k, name in enumerate(parts):
            heights = [bar.get(name, 0.0) for bar in bars]
            colour = colours.SERIES[k % len(colours.SERIES)]
            drawn = axes.bar(
                range(len(bars)),
                heights,
                width,
                base,
                label=name,
                color=colour,
                edgecolor="white",
                linewidth=0.5,
            )
            for patch, height in zip(drawn, heights, strict=True):
                patch.set_gid(f"note|{name} {height:.3g}")
            base += heights
        axes.set_xlim(-0.5, len(bars) - 0.5)

    return _chart(plot, title, x_name, y_name, whole=True)


def _chart(plot: Callable[[Axes], None], title: str, x_name: str, y_name: str, *, whole: bool) -> Picture:
    width, height = 320.0, 260.0

    def draw(figure: Any, where: Rectangle) -> None:
        from matplotlib.ticker import MaxNLocator

        left, bottom, w, h = where
        unit = w * figure.get_figure().get_size_inches()[0] * 72.0 / width
        axes = figure.add_axes((left + 0.16 * w, bottom + 0.3 * h, 0.8 * w, 0.57 * h))
        axes.spines[:].set_visible(False)
        axes.grid(axis="y")
        axes.xaxis.set_major_locator(MaxNLocator(10 if whole else 5, integer=whole, min_n_ticks=1))
        axes.tick_params(labelsize=11.0 * unit)
        plot(axes)
        axes.set_xlabel(x_name, fontsize=11.0 * unit)
        axes.set_ylabel(y_name, fontsize=11.0 * unit)
        figure.text(left + 0.02 * w, bottom + 0.93 * h, title, fontsize=12.0 * unit, fontweight="bold")
        if len(axes.get_legend_handles_labels()[1]) > 1:
            corner = (left, bottom + 0.18 * h)
            figure.legend(
                *axes.get_legend_handles_labels(), loc="upper left", bbox_to_anchor=corner, ncols=4,
                fontsize=9.5 * unit,
                handlelength=1.5, handletextpad=0.4, columnspacing=1.0,
            )  # fmt: skip

    return Picture(title, width, height, draw)
