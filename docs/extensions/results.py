"""A picture of what a program found, for its page: programs print, and draw nothing."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image
from sphinx_gallery.scrapers import figure_rst

from caryatid.fitting import primitives
from caryatid.scene import Scene
from caryatid.simulation.camera import SimulatedCamera
from caryatid.viz.drawings import draw_solid
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.pictures import picture_png

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
    """Forget what the program before made."""
    _seen.clear()


def take_picture(block: Any, variables: dict[str, Any], configuration: Any) -> str:
    """Draw what a program found: its graph, else the shape it fitted, else what its camera saw."""
    if not _seen:
        return ""
    graph, fit, view = (_seen.get(kind) for kind in ("graph", "fit", "view"))
    path = Path(next(variables["image_path_iterator"]))
    if graph is not None:
        path.write_bytes(picture_png(draw_graph(graph)))
    elif fit is not None:
        path.write_bytes(picture_png(draw_solid(fit.shape)))
    else:
        Image.fromarray(view.rgb).save(path)
    _seen.clear()
    return str(figure_rst([str(path)], configuration["src_dir"]))
