"""Pictures drawn with matplotlib, whoever shows them: the report, its PDF, notebook cells, the docs.

No display is needed, the user's own matplotlib settings have no effect, and the same picture gives the same
bytes.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.geometry.transforms import Array
from caryatid.viz.colours import ink_on

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
    "grid.color": LINE,
    "xtick.labelcolor": SOFT,
    "ytick.labelcolor": SOFT,
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "legend.frameon": False,
    "legend.labelcolor": SOFT,
    "legend.handlelength": 1.5,
    "legend.handletextpad": 0.4,
    "legend.columnspacing": 1.0,
    "path.simplify_threshold": 0.4,
    "image.interpolation": "none",
    "image.composite_image": False,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
"""matplotlib's settings that differ from its defaults."""

Rectangle = tuple[float, float, float, float]
"""Left, bottom, width and height, in shares of a figure."""


@dataclass(frozen=True, eq=False, slots=True)
class Picture:
    """A drawing that can be put into any matplotlib figure.

    Attributes:
        name: What it shows, for those who cannot see it; no two pictures of a page share a name.
        width: Its natural width [px].
        height: Its natural height [px].
        draw: Draws it into axes in pixels of that size, y down.
    """

    name: str
    width: float
    height: float
    draw: Callable[[Axes], None]

    def put(self, figure: Any, where: Rectangle) -> None:
        """Draw it into a rectangle of a figure, lines and letters scaled with it."""
        axes = figure.add_axes(where)
        axes.set_axis_off()
        axes.set(xlim=(0.0, self.width), ylim=(self.height, 0.0), autoscale_on=False)
        self.draw(axes)
        unit = where[2] * figure.get_size_inches()[0] * 72.0 / self.width
        if unit == 1.0:
            return
        artists = [*axes.texts, *axes.lines, *axes.patches]
        for artist in (*artists, *(a for inset in axes.child_axes for a in inset.findobj())):
            for size in ("fontsize", "linewidth", "markersize", "markeredgewidth"):
                if hasattr(artist, f"set_{size}"):
                    getattr(artist, f"set_{size}")(unit * getattr(artist, f"get_{size}")())


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
    root = ElementTree.fromstring(
        _saved(picture, "svg", picture.name, transparent=True, metadata={"Date": None})
    )
    for child in list(root):
        if child.tag.endswith("metadata") or child.find(".//{*}style") is not None:
            root.remove(child)
    size = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib |= {"viewBox": size, "role": "img", "aria-label": picture.name}
    rasters = 0
    for node in root.iter():
        node.tag = node.tag.rpartition("}")[2]
        node.attrib = {key.rpartition("}")[2]: " ".join(text.split()) for key, text in node.attrib.items()}
        node.tail = None
        if node.tag == "image":
            del node.attrib["id"]
            node.attrib |= {"href": _as_webp(node.attrib["href"]), "class": f"raster{rasters}"}
            node.set("preserveAspectRatio", "none")
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


def picture_png(picture: Picture) -> bytes:
    """Return a picture as the bytes of a PNG."""
    return _saved(picture, "png", dpi=72, metadata={"Software": None})


def _saved(picture: Picture, kind: str, salt: str = "caryatid", **options: Any) -> bytes:
    from matplotlib.figure import Figure

    with own_style(salt):
        figure = Figure(figsize=(picture.width / 72.0, picture.height / 72.0))
        picture.put(figure, (0.0, 0.0, 1.0, 1.0))
        content = io.BytesIO()
        figure.savefig(content, format=kind, **options)
    return content.getvalue()


def _as_webp(href: str) -> str:
    """The PNG of an image element, several times smaller."""
    buffer = io.BytesIO()
    data = base64.b64decode(href.partition(",")[2])
    Image.open(io.BytesIO(data)).save(buffer, "WEBP", quality=80, method=2)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def put_raster(
    axes: Axes, pixels: NDArray[np.uint8], left: float, top: float, width: float, height: float
) -> None:
    """Put pixels (H, W, C) into a picture's axes; the place is in pixels of the picture."""
    axes.imshow(pixels, extent=(left, left + width, top + height, top), aspect="auto", clip_on=False)


class Tag(NamedTuple):
    """A short name on a coloured plate, with where it belongs [px]; faint if it cannot be seen here."""

    x: float
    y: float
    text: str
    colour: str
    faint: bool = False


def put_tags(axes: Axes, tags: Sequence[Tag], size: float) -> None:
    """Write tags, letters `size` [px] high, moved until they cover neither each other nor the edge."""
    if not tags:
        return
    anchors = np.array([[tag.x, tag.y] for tag in tags])
    plates = np.array([[(0.62 * len(tag.text) + 0.7) * size, 1.45 * size] for tag in tags])
    centres = keep_apart(anchors, plates + 2.0, (axes.get_xlim()[1], axes.get_ylim()[0]))
    for tag, anchor, (x, y) in zip(tags, anchors, centres, strict=True):
        if np.hypot(*(anchor - (x, y))) > plates[0, 1]:
            axes.plot(*np.array([anchor, (x, y)]).T, color="white", linewidth=1.4, zorder=7.0, gid="shapes|")
        alpha = 0.6 if tag.faint else 1.0
        plate = {"boxstyle": "round,pad=0.22", "facecolor": tag.colour, "edgecolor": "white", "alpha": alpha}
        axes.text(
            x, y, tag.text, color=ink_on(tag.colour), fontsize=size, fontweight="bold", ha="center",
            va="center_baseline", bbox=plate | {"gid": "shapes|"}, alpha=alpha, zorder=8.0, gid="shapes|",
        )  # fmt: skip


def keep_apart(anchors: Array, sizes: Array, room: tuple[float, float]) -> Array:
    """Move the centres (N, 2) of plates of `sizes` (N, 2) as little as it takes for none to overlap.

    Plates that overlap are pushed apart along the axis on which they overlap least, for 200 rounds at most.

    Args:
        anchors: Where the plates belong (N, 2) [px].
        sizes: Their widths and heights (N, 2) [px].
        room: Width and height of where they may be [px].
    """
    low = sizes / 2.0
    high = np.maximum(np.asarray(room) - low, low)
    centres = np.clip(anchors, low, high)
    order = np.sign(np.arange(len(centres))[:, None] - np.arange(len(centres)))[..., None]
    for _ in range(200):
        gap = centres[:, None] - centres
        overlap = (sizes[:, None] + sizes) / 2.0 - np.abs(gap)
        least = overlap == overlap.min(axis=-1, keepdims=True)
        pushed = least & (order != 0) & (overlap > 1e-6).all(axis=-1, keepdims=True)
        if not pushed.any():
            break
        away = np.where(gap == 0.0, order, np.sign(gap))
        centres = np.clip(centres + 0.5 * (pushed * overlap * away).sum(axis=1), low, high)
    return centres
