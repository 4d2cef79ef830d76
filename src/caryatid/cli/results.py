"""Commands on what is on disk: `import`, `evaluate`, `order`, `report`, `describe`, `export`, `benchmark`."""

from __future__ import annotations

import os
import platform
import re
import time
from contextlib import closing
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import repeat
from pathlib import Path
from typing import Any

from rich.progress import MofNCompleteColumn, Progress

from caryatid import __version__
from caryatid.benchmark.episodes import Episode, short_name
from caryatid.benchmark.report import check_reference
from caryatid.benchmark.report import write_report as write_benchmark
from caryatid.benchmark.running import run_locally
from caryatid.benchmark.store import RESULTS, ResultStore, collect_provenance, import_pandas
from caryatid.benchmark.suites import SUITES, change_suite
from caryatid.cli import NOT_SAFE
from caryatid.cli.commands import (
    Benchmark,
    Check,
    Describe,
    Doctor,
    Evaluate,
    Export,
    Import,
    Order,
    Report,
    Why,
)  # fmt: skip
from caryatid.cli.output import kept, table
from caryatid.config import Config
from caryatid.errors import GoalError, InputError
from caryatid.evaluation.truths import evaluate_run
from caryatid.exports import export_graph, format_of
from caryatid.exports.streams import STREAMS, Stream
from caryatid.io.datasets import OpenOptions, open_dataset
from caryatid.io.importing import import_recording, levelled, reasons
from caryatid.io.staging import write_file
from caryatid.manipulation import order as orders
from caryatid.objects.reasons import Reasons
from caryatid.runtime import fingerprint
from caryatid.runtime.parallel import cores
from caryatid.segmentation.diagnosis import diagnose
from caryatid.sessions.session import is_session
from caryatid.simulation.warm_up import is_warm
from caryatid.sources import kind_of, open_run, read_known_graph, read_model, read_scene
from caryatid.steps import Run, read_config, read_run, read_steps
from caryatid.viz.check_report import SHOWN, make_check_report
from caryatid.viz.report import find_chromium, make_report, print_pdf, read_lift, render_html
from caryatid.viz.tables import (
    Table,
    census,
    count_of,
    describe,
    describe_order,
    describe_removed,
    order_table,
    sentence,
)

REPORTED, LIFTS = 12, 3
"""Numbers of objects up to which a run's report plans the whole order, and of lifts that it plans else."""


