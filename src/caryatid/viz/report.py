"""The report of a run: what it says, section by section, written to one HTML file that opens anywhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ReportConfig
from caryatid.sensing.views import Cloud
from caryatid.viz.drawings import bar_chart, draw_cloud, draw_image, draw_sphere, line_chart
from caryatid.viz.graph_drawing import BESIDE, draw_graph
from caryatid.viz.pictures import Picture, picture_svg
from caryatid.viz.tables import (
    Table,
    changes,
    count_of,
    object_table,
    point_table,
    settings_table,
    support_table,
)

if TYPE_CHECKING:
    import jinja2

    from caryatid.exploration import Step


@dataclass(frozen=True, eq=False, slots=True)
class Figure:
    """One picture of the report.

    Attributes:
        heading: Its heading, or empty.
        picture: What is drawn.
        caption: What is to be seen in it, or empty.
        wide: It takes the whole width of the page.
        link: Anchor of the section it leads to, or empty.
    """

    heading: str
    picture: Picture
    caption: str = ""
    wide: bool = False
    link: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class Section:
    """A part of the report, on the page as in print, or all a notebook shows of one thing.

    Attributes:
        title: Its heading.
        text: What stands below or beside it.
        figures: Pictures side by side.
        facts: Names and what is said under them.
        tables: Tables, one below the other.
        colour: Colour of the chip before the title, `#rrggbb`, or empty.
        anchor: Its id on the page.
        columns: How many pictures stand side by side.
    """

    title: str
    text: str = ""
    figures: Sequence[Figure] = ()
    facts: Sequence[tuple[str, str]] = ()
    tables: Sequence[Table] = ()
    colour: str = ""
    anchor: str = ""
    columns: int = 2


@dataclass(frozen=True, eq=False, slots=True)
class ViewPage:
    """One view, drawn.

    Attributes:
        step: What is known after it, without its images and clouds.
        figures: The pictures.
        thumbnail: The view's picture for the contact sheet; None for a cloud.
    """

    step: Step
    figures: tuple[Figure, ...]
    thumbnail: Picture | None

    @property
    def number(self) -> str:
        """The view's number as its folder in the run has it."""
        return f"{self.step.index:02d}"

    @property
    def objects(self) -> int:
        """How many objects are known, without the support surface."""
        return sum(o.role == "object" for o in self.step.graph.objects)

    @property
    def uncertain(self) -> int:
        """How many supports are uncertain."""
        return sum(not s.certain for s in self.step.graph.supports)


