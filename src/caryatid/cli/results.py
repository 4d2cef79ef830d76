"""`caryatid import`, `evaluate`, `order`, `report` and `export`: commands on recordings and run folders."""

from __future__ import annotations

from pathlib import Path

from caryatid.cli import NOT_SAFE
from caryatid.cli.commands import Evaluate, Export, Import, Order, Report
from caryatid.cli.output import table
from caryatid.evaluation.truths import evaluate_run
from caryatid.exports import export_graph, format_of
from caryatid.io.datasets import OpenOptions
from caryatid.io.importing import import_recording, reasons
from caryatid.io.staging import write_file
from caryatid.manipulation.order import plan_order
from caryatid.runtime.parallel import cores
from caryatid.sources import open_run, read_model
from caryatid.steps import read_config, read_steps
from caryatid.viz.report import make_report, print_pdf, read_lift, render_html
from caryatid.viz.tables import census, order_line, order_table


def import_log(command: Import) -> None:
    output, source, out = command.output, command.source, command.out
    config = command.settings.read({"recording.max_views": command.views})
    topics = OpenOptions(command.depth, command.info, command.rgb, command.tf, command.camera)
    with output.working(f"reading {source.name}"):
        imported = import_recording(source, out, topics, level=command.level, config=config)
    read = len(imported) + sum(imported.skipped.values())
    views = [
        {"view": n, "frame": f.number, "time": f.time, "posed": f.T_world_camera is not None}
        for n, f in enumerate(imported.frames)
    ]
    document = {"recording": str(out), "frames": read, "views": views}
    output.result(document | {"skipped": imported.skipped, "notes": list(imported.notes)}, "")
    for note in imported.notes:
        output.say(note)
    skipped = f"; skipped: {reasons(imported.skipped)}" if imported.skipped else ""
    output.say(f"{source.name}: {len(imported)} views of {read} frames{skipped}")
    output.say(f"recording: {out}; next, run `caryatid extract {out} --out run`")


def print_scores(command: Evaluate) -> None:
    output = command.output
    with open_run(command.run) as run:
        scores = evaluate_run(run, command.truth)
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
    truth = command.truth or "the ground truth of its source"
    shown = table(f"{command.run} against {truth}", ["view", *columns.values()], rows, figures=True)
    output.result({"views": views, "warnings": output.warnings}, shown)


def find_order(command: Order) -> int:
    config = command.settings.read(command.lift_settings())
    graph, voxels = read_model(command.run)
    reachable, seed = command.reachable(config), command.settings.seed
    with command.output.working("rehearsing"):
        order = plan_order(
            graph, config, goal=command.goal, hands=command.hands, seed=seed, threads=cores(),
            voxels=voxels, reachable=reachable,
        )  # fmt: skip
    steps = order_table(order, brief=True)
    rows = [[entry.text for entry in row] for row in steps.rows]
    jaw = f", opening {1e3 * config.gripper.opening:.0f} mm" if config.gripper.kind == "parallel" else ""
    gripper = "" if config.gripper.kind == "none" else f" with a {config.gripper.kind} gripper{jaw}"
    shown = table(f"Steps{gripper}", steps.columns, rows) if rows else ""
    refusal = f"{order.refusal}\n" if order.refusal else ""
    command.output.result(order.to_json(), f"{command.run}: {order_line(order)}\n", refusal, shown)
    return 0 if order.safe else NOT_SAFE


def redraw_report(command: Report) -> None:
    for path in write_report(command.run, command.pdf):
        command.output.say(f"report: {path}")
    command.output.result({"html": command.run / "report.html", "pdf": command.pdf}, "")


def export_model(command: Export) -> None:
    config, out, format_ = command.settings.read(), command.out, format_of(command.out, command.format)
    graph, _ = read_model(command.run)
    export_graph(graph, out, config.export)
    command.output.result({"file": str(out), "format": format_}, "")
    command.output.say(f"{out}: {format_}, {census(graph)}")


def write_report(folder: Path, pdf: Path | None = None) -> list[Path]:
    """Draw the report of a run or session; write its report.html, and a PDF if asked for; return their paths.

    Raises:
        InputError: It is neither a run nor a session, a file in it is broken, or a file cannot be written;
            an existing report.html then remains unchanged.
    """
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
            strip=[read_lift(path) for path in sorted((folder / "lifts").glob("*.png"))],
            warnings=record.get("warnings", ()),
            config=config.report,
        )
    page = render_html(report)
    files = {} if pdf is None else {pdf: print_pdf(page)}
    files[folder / "report.html"] = page.encode()
    for path, content in files.items():
        write_file(path, content)
    return list(files)
