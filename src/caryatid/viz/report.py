"""The report of a run: every view drawn, in one HTML file that opens anywhere, and as a PDF for print."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ReportConfig
from caryatid.graph import SupportGraph
from caryatid.sensing.views import Cloud
from caryatid.viz import drawings
from caryatid.viz.drawings import Picture, picture_svg
from caryatid.viz.graph_drawing import draw_graph, is_wide
from caryatid.viz.tables import (
    Entry,
    Table,
    changes,
    object_table,
    point_table,
    settings_table,
    support_table,
)

if TYPE_CHECKING:
    import jinja2

    from caryatid.exploration import Step


GRAPH_CAPTION = (
    "Arrows run from supporter to supported; beside them, in how many of the views that could have shown it "
    "the relation was found. Dashed arrows are uncertain; an object with a dashed rim has no known supporter."
)


@dataclass(frozen=True, eq=False, slots=True)
class Figure:
    """One picture of the report.

    Attributes:
        heading: Its heading.
        picture: What is drawn.
        caption: What is to be seen in it.
        wide: It takes the whole width of the page.
    """

    heading: str
    picture: Picture
    caption: str
    wide: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class ViewPage:
    """One view, drawn: all the report says of it and none of its data.

    Attributes:
        index: Number of the view, from 0.
        name: The view's name, or the cloud's.
        graph: What is known after it.
        figures: The pictures.
        thumbnail: The view's picture for the contact sheet; None for a cloud.
        points: The table of points of interest.
        choice: Why the next view was chosen, with its figures; empty where none was.
        reason: The same without figures.
        timings: Time of each stage [s].
        angle_travelled: Around the view sphere so far [rad].
        path_travelled: Length of the path so far [m].
        stop: Why the exploration ended here, or None.
    """

    index: int
    name: str
    graph: SupportGraph
    figures: tuple[Figure, ...]
    thumbnail: Picture | None
    points: Table
    choice: str
    reason: str
    timings: Mapping[str, float]
    angle_travelled: float
    path_travelled: float
    stop: str | None

    @property
    def number(self) -> str:
        """The view's number as its folder in the run has it."""
        return f"{self.index:02d}"

    @property
    def tables(self) -> tuple[Table, Table]:
        """Objects and supports."""
        return object_table(self.graph), support_table(self.graph)

    @property
    def objects(self) -> int:
        """How many objects are known, without the support surface."""
        return sum(o.role == "object" for o in self.graph.objects)


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
    def facts(self) -> list[str]:
        """Of each view its counts, its score, and what it changed."""
        said = []
        for number, page in enumerate(self.pages):
            parts = [page.name, f"{page.objects} objects", f"{len(page.graph.supports)} supports"]
            parts += [f"F1 {self.scores[number]['f1']:.3f}"] if self.scores else []
            parts += [changes(self.pages[number - 1].graph, page.graph)] if number else []
            said.append(" · ".join(parts))
        return said

    @property
    def contacts(self) -> list[tuple[ViewPage, Picture, str, str]]:
        """The contact sheet: the views that have a picture, each with its score and why it was taken."""
        if len(self.pages) == 1:
            return []
        scores = [f"F1 {score['f1']:.3f}" for score in self.scores] or [""] * len(self.pages)
        reasons = ["the first view", *(page.reason for page in self.pages[:-1])]
        return [
            (page, page.thumbnail, score, f"{reason[:1].upper()}{reason[1:]}")
            for page, score, reason in zip(self.pages, scores, reasons, strict=True)
            if page.thumbnail is not None
        ]

    @property
    def cards(self) -> list[tuple[str, str, str]]:
        """Big figures of the summary: name, figure, what it is made of."""
        last = self.pages[-1]
        kinds = [o.shape.kind for o in last.graph.objects if o.role == "object"]
        plural = {kind: f"{kind}es" if kind == "box" else f"{kind}s" for kind in sorted(set(kinds))}
        counts = [(kinds.count(kind), kind if kinds.count(kind) == 1 else plural[kind]) for kind in plural]
        uncertain = sum(not s.certain for s in last.graph.supports)
        seconds = [sum(page.timings.values()) for page in self.pages]
        cards = [
            ("objects", str(len(kinds)), ", ".join(f"{n} {kind}" for n, kind in counts if n) or "none found"),
            (
                "supports",
                str(len(last.graph.supports)),
                f"{len(last.graph.supports) - uncertain} certain, {uncertain} uncertain",
            ),
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
    def charts(self) -> list[Picture]:
        """The summary's charts: scores over views and path, what was found, time."""
        pages, number = self.pages, [float(page.index) for page in self.pages]
        charts = []
        if self.scores:
            lines = {
                name: [score[name.lower()] for score in self.scores] for name in ("F1", "precision", "recall")
            }
            charts.append(drawings.line_chart("F1 over views", "view", number, lines, "share", (0.0, 1.0)))
            path, unit = [page.path_travelled for page in pages], "path [m]"
            if path[-1] == 0.0:
                path = [float(np.rad2deg(page.angle_travelled)) for page in pages]
                unit = "angle around the scene [°]"
            if path[-1] > path[0]:
                f1 = {"F1": lines["F1"]}
                charts.append(drawings.line_chart("F1 over path length", unit, path, f1, "F1", (0.0, 1.0)))
        if len(pages) > 1:
            found = {
                "objects": [page.objects for page in pages],
                "supports": [len(page.graph.supports) for page in pages],
                "uncertain supports": [sum(not s.certain for s in page.graph.supports) for page in pages],
            }
            charts.append(drawings.line_chart("Found so far", "view", number, found, "number"))
        if any(page.timings for page in pages):
            times = [page.timings for page in pages]
            charts.append(drawings.bar_chart("Time of each stage", "view", times, "time [s]"))
        return charts


def draw_view(step: Step, config: ReportConfig | None = None) -> ViewPage:
    """Draw one step, so that its images and clouds need not be kept.

    Args:
        step: What `explore` yields, or `extract` takes from a recording or a cloud.
        config: Sizes of the pictures.
    """
    width = (config or ReportConfig()).image_width
    graph, cloud, view, decision = step.graph, step.cloud, step.view, step.decision
    figures = []
    thumbnail = None
    if view is not None:
        picture = drawings.draw_image(view, step.labels, graph, width)
        thumbnail = drawings.draw_image(view, step.labels, graph, width // 2, small=True)
        kind = "colour image" if view.rgb is not None else "depth image, near bright and far dark"
        caption = (
            f"The {kind} around the objects, tinted by its segments, with the outlines of the shapes fitted "
            "so far. Outlines are thin where something nearer hides them; an object with a pale name has no "
            "pixel here."
        )
        figures.append(Figure("What the camera saw", picture, caption))
    figures.append(Figure("What supports what", draw_graph(graph), GRAPH_CAPTION, is_wide(graph)))
    azimuth = sensor_azimuth(cloud, None if view is None else view.T_world_camera)
    if len(step.visited):
        azimuth = float(np.arctan2(step.visited[0, 1], step.visited[0, 0]))
    for turn, side in ((0.0, "from the first view's side"), (np.pi, "from the opposite side")):
        caption = (
            f"{len(cloud):,} points fused so far in their objects' colours, with the fitted shapes. Pale: "
            "the inside of a surface whose other side has not been seen."
        )
        picture = drawings.draw_cloud(cloud, graph, azimuth + turn)
        figures.append(Figure(f"The cloud {side}", picture, caption))
    if step.candidates is not None or decision is not None:
        picture = drawings.draw_sphere(step)
        figures.append(Figure("Where to look next", picture, _sphere_caption(step), wide=True))
    choice = ""
    if decision is not None:
        numbers = (
            f"saliency {decision.saliency:.2f}, path cost {decision.cost:.2f}, score {decision.score:.2f}"
        )
        choice = f"{decision.why.rstrip('.')} ({numbers})."
    return ViewPage(
        step.index,
        step.name,
        graph,
        tuple(figures),
        thumbnail,
        point_table(decision),
        choice,
        "" if decision is None else decision.why,
        dict(step.timings),
        step.angle_travelled,
        step.path_travelled,
        step.stop,
    )


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
        text += f" {len(step.candidates):,} views can be reached"
        refused = ", ".join(f"{count:,} {reason}" for reason, count in step.candidates.rejected.items())
        text += f"; refused: {refused}." if refused else "."
    return text


# On screen


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
    settings = settings_table(report.settings)
    return template("page.html.jinja").render(report=report, settings=settings, svg=_named_svg)


def _named_svg(picture: Picture, view: str = "") -> str:
    """A picture whose name, and so whose ids, no other picture of the page has."""
    return picture_svg(replace(picture, name=f"view {view}: {picture.name}") if view else picture)


# In print

A4 = (8.27, 11.69)
"""Width and height of a page [in]."""
MARGIN = 0.55
"""Free border of a page [in]."""
GLYPH = 0.58
"""Mean width of a letter in font sizes."""


def render_pdf(report: Report) -> bytes:
    """Write a report as a PDF on A4; the same report gives the same bytes."""
    from matplotlib.backends.backend_pdf import PdfPages

    content = io.BytesIO()
    metadata = {"Title": report.title, "CreationDate": None, "Producer": None, "Creator": "caryatid"}
    with drawings.own_style(), PdfPages(content, metadata=metadata) as pdf:
        sheets = _Sheets(pdf, report.title)
        sheets.text(report.title, 15.0, bold=True)
        for name, figure, note in report.cards:
            sheets.text(f"{name}: {figure} ({note})", 9.0)
        sheets.pictures([Figure("", chart, "") for chart in report.charts], 2)
        contacts = [
            Figure(" ".join(filter(None, (f"View {page.number}", score))), picture, reason)
            for page, picture, score, reason in report.contacts
        ]
        if contacts:
            sheets.text("Contact sheet", 12.0, bold=True)
            sheets.pictures(contacts, 3)
        for page, facts in zip(report.pages, report.facts, strict=True):
            sheets.chapter(f"View {page.number}")
            sheets.text(facts, 8.0)
            sheets.pictures([figure for figure in page.figures if not figure.wide], 2)
            sheets.pictures([figure for figure in page.figures if figure.wide], 1)
            for lead, remark in (("Next view", page.choice), ("Stopped", page.stop)):
                if remark:
                    sheets.text(f"{lead}: {remark}", 8.5, bold=True)
            for table in (page.points, *page.tables):
                sheets.table(table)
        if report.strip:
            sheets.chapter("Taken apart")
            sheets.pictures(report.strip, 3)
        sheets.chapter("Settings")
        sheets.table(settings_table(report.settings))
        sheets.turn(more=False)
        _add_bookmarks(pdf, sheets.chapters)
    return content.getvalue()


def _add_bookmarks(pdf: Any, chapters: Sequence[tuple[str, int]]) -> None:
    """Write the outline of a `PdfPages`, which has no way of its own: titles and their pages, from 0."""
    from matplotlib.backends.backend_pdf import Name

    file = pdf._ensure_file()
    outline, *items = (file.reserveObject("outline") for _ in range(len(chapters) + 1))
    for k, (title, page) in enumerate(chapters):
        entry = {"Title": title, "Parent": outline, "Dest": [file.pageList[page], Name("Fit")]}
        entry |= {"Prev": items[k - 1]} if k else {}
        entry |= {"Next": items[k + 1]} if k + 1 < len(items) else {}
        file.writeObject(items[k], entry)
    ends = {"First": items[0], "Last": items[-1], "Count": len(items)}
    file.writeObject(outline, {"Type": Name("Outlines")} | ends)
    root = {"Type": Name("Catalog"), "Pages": file.pagesObject, "Outlines": outline}
    file.writeObject(file.rootObject, root)


class _Sheets:
    """Pages that are filled from top to bottom."""

    def __init__(self, pdf: Any, title: str) -> None:
        self._pdf, self._title, self._number = pdf, title, 0
        self.chapters = [(title, 0)]
        self._new()

    def _new(self) -> None:
        from matplotlib.figure import Figure as Sheet

        self._sheet = Sheet(figsize=A4)
        self._top = A4[1] - MARGIN
        self._number += 1
        footer: dict[str, Any] = {"fontsize": 7.0, "color": drawings.SOFT}
        self._sheet.text(MARGIN / A4[0], 0.4 * MARGIN / A4[1], self._title, **footer)
        self._sheet.text(1.0 - MARGIN / A4[0], 0.4 * MARGIN / A4[1], str(self._number), ha="right", **footer)

    def turn(self, *, more: bool = True) -> None:
        """Put the page down, and take a new one if there is more to come."""
        self._pdf.savefig(self._sheet)
        if more:
            self._new()

    def chapter(self, title: str) -> None:
        """Begin a chapter on a new page."""
        self.turn()
        self.chapters.append((title, self._number - 1))
        self.text(title, 13.0, bold=True)

    def _room(self, height: float) -> None:
        """Turn the page where less than so much of it is left [in]."""
        if self._top - height < MARGIN:
            self.turn()

    def _write(self, text: str, left: float, size: float, **look: Any) -> None:
        """Write one line below the top, `left` inches from the page's edge."""
        self._sheet.text(left / A4[0], self._top / A4[1], text, fontsize=size, va="top", **look)

    def text(self, text: str, size: float, *, bold: bool = False) -> None:
        """Write a paragraph."""
        for line in _wrapped(text, A4[0] - 2.0 * MARGIN, size):
            self._room(1.4 * size / 72.0)
            self._write(line, MARGIN, size, fontweight="bold" if bold else "normal")
            self._top -= 1.4 * size / 72.0
        self._top -= 0.05

    def pictures(self, figures: Sequence[Figure], columns: int) -> None:
        """Put pictures side by side, with headings above and captions below them."""
        gap = 0.2
        width = (A4[0] - 2.0 * MARGIN + gap) / columns - gap
        for start in range(0, len(figures), columns):
            row = figures[start : start + columns]
            heights = [min(width * f.picture.height / f.picture.width, 4.6) for f in row]
            captions = [_wrapped(f.caption, width, 6.5) for f in row]
            below = max(len(lines) for lines in captions) * 9.0 / 72.0
            self._room(0.2 + max(heights) + below + 0.15)
            top = self._top
            for k, (figure, height, lines) in enumerate(zip(row, heights, captions, strict=True)):
                left = MARGIN + k * (width + gap)
                self._top = top
                self._write(figure.heading, left, 8.5, fontweight="bold")
                self._top -= 0.2 + height
                drawn = height * figure.picture.width / figure.picture.height
                place = (
                    (left + (width - drawn) / 2.0) / A4[0],
                    self._top / A4[1],
                    drawn / A4[0],
                    height / A4[1],
                )
                figure.picture.draw(self._sheet, place)
                self._top -= 0.04
                self._write("\n".join(lines), left, 6.5, color=drawings.SOFT, linespacing=1.3)
            self._top = top - 0.2 - max(heights) - below - 0.15

    def table(self, table: Table) -> None:
        """Write a table, over as many pages as it takes."""
        self._room(0.6)
        self.text(table.heading, 9.5, bold=True)
        if not table.rows:
            self.text("None.", 7.5)
            return
        size, line = 6.5, 8.5 / 72.0
        widths = _column_widths(table, size)
        for row in (tuple(Entry(name) for name in table.columns), *table.rows):
            cells = [
                _wrapped(entry.text, width - 0.06, size) for entry, width in zip(row, widths, strict=True)
            ]
            height = max(len(lines) for lines in cells) * line + 0.03
            self._room(height)
            left = MARGIN
            for entry, lines, width in zip(row, cells, widths, strict=True):
                colour = (
                    drawings.DOUBT if entry.doubt else drawings.INK if row in table.rows else drawings.SOFT
                )
                if entry.colour:
                    chip = {"facecolor": entry.colour, "edgecolor": "none", "boxstyle": "square,pad=0.15"}
                    self._write(" ", left, size, bbox=chip)
                for k, text in enumerate(lines):
                    self._sheet.text(
                        (left + (0.1 if entry.colour else 0.0)) / A4[0], (self._top - k * line) / A4[1], text,
                        fontsize=size, va="top", color=colour,
                    )  # fmt: skip
                left += width
            self._top -= height
        self._top -= 0.1


def _wrapped(text: str, width: float, size: float) -> list[str]:
    """Lines of a text that fit into so many inches."""
    return textwrap.wrap(text, max(int(width * 72.0 / (GLYPH * size)), 4)) or [""]


def _column_widths(table: Table, size: float) -> list[float]:
    """Widths of the columns [in]: each as wide as its entries, but for the last, which takes what is left."""
    letter = GLYPH * size / 72.0
    widths = []
    for k, name in enumerate(table.columns[:-1]):
        longest = max(len(row[k].text) + 2 * bool(row[k].colour) for row in table.rows)
        widths.append(
            (min(max(longest, *(len(word) for word in name.split() or [""]), 2), 20) + 1.6) * letter
        )
    return [*widths, A4[0] - 2.0 * MARGIN - sum(widths)]
