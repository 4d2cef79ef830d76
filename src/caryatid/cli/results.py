"""`caryatid import`, `evaluate`, `order`, `report` and `export`: commands on recordings and run folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from caryatid.cli import options
from caryatid.config.choices import ExportFormat

Topic = Annotated[str | None, options.shown("TOPIC")]


@dataclass(frozen=True, kw_only=True)
class Import(options.Command):
    """Convert a robot's log to a recording: sharp views from different viewpoints, with their poses.

    Read bags of ROS 1 (.bag) and ROS 2 (.mcap, .db3, or a folder with metadata.yaml), or a folder of the
    TUM RGB-D benchmark, which needs no topics. Depth must be registered to the colour image.

    Usage examples:
      caryatid import pour.bag --out pour
      caryatid import pour.bag --depth /depth/image --info /depth/camera_info --tf map --out pour
      caryatid import rgbd_dataset_freiburg1_desk --out desk
    """

    settings: options.Settings = options.Settings()
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Bag, or TUM RGB-D folder with depth.txt."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Recording to write, a folder in the BOP format; must be new or empty."""
    depth: Topic = None
    """Depth images: 16UC1 or mono16 [mm], 32FC1 [m], or PNG-compressed. If omitted, list all topics."""
    info: Topic = None
    """CameraInfo of the depth images."""
    rgb: Topic = None
    """Colour images that depth is registered to; also used to pick sharp frames."""
    tf: Annotated[str | None, options.shown("FRAME")] = None
    """World frame with z up, such as map or base_link. If omitted, import one frame without a pose."""
    camera: Annotated[Path | None, options.shown("FILE.json")] = None
    """Intrinsics of a TUM RGB-D folder: fx, fy, cx, cy [px]. If omitted, the published values."""
    level: options.Flag = False
    """Rotate the world frame so that z points up from the table, which most views must show."""
    views: Annotated[options.OptionalCount, options.default_of("recording.max_views")] = None
    """Maximum number of views."""

    def __call__(self) -> None:
        from caryatid.io.datasets import OpenOptions
        from caryatid.io.importing import import_recording, reasons

        config, output = self.settings.read({"recording.max_views": self.views}), self.output
        topics = OpenOptions(self.depth, self.info, self.rgb, self.tf, self.camera)
        with output.working(f"reading {self.source.name}"):
            imported = import_recording(self.source, self.out, topics, level=self.level, config=config)
        read = len(imported) + sum(imported.skipped.values())
        views = [
            {"view": n, "frame": f.number, "time": f.time, "posed": f.T_world_camera is not None}
            for n, f in enumerate(imported.frames)
        ]
        document = {"recording": str(self.out), "frames": read, "views": views}
        output.result(document | {"skipped": imported.skipped, "notes": list(imported.notes)}, "")
        for note in imported.notes:
            output.say(note)
        skipped = f"; skipped: {reasons(imported.skipped)}" if imported.skipped else ""
        output.say(f"{self.source.name}: {len(imported)} views of {read} frames{skipped}")
        output.say(f"recording: {self.out}; next, run `caryatid extract {self.out} --out run`")


@dataclass(frozen=True, kw_only=True)
class Evaluate(options.Command):
    """Score each view of a run: precision, recall and F1 of vertices and edges, mean IoU, probabilities.

    Brier score (0 is perfect) and average precision (1 is perfect) rate the probabilities of supports
    between objects that were found.

    Usage examples:
      caryatid evaluate run
      caryatid evaluate run scenes/tower
    """

    run: options.RunPath
    """Run folder or session."""
    truth: Annotated[str | None, tyro.conf.Positional, options.shown("[GT]", "the run's source")] = None
    """Scene (built-in name, scene.xml or its folder), or a recording with masks and gt.json."""

    def __call__(self) -> None:
        from caryatid.cli.output import table
        from caryatid.evaluation.truths import evaluate_run
        from caryatid.sources import open_run

        output = self.output
        with open_run(self.run) as run:
            scores = evaluate_run(run, self.truth)
        views = [{"view": n} | score.to_json() for n, score in enumerate(scores)]
        columns = {
            "precision": "precision", "recall": "recall", "f1": "F1", "edge_precision": "edge\nprecision",
            "edge_recall": "edge\nrecall", "mean_iou": "mean\nIoU", "brier": "Brier\nscore",
            "average_precision": "average\nprecision",
        }  # fmt: skip
        rows = [
            [str(number), *("–" if view[name] is None else f"{view[name]:.3f}" for name in columns)]
            for number, view in enumerate(views, start=1)
        ]
        truth = self.truth or "the ground truth of its source"
        shown = table(f"{self.run} against {truth}", ["view", *columns.values()], rows, figures=True)
        output.result({"views": views, "warnings": output.warnings}, shown)