@dataclass(frozen=True, eq=False, slots=True)
class Report:
    """All a report says.

    Attributes:
        title: Its heading.
        pages: The views in order, at least one.
        settings: Names and values of the run's settings; mappings and dataclasses in it are flattened.
        scores: F1, precision and recall after each view by name; empty where there is no ground truth.
        strip: Pictures of the objects being taken away, in order.

    Raises:
        ValueError: There are scores, but not one for each page, or there is no page.
    """

    title: str
    pages: Sequence[ViewPage]
    settings: Mapping[str, object] = field(default_factory=dict)
    scores: Sequence[Mapping[str, float]] = ()
    strip: Sequence[Figure] = ()

    def __post_init__(self) -> None:
        if not self.pages:
            raise ValueError("a report needs at least one view")
        if self.scores and len(self.scores) != len(self.pages):
            raise ValueError(f"{len(self.scores)} scores for {len(self.pages)} views")

    @property
    def sections(self) -> list[Section]:
        """Everything, in order: summary, contact sheet, the views, what was taken apart, settings."""
        sections = [Section("Summary", figures=self.charts, anchor="summary", columns=4)]
        if thumbnails := self._thumbnails():
            text = "Every view with the segments found in it, and why it was taken."
            sections.append(Section("Contact sheet", text, thumbnails, anchor="contacts", columns=4))
        sections += [self._view(number) for number in range(len(self.pages))]
        if self.strip:
            text = "Each object lifted straight up in physics, in the order found."
            sections.append(Section("Taken apart", text, self.strip, anchor="taken", columns=3))
        return [*sections, Section("Settings", tables=(settings_table(self.settings),), anchor="settings")]

    @property
    def cards(self) -> list[tuple[str, str, str]]:
        """Big figures of the summary: name, figure, what it is made of."""
        page = self.pages[-1]
        last, uncertain, supports = page.step, page.uncertain, len(page.step.graph.supports)
        kinds = [o.shape.kind for o in last.graph.objects if o.role == "object"]
        counts = ", ".join(count_of(kinds.count(kind), kind) for kind in sorted(set(kinds)))
        seconds = [sum(page.step.timings.values()) for page in self.pages]
        cards = [
            ("objects", str(len(kinds)), counts or "none found"),
            ("supports", str(supports), f"{supports - uncertain} certain, {uncertain} uncertain"),
            ("views", str(len(self.pages)), last.stop or "all there were"),
            ("per view", f"{np.mean(seconds):.2f} s", f"slowest {max(seconds):.2f} s"),
        ]
        if last.angle_travelled > 0.0 or last.path_travelled > 0.0:
            path = f"around the scene; path length {last.path_travelled:.1f} m"
            cards.append(("travelled", f"{np.rad2deg(last.angle_travelled):.0f}°", path))
        if self.scores:
            final = self.scores[-1]
            note = f"precision {final['precision']:.3f}, recall {final['recall']:.3f}"
            cards.insert(0, ("F1", f"{final['f1']:.3f}", note))
        return cards

    @property
    def charts(self) -> list[Figure]:
        """The summary's charts: scores over views and path, what was found, time."""
        steps, number = [page.step for page in self.pages], [float(p.step.index) for p in self.pages]
        charts = []
        if self.scores:
            names = ("F1", "precision", "recall")
            lines = {name: [score[name.lower()] for score in self.scores] for name in names}
            charts.append(line_chart("F1 over views", "view", number, lines, "share"))
            path, unit = [step.path_travelled for step in steps], "path [m]"
            if path[-1] == 0.0:
                path = [float(np.rad2deg(step.angle_travelled)) for step in steps]
                unit = "angle around the scene [°]"
            if path[-1] > path[0]:
                charts.append(line_chart("F1 over path length", unit, path, {"F1": lines["F1"]}, "F1"))
        if len(steps) > 1:
            found = {
                "objects": [page.objects for page in self.pages],
                "supports": [len(step.graph.supports) for step in steps],
                "uncertain supports": [page.uncertain for page in self.pages],
            }
            charts.append(line_chart("Found so far", "view", number, found, "number"))
        times = [step.timings for step in steps]
        if any(times):
            charts.append(bar_chart("Time of each stage", "view", times, "time [s]"))
        return [Figure("", chart) for chart in charts]

    def _thumbnails(self) -> list[Figure]:
        """The views that have a picture, each with its score and why it was taken; none of a single view."""
        figures, reason = [], "the first view"
        for number, page in enumerate(self.pages if len(self.pages) > 1 else ()):
            score = f" · F1 {self.scores[number]['f1']:.3f}" if self.scores else ""
            heading, reason = f"View {page.number}{score}", f"{reason[:1].upper()}{reason[1:]}"
            if page.thumbnail is not None:
                figures.append(Figure(heading, page.thumbnail, reason, link=f"view{page.number}"))
            reason = "" if page.step.decision is None else page.step.decision.why
        return figures

    def _view(self, number: int) -> Section:
        """A view: its counts, its score and what it changed, pictures, what comes next, tables."""
        page = self.pages[number]
        step, decision = page.step, page.step.decision
        facts = [step.name, count_of(page.objects, "object"), count_of(len(step.graph.supports), "support")]
        facts += [f"F1 {self.scores[number]['f1']:.3f}"] if self.scores else []
        facts += [changes(self.pages[number - 1].step.graph, step.graph)] if number else []
        remarks = []
        if decision is not None:
            numbers = (
                f"saliency {decision.saliency:.2f}, path cost {decision.cost:.2f}, score {decision.score:.2f}"
            )
            remarks.append(("Next view", f"{decision.why.rstrip('.')} ({numbers})."))
        if step.stop:
            remarks.append(("Stopped", step.stop))
        tables = [object_table(step.graph), support_table(step.graph)]
        if decision is not None and decision.points_of_interest:
            tables.append(point_table(decision))
        columns = 3 if len(page.figures) == 3 else 2
        title, text, anchor = f"View {page.number}", " · ".join(facts), f"view{page.number}"
        return Section(title, text, page.figures, remarks, tables, anchor=anchor, columns=columns)


