"""What `caryatid benchmark` does: run what is missing, and tell what there is."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from caryatid.benchmark.cluster import ClusterExecutor
from caryatid.benchmark.provenance import collect_provenance
from caryatid.benchmark.records import Episode, Outcome
from caryatid.benchmark.running import Executor, LocalExecutor, run_all
from caryatid.benchmark.scenes import find_scenes, short_name
from caryatid.benchmark.sections import SuiteReport
from caryatid.benchmark.store import ResultStore
from caryatid.benchmark.suites import Suite, find_suite
from caryatid.benchmark.telling import (
    check_reference,
    read_results,
    report_all,
    write_docs,
    write_page,
    write_tables,
)
from caryatid.benchmark.variants import with_conditions, with_fusions, with_planners, with_settings
from caryatid.cli.benchmark import CORES, Benchmark
from caryatid.cli.consoles import news_console
from caryatid.cli.episode_bar import EpisodeBar
from caryatid.errors import InputError
from caryatid.io.json_files import json_text
from caryatid.runtime.compiling import compile_kernels
from caryatid.runtime.fingerprint import fingerprint
from caryatid.runtime.interrupts import Interrupted, interruptible

RESULTS = "results.sqlite"
"""Name of the result store in the folder."""


@interruptible()
def run_benchmark(options: Benchmark) -> int:
    """Run the episodes that are missing and write the figures; Ctrl-C ends it, and what is done is kept."""
    console = news_console(options.general.quiet or options.general.json)
    suite = None if options.suite is None else _suite(options, options.suite)
    executor = _executor(options, lambda text: console.print(text, markup=False))
    code = None if suite is None else fingerprint()
    path = options.out / RESULTS
    if suite is not None:
        _check(options, suite, path, executor)
    with ResultStore(path, code, collect_provenance().as_strings()) as store:
        try:
            if suite is not None:
                with store.alone():
                    _run(options, suite, store, console, executor)
            return _tell(options, store, console)
        except KeyboardInterrupt:
            raise Interrupted("what is done is kept, start again to go on") from None


def _suite(options: Benchmark, name: str) -> Suite:
    """The suite with what the options change."""
    suite = find_suite(name)
    if options.planner:
        suite = with_planners(suite, options.planner)
    if options.fusion:
        suite = with_fusions(suite, options.fusion)
    if options.segmentation or options.noise:
        suite = with_conditions(suite, options.segmentation or ("labels",), options.noise or ("carmine",))
    if options.set:
        suite = with_settings(suite, options.set)
    if options.scenes:
        suite = replace(suite, scenes=tuple(find_scenes(options.scenes)))
    return replace(suite, seeds=options.seeds or suite.seeds, views=options.views or suite.views)


def _check(options: Benchmark, suite: Suite, path: Path, executor: Executor) -> None:
    """Refuse before anything is written or run what would come to nothing.

    Raises:
        InputError: There is no such method to compare with, or nobody to run episodes.
    """
    methods = {member.method: None for member in suite.members()}
    if path.is_file():
        with ResultStore(path) as store:
            methods |= {r.member.method: None for result in read_results(store) for r in result.records}
    elif isinstance(executor, ClusterExecutor):
        executor.check()
    check_reference(options.reference, methods)


def _run(options: Benchmark, suite: Suite, store: ResultStore, console: Console, executor: Executor) -> None:
    """Run what is not done, with a bar."""
    if options.retry:
        store.forget_failures()
    missing = store.plan(suite.name, suite.members())
    total = store.planned(suite.name)
    if missing and options.scheduler is None:
        compile_kernels(console.print)
    with EpisodeBar(console, suite.name, total, total - len(missing)) as bar:

        def done(episode: Episode, outcome: Outcome) -> None:
            bar.advance()
            if outcome.error is not None:
                name = f"{short_name(episode.scene)}, {episode.planner}, seed {episode.seed}"
                bar.say(f"failed: {name}: {outcome.error}")

        run_all(store, missing, executor, done)


def _executor(options: Benchmark, say: Callable[[str], None]) -> Executor:
    if options.scheduler is None:
        return LocalExecutor(options.jobs or CORES)
    if options.jobs is not None:
        raise InputError("--jobs", "a cluster has the workers it has", "leave --jobs or --scheduler out")
    return ClusterExecutor(options.scheduler, say)


def _tell(options: Benchmark, store: ResultStore, console: Console) -> int:
    """Write tables, figures and pages; say what there is."""
    results = read_results(store)
    reports = report_all(results, options.reference)
    for line in [result.said() for result in results] + write_tables(results, options.out):
        console.print(line, markup=False)
    if reports:
        command = f"caryatid benchmark --out {options.out.name}"
        if options.reference is not None:
            command += f" --reference {shlex.quote(options.reference)}"
        page = write_page(reports, store, options.out, command)
        console.print(f"figures: {page}", markup=False)
        if options.docs is not None:
            write_docs(reports, store, options.docs, f"{command} --docs {options.docs.name}")
    if options.general.json:
        sys.stdout.write(json_text({"results": str(options.out), "suites": figures(reports)}))
    return 0


def figures(reports: Sequence[SuiteReport]) -> dict[str, Any]:
    """Mean F1 by view of each suite, condition and method, for other programs."""
    return {
        report.name: {
            "planned": report.planned,
            "done": report.summary.episodes,
            "failed": len(report.summary.failures),
            "f1": {
                group.condition: {m.method: [e.value for e in m.curves["f1"]] for m in group.methods}
                for group in report.summary.groups
                if not group.family
            },
        }
        for report in reports
    }