def check_views(command: Check) -> int:
    config, source = command.settings.read(), command.source
    if kind_of(str(source)) == "cloud":
        raise InputError(source, "is a cloud", "run `caryatid extract`, which checks its unit and its frame")
    dataset = open_dataset(source, config.recording)
    with command.output.working("looking"):
        dataset = levelled(dataset, config) if command.level else dataset
        found = diagnose(dataset, config)
    columns = (
        "view", "size\n[px]", "width\n[°]", "readings", "near\n[m]", "far\n[m]", "largest\nplane",
        "tilt\n[°]",
    )  # fmt: skip
    rows = []
    for view in found.views:
        tilt = "–" if view["tilt"] is None else f"{view['tilt']:.1f}"
        rows.append([
            view["view"].rpartition("/")[2], f"{view['width']}×{view['height']}",
            f"{view['field_of_view']:.0f}", f"{view['readings']:.0%}", f"{view['near']:.2f}",
            f"{view['far']:.2f}", f"{view['plane']:.0%}", tilt,
        ])  # fmt: skip
    said = "".join(f"wrong: {problem}\n" for problem in found.problems)
    said += "".join(f"not confirmed: {doubt}\n" for doubt in found.doubts)
    if found.problems:
        said += (
            "Mend this, or give the options named here to every command, and check again. In a "
            "scene_camera.json, K is cam_K, depth is multiplied by depth_scale, and cam_R_w2c and "
            "cam_t_w2c [mm] are the inverse of T_world_camera.\n"
        )
    said += "" if said else "nothing is wrong\n"
    shown = table(f"{source}: {count_of(len(rows), 'view')}", columns, rows, figures=True)
    if command.report is not None:
        known = {view["view"] for view in found.views}
        frames = [frame for frame in dataset.frames if frame.name in known]
        views = [frame.load() for frame in frames[:: -(-len(frames) // SHOWN) or 1]]
        numbers = Table.of("Views", (name.replace("\n", " ") for name in columns), rows)
        page = make_check_report(source.name, found, views, numbers, config.cloud)
        write_file(command.report, render_html(page).encode())
    command.output.result(
        {"views": found.views, "problems": found.problems, "doubts": found.doubts}, shown, said
    )
    return 1 if found.problems else 0


def import_log(command: Import) -> None:
    output, source, out = command.output, command.source, command.out
    config = command.settings.read({"recording.max_views": command.views})
    given = {"--depth": command.depth, "--info": command.info, "--rgb": command.rgb}
    count = max(1, *map(len, given.values()))
    for option, topics in given.items():
        if len(topics) not in (0, count):
            remedy = "give --depth and --info for each camera, and --rgb for all or none"
            raise InputError(option, f"is given for {len(topics)} of {count} cameras", remedy)
    depths, infos, rgbs = (topics or (None,) * count for topics in given.values())
    cameras = [
        OpenOptions(depth, info, rgb, command.tf, command.camera)
        for depth, info, rgb in zip(depths, infos, rgbs, strict=True)
    ]
    with output.working(f"reading {source.name}"):
        imported = import_recording(source, out, cameras, level=command.level, config=config)
    read = len(imported) + sum(imported.skipped.values())
    views = [
        {"view": n, "frame": f.number, "time": f.time, "posed": f.T_world_camera is not None}
        for n, f in enumerate(imported.frames)
    ]
    problems = diagnose(imported, config).problems
    document = {"recording": str(out), "frames": read, "views": views, "skipped": imported.skipped}
    output.result(document | {"notes": list(imported.notes), "problems": problems}, "")
    for note in imported.notes:
        output.say(note)
    skipped = f"; skipped: {reasons(imported.skipped)}" if imported.skipped else ""
    output.say(f"{source.name}: {len(imported)} views of {read} frames{skipped}")
    for problem in problems:
        output.say(f"wrong: {problem}")
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
    graph, known, seed, voxels = read_model(command.run)
    config = command.settings.read(*command.lift_settings(), base=known)
    reachable, seed = command.reachable(config), seed if command.seed is None else command.seed
    with command.output.working("rehearsing"):
        order = orders.plan_order(
            graph, config, goal=command.goal, hands=command.hands, seed=seed, threads=cores(),
            voxels=voxels, reachable=reachable,
        )  # fmt: skip
    steps = order_table(order, graph, brief=True)
    rows = [[entry.text for entry in row] for row in steps.rows]
    shown = table(steps.heading, steps.columns, rows) if rows else ""
    text = "".join(f"{line}\n" for line in describe_order(order, graph))
    command.output.result(order.to_json(), text, shown)
    return 0 if order.safe else NOT_SAFE


def redraw_report(command: Report) -> None:
    paths, _ = write_report(command.run, command.pdf, command)
    for path in paths:
        command.output.say(f"report: {path}")
    command.output.result({"html": command.run / "report.html", "pdf": command.pdf}, "")


def export_model(command: Export) -> None:
    config, out = command.settings.read(), command.out
    if command.format is None and out.suffix in STREAMS:
        with open_run(command.run) as run, Stream(out) as stream:
            scores = [score["f1"] for score in run.record.get("scores", ())]
            for step, f1 in zip(read_steps(run), scores or repeat(None), strict=False):
                stream.add(step, f1)
        command.output.result({"file": str(out), "format": out.suffix[1:]}, "")
        command.output.say(f"{out}: {count_of(len(run.views), 'view')}")
        return
    format_ = format_of(out, command.format)
    graph = read_known_graph(command.run)
    export_graph(graph, out, config.export)
    command.output.result({"file": str(out), "format": format_}, "")
    command.output.say(f"{out}: {format_}, {census(graph)}")


def describe_model(command: Describe) -> None:
    text = describe(read_known_graph(command.run))
    command.output.result({"text": text}, text)


def tell_reasons(command: Why) -> None:
    if len(command.objects) not in (1, 2):
        given = count_of(len(command.objects), "id")
        raise InputError("ID", f"{given} of objects given", "give one, or two to ask why they are two")
    reasons = None if len(command.objects) > 1 else _read_reasons(command.run, command.objects[0])
    if reasons is None:
        with command.output.working("looking at all views again"):
            reasons = read_scene(command.run).why(*command.objects)
    terms = ("points", "free", "parameters", "border", "others", "total")
    rows = [[option.what, *(f"{getattr(option, term):.0f}" for term in terms)] for option in reasons.options]
    heads = ["explanation", "points", "free\nspace", "parameters", "border", "colours,\nviews", "total"]
    title = f"{' and '.join(reasons.subject)}: costs in nats, the explanation in use first"
    notes = "".join(f"{option.what}: {option.note}\n" for option in reasons.options if option.note)
    command.output.result(reasons.to_json(), table(title, heads, rows, figures=True), notes)


def _read_reasons(path: Path, word: str) -> Reasons | None:
    """Read why an object of a run is what it is, as its last step tells; None if it does not."""
    if is_session(path):
        return None
    run = read_run(path)
    known = run.views[-1].load_step().reasons
    return next((reasons for reasons in known if reasons.subject == (run.graph.find_id(word),)), None)


def write_report(
    folder: Path, pdf: Path | None = None, asked: Report | None = None
) -> tuple[list[Path], list[str]]:
    """Draw the report of a run or session; write its report.html, and a PDF if asked for.

    The order in it is for the goal, hands and gripper asked for, or else for those of the run.

    Returns:
        The paths of the files, and what was removed and what to remove, a sentence each.

    Raises:
        InputError: It is neither a run nor a session, a file in it is broken, or a file cannot be written;
            an existing report.html then remains unchanged.
    """
    with open_run(folder) as run:
        config, record = read_config(run), run.record
        if asked is not None:
            config = asked.settings.read(*asked.lift_settings(), base=config)
        settings = {"source": record["source"], "seed": record["seed"]} | record["options"]
        settings |= {"fusion": config.fusion.method, "views": config.active.max_views}
        made_by = f"caryatid {record.get('versions', {}).get('caryatid', '')}".rstrip()
        about = [record.get("conditions"), made_by, record.get("date", "")[:16].replace("T", " ")]
        order, answer = None, describe_removed(record.get("lifts", ()))
        if run.graph.movable:
            wanted = _choose_options(run, config, asked)
            try:
                order = orders.plan_order(run.graph, config, threads=cores(), **wanted)
                answer += describe_order(order, run.graph)
            except GoalError:
                raise
            except InputError as error:
                answer += [f"No lift was rehearsed. {sentence(str(error))}"]
            if order is not None and len(order.steps) == wanted["steps"]:
                answer += [f"Only {wanted['steps']} lifts were planned; `caryatid order` plans all."]
        report = make_report(
            Path(record["source"]).name,
            read_steps(run),
            about=" · ".join(filter(None, about)),
            answer="\n".join(answer),
            order=order,
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
    return list(files), answer


def _choose_options(run: Run, config: Config, asked: Report | None) -> dict[str, Any]:
    """Find what order a report is to have: as asked for, or as the run's command was, without a lost goal.

    Unless asked, the order of a large scene is not planned to its end, which takes a minute and more.
    """
    options, graph = run.record["options"], run.graph
    goal, hands, reachable = run.record.get("goal") or options.get("goal"), options.get("hands", 1), None
    goal = None if goal is None else graph.find_id(goal)
    if asked is not None:
        goal, hands, reachable = asked.goal or goal, max(asked.hands, hands), asked.reachable(config)
    steps = None if asked is not None or len(graph.movable) <= REPORTED else LIFTS
    known = {"goal": goal, "hands": hands, "reachable": reachable, "steps": steps, "seed": run.record["seed"]}
    return known | {"voxels": run.views[-1].load_step().voxels}


def compare_methods(command: Benchmark) -> None:
    import_pandas()
    suite = None
    if command.suite is not None:
        suite = change_suite(
            SUITES[command.suite],
            planners=command.planner,
            fusions=command.fusion,
            segmentations=command.segmentation,
            noises=command.noise,
            preset=command.preset,
            settings=command.set,
            scenes=command.scenes,
            seeds=command.seeds,
            views=command.views,
        )
    with (
        kept("finished episodes are kept; run the same command to continue"),
        ResultStore(command.out / RESULTS, fingerprint() if suite else None, collect_provenance()) as store,
    ):
        missing = store.plan(command.suite or "", suite.members(), retry=command.retry) if suite else []
        check_reference(command.reference, store)
        if command.suite and missing:
            _run_episodes(command, command.suite, missing, store)
        _report_benchmark(command, store)


def _run_episodes(command: Benchmark, suite: str, missing: list[Episode], store: ResultStore) -> None:
    """Run the missing episodes with a progress bar; without a terminal, print a line every minute."""
    output = command.output
    episodes = run_locally(missing, command.jobs or os.cpu_count() or 1)
    total = len({member.episode for member in store.suites[suite]})
    console = output.progress
    hidden = console.quiet or not console.is_interactive
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    bar = Progress(*columns, console=console, disable=hidden, speed_estimate_period=600.0)
    task = bar.add_task(suite, total=total, completed=total - len(missing))
    printed = time.monotonic()
    with bar, closing(episodes) as outcomes:
        for done, (episode, outcome) in enumerate(outcomes, start=total - len(missing) + 1):
            store.add(episode, outcome)
            bar.advance(task)
            if outcome.error is not None:
                name = f"{short_name(episode.scene)}, {episode.planner}, seed {episode.seed}"
                output.say(f"failed: {name}: {outcome.error}")
            if hidden and time.monotonic() - printed >= 60.0:
                printed = time.monotonic()
                output.say(f"{suite}: {done} of {total} episodes")


def _report_benchmark(command: Benchmark, store: ResultStore) -> None:
    """Write tables, figures and pages, and print the summary."""
    output, suites = command.output, {}
    for each in write_benchmark(store, command.out, command.reference):
        done, failed = each.episodes, len(each.failures)
        suites[each.name] = {"planned": each.planned, "done": done, "failed": failed, "f1": each.f1()}
        output.say(
            f"{each.name}: {done} of {each.planned} episodes" + (f", {failed} failed" if failed else "")
        )
    if suites:
        output.say(f"figures: {command.out / 'index.html'}")
    output.result({"results": str(command.out), "suites": suites}, "")


def describe_installation(command: Doctor) -> None:
    kernels = "compiled" if is_warm() else "not compiled: the first run takes half a minute longer"
    found = {
        "caryatid": __version__, "Python": platform.python_version(), "system": platform.platform(),
        "cores": str(cores()), "kernels": kernels, "Chromium": find_chromium() or "not found: no PDFs",
    }  # fmt: skip
    for line in requires("caryatid") or ():
        package, extra = re.findall(r"^([\w-]+)(?:.*extra == .(\w+))?", line)[0]
        if extra not in ("", "all", "dev", "docs", "bench"):
            try:
                known = version(package)
            except PackageNotFoundError:
                known = "is missing"
            name = f"extra {extra}"
            found[name] = ", ".join(filter(None, (found.get(name), f"{package} {known}")))
    command.output.result(found, table("Installation", ("what", "found"), found.items()))
