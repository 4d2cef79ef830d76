"""The moving picture of README.md: a robot explores; what it sees, what it knows, where it looks next.

    python benchmarks/pictures/film.py

writes docs/pictures/explore.gif, the same bytes each time, in about a minute.
"""

from __future__ import annotations

import sys
import textwrap
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
from filmed import (
    PANEL,
    Eye,
    coarse,
    dome,
    eye,
    furniture,
    geoms_of,
    picture_of,
    robot_geoms,
    table_centre,
)
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import caryatid as ct
from caryatid.evaluation import score, true_scene_from_simulation
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.simulation import ground_truth, load_scene
from caryatid.simulation.camera import intrinsics, render
from caryatid.simulation.setup import Simulation, make_simulation
from caryatid.viz import colours
from caryatid.viz.drawings import keep_apart
from caryatid.viz.graph_drawing import arrange

OUT = Path(__file__).parents[2] / "docs/pictures/explore.gif"
SCENE, SEED = "clutter", 0
WIDTH, HEADER = 800, 58
TOP, BELOW = (400, 300), (400, 262)
"""Sizes of the two pictures above, and of the two below [px]."""
CUT = (110, 82, 530, 397)
"""The part of the camera's picture that is shown [px]."""
LOOK, KNOW, CHOOSE, MOVE, END = 800, 1800, 1800, 60, 3500
"""How long what was seen, what is known and what is chosen stand, a frame of moving, and the end [ms]."""
MOVES, TURN = 24, np.deg2rad(5.0)
"""Frames of a way at the most, and the angle between two of them [rad]."""
TINT = 0.62
"""Share of its object's colour in the colour of a part."""
PAPER, INK, SOFT, DOUBT = "#ffffff", "#1d2126", "#5d666f", "#b4480b"
EXACT = 150
"""How many of the GIF's 256 colours are the commonest as they are."""


def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts/ttf" / name), size)


def overview(stage: Simulation, step: ct.Step, T_world_camera: Array, at: Eye, painted: bool) -> Image.Image:
    """The robot around the table, what is known of it, and where it would be good to look from."""
    solids = furniture(stage, 0.2) + geoms_of(step.graph) + robot_geoms(T_world_camera)
    rgb, depth = picture_of(solids, at)
    if painted:
        for colour, far, opaque in dome(step, at):
            share = np.where(far < depth, opaque, 0.0)[..., None]
            rgb = share * colour + (1.0 - share) * rgb
    image = coarse(rgb)
    draw = ImageDraw.Draw(image)
    spots, _ = at.projection.project(step.sphere.centre_world + step.sphere.radius * step.visited)
    for number, spot in enumerate(spots, start=1):
        disc(draw, spot, str(number), "#2d3748", 8)
    if painted and step.decision is not None:
        (spot,), _ = at.projection.project(step.decision.T_world_camera[None, :3, 3])
        disc(draw, spot, "?", "#000000", 10)
    return image


def disc(draw: ImageDraw.ImageDraw, at: Array, word: str, colour: str, radius: int) -> None:
    """A number on a round plate."""
    x, y = float(at[0]), float(at[1])
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour, outline="#ffffff", width=2)
    draw.text((x, y), word, fill="#ffffff", font=font(radius + 3, bold=True), anchor="mm")


def model(stage: Simulation, graph: SupportGraph | None, at: Eye) -> Image.Image:
    """The fitted shapes on the table, with an arrow from each supporter to what it supports."""
    table = [s for s in furniture(stage, 0.0) if s[0].kind == "box" and s[0].extents[2] > 0.0]
    rgb, _ = picture_of(table + ([] if graph is None else geoms_of(graph)), at)
    image = coarse(rgb)
    if graph is None:
        return image
    draw, by_id = ImageDraw.Draw(image), {o.id: o for o in graph.objects}
    middles = {name: at.projection.project(o.centre_world[None])[0][0] for name, o in by_id.items()}
    for support in graph.supports:
        if by_id[support.supporter].role == "support_surface":
            continue
        arrow(draw, middles[support.supporter], middles[support.supported], support.certain)
    names = [o for o in graph.objects if o.role != "support_surface"]
    sizes = np.array([[9.0 * len(o.id) + 6.0, 17.0] for o in names])
    spots = keep_apart(np.array([middles[o.id] for o in names]), sizes, (2, 2, TOP[0] - 2, TOP[1] - 2))
    for item, (x, y), (w, h) in zip(names, spots, sizes, strict=True):
        colour = colours.object_colour(item.label)
        plate = (x - w / 2, y - h / 2, x + w / 2, y + h / 2)
        draw.rounded_rectangle(plate, 4, fill=colour, outline="#ffffff")
        draw.text((x, y), item.id, fill=colours.ink_on(colour), font=font(12, bold=True), anchor="mm")
    return image


