"""SVG as text: elements, paths, labels that keep clear of each other, and pixels put in as data."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.geometry.transforms import Array
from caryatid.viz.colours import ink_on

GLYPH_WIDTH = 0.6
"""Mean width of a letter in font sizes."""


def element(tag: str, *children: str, **attributes: object) -> str:
    """Write one element; children are markup already, attributes are escaped here.

    Names of attributes: `_` stands for `-`, and one at the end is dropped (`class_`). None leaves one out.
    """
    pairs = [
        f' {name.rstrip("_").replace("_", "-")}="{_value(value)}"'
        for name, value in attributes.items()
        if value is not None
    ]
    opening = f"<{tag}{''.join(pairs)}"
    return f"{opening}>{''.join(children)}</{tag}>" if children else f"{opening}/>"


def text(x: float, y: float, content: str, **attributes: object) -> str:
    """Write a text; its content is escaped.

    Args:
        x: Where it begins [px].
        y: Its base line [px].
        content: What it says.
        **attributes: As in `element`.
    """
    return element("text", escape(content), x=x, y=y, **attributes)


def tooltip(content: str) -> str:
    """Write the title that is shown when the pointer rests on the parent element."""
    return element("title", escape(content)) if content else ""


def path(points: Array, closed: bool = False) -> str:
    """Write path data through points (N, 2)."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("Z" if closed else "")


def picture(
    width: float,
    height: float,
    *children: str,
    name: str,
    text_size: float = 13.0,
    corner: tuple[float, float] = (0.0, 0.0),
) -> str:
    """Write a whole SVG that grows with the page.

    Args:
        width: Of what is shown [px].
        height: Of what is shown [px].
        children: Markup.
        name: What a screen reader says of it.
        text_size: Height of letters [px].
        corner: Upper left corner of what is shown [px].
    """
    return element(
        "svg",
        *children,
        viewBox=f"{corner[0]:g} {corner[1]:g} {width:g} {height:g}",
        role="img",
        aria_label=name,
        font_size=text_size,
    )


def raster(
    pixels: NDArray[np.uint8], x: float, y: float, width: float, height: float, jpeg: int | None = None
) -> str:
    """Put pixels into a picture, as PNG or JPEG.

    Args:
        pixels: (H, W), (H, W, 3) or (H, W, 4).
        x: Left edge [px].
        y: Upper edge [px].
        width: What it takes [px].
        height: What it takes [px].
        jpeg: Quality, or None for PNG.
    """
    image = Image.fromarray(pixels)
    buffer = io.BytesIO()
    if jpeg is None:
        if pixels.ndim == 3 and pixels.shape[2] == 4:
            image = image.quantize(256, method=Image.Quantize.FASTOCTREE)
        image.save(buffer, "PNG", compress_level=9)
    else:
        image.save(buffer, "JPEG", quality=jpeg)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    kind = "png" if jpeg is None else "jpeg"
    return element(
        "image",
        href=f"data:image/{kind};base64,{data}",
        x=x,
        y=y,
        width=width,
        height=height,
        preserveAspectRatio="none",
    )


@dataclass(frozen=True, slots=True)
class Tag:
    """A short name on a coloured plate.

    Attributes:
        x: Where it belongs [px].
        y: Where it belongs [px].
        content: What it says.
        colour: Colour of the plate, `#rrggbb`.
        faint: What it names cannot be seen here.
    """

    x: float
    y: float
    content: str
    colour: str
    faint: bool = False


def tags(items: Sequence[Tag], bounds: tuple[float, float, float, float], size: float) -> str:
    """Write tags into a picture, moved until they cover neither each other nor the edge.

    A tag moved by more than its height gets a line to where it belongs.

    Args:
        items: The tags.
        bounds: Left, top, right and bottom of the picture [px].
        size: Height of letters [px].
    """
    if not items:
        return ""
    anchors = np.array([[item.x, item.y] for item in items])
    plates = np.array([[len(item.content) * GLYPH_WIDTH * size + 0.7 * size, 1.35 * size] for item in items])
    centres = keep_apart(anchors, plates + 2.0, bounds)
    leaders, drawn = [], []
    for item, anchor, (x, y), (w, h) in zip(items, anchors, centres, plates, strict=True):
        if np.hypot(*(anchor - (x, y))) > h:
            leaders.append(element("path", d=path(np.array([anchor, (x, y)])), class_="leader"))
        plate = element("rect", x=x - w / 2, y=y - h / 2, width=w, height=h, rx=h / 4, fill=item.colour)
        name = text(x, y + 0.35 * size, item.content, fill=ink_on(item.colour), font_size=size)
        drawn.append(element("g", plate, name, class_="tag faint" if item.faint else "tag"))
    return "".join(leaders + drawn)


def keep_apart(anchors: Array, sizes: Array, bounds: tuple[float, float, float, float]) -> Array:
    """Move the centres (N, 2) of plates of `sizes` (N, 2) as little as it takes for none to overlap.

    Pairs that overlap are pushed apart along the axis on which they overlap least, for a fixed number of
    rounds.
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


def _value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.1f}".rstrip("0").rstrip(".") if abs(value) >= 1.0 else f"{value:.3g}"
    return escape(str(value))
