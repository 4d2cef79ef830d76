"""`caryatid import`, `evaluate`, `order`, `report` and `export`: from recordings, and from run folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from caryatid.cli.options import (
    Command,
    Flag,
    ModellingCommand,
    OptionalCount,
    OptionalPath,
    OptionalText,
    RunPath,
    SettingsCommand,
    default_of,
    defaults_to,
    one_of,
    shown_as,
)
from caryatid.config.choices import ExportFormat

Topic = Annotated[OptionalText, shown_as("TOPIC")]


@dataclass(frozen=True, kw_only=True)
class Import(SettingsCommand):
    """Turn a robot's recording into a scene folder of sharp views from different viewpoints.

    Reads bags of ROS 1 (.bag) and ROS 2 (.mcap, .db3, or a folder with metadata.yaml), and folders of the
    TUM RGB-D benchmark, which need no topics. Depth must be registered to the colour image.

    To try:
      caryatid import pour.bag --out pour
      caryatid import pour.bag --depth /depth/image --info /depth/camera_info --tf map --out pour
      caryatid import rgbd_dataset_freiburg1_desk --out desk
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Bag, or folder with depth.txt."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Scene folder to write, in the BOP format; must be new or empty."""
    depth: Topic = None
    """Depth images: 16UC1 or mono16 [mm], 32FC1 [m], or PNG-compressed. When left out, they are listed."""
    info: Topic = None
    """Camera of the depth images (CameraInfo)."""
    rgb: Topic = None
    """Colour images that depth is registered to; they also tell how sharp a frame is."""
    tf: Annotated[OptionalText, shown_as("FRAME")] = None
    """World frame, level with z up, such as map or base_link. When left out: one frame without a pose."""
    camera: Annotated[OptionalPath, shown_as("FILE.json")] = None
    """Camera of a TUM RGB-D folder: fx, fy, cx, cy [px]. When left out: as published."""
    level: Flag = False
    """Rotate the world so that the table is level, for poses whose z does not point up; most views must
    show the table."""
    views: Annotated[OptionalCount, default_of("recording.max_views")] = None
    """Maximum number of views."""

    def __call__(self) -> None:
        config = self.settings.read({"recording.max_views": self.views})
        from caryatid.cli.output import Output
        from caryatid.io.datasets import Topics
        from caryatid.io.importing import import_recording, reasons

        out = Output(self.general)
        topics = Topics(self.depth, self.info, self.rgb, self.tf)
        with out.working(f"reading {self.source.name}"):
            imported = import_recording(
                self.source, self.out, topics, camera_file=self.camera, level=self.level, config=config
            )
        if self.general.json:
            views = [
                {"view": n, "frame": f.number, "time": f.time, "posed": f.T_world_camera is not None}
                for n, f in enumerate(imported.chosen)
            ]
            document = {"recording": str(self.out), "frames": imported.read, "views": views}
            out.result(document | {"skipped": imported.skipped, "notes": list(imported.notes)})
        for note in imported.notes:
            out.say(note)
        skipped = f"; skipped: {reasons(imported.skipped)}" if imported.skipped else ""
        out.say(f"{self.source.name}: {len(imported.chosen)} views of {imported.read} frames{skipped}")
        out.say(f"recording: {self.out}, try `caryatid extract {self.out} --out run`")


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
        from caryatid.cli.output import Output, figures_table
        from caryatid.evaluation.truths import evaluate_run

        scores = evaluate_run(self.run, self.truth)
        columns = ("view", "precision", "recall", "F1", "edge precision", "edge recall", "mean IoU")
        table = figures_table(f"{self.run} against {self.truth}", *columns)
        for view in scores:
            s = view.score
            figures = (s.precision, s.recall, s.f1, s.edge_precision, s.edge_recall, s.mean_iou)
            table.add_row(f"{view.view:02d}", *(f"{f:.3f}" for f in figures))
        Output(self.general).result({"views": [s.to_json() for s in scores]}, table)


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
    goal: Annotated[OptionalText, shown_as("ID")] = None
    """Reach this object only, and take away no more than necessary."""
    hands: Literal[1, 2] = 2
    """With 2, another hand may hold one object while the first lifts one."""

    def __call__(self) -> None:
        config = self.modelling.read()
        from rich.text import Text

        from caryatid.cli.output import Output, numbered_table
        from caryatid.io.runs import read_run
        from caryatid.manipulation.order import order_record, plan_order
        from caryatid.runtime.threads import cores

        out = Output(self.general)
        graph, seed = read_run(self.run).graph, self.modelling.seed
        with out.working("rehearsing"):
            order = plan_order(graph, config, goal=self.goal, hands=self.hands, seed=seed, threads=cores())
        outcome = "a safe order" if order.safe else "no safe order"
        goal = f" to reach {self.goal}" if self.goal else ""
        table = numbered_table(f"{self.run}: {outcome}{goal}", "take", "hold", "why")
        for number, step in enumerate(order.steps, start=1):
            why = Text(step.why if step.safe else f"! {step.why}")
            table.add_row(str(number), step.object_id, ", ".join(step.hold), why)
        out.result(order_record(order), table, *([Text(order.refusal)] if order.refusal else []))


@dataclass(frozen=True, kw_only=True)
class ReportCommand(Command):
    """Write the report of a run again, also as a PDF.

    To try:
      caryatid report run
      caryatid report run --pdf report.pdf
    """

    run: RunPath
    """Run folder; its report.html is replaced."""
    pdf: Annotated[OptionalPath, shown_as("FILE.pdf")] = None
    """Write a PDF as well, A4; replaces an earlier one."""

    def __call__(self) -> None:
        from caryatid.cli.output import Output
        from caryatid.runs import write_report

        out = Output(self.general)
        for path in write_report(self.run, self.pdf):
            out.say(f"report: {path}")
        if self.general.json:
            out.result({"html": self.run / "report.html", "pdf": self.pdf})


@dataclass(frozen=True, kw_only=True)
class Export(SettingsCommand):
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

    def __call__(self) -> None:
        config = self.settings.read()
        from caryatid.cli.output import Output, summary
        from caryatid.exports import export_graph, format_of
        from caryatid.io.graph_json import read_graph
        from caryatid.io.runs import read_run

        out = Output(self.general)
        format_ = self.format or format_of(self.out)
        graph = read_graph(self.run) if self.run.suffix == ".json" else read_run(self.run).graph
        export_graph(graph, self.out, format_, config.export)
        if self.general.json:
            out.result({"file": str(self.out), "format": format_})
        out.say(f"{self.out}: {format_}, {summary(graph)}")
