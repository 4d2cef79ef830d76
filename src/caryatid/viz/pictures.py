"""The model of a picture: SVG elements, which report, notebook cells, viewer and docs put into their pages.

The same picture gives the same bytes, and loads nothing.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, tostring

import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image

from caryatid.geometry.transforms import Array
from caryatid.viz.colours import ink_on

THEME = {
    "ink": "#1d2126", "soft": "#5d666f", "line": "#dcdfe2", "doubt": "#b4480b", "wrong": "#c01048",
}  # fmt: skip
"""Colours that a page may replace by its own, so that drawings can be read on light and dark."""
INK, SOFT, LINE, DOUBT, WRONG = (f"var(--{name}, {colour})" for name, colour in THEME.items())


@dataclass(frozen=True, eq=False, slots=True)
class Picture:
    """A drawing.

    Attributes:
        name: What it shows, for those who cannot see it.
        width: Its natural width [px].
        height: Its natural height [px].
        parts: Its SVG elements in pixels of that size, y down, the hindmost first.
    """

    name: str
    width: float
    height: float
    parts: Sequence[Element]


def picture_svg(picture: Picture) -> str:
    """Return a picture as an SVG element that stands inside an HTML page."""
    role = "group" if any(part.tag == "a" for part in picture.parts) else "img"  # An image has no links.
    look = {"role": role, "aria_label": picture.name, "font_family": "system-ui, DejaVu Sans, sans-serif"}
    root = element("svg", viewBox=f"0 0 {picture.width:g} {picture.height:g}", **look)
    root.extend(picture.parts)
    return tostring(root, encoding="unicode")


# Elements


def element(tag: str, **look: Any) -> Element:
    """An SVG element; `_` stands for the `-` in names of attributes."""
    numbers = {name: value if isinstance(value, str) else f"{value:.4g}" for name, value in look.items()}
    return Element(tag, {name.replace("_", "-"): value for name, value in numbers.items()})


def group(parts: Iterable[Element], kind: str, title: str = "") -> Element:
    """Elements of a class, with a tooltip."""
    whole = element("g", **{"class": kind})
    if title:
        whole.append(element("title"))
        whole[0].text = title
    whole.extend(parts)
    return whole


def line(points: Array, colour: str, width: float, **look: Any) -> Element:
    """A line through points (N, 2), interrupted where they are NaN."""
    gaps = np.flatnonzero(np.isnan(points).any(axis=1))
    pieces = [piece[~np.isnan(piece).any(axis=1)] for piece in np.split(points, gaps)]
    shown = [shapely.simplify(shapely.linestrings(piece), 0.2) for piece in pieces if len(piece) > 1]
    course = " ".join("M" + " ".join(f"{x:.1f},{y:.1f}" for x, y in piece.coords) for piece in shown)
    known = {"fill": "none", "stroke_linecap": "round", "stroke_linejoin": "round"}
    return element("path", d=course, stroke=colour, stroke_width=width, **(known | look))


def area(corners: Array, colour: str, **look: Any) -> Element:
    """A filled polygon with corners (N, 2)."""
    return element("polygon", points=" ".join(f"{x:.1f},{y:.1f}" for x, y in corners), fill=colour, **look)


def dot(at: Array, radius: float, colour: str, **look: Any) -> Element:
    """A filled circle about a place (2,)."""
    return element("circle", cx=float(at[0]), cy=float(at[1]), r=radius, fill=colour, **look)


def text(x: float, y: float, words: str, size: float, colour: str, **look: Any) -> Element:
    """Words, their middle at a place."""
    known = {"text_anchor": "middle", "dominant_baseline": "central"}
    written = element("text", x=x, y=y, font_size=size, fill=colour, **(known | look))
    written.text = words
    return written


def raster(
    pixels: NDArray[np.uint8], left: float, top: float, width: float, height: float, kind: str = "raster"
) -> Element:
    """Pixels (H, W, C), stretched to a place."""
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "WEBP", quality=65, method=2)
    data = base64.b64encode(content.getvalue()).decode("ascii")
    look = {"class": kind, "preserveAspectRatio": "none", "href": f"data:image/webp;base64,{data}"}
    return element("image", x=left, y=top, width=width, height=height, **look)


# Names


class Tag(NamedTuple):
    """A short name on a coloured plate, with where it belongs [px]; faint if it cannot be seen here."""

    x: float
    y: float
    text: str
    colour: str
    faint: bool = False


def draw_tags(tags: Sequence[Tag], width: float, height: float, size: float) -> list[Element]:
    """Draw tags, moved until they cover neither each other nor the edge of a picture.

    Letters are `size` [px] high, or lower where the tags would otherwise fill more than a sixth of the
    picture; below 6 px they could not be read and are left out.
    """
    anchors = np.array([tag[:2] for tag in tags]).reshape(-1, 2)
    plates = np.array([[0.62 * len(tag.text) + 1.0, 1.45] for tag in tags]).reshape(-1, 2)  # [letters]
    size = min(size, float(np.sqrt(width * height / 6.0 / max(plates.prod(axis=1).sum(), 1.0))))
    if size < 6.0:
        return []
    plates *= size
    parts = []
    centres = keep_apart(anchors, plates + 2.0, np.array([width, height]))
    for tag, anchor, centre, (wide, high) in zip(tags, anchors, centres, plates, strict=True):
        if np.hypot(*(anchor - centre)) > high:
            parts.append(line(np.stack([anchor, centre]), "white", 1.4))
        left, top = centre - (wide / 2.0, high / 2.0)
        look = {"fill": tag.colour, "stroke": "white", "opacity": "0.6" if tag.faint else "1"}
        parts.append(element("rect", x=left, y=top, width=wide, height=high, rx=high / 2.0, **look))
        parts.append(text(centre[0], centre[1], tag.text, size, ink_on(tag.colour), font_weight="bold"))
    return [group(parts, "shapes")]


def keep_apart(anchors: Array, sizes: Array, room: Array) -> Array:
    """Move the centres (N, 2) of plates of `sizes` (N, 2) as little as it takes for none to overlap.

    Plates that overlap are pushed apart along the axis on which they overlap least, for 200 rounds at most.

    Args:
        anchors: Where the plates belong (N, 2) [px].
        sizes: Their widths and heights (N, 2) [px].
        room: Width and height (2,) of where they may be [px].
    """
    from scipy.spatial import KDTree

    low = sizes / 2.0
    high = np.maximum(room - low, low)
    centres = np.clip(anchors, low, high)
    for _ in range(200 if len(centres) else 0):
        a, b = KDTree(centres / sizes.max(axis=0)).query_pairs(1.0, np.inf, output_type="ndarray").T
        gap = centres[a] - centres[b]
        overlap = low[a] + low[b] - np.abs(gap)
        pushed = (overlap == overlap.min(axis=1, keepdims=True)) & (overlap > 1e-6).all(axis=1, keepdims=True)
        if not pushed.any():
            break
        push = 0.5 * pushed * overlap * np.where(gap == 0.0, -1.0, np.sign(gap))
        np.add.at(centres, a, push)
        np.add.at(centres, b, -push)
        centres = np.clip(centres, low, high)
    return centres
