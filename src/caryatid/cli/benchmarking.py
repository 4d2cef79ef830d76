"""What `caryatid benchmark` does: run what is missing, and tell what there is."""

from __future__ import annotations

import shlex
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from caryatid.benchmark.episodes import Episode, find_scenes, short_name
from caryatid.benchmark.report import (
    check_reference,
    summarise_store,
    write_document,
    write_page,
    write_results,
    write_tables,
)
from caryatid.benchmark.running import Outcomes, connect, run_locally, run_on_cluster
from caryatid.benchmark.store import RESULTS, ResultStore, collect_provenance, import_pandas
from caryatid.benchmark.suites import (
    Suite,
    find_suite,
    with_conditions,
    with_fusions,
    with_planners,
    with_settings,
)
from caryatid.cli.benchmark import CORES, Benchmark
from caryatid.cli.consoles import news_console
from caryatid.cli.episode_bar import EpisodeBar
from caryatid.errors import InputError
from caryatid.io.json_files import json_text
from caryatid.runtime.compiling import compile_kernels
from caryatid.runtime.fingerprint import fingerprint
from caryatid.runtime.interrupts import Interrupted, interruptible

SUMMARY = "summary.json.gz"
"""What figures are made of, without the episodes; the documentation is built from such files."""


@interruptible()
def run_benchmark(options: Benchmark) -> int:
    """Run the episodes that are missing and write the figures; Ctrl-C ends it, and what is done is kept.

    Raises:
        InputError: Options contradict each other, or pandas is not installed.
        Interrupted: Ctrl-C was pressed.
    """
    console = news_console(options.general.quiet or options.general.json)
    import_pandas()
    path = options.out / RESULTS
    suite = None if options.suite is None else _suite(options, options.suite)
    if options.scheduler is not None and options.jobs is not None:
        raise InputError("--jobs", "a cluster has the workers it has", "leave --jobs or --scheduler out")
    if suite is not None:
        _check(options, suite, path)
    about = collect_provenance()
    with ResultStore(path, None if suite is None else fingerprint(), about) as store:
        try:
            if suite is not None:
                _run(options, suite, store, console)
            return _report(options, store, console)
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


def _check(options: Benchmark, suite: Suite, path: Path) -> None:
    """Refuse before anything is written or run what would come to nothing.

    Raises:
        InputError: There is no such method to compare with, or nobody to run episodes.
    """
    methods = {member.method: None for member in suite.members()}
    if path.is_file() and path.stat().st_size:
        with ResultStore(path) as store:
            methods |= {member.method: None for members in store.suites.values() for member in members}
    elif options.scheduler is not None:
        connect(options.scheduler).close()
    check_reference(options.reference, methods)


def _run(options: Benchmark, suite: Suite, store: ResultStore, console: Console) -> None:
    """Run what is not done, with a bar."""
    missing = store.plan(suite.name, suite.members(), retry=options.retry)
    total = len({member.episode for member in store.suites[suite.name]})
    if missing and options.scheduler is None:
        compile_kernels(console.print)
    with (
        EpisodeBar(console, suite.name, total, total - len(missing)) as bar,
        closing(_outcomes(options, missing, console)) as outcomes,
    ):
        for episode, outcome in outcomes:
            store.add(episode, outcome)
            bar.advance()
            if outcome.error is not None:
                name = f"{short_name(episode.scene)}, {episode.planner}, seed {episode.seed}"
                bar.say(f"failed: {name}: {outcome.error}")


def _outcomes(options: Benchmark, missing: list[Episode], console: Console) -> Outcomes:
    if missing and options.scheduler is not None:
        yield from run_on_cluster(missing, options.scheduler, lambda text: console.print(text, markup=False))
    elif missing:
        yield from run_locally(missing, options.jobs or CORES)


def _report(options: Benchmark, store: ResultStore, console: Console) -> int:
    """Write tables, figures and pages; say what there is."""
    results = summarise_store(store, options.reference)
    for result in results:
        failed = f", {len(result.failures)} failed" if result.failures else ""
        console.print(f"{result.name}: {result.episodes} of {result.planned} episodes{failed}", markup=False)
    for line in write_tables(store, options.out):
        console.print(line, markup=False)
    if results:
        command = f"caryatid benchmark --out {options.out.name}"
        if options.reference is not None:
            command += f" --reference {shlex.quote(options.reference)}"
        write_results(results, store.about, options.out / SUMMARY)
        console.print(f"figures: {write_page(results, store.about, options.out, command)}", markup=False)
        if options.docs is not None:
            write_document(results, store.about, options.docs, f"{command} --docs {options.docs.name}")
    if options.general.json:
        suites = {
            result.name: {
                "planned": result.planned,
                "done": result.episodes,
                "failed": len(result.failures),
                "f1": result.f1(),
            }
            for result in results
        }
        sys.stdout.write(json_text({"results": str(options.out), "suites": suites}))
    return 0
