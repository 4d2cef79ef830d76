"""Pictures drawn with matplotlib for the report, its PDF, notebook cells and the docs.

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
from html import escape
from itertools import count
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.geometry.transforms import Array
from caryatid.viz.colours import ink_on

if TYPE_CHECKING:
    from matplotlib.axes import Axes

THEME = {
    "ink": "#1d2126", "soft": "#5d666f", "line": "#dcdfe2", "doubt": "#b4480b", "wrong": "#c01048",
}  # fmt: skip
"""Colours that a page may replace by its own, so that drawings can be read on light and dark."""
INK, SOFT, LINE, DOUBT, WRONG = THEME.values()
STYLE = {
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
    "path.simplify_threshold": 0.4,
    "lines.solid_capstyle": "round",
    "image.interpolation": "none",
    "image.composite_image": False,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
"""matplotlib's settings that differ from its defaults."""


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

    def put(self, figure: Any, where: tuple[float, float, float, float]) -> None:
        """Draw it into a figure, lines and letters scaled with it: left, bottom, width, height [shares]."""
        axes = figure.add_axes(where)
        axes.set_axis_off()
        axes.set(xlim=(0.0, self.width), ylim=(self.height, 0.0), autoscale_on=False)
        self.draw(axes)
        unit = where[2] * figure.get_size_inches()[0] * 72.0 / self.width
        if unit == 1.0:
            return
        artists = [*axes.texts, *axes.lines, *axes.patches, *axes.collections]
        for artist in (*artists, *(part for inset in axes.child_axes for part in inset.findobj())):
            for size in ("fontsize", "linewidth", "markersize", "markeredgewidth", "mutation_scale"):
                if hasattr(artist, f"set_{size}"):
                    getattr(artist, f"set_{size}")(np.multiply(unit, getattr(artist, f"get_{size}")()))


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
    numbers = count()

    def raster(found: re.Match[str]) -> str:
        """An image element with its PNG as WebP, several times smaller."""
        content = io.BytesIO()
        Image.open(io.BytesIO(base64.b64decode(found[1]))).save(content, "WEBP", quality=65, method=2)
        data = base64.b64encode(content.getvalue()).decode("ascii")
        form = f'class="raster{next(numbers)}" preserveAspectRatio="none"'
        return f'<image {form} href="data:image/webp;base64,{data}"'

    saved = _saved(picture, "svg", picture.name, transparent=True, metadata={"Date": None}).decode()
    size = f"{picture.width:g} {picture.height:g}"
    text = f'<svg viewBox="0 0 {size}" role="img" aria-label="{escape(picture.name)}">'
    text += saved[saved.index("</metadata>") + len("</metadata>") :]
    text = re.sub(r"<defs>\s*<style.*?</defs>", "", text, count=1, flags=re.DOTALL)
    text = re.sub(r'<image xlink:href="data:image/png;base64,\s*([^"]*)" id="[^"]*"', raster, text)
    text = re.sub(r"""<g id=(["'])([^|>]*?)\|(.*?)\1>""", r"<g class=\1\2\1><title>\3</title>", text)
    text = re.sub(r'<g id="[^"]*"', "<g", text).replace("<title></title>", "")
    text = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d)\d+", r"\1", path[0]), text)
    text = re.sub(r">\s+<", "><", text.replace("xlink:href", "href"))
    for variable, colour in THEME.items():
        text = text.replace(colour, f"var(--{variable}, {colour})")
    return text.strip()


def picture_png(picture: Picture, **texts: str) -> bytes:
    """Return a picture as the bytes of a PNG, with texts stored in it by their names."""
    return _saved(picture, "png", dpi=72, metadata={"Software": None} | texts)


def _saved(picture: Picture, kind: str, salt: str = "caryatid", **options: Any) -> bytes:
    from matplotlib.figure import Figure

    with own_style(salt):
        figure = Figure(figsize=(picture.width / 72.0, picture.height / 72.0))
        picture.put(figure, (0.0, 0.0, 1.0, 1.0))
        content = io.BytesIO()
        figure.savefig(content, format=kind, **options)
    return content.getvalue()


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
    """Write tags, moved until they cover neither each other nor the edge.

    Letters are `size` [px] high, or lower where the tags would otherwise fill more than a sixth of the axes;
    below 6 px they could not be read and are left out.
    """
    from matplotlib.collections import LineCollection

    room = np.array([axes.get_xlim()[1], axes.get_ylim()[0]])
    anchors = np.array([tag[:2] for tag in tags]).reshape(-1, 2)
    plates = np.array([[0.62 * len(tag.text) + 1.0, 1.45] for tag in tags]).reshape(-1, 2)  # [letters]
    size = min(size, float(np.sqrt(room.prod() / 6.0 / max(plates.prod(axis=1).sum(), 1.0))))
    if size < 6.0 or not tags:
        return
    centres = keep_apart(anchors, size * plates + 2.0, room)
    moved = np.hypot(*(anchors - centres).T) > 1.45 * size
    half = np.maximum(0.5 * size * (plates[:, :1] - plates[:, 1:]), 0.1) * (1.0, 0.0)
    pills = np.stack([centres - half, centres + half], axis=1)
    alpha = [0.6 if tag.faint else 1.0 for tag in tags]
    for lines, look in (
        (np.stack([anchors, centres], axis=1)[moved], {"colors": "white", "linewidths": 1.4}),
        (pills, {"colors": "white", "linewidths": 1.45 * size, "alpha": alpha}),
        (pills, {"colors": [tag.colour for tag in tags], "linewidths": 1.3 * size, "alpha": alpha}),
    ):
        collection = LineCollection([*lines], capstyle="round", zorder=7.0, gid="shapes|", **look)
        axes.add_collection(collection, autolim=False)
    for tag, centre in zip(tags, centres, strict=True):
        axes.text(
            centre[0], centre[1], tag.text, color=ink_on(tag.colour), fontsize=size, fontweight="bold",
            ha="center", va="center_baseline", zorder=8.0, gid="shapes|",
        )  # fmt: skip


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
