"""The film strip of a dismantling: one picture of each lift."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from caryatid.config import Config
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.manipulation.dismantling import Taken, posed
from caryatid.sensing.views import View
from caryatid.simulation.camera import intrinsics, render
from caryatid.simulation.lifting import ASIDE
from caryatid.simulation.world import SimulatedScene
from caryatid.viz.drawings import draw_image, draw_layers
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
    names, K = list(scene.object_bodies.values()), intrinsics(config.sensor)
    found = {t.body: graph[t.step.object_id] for t in taken if t.body is not None}
    label_of = np.zeros(max(scene.object_bodies, default=0) + 1, dtype=np.int32)
    for label, name in scene.object_bodies.items():
        label_of[label] = found[name].label if name in found else 0
    figures = []
    for number, t in enumerate(taken, start=1):
        if t.body is None:
            continue
        rising = np.flatnonzero(t.film[:, names.index(t.body), 2] < ASIDE / 2.0)
        state = t.film[rising[(len(rising) - 1) // 2]] if t.ok else t.film[-1]
        image = render(posed(scene, state), T_world_camera, K, config.sensor)
        view = View(image.depth.astype(np.float32), K, rgb=image.rgb, name=f"lift {number}")
        objects, width = SupportGraph(tuple(found.values())), config.report.image_width // 2
        picture = draw_image(view, label_of[image.labels], objects, width)
        held = f", {', '.join(t.step.hold)} held" if t.held else ""
        outcome = "Nothing else moved" if t.ok else f"{', '.join(t.disturbed)} moved"
        figures.append(Figure(f"{number}: {t.step.object_id}{held}", picture, f"{outcome}; {t.step.why}.", 3))
    return tuple(figures)


def stored_figures(figures: Sequence[Figure]) -> dict[str, bytes]:
    """The pictures of lifts as files of a run folder: `lifts/NN.png`, with headings and captions in them."""
    return {
        f"lifts/{number:02d}.png": picture_png(f.picture, heading=f.heading, caption=f.caption)
        for number, f in enumerate(figures, start=1)
    }


def read_figures(folder: Path) -> tuple[Figure, ...]:
    """Read back what `stored_figures` gave; none where there are none."""
    figures = []
    for path in sorted((folder / "lifts").glob("*.png")):
        with Image.open(path) as image:
            picture = draw_layers(f"lift {path.stem}", [np.asarray(image.convert("RGB"))])
            figures.append(Figure(image.info.get("heading", ""), picture, image.info.get("caption", ""), 3))
    return tuple(figures)
