"""Draw the documentation's pictures: stages of the loop on one scene, README.md's film, viewer and report.

    python docs/pictures/draw.py concepts
    python docs/pictures/draw.py film
    python docs/pictures/draw.py viewer
    python docs/pictures/draw.py report

The first two commands draw with `caryatid.viz`, like reports; all take screenshots in Chromium.
"""

from __future__ import annotations

import io
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image, ImageOps

from caryatid import Config, Step, cli, explore
from caryatid.evaluation.scores import score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry import transforms
from caryatid.graph import Support, SupportGraph
from caryatid.manipulation.clearing import SimulatedHands, bodies_of
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
from caryatid.viz.pictures import Picture, area, dot, line, picture_svg
from caryatid.viz.report import draw_lift, read_lift

PICTURES = Path(__file__).parent
sys.path.insert(0, str(PICTURES.parents[1] / "tests"))
from browser import Tab, chromium  # noqa: E402  (after the path)

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


def sheet(page: Any, pictures: Sequence[Titled], width: int, columns: int, heading: str = "") -> Image.Image:
    """Arrange titled pictures in rows of cells of this width [px], with Chromium."""
    cells = "".join(f"<div>{escape(title)}{picture_svg(picture)}</div>" for picture, title in pictures)
    page.set_content(
        f"<body style='margin: 0; font: 14px DejaVu Sans; text-align: center'><p style='margin: 8px; "
        f"text-align: left' {'' if heading else 'hidden'}>{escape(heading)}</p><main style='display: grid; "
        f"grid-template-columns: repeat({columns}, {width}px)'>{cells}</main></body>"
    )
    page.set_viewport_size({"width": columns * width, "height": 100})
    return Image.open(io.BytesIO(page.screenshot(full_page=True))).convert("RGB")


def plain(view: View, labels: NDArray[np.int32] | None = None, graph: SupportGraph | None = None) -> Picture:
    """Draw a view without shapes, with its segments if labels are given."""
    none = np.zeros(view.depth.shape, np.int32)
    shown = none if labels is None else labels
    return draw_image(view, shown, graph or SupportGraph(), view.depth.shape[1], shapes=False)


def planes(step: Step, supports: Sequence[Support]) -> Picture:
    """Draw a view with the separating planes of supports and their normals."""
    view = step.view
    assert view is not None
    base, projection, parts = plain(view), Projection(view.pose, view.K, view.depth), []
    for support in supports:
        at, normal = support.contact_world, support.normal_world
        if at is None or normal is None:
            continue
        colour = "#d55e00" if support.doubtful else "#3b4252"
        u = transforms.perpendicular(normal)
        v = np.cross(normal, u)
        corners = [at + PLANE * (a * u + b * v) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        parts.append(area(projection.project(np.array(corners))[0], colour, opacity=0.5))
        ends = projection.project(np.stack([at, at + NORMAL * normal]))[0]
        parts += [line(ends, colour, 2.0), dot(ends[1], 4.0, colour)]
    return replace(base, name=f"separating planes of {len(supports)} supports", parts=[*base.parts, *parts])


def azimuth_of(view: View) -> float:
    """Return the azimuth from which a view looks [rad]."""
    return float(np.arctan2(-view.pose[1, 2], -view.pose[0, 2]))


def concepts(page: Any) -> dict[str, Image.Image]:
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
    drawn = [draw_lift(scene, t, last.graph, views[0].pose, config) for t in taken if t.body is not None]
    lifts = [read_lift(io.BytesIO(content)) for content in drawn]
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
    return {name: sheet(page, *content) for name, content in pages.items()}


def film(page: Any) -> tuple[list[Image.Image], list[int]]:
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
        images.append(sheet(page, pictures, 400, 2, f"view {number} · F1 {f1:.2f} · {phase}"))
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
    opening = partial(open_source, source, noise="carmine", segmentation=None, seed=0)
    with closing(LoopPage(opening, Config(), **options)) as page:
        page.start()
        page.wait()
        tab = Tab(browser.new_page(viewport={"width": 1280, "height": 720}))
        tab.open(page.url, resolution=1.0)
        yield page, tab


def viewer(browser: Any) -> Iterator[tuple[str, Image.Image]]:
    """Take screenshots of the viewer, with a scene and with a recording."""

    def shot(tab: Any) -> Image.Image:
        tab.page.wait_for_timeout(2000)  # The browser lays out text, then decodes pictures.
        tab.settle()
        return Image.open(io.BytesIO(tab.page.screenshot())).convert("RGB")

    with viewing(browser, "clutter") as (page, tab):
        yield "first", shot(tab)
        for number in (2, 3):
            tab.press("next view")
            tab.wait_for_text(f"View {number} of {number}")
        yield "views", shot(tab)
        page.describe("o6")
        tab.wait_for_text("Without o6")
        yield "object", shot(tab)
        page.describe("")
        tab.page.get_by_text("order", exact=True).click()
        page._gripper.value = "robotiq-140"
        tab.press("plan")
        tab.wait_for_text("after view 3")
        yield "order", shot(tab)
        tab.press("clear")
        page.wait()
        tab.wait_for_text("finished")
        yield "cleared", shot(tab)
    with viewing(browser, "sample-recording", segmentation="auto") as (page, tab):
        tab.page.get_by_text("image", exact=True).click()
        page._kind.value = "segments and shapes"
        yield "recording", shot(tab)
        tab.page.set_viewport_size({"width": 1600, "height": 1000})
        yield "large", shot(tab)
        tab.page.set_viewport_size({"width": 390, "height": 844})
        tab.open(page.url, resolution=1.0)
        yield "phone", shot(tab)


def report(browser: Any) -> Iterator[tuple[str, Image.Image]]:
    """Take screenshots of reports: a safe lift, none that is safe, and where to look."""
    page = browser.new_page(viewport={"width": 1280, "height": 740})
    for name, scene, views in (("safe", "clutter", 5), ("unsafe", "blocks-6-0", 2), ("map", "clutter", 1)):
        with TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            assert cli.main(["explore", scene, "--views", str(views), "--out", str(run), "--quiet"]) == 0
            page.goto((run / "report.html").as_uri())
        shown = page.locator("figure:has-text('Map')").last if name == "map" else page
        yield name, Image.open(io.BytesIO(shown.screenshot())).convert("RGB")


def main(what: Annotated[Literal["concepts", "film", "viewer", "report"], tyro.conf.Positional]) -> None:
    """Draw the pictures of docs/concepts.md, the film of README.md, or viewer or report of docs/runs.md."""
    known: dict[str, Any] = {"method": Image.Quantize.MEDIANCUT, "dither": Image.Dither.NONE}
    with chromium() as browser:
        if what == "film":
            images, times = film(browser.new_page())
            first, *others = [image.quantize(256, **known) for image in images]
            file = PICTURES / "explore.gif"
            first.save(file, save_all=True, append_images=others, duration=times, loop=0, optimize=False)
            return
        shots = {"viewer": viewer, "report": report}
        pictures = shots[what](browser) if what in shots else concepts(browser.new_page()).items()
        for name, image in pictures:
            file = f"{what}-{name}.png" if what in shots else f"concepts/{name}.png"
            image.quantize(256, **known).save(PICTURES / file, optimize=True)


if __name__ == "__main__":
    tyro.cli(main)
