"""The report of a run: one self-contained HTML file, which Chromium prints as a PDF."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import textwrap
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from caryatid.config import Config, ReportConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.graph import DOUBTFUL, SupportGraph
from caryatid.manipulation.clearing import Taken
from caryatid.sensing.views import Cloud
from caryatid.simulation.camera import intrinsics, render
from caryatid.simulation.lifting import ASIDE
from caryatid.simulation.world import SimulatedScene, posed
from caryatid.viz.drawings import draw_chart, draw_cloud, draw_image, draw_sphere, draw_stands, tint, window
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.pictures import Picture, picture_svg, raster
from caryatid.viz.scene_3d import name_plate, scene_3d_html
from caryatid.viz.tables import (
    Table,
    census,
    changes,
    count_of,
    doubts,
    noticed,
    object_table,
    order_table,
    point_table,
    reason_table,
    sentence,
    sides_to_see,
    support_table,
)

if TYPE_CHECKING:
    import jinja2

    from caryatid.exploration import Step
    from caryatid.manipulation.order import Order


SUPPORTS = (
    "Arrows run from supporter to supported, labelled with the probability of the support; thicker is more "
    "probable. Dashed arrows are doubtful; an object with a dashed outline has no known supporter. 2/3: "
    "found in 2 of the 3 views that could show it."
)
"""Caption of a support graph."""
WIDE = 680.0
"""Width from which a graph cannot be read in half the page [px]: more than eight vertices side by side."""
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
"""What Chromium is called, in order of preference; the environment's CHROMIUM goes before."""


@dataclass(frozen=True, eq=False, slots=True)
class Figure:
    """One picture of the report.

    Attributes:
        heading: Its heading, or empty.
        picture: What is drawn.
        caption: Caption of the picture, or empty.
        share: Divisor of the page width: 2 = half of it.
        link: Anchor of the section it links to, or empty.
        page: An HTML page that covers the picture on a screen, or empty; the caption is then for print.
    """

    heading: str
    picture: Picture
    caption: str = ""
    share: int = 2
    link: str = ""
    page: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class Section:
    """A section of the report in HTML and PDF, or a notebook cell.

    Attributes:
        title: Heading.
        text: Text below or beside the heading, a paragraph a line.
        figures: Pictures, side by side if they fit.
        facts: Names and texts.
        tables: Tables, one below the other.
        colour: Colour of the chip before the title, `#rrggbb`, or empty.
        folded: Whether the page shows only the title until it is clicked.
    """

    title: str
    text: str = ""
    figures: Sequence[Figure] = ()
    facts: Sequence[tuple[str, str]] = ()
    tables: Sequence[Table] = ()
    colour: str = ""
    folded: bool = False

    @property
    def anchor(self) -> str:
        """Its id on the page."""
        return self.title.lower().replace(" ", "")


@dataclass(frozen=True, eq=False, slots=True)
class Report:
    """The contents of a report.

    Attributes:
        title: Heading.
        about: Conditions, version and date of the run.
        sections: Answer, what is doubtful, how it went, removal, and folded: tables, views, settings.
        of_run: Whether it has shapes and segments.
    """

    title: str
    about: str
    sections: Sequence[Section]
    of_run: bool = True