def draw_view(step: Step, config: ReportConfig | None = None) -> ViewPage:
    """Draw one step, so that its images and clouds need not be kept.

    Args:
        step: What `explore` yields, or `extract` takes from a recording or a cloud.
        config: Sizes of the pictures.
    """
    width = (config or ReportConfig()).image_width
    graph, cloud, view = step.graph, step.cloud, step.view
    figures = []
    thumbnail = None
    if view is not None:
        picture = draw_image(view, step.labels, graph, width)
        thumbnail = draw_image(view, step.labels, graph, width // 2, shapes=False)
        kind = "colour image" if view.rgb is not None else "depth image, near bright and far dark"
        caption = (
            f"The {kind} around the objects, tinted by its segments, with the outlines of the shapes fitted "
            "so far. Outlines are thin where something nearer hides them; an object with a pale name has no "
            "pixel here."
        )
        figures.append(Figure("What the camera saw", picture, caption))
    caption = (
        "Arrows run from supporter to supported; beside them, in how many of the views that could have shown "
        "it the relation was found. Dashed arrows are uncertain; an object with a dashed rim has no known "
        "supporter."
    )
    picture = draw_graph(graph)
    figures.append(Figure("What supports what", picture, caption, picture.width > BESIDE))
    azimuth = sensor_azimuth(cloud, None if view is None else view.T_world_camera)
    if len(step.visited):
        azimuth = float(np.arctan2(step.visited[0, 1], step.visited[0, 0]))
    caption = (
        f"{len(cloud):,} points fused so far in their objects' colours, with the fitted shapes. Pale: the "
        "inside of a surface whose other side has not been seen."
    )
    for turn, side in ((0.0, "from the first view's side"), (np.pi, "from the opposite side")):
        figures.append(Figure(f"The cloud {side}", draw_cloud(cloud, graph, azimuth + turn), caption))
    if step.candidates is not None or step.decision is not None:
        figures.append(Figure("Where to look next", draw_sphere(step), _sphere_caption(step), wide=True))
    nothing = cloud.select(np.zeros(0, dtype=np.intp))
    kept = replace(step, view=None, labels=step.labels[:0], cloud=nothing, candidates=None)
    return ViewPage(kept, tuple(figures), thumbnail)


def sensor_azimuth(cloud: Cloud, T_world_camera: NDArray[np.float64] | None) -> float:
    """Direction [rad] from the scene to the sensor at a pose (4, 4); where unknown, the world's −x."""
    backward = np.array([-1.0, 0.0, 0.0])
    if T_world_camera is not None:
        backward = -T_world_camera[:3, 2]
    elif cloud.viewpoint_world is not None and len(cloud):
        backward = cloud.viewpoint_world - cloud.points_world.mean(axis=0)
    return float(np.arctan2(backward[1], backward[0]))


def _sphere_caption(step: Step) -> str:
    text = (
        "The view sphere, coloured by saliency; washed out where the robot cannot bring its camera. Rays "
        "lead from points of interest to where they are best seen. Numbers: views made; next: the choice."
    )
    if step.candidates is not None:
        refused = ", ".join(f"{count:,} {reason}" for reason, count in step.candidates.rejected.items())
        text += f" {len(step.candidates):,} views can be reached{f'; refused: {refused}' if refused else ''}."
    return text


@cache
def template(name: str) -> jinja2.Template:
    """One of the HTML templates of this package; everything put into it is escaped."""
    import jinja2

    folder = resources.files("caryatid.viz")
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        loader=jinja2.FunctionLoader(lambda file: folder.joinpath(file).read_text(encoding="utf-8")),
    )
    return environment.get_template(name)


def render_html(report: Report) -> str:
    """Write a report as one HTML file that loads nothing from anywhere."""

    def svg(section: Section, number: int, picture: Picture) -> str:
        """A picture whose name, and so whose ids, no other picture of the page has."""
        return picture_svg(replace(picture, name=f"{section.title}, {number}: {picture.name}"))

    return template("page.html.jinja").render(report=report, sections=report.sections, svg=svg)
