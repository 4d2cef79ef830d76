"""`caryatid benchmark`: compare methods over scenes, sensors and seeds."""

from __future__ import annotations

import os
import time
from contextlib import closing

from rich.progress import MofNCompleteColumn, Progress

from caryatid.benchmark.episodes import Episode, short_name
from caryatid.benchmark.report import check_reference, write_report
from caryatid.benchmark.running import run_locally, run_on_cluster
from caryatid.benchmark.store import RESULTS, ResultStore, collect_provenance, import_pandas
from caryatid.benchmark.suites import SUITES, change_suite
from caryatid.cli.commands import Benchmark
from caryatid.cli.output import kept
from caryatid.errors import InputError, needs_extra
from caryatid.runtime import fingerprint


def compare_methods(command: Benchmark) -> None:
    import_pandas()
    if command.scheduler is not None:
        with needs_extra("cluster", "--scheduler"):  # before anything is written
            import distributed  # noqa: F401
        if command.jobs is not None:
            reason = "cannot be combined with --scheduler, which has its own workers"
            raise InputError("--jobs", reason, "omit one of the two options")
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
            _run(command, command.suite, missing, store)
        _report(command, store)


def _run(command: Benchmark, suite: str, missing: list[Episode], store: ResultStore) -> None:
    """Run the missing episodes with a progress bar; without a terminal, print a line every minute."""
    output = command.output
    if command.scheduler is not None:
        episodes = run_on_cluster(missing, command.scheduler, output.say)
    else:
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


def _report(command: Benchmark, store: ResultStore) -> None:
    """Write tables, figures and pages, and print the summary."""
    output, suites = command.output, {}
    for each in write_report(store, command.out, reference=command.reference, document=command.docs):
        done, failed = each.episodes, len(each.failures)
        suites[each.name] = {"planned": each.planned, "done": done, "failed": failed, "f1": each.f1()}
        output.say(
            f"{each.name}: {done} of {each.planned} episodes" + (f", {failed} failed" if failed else "")
        )
    if suites:
        output.say(f"figures: {command.out / 'index.html'}")
    output.result({"results": str(command.out), "suites": suites}, "")
