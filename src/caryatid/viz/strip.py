"""The film strip of a dismantling: one picture of each lift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.config import Config
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.manipulation.dismantling import Taken, posed, poses_of
from caryatid.simulation.camera import intrinsics, render
from caryatid.simulation.lifting import ASIDE
from caryatid.simulation.world import SimulatedScene
from caryatid.viz import svg
from caryatid.viz.images import name_on, tinted
from caryatid.viz.page import Figure

HEADROOM = 0.25
"""Room above the objects that a picture shows [m]: the lifted one is to be seen."""
AROUND = 0.07
"""Room around the objects' middles, as a share of their distance [1]: 10 cm at 1.5 m."""
TAG_SIZE = 28.0
"""Height of letters on a picture 640 px wide [px]."""
HALF_WAY = 0.5
"""A lift that does no harm is shown when so much of it is done [1]; one that does, at its end."""


def draw_lifts(
    scene: SimulatedScene,
    taken: Sequence[Taken],
    graph: SupportGraph,
    T_world_camera: Array,
    config: Config,
) -> tuple[Figure, ...]:
    """Draw each lift as it looked on the way up, bodies in the colours of the objects they were found as.

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
        moment = t.film[rising[int((len(rising) - 1) * HALF_WAY)]] if t.ok else t.film[-1]
        image = render(posed(scene, moment), T_world_camera, K, config.sensor)
        step = max(1, round(2 * config.sensor.width / config.report.image_width))
        labels = label_of[image.labels][::step, ::step]
        height, width = labels.shape
        pixels = tinted(image.rgb[::step, ::step], labels, width)
        tags = [tag for item in found.values() if (tag := name_on(item, labels)) is not None]
        picture = svg.picture(
            width,
            height,
            svg.raster(pixels, 0, 0, width, height, jpeg=config.report.jpeg_quality),
            svg.tags(tags, (0, 0, width, height), TAG_SIZE * width / 640.0),
            name=f"lift {number}: {t.step.object_id}",
        )
        held = f", {', '.join(t.step.hold)} held" if t.held else ""
        outcome = "Nothing else moved" if t.ok else f"{', '.join(t.disturbed)} moved"
        figures.append(
            Figure("camera", picture, f"{number}: {t.step.object_id}{held}", f"{outcome}; {t.step.why}.")
        )
    return tuple(figures)


def _zoomed(K: Array, positions_world: Array, T_world_camera: Array, config: Config) -> Array:
    """Pinhole matrix (3, 3) [px] of the part of a picture that shows the objects, also on their way up."""
    above = positions_world + (0.0, 0.0, HEADROOM)
    p = transforms.transform(transforms.invert(T_world_camera), np.concatenate([positions_world, above]))
    at = p[:, :2] / p[:, 2:]
    low, high = at.min(axis=0) - AROUND, at.max(axis=0) + AROUND
    size = np.array([config.sensor.width, config.sensor.height])
    zoomed = K.copy()
    zoomed[[0, 1], [0, 1]] = np.min(size / (high - low))
    zoomed[:2, 2] = size / 2.0 - zoomed[0, 0] * (low + high) / 2.0
    return zoomed