def arrow(draw: ImageDraw.ImageDraw, start: Array, end: Array, certain: bool) -> None:
    """An arrow with a white rim, broken where it is uncertain."""
    along = end - start
    length = float(np.linalg.norm(along))
    along = along / max(length, 1e-9)
    across = np.array([-along[1], along[0]])
    start, tip = start + 9.0 * along, end - 10.0 * along
    base = tip - 10.0 * along
    steps = [(0.0, 1.0)] if certain else [(k / 4.0, k / 4.0 + 0.15) for k in range(4)]
    for colour, width in (("#ffffff", 6), (INK if certain else DOUBT, 3)):
        for a, b in steps:
            draw.line([tuple(start + a * (base - start)), tuple(start + b * (base - start))], colour, width)
        grown = 2.0 if width == 6 else 0.0
        corners = [tip + grown * along, base + (6 + grown) * across, base - (6 + grown) * across]
        draw.polygon([tuple(c) for c in corners], fill=colour)


def camera_picture(step: ct.Step | None, rgb: NDArray[np.uint8]) -> Image.Image:
    """What the camera sees, its parts in their objects' colours once they are found."""
    if step is None:
        shown = rgb
    else:
        part = (step.labels > 0) & (step.labels != SUPPORT_LABEL)
        tint = TINT * colours.label_colours(step.labels) + (1.0 - TINT) * rgb.mean(axis=-1, keepdims=True)
        shown = np.where(part[..., None], tint, rgb).astype(np.uint8)
    return Image.fromarray(shown).crop(CUT).resize(TOP, Image.Resampling.BICUBIC)


def graph_picture(graph: SupportGraph | None) -> Image.Image:
    """The support graph, from the table upwards."""
    image = Image.new("RGB", BELOW, PANEL)
    draw = ImageDraw.Draw(image)
    width, height = BELOW
    floor = height - 20
    draw.rounded_rectangle(
        (12, floor - 13, width - 12, floor + 9), 3, fill=colours.SURFACE_COLOUR, outline=INK
    )
    draw.text((width / 2, floor - 2), "table", fill="#111111", font=font(12, bold=True), anchor="mm")
    if graph is None:
        return image
    layout = arrange(graph)
    column = min(62.0, (width - 60.0) / max(layout.width, 1.0))
    row = min(62.0, 190.0 / max(layout.layers - 1, 1))
    left = (width - column * layout.width) / 2.0

    def place(x: float, level: float) -> Array:
        return np.array([left + column * x, floor - row * level])

    for support in graph.supports:
        route = layout.route.get(support.pair)
        line = (
            [place(*layout.position[name]) for name in support.pair]
            if route is None
            else [place(*at) for at in route]
        )
        if layout.position[support.supporter][1] == 0:
            line[0] = np.array([line[1][0], line[0][1] - 13.0])
        else:
            line[0] = line[0] - (0.0, 11.0)
        line[-1] = line[-1] + (0.0, 17.0)
        colour = INK if support.certain else DOUBT
        for a, b in pairwise(line):
            pieces = [(0.0, 1.0)] if support.certain else [(k / 4.0, k / 4.0 + 0.14) for k in range(4)]
            for p, q in pieces:
                draw.line([tuple(a + p * (b - a)), tuple(a + q * (b - a))], colour, 2)
        x, y = line[-1]
        draw.polygon([(x, y - 5), (x - 4, y + 4), (x + 4, y + 4)], fill=colour)
    for item in graph.objects:
        if item.role == "support_surface":
            continue
        x, y = place(*layout.position[item.id])
        colour = colours.object_colour(item.label)
        draw.rounded_rectangle((x - 19, y - 12, x + 19, y + 12), 4, fill=colour, outline=INK)
        draw.text((x, y), item.id, fill=colours.ink_on(colour), font=font(13, bold=True), anchor="mm")
    return image


def frame(parts: tuple[Image.Image, ...], number: int, figures: str, phase: str) -> Image.Image:
    """Put four pictures, the counter and what is being done together."""
    page = Image.new("RGB", (WIDTH, HEADER + TOP[1] + BELOW[1] + 2), PAPER)
    draw = ImageDraw.Draw(page)
    draw.text((12, 29), f"view {number}", fill=INK, font=font(25, bold=True), anchor="lm")
    draw.text((130, 17), figures, fill=INK, font=font(15, bold=True), anchor="lm")
    draw.text((130, 41), textwrap.shorten(phase, 86, placeholder=" …"), fill=SOFT, font=font(14), anchor="lm")
    corners = [(0, HEADER), (400, HEADER), (0, HEADER + 302), (400, HEADER + 302)]
    names = (
        "what the camera sees",
        "what is known: shapes, supports",
        "where to look from: red shows most",
        "the support graph",
    )
    for part, (x, y), name in zip(parts, corners, names, strict=True):
        page.paste(part, (x, y))
        width = font(12).getlength(name) + 12
        draw.rectangle((x, y, x + width, y + 19), fill=PAPER)
        draw.text((x + 6, y + 9), name, fill=INK, font=font(12), anchor="lm")
    draw.line([(400, HEADER), (400, page.height)], PAPER, 2)
    draw.line([(0, HEADER + 301), (WIDTH, HEADER + 301)], PAPER, 2)
    return page