def make_report(
    title: str,
    steps: Iterable[Step],
    *,
    about: str = "",
    answer: str = "",
    order: Order | None = None,
    settings: Mapping[str, object] | None = None,
    scores: Sequence[Mapping[str, Any]] = (),
    strip: Sequence[Figure] = (),
    warnings: Sequence[str] = (),
    config: ReportConfig | None = None,
) -> Report:
    """Make the report of a run; steps are drawn one by one, to keep only one image and cloud in memory.

    Args:
        title: Heading of the report.
        steps: Steps that `explore` or `extract` yields; at least one.
        about: Conditions, version and date of the run.
        answer: What was removed, what to remove, how safe that is; the first line is the largest.
        order: The order in which to remove objects, with its grasps.
        settings: Names and values of the run's settings.
        scores: Values of the `Score` after each view by name; empty without ground truth.
        strip: Pictures of the lifts, in order.
        warnings: What may be wrong with the views, one sentence each.
        config: Sizes of the pictures.

    Raises:
        ValueError: The number of scores differs from that of the steps, or there are no steps.
    """
    width = (config or ReportConfig()).image_width
    seen: list[Step] = []
    views: list[Section] = []
    contacts, happened, shown, last, most = [], list[tuple[str, str]](), None, None, 0
    for number, step in enumerate(steps):
        f1 = f"F1 {scores[number]['f1']:.3f}" if number < len(scores) else ""
        before = seen[-1] if seen else None
        lines = {} if before is None else changes(before, step)
        news = "; ".join(f"{kind}: {', '.join(items)}" for kind, items in lines.items())
        news = news or ("" if before is None else "no change")
        told = [(f"Before view {step.index + 1}", str(change)) for change in noticed(before, step)]
        happened += told
        views.append(_view(step, news, f1, width, told))
        if step.view is not None:
            picture = draw_image(step.view, step.labels, step.graph, width // 2, shapes=False)
            chosen = None if before is None else before.decision
            why = "the first view" if before is None else "" if chosen is None else chosen.why
            caption = textwrap.shorten(f"{sentence(why)} {sentence(news)}", 220, placeholder=" …")
            heading = " · ".join(filter(None, (views[-1].title, f1)))
            contacts.append(Figure(heading, picture, caption, 4, views[-1].anchor))
        count = len(np.unique(step.labels))
        if shown is None or step.changes or count >= most:
            shown, most = step, count
        last = step
        nothing = step.cloud.select(np.zeros(0, dtype=np.intp))
        seen.append(replace(step, view=None, labels=step.labels[:0], cloud=nothing, candidates=None))
    if last is None or shown is None:
        raise ValueError("a report needs at least one view")
    if scores and len(scores) != len(seen):
        raise ValueError(f"{len(scores)} scores for {len(seen)} views")
    text = f"{answer} {census(last.graph)} after {count_of(len(seen), 'view')}.".strip()
    sections = [*_answer(last, shown, text, order, scores[-1] if scores else None, width)]
    facts = [("Warning", sentence(warning)) for warning in warnings]
    facts += happened
    facts += [("Finished", sentence(last.stop))] if last.stop else []
    pictures = [*contacts * (len(contacts) > 1), *_charts(seen, scores)]
    if pictures or facts:
        sections.append(Section("How it went", figures=pictures, facts=facts))
    if strip:
        text = "Each object is lifted straight up in simulation, one after the other."
        sections.append(Section("Removal", text, strip))
    tables = [object_table(last.graph), support_table(last.graph)]
    tables += [reason_table(last.reasons, last.graph)] * bool(last.reasons)
    sections += [Section("Objects and supports", tables=tables, folded=True), *views]
    words = {"None": "not set", "True": "on", "False": "off"}
    named = ((name, words.get(str(value), str(value))) for name, value in (settings or {}).items())
    source = Table.of("Source and options", ("name", "value"), named)
    sections.append(Section("Settings", tables=[source], folded=True))
    return Report(title, about, sections)


def _answer(
    step: Step, shown: Step, text: str, order: Order | None, score: Mapping[str, Any] | None, width: int
) -> Iterator[Section]:
    """The final graph beside the view of the step that shows most objects, the order, doubts, and in 3D."""
    graph, truth, facts = step.graph, {"wrong": (), "missing": ()} | dict(score or {}), []
    if step.removal is not None:
        facts.append((f"Without {step.removal.object_id}", f"{step.removal}."))
    if "matches" in truth:
        errors = {
            "wrong supports": [f"{a} → {b}" for a, b in truth["wrong"]],
            "missing supports": [f"{a} → {b}" for a, b in truth["missing"]],
            "wrong objects": [o.id for o in graph.objects if o.id not in truth["matches"]],
            "missing objects": truth["unfound"],
        }
        listed = "; ".join(f"{name}: {', '.join(names)}" for name, names in errors.items() if names)
        known = f"F1 {truth['f1']:.3f}, precision {truth['precision']:.3f}, recall {truth['recall']:.3f}."
        listed = f"{sentence(listed or 'nothing is wrong or missing')} {known}"
        facts.append(("Compared with the ground truth", listed))
    red = " Red: wrong or missing, compared with the ground truth." * bool(truth["wrong"] or truth["missing"])
    supports = _graph_figure(graph, SUPPORTS + red, truth["wrong"], truth["missing"])
    azimuth = _first_azimuth(step)
    solid, still = draw_cloud(step.cloud, graph, azimuth), "All points, with the fitted shapes."
    seen = Figure("Fused cloud", solid, still)
    if shown.view is not None:
        caption = f"View {shown.index + 1}, tinted by its segments, with the final shapes of all views; "
        caption += "objects with pale names are not visible."
        seen = Figure("The objects", draw_image(shown.view, shown.labels, graph, width), caption)
    yield Section("Answer", text, [supports, seen] if supports.share == 1 else [seen, supports], facts)
    if order is not None and (steps := order_table(order, graph, brief=True)).rows:
        yield Section("Order", tables=[steps])
    doubtful = [(lead, why) for lead, why, _ in doubts(graph)]
    text = f"Nothing: all supports and objects have a probability above {DOUBTFUL}, and all shapes fit."
    if any(s.probability is None for s in graph.supports):
        text = "The probability of supports is unknown: it is not part of the rules of the paper."
    elif doubtful:
        text = "Arrows on the map below show from which azimuths to look." if sides_to_see(graph) else ""
    yield Section("What is doubtful", text, facts=doubtful)
    if graph.objects:
        yield Section("In 3D", figures=[Figure("", solid, still, 1, page=scene_3d_html(graph, azimuth))])


def _graph_figure(graph: SupportGraph, caption: str, *errors: Collection[Sequence[str]]) -> Figure:
    """The support graph, beside another picture if it can be read there."""
    picture = draw_graph(graph, *errors)
    return Figure("Support graph", picture, caption, share=1 if picture.width > WIDE else 2)


def _charts(steps: Sequence[Step], scores: Sequence[Mapping[str, float]]) -> list[Figure]:
    """Scores over views, where the robot stood, and from where to look."""
    figures = []
    if scores:
        lines = {name: [s[name.lower()] for s in scores] for name in ("F1", "precision", "recall")}
        figures.append(Figure("", draw_chart("F1 over views", "share", lines, top=1.0), share=3))
    sides = sides_to_see(steps[-1].graph)
    if sides or any(step.robot is not None for step in steps):
        caption = (
            "From above: platform (or arm base) and camera direction at each view, and the platform's path."
        )
        caption += " Orange: from where unseen sides of what is doubtful can be seen." * bool(sides)
        figures.append(Figure("Map", draw_stands(steps, sides), caption, 3))
    return figures


def _view(step: Step, news: str, f1: str, width: int, happened: Sequence[tuple[str, str]]) -> Section:
    """A view: its counts, its score and what it changed, pictures, what comes next, tables."""
    decision, facts, tables = step.decision, [*happened], []
    if step.lift is not None:
        facts.append((f"Removed {step.lift.object_id}", sentence(step.lift.why)))
    if decision is not None:
        known = f"saliency {decision.saliency:.2f}, path cost {decision.cost:.2f}, score {decision.score:.2f}"
        facts.append(("Next view", f"{decision.why.rstrip('.')} ({known})."))
        tables += [point_table(decision)] * bool(decision.points_of_interest)
    text = " · ".join(filter(None, (step.name, census(step.graph), f1, news)))
    return Section(f"View {step.index + 1}", text, _figures(step, width), facts, tables, folded=True)


def _first_azimuth(step: Step) -> float:
    """Direction [rad] from the scene to where the first view was taken."""
    if len(step.visited):
        return float(np.arctan2(step.visited[0, 1], step.visited[0, 0]))
    return sensor_azimuth(step.cloud, None if step.view is None else step.view.T_world_camera)


def _figures(step: Step, width: int) -> list[Figure]:
    graph, cloud, view, figures = step.graph, step.cloud, step.view, []
    if view is not None:
        kind = "colour image" if view.rgb is not None else "depth image, near bright and far dark"
        caption = (
            f"The {kind} around the objects, tinted by segment, with the outlines of the fitted shapes. "
            "Hidden outlines are thin; objects with pale names are not visible."
        )
        picture = draw_image(view, step.labels, graph, width)
        figures.append(Figure("Camera image", picture, caption))
    figures.append(_graph_figure(graph, SUPPORTS))
    caption = (
        f"{len(cloud):,} fused points, coloured by object, with the fitted shapes. Pale: the inside of a "
        "surface whose outside is unseen."
    )
    figures.append(Figure("Fused cloud", draw_cloud(cloud, graph, _first_azimuth(step)), caption))
    if step.candidates is not None or step.decision is not None:
        caption = (
            "The view sphere from above, coloured by saliency; pale views are out of the robot's reach. Rays "
            "lead from points of interest to the views that show them best. Numbers: views so far."
        )
        if step.candidates is not None:
            refused = [f"{count:,} {reason}" for reason, count in step.candidates.rejected.items()]
            caption += f" {len(step.candidates):,} views are reachable"
            caption += f"{'; rejected: ' * bool(refused)}{', '.join(refused)}."
        figures.append(Figure("Next best view", draw_sphere(step), caption))
    return figures


def sensor_azimuth(cloud: Cloud, T_world_camera: Array | None) -> float:
    """Direction [rad] from the scene to the sensor at a pose (4, 4); where unknown, the world's −x."""
    backward = np.array([-1.0, 0.0, 0.0])
    if T_world_camera is not None:
        backward = -T_world_camera[:3, 2]
    elif cloud.viewpoint_world is not None and len(cloud):
        backward = cloud.viewpoint_world - cloud.points_world.mean(axis=0)
    return float(np.arctan2(backward[1], backward[0]))


# Lifts


def draw_lift(
    scene: SimulatedScene, taken: Taken, graph: SupportGraph, T_world_camera: Array, config: Config
) -> bytes:
    """Draw a lift half way up, or at its end if it disturbed an object, as a PNG with heading and caption.

    Args:
        scene: The simulated scene.
        taken: Outcome of the step; a body was lifted.
        graph: The graph before the lift.
        T_world_camera: Camera pose (4, 4) of the picture.
        config: Sizes of the picture.
    """
    labels = {body: graph[i].label for i, body in taken.bodies.items()}
    label_of = np.zeros(max(scene.object_bodies) + 1, dtype=np.int32)
    for label, name in scene.object_bodies.items():
        label_of[label] = labels.get(name, 0)
    names = list(scene.object_bodies.values())
    heights = taken.film[:, names.index(taken.body or "")][:, 2]
    rising = np.flatnonzero(heights < ASIDE / 2.0)
    state = taken.film[rising[(len(rising) - 1) // 2]] if taken.ok else taken.film[-1]
    shot = render(posed(scene, state), T_world_camera, intrinsics(config.sensor), config.sensor)
    found = label_of[shot.labels]
    drawn, tinted = Image.fromarray(shot.rgb), Image.fromarray(tint(shot.rgb, found))
    drawn.paste(tinted, mask=tinted)
    for item in graph.objects:
        v, u = np.nonzero(found == item.label)
        if len(u) and item.role == "object":
            plate = name_plate(item.id, item.label)
            plate.thumbnail((64, 20))
            drawn.paste(plate, (int(np.median(u)) - plate.width // 2, int(np.median(v)) - plate.height // 2))
    drawn = drawn.crop(window(found))
    drawn.thumbnail((config.report.image_width // 2,) * 2)
    held = f", {', '.join(taken.step.hold)} held" if taken.held else ""
    outcome = "Nothing else moved" if taken.ok else f"{', '.join(taken.disturbed)} moved"
    said = PngInfo()
    said.add_itxt("heading", f"{taken.step.object_id}{held}")
    said.add_itxt("caption", f"{outcome}; {taken.step.why}.")
    content = io.BytesIO()
    drawn.save(content, "PNG", pnginfo=said)
    return content.getvalue()


def read_lift(file: Path | BinaryIO) -> Figure:
    """Read a picture that `draw_lift` drew."""
    with Image.open(file) as image:
        (width, height), info = image.size, image.info
        pixels = raster(np.asarray(image.convert("RGB")), 0.0, 0.0, width, height)
    picture = Picture(f"lift of {info.get('heading', '')}", width, height, [pixels])
    return Figure(info.get("heading", ""), picture, info.get("caption", ""), 3)


# As HTML and PDF


@cache
def template(name: str) -> jinja2.Template:
    """One of the HTML templates of this package; everything put into it is escaped."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        loader=jinja2.PackageLoader("caryatid", "viz"),
    )
    return environment.get_template(name)


def render_html(report: Report) -> str:
    """Write a report as one self-contained HTML file; ids lead to the rows of their objects."""
    rows = [row for section in report.sections for table in section.tables for row in table.rows]
    ids = sorted({row[0].about for row in rows if re.fullmatch(r"[os]\d+", row[0].about)})
    known = "|".join(ids) or "(?!)"

    def link(text: str) -> str:
        return re.sub(rf"\b({known})\b", r'<a href="#\1">\1</a>', escape(text))

    def svg(picture: Picture) -> str:
        vertex = rf'<g class="node ({known})\b.*?</g>'
        drawn, links = re.subn(vertex, r'<a href="#\1">\g<0></a>', picture_svg(picture))
        return drawn.replace('role="img"', 'role="group"', 1) if links else drawn

    return template("page.html.jinja").render(report=report, svg=svg, link=link, ids=ids)


def find_chromium() -> str | None:
    """Path of Chromium, if it is installed."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, CHROMIUM_NAMES)), None)


def print_pdf(html: str) -> bytes:
    """Print a page on A4, with bookmarks.

    Raises:
        InputError: Chromium is not installed, or does not print the page.
    """
    program = find_chromium()
    if program is None:
        remedy = "install Chromium or Chrome, or set CHROMIUM to its path"
        raise InputError("the PDF", "is printed by Chromium, which was not found", remedy)
    with TemporaryDirectory() as folder:
        page, printed = Path(folder, "report.html"), Path(folder, "report.pdf")
        page.write_text(html, encoding="utf-8")
        options = ["--headless", "--disable-gpu", "--no-pdf-header-footer", "--generate-pdf-document-outline"]
        options += [f"--user-data-dir={folder}/profile", f"--print-to-pdf={printed}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            options.append("--no-sandbox")  # As root, Chromium has none.
        try:
            subprocess.run([program, *options, page.as_uri()], check=True, capture_output=True, timeout=120.0)
            return printed.read_bytes()
        except (OSError, subprocess.SubprocessError) as error:
            told = (getattr(error, "stderr", None) or b"").decode(errors="replace").strip() or str(error)
            reason = f"was not printed by {program} ({told.splitlines()[-1]})"
            raise InputError("the PDF", reason, "print report.html from a browser") from error
