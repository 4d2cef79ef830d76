"""`caryatid evaluate`, `order`, `report` and `export`: what can be done with a run folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from caryatid.cli.options import (
    SAID,
    Command,
    ModellingCommand,
    RunPath,
    Settings,
    defaults_to,
    one_of,
)
from caryatid.config.choices import ExportFormat


@dataclass(frozen=True, kw_only=True)
class Evaluate(Command):
    """Score each view of a run: precision, recall and F1 of vertices and edges, mean IoU.

    To try:
      caryatid evaluate run scenes/tower
    """

    run: RunPath
    """Run folder."""
    truth: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="GT")]
    """Scene folder (scene.xml and gt.json), or recording with masks and gt.json."""

    def __call__(self) -> None:
        """Run the command."""
        from rich.table import Table
        from rich.text import Text

        from caryatid.cli.output import result_console, write_json
        from caryatid.evaluation.truths import evaluate_run

        scores = evaluate_run(self.run, self.truth)
        if self.general.json:
            write_json({"views": [s.to_json() for s in scores]})
            return
        table = Table(title=Text(f"{self.run} against {self.truth}"), title_justify="left")
        for column in ("view", "precision", "recall", "F1", "edge precision", "edge recall", "mean IoU"):
            table.add_column(column, justify="right")
        for view in scores:
            s = view.score
            figures = (s.precision, s.recall, s.f1, s.edge_precision, s.edge_recall, s.mean_iou)
            table.add_row(f"{view.view:02d}", *(f"{f:.3f}" for f in figures))
        result_console().print(table)


@dataclass(frozen=True, kw_only=True)
class OrderCommand(ModellingCommand):
    """Find a safe order to take everything away, or to reach one object.

    Each lift is rehearsed in physics on the extracted shapes, and on others as likely, before it is chosen.
    Where no order is safe, the output names the objects in each other's way and gives the least risky order.

    To try:
      caryatid order run
      caryatid order run --goal o3
    """

    run: RunPath
    """Run folder."""
    goal: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="ID"), SAID] = None
    """Reach this object only, and take away no more than necessary."""
    hands: Literal[1, 2] = 2
    """With 2, another hand may hold one object while the first lifts one."""

    def __call__(self) -> None:
        """Run the command."""
        from rich.text import Text

        from caryatid.cli.output import Progress, left_table, result_console, write_json
        from caryatid.io.runs import read_run
        from caryatid.manipulation.order import order_record, plan_order
        from caryatid.runtime.threads import cores

        config = self.modelling.settings()
        graph = read_run(self.run).graph
        with Progress(self.general.silent).working("rehearsing"):
            seed = self.modelling.seed
            order = plan_order(graph, config, goal=self.goal, hands=self.hands, seed=seed, threads=cores())
        if self.general.json:
            write_json(order_record(order))
            return
        outcome = "a safe order" if order.safe else "no safe order"
        goal = f" to reach {self.goal}" if self.goal else ""
        table = left_table(f"{self.run}: {outcome}{goal}", "take", "hold", "why")
        for number, step in enumerate(order.steps, start=1):
            why = Text(step.why if step.safe else f"! {step.why}")
            table.add_row(str(number), step.object_id, ", ".join(step.hold), why)
        console = result_console()
        console.print(table)
        if order.refusal:
            console.print(Text(order.refusal))


@dataclass(frozen=True, kw_only=True)
class ReportCommand(Command):
    """Write the report of a run again, also as a PDF.

    To try:
      caryatid report run
      caryatid report run --pdf report.pdf
    """

    run: RunPath
    """Run folder; its report.html is replaced."""
    pdf: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.pdf"), SAID] = None
    """Write a PDF as well, A4; replaces an earlier one."""

    def __call__(self) -> None:
        """Run the command."""
        from caryatid.cli.output import Progress, write_json
        from caryatid.io.runs import read_run
        from caryatid.io.staging import write_file
        from caryatid.steps import read_config, read_steps
        from caryatid.viz import Report, draw_view, render_html, render_pdf
        from caryatid.viz.strip import read_figures

        run = read_run(self.run)
        config = read_config(run)
        settings = {"source": run.record["source"], "seed": run.record["seed"]} | run.record["options"]
        settings |= {"fusion": config.fusion.method, "views": config.active.max_views}
        report = Report(
            f"caryatid: {Path(run.record['source']).name}",
            [draw_view(step, config.report) for step in read_steps(run)],
            settings,
            run.record.get("scores", ()),
            read_figures(run.folder),
        )
        files = {} if self.pdf is None else {self.pdf: render_pdf(report)}
        files[self.run / "report.html"] = render_html(report).encode()
        for path, content in files.items():
            write_file(path, content)
        if self.general.json:
            pdf = None if self.pdf is None else str(self.pdf)
            write_json({"html": str(self.run / "report.html"), "pdf": pdf})
        progress = Progress(self.general.silent)
        for path in files:
            progress.say(f"report: {path}")


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write the scene model of a run for simulators, viewers and graph programs.

    To try:
      caryatid export run --format mjcf --out scene.xml
      caryatid export run --out scene.glb
    """

    run: RunPath
    """Run folder, or a graph.json."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write: .xml (mjcf), .urdf, .glb, .gltf, .graphml, .dot or .gv; replaces an earlier one."""
    format: Annotated[ExportFormat | None, one_of(ExportFormat), defaults_to("by the ending of FILE")] = None
    """mjcf: free bodies on a table; urdf: links fixed to the world; gltf: meshes; graphml, dot: the graph."""
    settings: tyro.conf.OmitArgPrefixes[Settings] = field(default_factory=Settings)

    def __call__(self) -> None:
        """Run the command."""
        config = self.settings.settings()
        from caryatid.cli.output import Progress, summary, write_json
        from caryatid.exports import export_graph, format_of
        from caryatid.io.graph_json import read_graph
        from caryatid.io.runs import read_run

        format_ = self.format or format_of(self.out)
        graph = read_graph(self.run) if self.run.suffix == ".json" else read_run(self.run).graph
        export_graph(graph, self.out, format_, config.export)
        if self.general.json:
            write_json({"file": str(self.out), "format": format_})
        Progress(self.general.silent).say(f"{self.out}: {format_}, {summary(graph)}")
