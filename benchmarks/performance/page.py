"""The page about performance: what is asked for, what is missed, all rows, and how cost grows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caryatid.benchmark.plotting import SOFT, WIDTH, add_axes, marks, render
from caryatid.benchmark.provenance import Provenance
from performance.growth import AXES, Curve
from performance.limits import Machine
from performance.rows import Row, missed
from performance.telling import COLUMNS, MISSED, NOTHING, asked, cells, digits, found, notes, verdict
from performance.turns import PARTS

TEMPLATE = Path(__file__).with_name("page.md.jinja")
TEXTS = {
    "turn": (
        "The turn",
        "From the camera's images to the next view, in a heap of ten objects, against Open3D's "
        "`voxel_down_sample(0.005)`, `segment_plane(0.01, 3, 1000)`, `cluster_dbscan(0.015, 10)` and "
        "`get_oriented_bounding_box` a cluster on the same depth images; both take turns view by view.",
    ),
    "perceive": ("Perceiving", "The same from the camera's images to the fused graph."),
    "stage": (
        "Stages",
        "Those called by themselves, on a first view; then the stages of the turns of later views.",
    ),
    "fit": (
        "Fits",
        "Points with σ = 1 mm on shapes of table-top size, a threshold of 4 mm for all. Ours, like CGAL, "
        "gets normals of planes through each point's 20 neighbours; *without normals* both estimate them. "
        "pyransac3d runs 1000 iterations, a fifth of its default for cuboids and a tenth for cylinders. "
        "Points are handed over in each library's own form, untimed.",
    ),
    "choose": (
        "Fits of any shape",
        "The same where nobody says which shape it is: ours fits all three and chooses, the peers are told.",
    ),
    "decision": ("The next view", "One decision over the whole view sphere, both planners on the same map."),
    "map": ("The voxel map", "Free space and hits of a VGA view, entered into a map that holds others."),
    "start": ("Start-up", "Each in a process of its own."),
    "growth": ("Growth", "Exponents of the whole turn, and the memory many views take."),
}
"""Heading and text of each group of rows."""
HEIGHT = 6.6
"""Of the figure [in]."""


@dataclass(frozen=True, slots=True)
class Section:
    """A table of the page.

    Attributes:
        title: Its heading.
        text: What to know before.
        columns: Heads of the columns that hold something.
        lines: Cells, line by line.
        notes: What else there is to say, a row each.
    """

    title: str
    text: str
    columns: list[str]
    lines: list[list[str]]
    notes: list[str]


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """What a run of the benchmark gave.

    Attributes:
        rows: What was measured.
        curves: How cost grows.
        disturbed: What was measured while another process held a core.
        machine: What the machine can do.
        provenance: Which code on which machine.
        peers: The peers' versions.
    """

    rows: Sequence[Row]
    curves: Sequence[Curve]
    disturbed: Sequence[str]
    machine: Machine
    provenance: Provenance
    peers: str


def write_page(run: Run, path: Path) -> None:
    """Write the page, and its figure into a folder of its name beside it."""
    path.write_text(render_page(run, path.stem), encoding="utf-8")
    if run.curves:
        folder = path.with_suffix("")
        folder.mkdir(exist_ok=True)
        (folder / "growth.svg").write_text(draw(run.curves), encoding="utf-8")


def render_page(run: Run, folder: str) -> str:
    """Return the page's Markdown; `folder` is where the figure is, seen from it."""
    import jinja2

    environment = jinja2.Environment(trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    groups = [group for group in TEXTS if any(row.group == group for row in run.rows)]
    wanted = [row for row in run.rows if row.target is not None]
    text = environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        run=run,
        folder=folder,
        asked_rows=wanted,
        missed=missed(run.rows),
        unmeasured=[row for row in wanted if row.met is None],
        sections=[_section(group, [row for row in run.rows if row.group == group]) for group in groups],
        curves=[_table(curve) for curve in run.curves],
        asked=asked,
        found=found,
        verdict=lambda row: _marked(verdict(row)),
    )
    return "\n".join(_single_gaps(text.splitlines())) + "\n"


def draw(curves: Sequence[Curve]) -> str:
    """The figure: time of a turn over each size, as SVG."""
    axes_names = [axis for axis in AXES if any(c.axis == axis for c in curves)]
    kinds = marks(list(PARTS.values()))

    def plot(figure: Any) -> None:
        from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, StrMethodFormatter

        for k, name in enumerate(axes_names):
            left, bottom = 0.75 + 3.6 * (k % 2), 0.55 + 3.1 * (1 - k // 2)
            axes = add_axes(figure, left, WIDTH - left - 2.7, bottom, HEIGHT - bottom - 2.35)
            drawn = [c for c in curves if c.axis == name]
            for curve in drawn:
                mark = kinds[PARTS[curve.segmentation]]
                axes.plot(curve.sizes, [1e3 * t for t in curve.turns], label=mark.name, **mark.line())
            ends = np.array([min(c.sizes[0] for c in drawn), max(c.sizes[-1] for c in drawn)])
            times = 1e3 * np.array([t for c in drawn for t in c.turns])
            steep = times.min() * ends / ends[0]
            axes.plot(ends, steep, color=SOFT, linewidth=0.8, linestyle="--", label="in proportion")
            axes.set(xscale="log", yscale="log", xlabel=AXES[name], ylabel="time of a turn [ms]")
            axes.set_ylim(0.8 * times.min(), 1.25 * times.max())
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
            for side in (axes.xaxis, axes.yaxis):
                side.set_minor_formatter(NullFormatter())
            if max(ends) < 20.0 * min(ends):
                axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.grid(visible=True)
        handles, names = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="upper center", ncols=len(names), frameon=False)

    return render(plot, HEIGHT, "performance-growth")[0]


def _section(group: str, rows: Sequence[Row]) -> Section:
    """Table of a group, without the columns in which nothing stands."""
    lines = [cells(row) for row in rows]
    kept = [k for k in range(len(COLUMNS)) if any(line[k] != NOTHING for line in lines)]
    title, text = TEXTS[group]
    return Section(
        title,
        text,
        [COLUMNS[k] for k in kept],
        [[_marked(line[k]) if COLUMNS[k] != "row" else f"`{line[k]}`" for k in kept] for line in lines],
        [f"{which}: {note}" for note, which in notes(rows).items()],
    )


def _table(curve: Curve) -> dict[str, Any]:
    """A curve as a table: a line a size, the turn and its stages in milliseconds."""
    lines = [
        [f"{size:,.0f}", digits(1e3 * turn), *(digits(1e3 * took[k]) for took in curve.stages.values())]
        for k, (size, turn) in enumerate(zip(curve.sizes, curve.turns, strict=True))
    ]
    return {
        "title": f"Over the {AXES[curve.axis]}, {PARTS[curve.segmentation]}",
        "exponent": f"{curve.exponent:.2f}, over the upper half {curve.last_exponent:.2f}",
        "note": curve.shortened,
        "columns": [AXES[curve.axis], "turn [ms]", *curve.stages],
        "lines": lines,
    }


def _marked(cell: str) -> str:
    """A cell in which what is missed stands out."""
    return re.sub(rf"{MISSED}$", f"**{MISSED}**", cell)


def _single_gaps(lines: Sequence[str]) -> list[str]:
    """Lines with no more than one empty one in a row, and none within a table."""
    kept: list[str] = []
    for k, line in enumerate(lines):
        within = kept and kept[-1].startswith("|") and next((x for x in lines[k:] if x), "").startswith("|")
        if line or (kept and kept[-1] and not within):
            kept.append(line)
    return kept
