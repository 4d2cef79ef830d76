"""Draw a picture of an example program's result for its page; the programs themselves only print."""

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
from caryatid.viz.pictures import Picture, picture_svg

_seen: dict[str, Any] = {}
"""The last result of each kind of the program that is running."""


def watch() -> None:
    """Record the last graph, fit and view of programs."""
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
    """Forget the results of the previous program."""
    _seen.clear()


def take_picture(block: Any, variables: dict[str, Any], configuration: Any) -> str:
    """Draw a program's result: its graph, else the shape it fitted, else the view of its camera."""
    if not _seen:
        return ""
    graph, fit, view = (_seen.get(kind) for kind in ("graph", "fit", "view"))
    path = Path(next(variables["image_path_iterator"]))
    if graph is not None:
        path = _write(draw_graph(graph), path)
    elif fit is not None:
        path = _write(draw_solid(fit.shape), path)
    else:
        Image.fromarray(view.rgb).save(path)
    _seen.clear()
    return str(figure_rst([str(path)], configuration["src_dir"]))


def _write(picture: Picture, path: Path) -> Path:
    """Write a picture as an SVG file; returns its path."""
    path = path.with_suffix(".svg")
    size = f'xmlns="http://www.w3.org/2000/svg" width="{picture.width:g}" height="{picture.height:g}"'
    path.write_text(picture_svg(picture).replace("<svg", f"<svg {size}", 1), encoding="utf-8")
    return path
