"""The report's colours: one for each object, the same in every picture, and the scale of saliency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.sensing.views import MAX_LABEL

Colour = tuple[int, int, int]

PALETTE = (
    "#0072b2", "#d55e00", "#56b4e9", "#e69f00", "#009e73", "#f0e442", "#cc79a7",
    "#332288", "#44aa99", "#999933", "#882255", "#ddcc77", "#aa4499", "#117733",
)  # fmt: skip
"""Colours for objects 1, 2, …: first the seven of Okabe and Ito, then seven of Tol's muted set, each in the
order in which neighbours stay furthest apart also for the colour-blind."""
STRIPES = ((), (1,), (-1,), (1, -1))
"""Directions of the stripes on the first half of the palette, all of whose colours can be told apart, on the
second, on the first again, …: 1 rises to the right, −1 falls."""
SURFACE_COLOUR = "#9c9184"
"""The support surface."""
NOTHING_COLOUR = "#b9bec4"
"""Points that belong to no object."""
SALIENCY_STOPS = (
    (-1.0, "#1f4e9e"), (-0.5, "#86a9d9"), (0.0, "#ececec"),
    (0.35, "#fbe08a"), (0.7, "#f39c34"), (1.0, "#b3301b"),
)  # fmt: skip
"""Saliency −1 … 1: blue where it is inhibited, grey at 0, yellow to red where there is something to see."""
DEPTH_STOPS = ((0.0, "#ffe945"), (0.33, "#bcae6c"), (0.66, "#4b6579"), (1.0, "#00204c"))
"""Depth images without colour, near to far: the ends and two steps of cividis."""


def rgb(colour: str) -> Colour:
    """Return red, green and blue 0…255 of `#rrggbb`."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def _css(colour: Array | NDArray[np.uint8]) -> str:
    return f"#{bytes(np.rint(colour).astype(np.uint8)).hex()}"


def object_colour(label: int) -> str:
    """Return `#rrggbb` of the object with this label; it depends on nothing but the label.

    After its last colour the palette begins again, darker.
    """
    if not 0 < label <= MAX_LABEL:
        return SURFACE_COLOUR
    turn, position = divmod(label - 1, len(PALETTE))
    return _css((1.0, 0.72, 0.5)[turn % 3] * np.array(rgb(PALETTE[position])))


def rgba(label: int) -> tuple[float, float, float, float]:
    """Return red, green, blue and opacity, 0 … 1, of the object with this label."""
    red, green, blue = rgb(object_colour(label))
    return red / 255.0, green / 255.0, blue / 255.0, 1.0


def object_stripes(label: int) -> tuple[int, ...]:
    """Return the directions of the stripes on the object with this label, which tell like colours apart."""
    if not 0 < label <= MAX_LABEL:
        return ()
    return STRIPES[2 * (label - 1) // len(PALETTE) % len(STRIPES)]


def striped_colours(labels: NDArray[np.int32], u: Array, v: Array, pitch: float) -> Array:
    """Return the colours (..., 3), 0 … 255, of labelled pixels, with the stripes of those that have some.

    Args:
        labels: Of the pixels (...).
        u: Their columns (...) [px].
        v: Their rows (...) [px].
        pitch: From stripe to stripe along a row or column [px]; the stripe takes a third of it.
    """
    stripe = np.zeros(labels.shape, dtype=np.bool_)
    found = np.flatnonzero(np.bincount(labels.ravel()))
    for direction in set().union(*(object_stripes(int(label)) for label in found)):
        striped = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.bool_)
        striped[[label for label in found if direction in object_stripes(int(label))]] = True
        stripe |= striped[labels] & ((u + direction * v) % pitch < pitch / 3.0)
    colour = label_colours(labels).astype(np.float64)
    return np.where(stripe[..., None], (255.0 + colour) / 2.0, colour)


def label_colours(labels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the colours (..., 3) of an array of labels (...); 0 = belongs to no object."""
    table = np.zeros((int(labels.max(initial=0)) + 1, 3), dtype=np.uint8)
    for label in np.flatnonzero(np.bincount(labels.ravel())):
        table[label] = rgb(NOTHING_COLOUR if label == 0 else object_colour(int(label)))
    return table[labels]


def ink_on(colour: str) -> str:
    """Return black or white, whichever is read better on this colour."""
    red, green, blue = rgb(colour)
    return "#111111" if 0.299 * red + 0.587 * green + 0.114 * blue > 120.0 else "#ffffff"


def scale(values: Array, stops: tuple[tuple[float, str], ...]) -> NDArray[np.uint8]:
    """Map values (...) to colours (..., 3) between the stops; beyond the ends the ends' colours."""
    positions, colours = zip(*stops, strict=True)
    channels = np.array([rgb(colour) for colour in colours]).T
    mapped = [np.interp(values, positions, channel) for channel in channels]
    return np.stack(mapped, axis=-1).round().astype(np.uint8)


def saliency_colour(saliency: float) -> str:
    """Return `#rrggbb` of one saliency value."""
    return _css(scale(np.array([saliency]), SALIENCY_STOPS)[0])