@dataclass(frozen=True, kw_only=True)
class OrderCommand(options.LiftingCommand, options.ComputingCommand):
    """Find a safe order in which to remove all objects, or to reach one.

    Rehearse each lift in physics, on the extracted shapes and on samples of their uncertainty, to estimate
    the probability that nothing else moves. If no order is safe, print the least risky one and the objects
    that block each other.

    Usage examples:
      caryatid order run
      caryatid order run --goal o3
      caryatid order run --risk 0.2
    """

    settings: options.Modelling = options.Modelling()
    run: options.RunPath
    """Run folder, session, or graph.json."""

    def __call__(self) -> int:
        from caryatid.cli import NOT_SAFE
        from caryatid.cli.output import table
        from caryatid.manipulation.order import plan_order
        from caryatid.runtime.parallel import cores
        from caryatid.sources import read_model
        from caryatid.viz.tables import order_line, order_table

        config = self.settings.read(self.lift_settings())
        graph, voxels = read_model(self.run)
        known: dict[str, Any] = {"goal": self.goal, "hands": self.hands, "seed": self.settings.seed}
        known |= {"voxels": voxels, "reachable": self.reachable(config)}
        with self.output.working("rehearsing"):
            order = plan_order(graph, config, threads=cores(), **known)
        steps = order_table(order, brief=True)
        rows = [[entry.text for entry in row] for row in steps.rows]
        jaw = f", opening {1e3 * config.gripper.opening:.0f} mm" if config.gripper.kind == "parallel" else ""
        gripper = "" if config.gripper.kind == "none" else f" with a {config.gripper.kind} gripper{jaw}"
        shown = table(f"Steps{gripper}", steps.columns, rows) if rows else ""
        refusal = f"{order.refusal}\n" if order.refusal else ""
        self.output.result(order.to_json(), f"{self.run}: {order_line(order)}\n", refusal, shown)
        return 0 if order.safe else NOT_SAFE


@dataclass(frozen=True, kw_only=True)
class ReportCommand(options.Command):
    """Write the report of a run again, optionally also as a PDF.

    Usage examples:
      caryatid report run
      caryatid report run --pdf report.pdf
    """

    run: options.RunPath
    """Run folder or session; its report.html is replaced."""
    pdf: Annotated[Path | None, options.shown("FILE.pdf")] = None
    """Also write a PDF (A4); replaces an existing file."""

    def __call__(self) -> None:
        for path in write_report(self.run, self.pdf):
            self.output.say(f"report: {path}")
        self.output.result({"html": self.run / "report.html", "pdf": self.pdf}, "")


@dataclass(frozen=True, kw_only=True)
class Export(options.Command):
    """Export the scene model of a run to simulators, 3D viewers and graph tools.

    Usage examples:
      caryatid export run --format mjcf --out scene.xml
      caryatid export run --out scene.glb
    """

    settings: options.Settings = options.Settings()
    run: options.RunPath
    """Run folder, session, or graph.json."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write: .xml (mjcf), .urdf, .glb, .gltf, .graphml, .dot or .gv; replaces an existing file."""
    format: Annotated[
        ExportFormat | None, options.one_of(ExportFormat), options.shown(default="by the suffix of FILE")
    ] = None
    """mjcf: free bodies on a table; urdf: links fixed to the world; gltf: meshes; graphml, dot: the graph."""

    def __call__(self) -> None:
        from caryatid.exports import export_graph, format_of
        from caryatid.sources import read_model
        from caryatid.viz.tables import census

        config, format_ = self.settings.read(), format_of(self.out, self.format)
        graph, _ = read_model(self.run)
        export_graph(graph, self.out, config.export)
        self.output.result({"file": str(self.out), "format": format_}, "")
        self.output.say(f"{self.out}: {format_}, {census(graph)}")


def write_report(folder: Path, pdf: Path | None = None) -> list[Path]:
    """Draw the report of a run or session; write its report.html, and a PDF if asked for; return their paths.

    Raises:
        InputError: It is neither a run nor a session, a file in it is broken, or a file cannot be written;
            an existing report.html then remains unchanged.
    """
    from caryatid.io.staging import write_file
    from caryatid.sources import open_run
    from caryatid.steps import read_config, read_steps
    from caryatid.viz.pdf import render_pdf
    from caryatid.viz.report import make_report, read_lifts, render_html

    with open_run(folder) as run:
        config, record = read_config(run), run.record
        settings = {"source": record["source"], "seed": record["seed"]} | record["options"]
        settings |= {"fusion": config.fusion.method, "views": config.active.max_views}
        made_by = f"caryatid {record.get('versions', {}).get('caryatid', '')}".rstrip()
        about = [record.get("conditions"), made_by, record.get("date", "")[:16].replace("T", " ")]
        report = make_report(
            Path(record["source"]).name,
            read_steps(run),
            about=" · ".join(filter(None, about)),
            settings=settings,
            scores=record.get("scores", ()),
            strip=read_lifts(folder),
            warnings=record.get("warnings", ()),
            config=config.report,
        )
    files = {} if pdf is None else {pdf: render_pdf(report)}
    files[folder / "report.html"] = render_html(report).encode()
    for path, content in files.items():
        write_file(path, content)
    return list(files)
