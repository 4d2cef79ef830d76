"""The film strip of a dismantling: one picture of each lift."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from caryatid.config import Config
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.manipulation.dismantling import Taken, posed, poses_of
from caryatid.sensing.views import View
from caryatid.simulation.camera import intrinsics, render
from caryatid.simulation.lifting import ASIDE
from caryatid.simulation.world import SimulatedScene
from caryatid.viz.drawings import draw_image
from caryatid.viz.pictures import picture_png
from caryatid.viz.report import Figure


def draw_lifts(
    scene: SimulatedScene,
    taken: Sequence[Taken],
    graph: SupportGraph,
    T_world_camera: Array,
    config: Config,
) -> tuple[Figure, ...]:
    """Draw each lift as it looked half way up, or at its end where it did harm, in the objects' colours.

    Args:
        scene: The scene in physics.
        taken: The steps, done.
        graph: The objects they took.
        T_world_camera: Where it is seen from (4, 4).
        config: Sizes of the pictures.
    """
    names = list(scene.object_bodies.values())
    by_id = {o.id: o for o in graph.objects}
    found = {t.body: by_id[t.step.object_id] for t in taken if t.body is not None}
    label_of = np.zeros(max(scene.object_bodies, default=0) + 1, dtype=np.int32)
    for label, name in scene.object_bodies.items():
        label_of[label] = found[name].label if name in found else 0
    K = _zoomed(intrinsics(config.sensor), poses_of(scene)[:, :3], T_world_camera, config)
    figures = []
    for number, t in enumerate(taken, start=1):
        if t.body is None:
            continue
        rising = np.flatnonzero(t.film[:, names.index(t.body), 2] < ASIDE / 2.0)
        moment = t.film[rising[(len(rising) - 1) // 2]] if t.ok else t.film[-1]
        image = render(posed(scene, moment), T_world_camera, K, config.sensor)
        view = View(image.depth.astype(np.float32), K, rgb=image.rgb, name=f"lift {number}")
        objects = SupportGraph(tuple(found.values()))
        picture = draw_image(view, label_of[image.labels], objects, config.report.image_width // 2)
        held = f", {', '.join(t.step.hold)} held" if t.held else ""
        outcome = "Nothing else moved" if t.ok else f"{', '.join(t.disturbed)} moved"
        figures.append(Figure(f"{number}: {t.step.object_id}{held}", picture, f"{outcome}; {t.step.why}."))
    return tuple(figures)


def _zoomed(K: Array, positions_world: Array, T_world_camera: Array, config: Config) -> Array:
    """Pinhole matrix (3, 3) [px] of the part of a picture that shows the objects, also on their way up."""
    above = positions_world + (0.0, 0.0, 0.25)  # Room for the lifted one [m].
    p = transforms.transform(transforms.invert(T_world_camera), np.concatenate([positions_world, above]))
    at = p[:, :2] / p[:, 2:]
    # Room around the objects' middles, as a share of their distance: 10 cm at 1.5 m.
    low, high = at.min(axis=0) - 0.07, at.max(axis=0) + 0.07
    size = np.array([config.sensor.width, config.sensor.height])
    zoomed = K.copy()
    zoomed[[0, 1], [0, 1]] = np.min(size / (high - low))
    zoomed[:2, 2] = size / 2.0 - zoomed[0, 0] * (low + high) / 2.0
    return zoomed


def stored_figures(figures: Sequence[Figure]) -> dict[str, bytes]:
    """The pictures of lifts as files of a run folder: `lifts/NN.png`, with headings and captions in them."""
    files = {}
    for number, figure in enumerate(figures, start=1):
        text, buffer = PngInfo(), io.BytesIO()
        text.add_itxt("heading", figure.heading)
        text.add_itxt("caption", figure.caption)
        Image.open(io.BytesIO(picture_png(figure.picture))).save(buffer, "PNG", pnginfo=text)
        files[f"lifts/{number:02d}.png"] = buffer.getvalue()
    return files


def read_figures(folder: Path) -> tuple[Figure, ...]:
    """Read back what `stored_figures` gave; none where there are none."""
    figures = []
    for path in sorted((folder / "lifts").glob("*.png")):
        with Image.open(path) as image:
            pixels, text = np.asarray(image.convert("RGB")), image.info
        nothing = np.zeros(pixels.shape[:2], dtype=np.int32)
        view = View(nothing.astype(np.float32), np.eye(3), rgb=pixels, name=f"lift {path.stem}")
        picture = draw_image(view, nothing, SupportGraph(), pixels.shape[1])
        figures.append(Figure(text.get("heading", ""), picture, text.get("caption", "")))
    return tuple(figures)