def ways(start: Array, end: Array) -> Array:
    """Directions (N, 3) from one view to the next, around the table, both ends left out."""
    azimuth = np.arctan2([start[1], end[1]], [start[0], end[0]])
    turn = np.arctan2(np.sin(azimuth[1] - azimuth[0]), np.cos(azimuth[1] - azimuth[0]))
    count = int(np.clip(np.ceil(abs(turn) / TURN), 3, MOVES))
    share = np.linspace(0.0, 1.0, count + 1)[1:-1]
    share = share**2 * (3.0 - 2.0 * share)
    a, z = azimuth[0] + share * turn, start[2] + share * (end[2] - start[2])
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(a), flat * np.sin(a), z], axis=-1)


def film() -> tuple[list[Image.Image], list[int]]:
    """Explore, and draw frames and how long each stands [ms]."""
    scene = load_scene(SCENE)
    truth = true_scene_from_simulation(scene, ground_truth(scene))
    config = ct.Config()
    stage = make_simulation(scene, config, noise="carmine", seed=SEED)
    centre = table_centre(stage)
    near = eye(centre + (0.02, 0.0, 0.1), 285.0, 34.0, 3.2, TOP, 3.7)
    far = eye(centre * (1.0, 1.0, 0.0) + (0.0, 0.0, 0.98), 232.0, 30.0, 8.0, BELOW, 1.72)
    images: list[Image.Image] = []
    times: list[int] = []
    before: ct.Step | None = None
    figures = "nothing is known yet"

    def add(parts: tuple[Image.Image, ...], number: int, phase: str, time: int) -> None:
        images.append(frame(parts, number, figures, phase))
        times.append(time)

    known, graph_drawn = model(stage, None, near), graph_picture(None)
    for step in ct.explore(stage.camera, stage.robot, config=config, seed=SEED):
        assert step.view is not None
        T, rgb, number = step.view.pose, step.view.rgb, step.index + 1
        if rgb is None:
            raise RuntimeError("a simulated view has colours")
        shown = replace(step, graph=SupportGraph() if before is None else before.graph)
        around = overview(stage, shown, T, far, painted=False)
        add((camera_picture(None, rgb), known, around, graph_drawn), number, "look", LOOK)
        known, graph_drawn = model(stage, step.graph, near), graph_picture(step.graph)
        f1 = score(step.graph, truth, np.random.default_rng(0)).f1
        doubt = sum(not s.certain for s in step.graph.supports)
        figures = f"{len(step.graph.objects) - 1} objects · {len(step.graph.supports)} supports"
        figures += f" ({doubt} uncertain) · F1 {f1:.2f}" if doubt else f" · F1 {f1:.2f}"
        seen = camera_picture(step, rgb)
        phase = "fit boxes, cylinders and spheres; infer what supports what; fuse with the views before"
        add((seen, known, overview(stage, step, T, far, painted=False), graph_drawn), number, phase, KNOW)
        if step.decision is None:
            around = overview(stage, step, T, far, painted=False)
            add((seen, known, around, graph_drawn), number, f"done: {step.stop}", END)
            break
        phase = f"next view: {step.decision.why}"
        add((seen, known, overview(stage, step, T, far, painted=True), graph_drawn), number, phase, CHOOSE)
        target = step.sphere.direction_of(step.decision.T_world_camera)
        for pose in step.sphere.poses(ways(step.visited[-1], target)):
            passing = render(stage.scene, pose, intrinsics(config.sensor), config.sensor).rgb
            around = overview(stage, step, pose, far, painted=True)
            add((camera_picture(None, passing), known, around, graph_drawn), number, phase, MOVE)
        before = step
    return images, times


def reduced(images: list[Image.Image]) -> list[Image.Image]:
    """Frames of 256 colours: the film's commonest as they are, the others as near as each frame allows."""
    found, counts = np.unique(
        np.concatenate([np.asarray(image).reshape(-1, 3) for image in images]), axis=0, return_counts=True
    )
    exact = found[np.argsort(-counts, kind="stable")[:EXACT]]
    flat = []
    for image in images:
        pixels = np.asarray(image).reshape(-1, 3)
        code = pixels.astype(np.int64) @ (65536, 256, 1)
        known = np.isin(code, exact.astype(np.int64) @ (65536, 256, 1))
        others = Image.fromarray(pixels[~known][None])
        near = others.quantize(256 - EXACT, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        palette = Image.new("P", (1, 1))
        palette.putpalette([*exact.ravel().tolist(), *(near.getpalette() or [])])
        flat.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    return flat


def main() -> None:
    """Write the GIF; with a folder as argument also each frame, to look at."""
    images, times = film()
    flat = reduced(images)
    flat[0].save(OUT, save_all=True, append_images=flat[1:], duration=times, loop=0, optimize=False)
    print(f"{OUT}: {len(flat)} frames, {sum(times) / 1e3:.1f} s, {OUT.stat().st_size / 1e6:.2f} MB")
    for folder in map(Path, sys.argv[1:]):
        for k, image in enumerate(images):
            image.save(folder / f"frame-{k:03d}.png")


if __name__ == "__main__":
    main()
