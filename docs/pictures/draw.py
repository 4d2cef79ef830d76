"""Draw the documentation's pictures: each stage of the loop on one scene, README.md's film, and the viewer.

    python docs/pictures/draw.py concepts
    python docs/pictures/draw.py film
    python docs/pictures/draw.py viewer

The same command always draws the same pictures. The first two commands draw with `caryatid.viz`, like
reports, and reproduce each file byte for byte; the last one takes screenshots in Chromium.
"""

from __future__ import annotations

import io
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageOps

from caryatid import Config, Step, explore
from caryatid.evaluation.scores import score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry import transforms
from caryatid.graph import Support, SupportGraph
from caryatid.manipulation.dismantling import SimulatedHands, bodies_of
from caryatid.manipulation.order import plan_order
from caryatid.planning.decision import PlanningState
from caryatid.planning.planners import make_planner
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import ground_truth
from caryatid.simulation.world import box, build_spec, cylinder, scene_from_spec, sphere
from caryatid.sources import open_source
from caryatid.viewer.loop import LoopPage
from caryatid.viz.drawings import Projection, draw_cloud, draw_image, draw_sphere
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.pictures import Picture, own_style
from caryatid.viz.report import draw_lift

PICTURES = Path(__file__).parent
TITLE = 24.0
"""Height of a line of text above a picture [px]."""
PLANE, NORMAL = 0.042, 0.05
"""Half the side of a drawn separating plane, and the length of its drawn normal [m]."""
LOOK, KNOW, CHOOSE, END = 900, 2000, 2200, 4000
"""How long the film shows the view, the model, the choice, and the end [ms]."""
SOLIDS = (
    box((0.1, 0.2, 0.28), at=(-0.08, 0.14, 0.14), density=1200.0, friction=0.1),
    box((0.02, 0.09, 0.24), at=(-0.169, 0.14, 0.1215), turn=(0.0, 14.0, 0.0), friction=0.1),
    box((0.12, 0.12, 0.07), at=(0.08, 0.14, 0.035)),
    cylinder(0.035, 0.09, at=(0.08, 0.14, 0.115)),
    box((0.11, 0.1, 0.1), at=(0.0, -0.07, 0.05)),
    box((0.07, 0.36, 0.02), at=(0.0, -0.19, 0.11), density=500.0),
    cylinder(0.04, 0.08, at=(0.0, -0.06, 0.16), density=3000.0),
    sphere(0.035, at=(-0.1, -0.2, 0.035)),
)
"""A tall box, a board that leans on it, a stack behind it; a beam on a block, held by a weight; a ball."""
Titled = tuple[Picture, str]


def sheet(pictures: Sequence[Titled], width: int, columns: int, heading: str = "") -> Image.Image:
    """Arrange titled pictures on one page, in rows of cells of this width [px]."""
    rows = [pictures[k : k + columns] for k in range(0, len(pictures), columns)]
    heights = [TITLE + max(width * p.height / p.width for p, _ in row) for row in rows]
    top = 1.4 * TITLE if heading else 0.0
    size = np.array([columns * width, sum(heights) + top])
    with own_style():
        figure = Figure(figsize=tuple(size / 100.0), dpi=100)
        figure.text(0.01, 1.0 - 0.5 * top / size[1], heading, va="center", fontsize=10)
        for row, height in zip(rows, heights, strict=True):
            for column, (picture, title) in enumerate(row):
                tall = width * picture.height / picture.width
                at = (column + 0.5) / columns, 1.0 - (top + TITLE / 2) / size[1]
                figure.text(*at, title, ha="center", va="center")
                bottom = 1.0 - (top + TITLE + tall) / size[1]
                picture.put(figure, (column / columns + 0.005, bottom, 0.99 / columns, tall / size[1]))
            top += height
        content = io.BytesIO()
        figure.savefig(content, format="png", metadata={"Software": None})
    return Image.open(content).convert("RGB")


def plain(view: View, labels: NDArray[np.int32] | None = None, graph: SupportGraph | None = None) -> Picture:
    """Draw a view without shapes, with its segments if labels are given."""
    none = np.zeros(view.depth.shape, np.int32)
    shown = none if labels is None else labels
    return draw_image(view, shown, graph or SupportGraph(), view.depth.shape[1], shapes=False)


