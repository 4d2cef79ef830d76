"""A picture of what a program found, for its page: programs print, and draw nothing."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from sphinx_gallery.scrapers import figure_rst

from caryatid.fitting import primitives
from caryatid.scene import Scene
from caryatid.simulation.camera import SimulatedCamera

sys.path.append(str(Path(__file__).parents[2] / "benchmarks" / "pictures"))

from solids import Eye, draw_solids
from stages import on_table, show_graph, show_shapes

SIZE = (520, 400)
"""Width and height of a panel [px]."""
LOOK = (np.deg2rad(310.0), np.deg2rad(32.0))
"""Azimuth and elevation things are looked at from."""

_seen: dict[str, Any] = {}
"""The last of each kind of what the program that runs has made."""


def watch() -> None:
    """Keep the last graph, fit and view of programs."""
    Scene.update = _kept("graph", Scene.update)  # type: ignore[method-assign]
    primitives.fit = _kept("fit", primitives.fit)
    SimulatedCamera.capture = _kept("view", SimulatedCamera.capture)  # type: ignore[method-assign]


def _kept(kind: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def called(*arguments: Any, **options: Any) -> Any:
        result = function(*arguments, **options)
        _seen[kind] = result
        return result

    return called


def forget(configuration: Any, program: str) -> None:
    """Begin anew with another program."""
    _seen.clear()


def take_picture(block: Any, variables: dict[str, Any], configuration: Any) -> str:
    """Draw what a program found: its graph, else the shape it fitted, else what its camera saw."""
    if not _seen:
        return ""
    graph, fit, view = (_seen.get(kind) for kind in ("graph", "fit", "view"))
    count = 1 if graph is None else 2
    figure, axes = plt.subplots(1, count, figsize=(count * SIZE[0] / 100, SIZE[1] / 100), squeeze=False)
    figure.subplots_adjust(0.0, 0.0, 1.0, 1.0, wspace=0.02)
    if graph is not None:
        surface = graph.support_surface
        top = float(surface.centre_world[2] + surface.shape.extents[2] / 2.0)
        shapes = [o.shape for o in on_table(graph)]
        show_shapes(axes[0, 0], on_table(graph), top, eye_on(shapes))
        show_graph(axes[0, 1], graph)
    elif fit is not None:
        eye = eye_on([fit.shape])
        low = float(fit.shape.outline()[:, 2].min())
        axes[0, 0].imshow(draw_solids([fit.shape], [(0.9, 0.62, 0.0)], low, eye)[0])
    else:
        axes[0, 0].imshow(view.rgb)
    for panel in axes[0]:
        panel.axis("off")
    path = next(variables["image_path_iterator"])
    figure.savefig(path, dpi=100)
    plt.close(figure)
    _seen.clear()
    return str(figure_rst([path], configuration["src_dir"]))


def eye_on(shapes: Any) -> Eye:
    """An eye that sees all of some shapes."""
    corners = np.concatenate([shape.outline() for shape in shapes])
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    azimuth, elevation = LOOK
    level = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    radius = 1.05 * float(np.linalg.norm(corners - centre, axis=1).max())
    return Eye.towards(centre, level + np.array([0.0, 0.0, np.sin(elevation)]), radius, *SIZE)
