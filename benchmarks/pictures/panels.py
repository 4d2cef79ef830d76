"""Panels of pictures: a view with some objects in colour, shapes as solids, arrows for supports."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib import pyplot as plt
from numpy.typing import NDArray
from PIL import Image
from solids import Eye, draw_solids

from caryatid.exploration import Step
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array

Shape = Shape
Colour = tuple[float, float, float]

SIZE = (430, 360)
"""Width and height of a panel [px]."""
RIGHT, MISSED, EXTRA = "#2e7d32", "#d50000", "#d500f9"
"""Colours of supports that are right, missed, and not there."""
INVENTED_COLOUR = (0.93, 0.45, 1.0)
"""Of found objects that are no true ones."""
LEGEND = (
    ("right support", RIGHT),
    ("missed", MISSED),
    ("found, but not there", EXTRA),
)
ASIDE = 8.0
"""How far an arrow is beside the line between two centres: there may be one each way [px]."""
HALO = (patheffects.withStroke(linewidth=3.5, foreground="white"),)


def best_eye(shapes: Sequence[Shape], top: float) -> Eye:
    """The eye that shows the largest share of the shape it shows least of."""
    corners = np.concatenate([s.outline() for s in shapes])
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    radius = 0.92 * float(np.linalg.norm(corners - centre, axis=1).max())
    best, best_share = None, -1.0
    for elevation in np.radians([12.0, 25.0, 40.0]):
        for azimuth in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
            level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            direction = np.cos(elevation) * level + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
            small = Eye.towards(centre, direction, radius, 72, 60)
            _, together = draw_solids(shapes, [(0.5,) * 3] * len(shapes), top, small)
            shares = []
            for i, shape in enumerate(shapes):
                _, alone = draw_solids([shape], [(0.5,) * 3], top, small)
                shares.append(np.sum(together == i) / max(np.sum(alone == 0), 1))
            if min(shares) > best_share + 0.02:
                best, best_share = direction, min(shares)
    assert best is not None
    return Eye.towards(centre, best, radius, *SIZE)


def show_view(panel: Any, steps: Sequence[Step], tags: Mapping[int, tuple[str, Colour]]) -> None:
    """Show the view that shows most of some objects, they in colour and all else in grey.

    Args:
        panel: Where to.
        steps: The views.
        tags: Letter and colour of the objects, by label.
    """

    def pixels(step: Step) -> float:
        """Sum of the objects' widths, so that each counts."""
        return float(sum(np.sqrt(np.sum(labels_of(step) == label)) for label in tags))

    best = max(steps, key=pixels)
    labels = labels_of(best)
    assert best.view is not None
    assert best.view.rgb is not None
    rgb = best.view.rgb
    grey = rgb.mean(axis=-1, keepdims=True) / 255.0
    image = np.repeat(0.35 + 0.6 * grey, 3, axis=2)
    for label, (_, colour) in tags.items():
        image[labels == label] = np.array(colour) * (0.35 + 0.85 * grey[labels == label])
    panel.imshow(np.clip(image, 0.0, 1.0))
    panel.set_title(f"view {best.index + 1} of {len(steps)}, which shows most of them", fontsize=11)
    for label, (text, _) in tags.items():
        v, u = np.nonzero(labels == label)
        if len(u):
            letter(panel, np.array([np.median(u), np.median(v)]), text)
    v, u = np.nonzero(np.isin(labels, list(tags)))
    shape = SIZE[1] / SIZE[0]
    half = 0.75 * max(float(np.ptp(u)), float(np.ptp(v)) / shape, 60.0)
    x, y = (u.min() + u.max()) / 2.0, (v.min() + v.max()) / 2.0
    panel.set_xlim(x - half, x + half)
    panel.set_ylim(y + half * shape, y - half * shape)
    panel.axis("off")


def labels_of(step: Step) -> NDArray[np.int32]:
    """True labels (H, W) of a simulated view."""
    assert step.view is not None
    assert step.view.labels is not None
    return step.view.labels


def show_solids(
    panel: Any,
    tags: Mapping[str, tuple[Shape, str, Colour]],
    top: float,
    eye: Eye,
    title: str,
) -> None:
    """Show shapes as solids, each with its letter."""
    image, seen = draw_solids([t[0] for t in tags.values()], [t[2] for t in tags.values()], top, eye)
    panel.imshow(image)
    panel.set_title(title, fontsize=11)
    for i, (shape, text, _) in enumerate(tags.values()):
        v, u = np.nonzero(seen == i)
        at = (
            np.array([np.median(u), np.median(v)])
            if len(u)
            else eye.project(shape.T_world_object[None, :3, 3])[0]
        )
        letter(panel, at, text)
    panel.set_xlim(0, eye.width)
    panel.set_ylim(eye.height, 0)
    panel.axis("off")


def show_lost(panel: Any, shape: Shape, text: str, eye: Eye) -> None:
    """Outline an object that was not found where it is."""
    _, seen = draw_solids([shape], [(0.5,) * 3], -np.inf, eye)
    panel.contour(seen == 0, levels=[0.5], colors=MISSED, linestyles="dashed", linewidths=1.8)
    v, u = np.nonzero(seen == 0)
    note = {"color": MISSED, "ha": "center", "va": "center", "path_effects": HALO}
    panel.text(np.median(u), v.min() - 10, f"{text} lost", fontsize=12, **note)


def letter(panel: Any, at: Array, text: str) -> None:
    """Write an object's letter over it."""
    panel.text(*at, text, fontsize=17, fontweight="bold", ha="center", va="center", path_effects=HALO)


def arrow(panel: Any, eye: Eye, supporter: Shape | None, supported: Shape, top: float, colour: str) -> None:
    """Draw a support; one of the table comes from below the object."""
    end = supported.T_world_object[:3, 3]
    if supporter is None:
        foot = eye.project(np.array([[end[0], end[1], top]]))[0]
        pixels = np.stack([foot + (0.0, 55.0), foot + (0.0, -4.0)])
    else:
        pixels = eye.project(np.stack([supporter.T_world_object[:3, 3], end]))
        along = (pixels[1] - pixels[0]) / max(float(np.linalg.norm(pixels[1] - pixels[0])), 1.0)
        pixels = pixels + ASIDE * np.array([-along[1], along[0]]) + np.outer([14.0, -14.0], along)
    style = {"arrowstyle": "-|>,head_width=0.45,head_length=0.8", "color": colour, "shrinkA": 0, "shrinkB": 0}
    panel.annotate("", pixels[1], pixels[0], arrowprops=style | {"linewidth": 3.0, "path_effects": HALO})


def png(figure: Any, palette: int | None = None) -> bytes:
    """Write a figure as PNG, of so many colours where a number is given."""
    written, packed = io.BytesIO(), io.BytesIO()
    figure.savefig(written, format="png")
    plt.close(figure)
    image = Image.open(written).convert("RGB")
    if palette is not None:
        image = image.quantize(palette, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    image.save(packed, format="png", optimize=True)
    return packed.getvalue()