def planes(step: Step, supports: Sequence[Support]) -> Picture:
    """Draw a view with the separating planes of supports and their normals."""
    view = step.view
    assert view is not None
    base, projection = plain(view), Projection(view.pose, view.K, view.depth)

    def draw(axes: Axes) -> None:
        base.draw(axes)
        for support in supports:
            at, normal = support.contact_world, support.normal_world
            if at is None or normal is None:
                continue
            colour = "#d55e00" if support.doubtful else "#3b4252"
            u = transforms.perpendicular(normal)
            v = np.cross(normal, u)
            corners = [at + PLANE * (a * u + b * v) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
            axes.fill(*projection.project(np.array(corners))[0].T, color=colour, alpha=0.5)
            foot, head = projection.project(np.stack([at, at + NORMAL * normal]))[0]
            axes.arrow(*foot, *(head - foot), color=colour, width=2.0, length_includes_head=True)

    return Picture(f"separating planes of {len(supports)} supports", base.width, base.height, draw)


def azimuth_of(view: View) -> float:
    """Return the azimuth from which a view looks [rad]."""
    return float(np.arctan2(-view.pose[1, 2], -view.pose[0, 2]))


def concepts() -> dict[str, Image.Image]:
    """Draw a picture of each stage of the loop."""
    config = replace(Config(), active=replace(Config().active, max_views=4))
    scene = scene_from_spec(build_spec(SOLIDS, "concepts"), "concepts", "concepts", least=1.0)
    simulation = make_simulation(scene, config, noise="carmine", seed=0)
    steps = list(
        explore(simulation.camera, simulation.robot, config=config, segmentation="auto", early_stop=False)
    )
    first, last = steps[0], steps[-1]
    views = [step.view for step in steps if step.view is not None]
    empty, side = SupportGraph(), azimuth_of(views[0]) - 0.5
    pale = replace(views[0], rgb=None)
    known = Scene(config, segmentation="auto")
    known.update(views[0])
    assert known.voxels is not None
    assert first.candidates is not None
    state = PlanningState(
        first.graph, first.sphere, known.voxels, first.visited, first.candidates, config.active
    )
    paper = replace(first, decision=make_planner("attention").plan(state, np.random.default_rng(0)))
    order = plan_order(last.graph, config, hands=2)
    bodies = bodies_of(last.graph, true_scene_from_simulation(scene, ground_truth(scene)))
    hands = SimulatedHands(scene, config)
    taken = [hands.take(lift, bodies) for lift in order.steps]
    supports = last.graph.supports
    lifts = [draw_lift(scene, t, last.graph, views[0].pose, config) for t in taken if t.body is not None]
    pages: dict[str, tuple[Sequence[Titled], int, int]] = {
        "view": ([(plain(views[0]), "colour"), (plain(pale), "depth, near is light")], 480, 2),
        "parts": ([(plain(views[0], first.labels, first.graph), "the segments on the table")], 640, 1),
        "shapes": (
            [
                (draw_cloud(first.cloud, empty, side), "points of the first view, from the side"),
                (draw_cloud(first.cloud, first.graph, side), "the shapes that explain them"),
            ], 560, 2,
        ),
        "contacts": (
            [
                (planes(last, [s for s in supports if s.kind == "bottom-up"]), "supports from below"),
                (planes(last, [s for s in supports if s.kind != "bottom-up"]), "leaning, held from above"),
            ], 560, 2,
        ),
        "graph": (
            [
                (draw_cloud(last.cloud, last.graph, azimuth_of(views[-1])), "the shapes after four views"),
                (draw_graph(last.graph), "which object supports which, with probabilities"),
            ], 560, 2,
        ),
        "fusion": ([(draw_graph(steps[k].graph), f"after view {k + 1}") for k in (0, 1, 3)], 420, 3),
        "interest": ([(draw_sphere(paper), "points of interest and their saliency")], 560, 1),
        "next": (
            [
                (draw_sphere(first), "what each view would show, minus the path length"),
                (plain(views[1]), "the view that was chosen"),
            ], 520, 2,
        ),
        "order": ([(f.picture, f.heading) for f in lifts], 280, 4),
    }  # fmt: skip
    return {name: sheet(*page) for name, page in pages.items()}


def film() -> tuple[list[Image.Image], list[int]]:
    """Explore a scene; return frames of the view, the model and the choice, and their durations [ms]."""
    scene, config = load_scene("clutter"), Config()
    truth = true_scene_from_simulation(scene, ground_truth(scene))
    simulation = make_simulation(scene, config, noise="carmine", seed=0)
    images, times, graph = [], [], SupportGraph()

    def add(step: Step, phase: str, time: int, *, found: bool) -> None:
        view, number = step.view, step.index + 1
        assert view is not None
        pictures = [
            (plain(view, step.labels, step.graph) if found else plain(view), "what the camera sees"),
            (draw_cloud(step.cloud, graph, azimuth_of(view) - 0.4), "what is known: points and shapes"),
            (draw_sphere(step if time == CHOOSE else replace(step, decision=None)), "where to look from"),
            (draw_graph(graph), "the support graph"),
        ]
        f1 = score(graph, truth).f1 if graph.objects else 0.0
        images.append(sheet(pictures, 400, 2, f"view {number} · F1 {f1:.2f} · {phase}"))
        times.append(time)

    for step in explore(simulation.camera, simulation.robot, config=config, seed=0):
        add(step, "look", LOOK, found=False)
        graph = step.graph
        add(step, "fit shapes, infer what supports what, fuse", KNOW, found=True)
        if step.decision is None:
            add(step, f"done: {step.stop}", END, found=True)
            break
        why = textwrap.shorten(f"next view: {step.decision.why}", 90, placeholder=" …")
        add(step, why, CHOOSE, found=True)
    size = images[0].width, max(image.height for image in images)
    return [ImageOps.pad(image, size, color="white", centering=(0, 0)) for image in images], times


@contextmanager
def viewing(browser: Any, source: str, **options: Any) -> Iterator[tuple[LoopPage, Any]]:
    """Open a viewer's page, take its first view, and show it in a tab of Chromium."""
    from browser import Tab

    opening = partial(open_source, source, noise="carmine", segmentation=None, seed=0)
    with closing(LoopPage(opening, Config(), **options)) as page:
        page.start()
        page.wait()
        tab = Tab(browser.new_page(viewport={"width": 1280, "height": 720}))
        tab.open(page.url, resolution=1.0)
        yield page, tab


def viewer() -> Iterator[tuple[str, Image.Image]]:
    """Take screenshots of the viewer, with a scene and with a recording."""
    sys.path.insert(0, str(PICTURES.parents[1] / "tests"))
    from browser import chromium

    def shot(tab: Any) -> Image.Image:
        tab.page.wait_for_timeout(2000)  # The browser lays out text, then decodes pictures.
        tab.settle()
        return Image.open(io.BytesIO(tab.page.screenshot())).convert("RGB")

    with chromium() as browser:
        with viewing(browser, "clutter") as (page, tab):
            yield "first", shot(tab)
            for number in (2, 3):
                tab.press("next view")
                tab.wait_for_text(f"View {number} of {number}")
            yield "views", shot(tab)
            tab.click(page, page.drawing.anchors["o6"])
            tab.wait_for_text("Without o6")
            yield "object", shot(tab)
            tab.press("clear")
            page.wait()
            tab.wait_for_text("finished")
            yield "cleared", shot(tab)
        with viewing(browser, "sample-recording", segmentation="auto") as (_, tab):
            yield "recording", shot(tab)


def main(what: Annotated[Literal["concepts", "film", "viewer"], tyro.conf.Positional]) -> None:
    """Draw the pictures of docs/concepts.md, the film of README.md, or the viewer of docs/runs.md."""
    known: dict[str, Any] = {"method": Image.Quantize.MEDIANCUT, "dither": Image.Dither.NONE}
    if what == "film":
        images, times = film()
        first, *others = [image.quantize(256, **known) for image in images]
        file = PICTURES / "explore.gif"
        first.save(file, save_all=True, append_images=others, duration=times, loop=0, optimize=False)
        return
    pictures = viewer() if what == "viewer" else concepts().items()
    for name, image in pictures:
        file = f"viewer-{name}.png" if what == "viewer" else f"concepts/{name}.png"
        image.quantize(256, **known).save(PICTURES / file, optimize=True)


if __name__ == "__main__":
    tyro.cli(main)
