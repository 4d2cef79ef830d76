"""`caryatid benchmark`: ways to look at clutter compared over scenes, sensors and seeds."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from caryatid.benchmark.cluster import ClusterExecutor
from caryatid.benchmark.fingerprint import fingerprint
from caryatid.benchmark.provenance import collect_provenance
from caryatid.benchmark.records import Episode, Outcome
from caryatid.benchmark.running import Executor, LocalExecutor, run_all
from caryatid.benchmark.scenes import find_scenes, short_name
from caryatid.benchmark.sections import SuiteReport
from caryatid.benchmark.store import ResultStore
from caryatid.benchmark.suites import Suite, find_suite
from caryatid.benchmark.telling import read_results, report_all, write_docs, write_page, write_tables
from caryatid.benchmark.variants import with_conditions, with_fusions, with_planners, with_settings
from caryatid.commands.episode_bar import EpisodeBar
from caryatid.commands.names import PlannerName, SuiteName
from caryatid.commands.options import SAID, General, defaults_to, whole_number
from caryatid.config import FusionMethod, NoiseModel, SegmentationMethod
from caryatid.errors import InputError
from caryatid.formats.json_files import json_text

RESULTS = "results.sqlite"
"""Name of the result store in the folder."""

Count = Annotated[int | None, whole_number(1)]
CORES = os.cpu_count() or 1
GENERAL = General()


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Compare ways to look at clutter: methods × scenes × seeds, with figures.

    What is done is kept after every episode: stop it at any time and start it again. Without --suite the
    figures of what a folder holds are made again, and nothing is run.

    To try:
      caryatid benchmark --suite smoke --out bench
      caryatid benchmark --suite planners --planner support --planner random --out bench
      caryatid benchmark --suite fig5 --scenes my-scenes/ --seeds 1 --out bench
      caryatid benchmark --suite planners --segmentation auto --noise none --out bench
    """

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder of the results; those already there count."""
    suite: Annotated[SuiteName, SAID] = None
    """What to compare."""
    scenes: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="SCENE", help_behavior_hint="")
    ] = ()
    """Scenes in place of the suite's: a built-in name, a scene folder, a folder of them; may be repeated."""
    planner: Annotated[tyro.conf.UseAppendAction[tuple[PlannerName, ...]], SAID] = ()
    """Planner in place of the suite's methods; may be repeated. The others are compared with the first."""
    fusion: Annotated[tyro.conf.UseAppendAction[tuple[FusionMethod, ...]], SAID] = ()
    """Fusion in place of the suite's; may be repeated."""
    segmentation: Annotated[tyro.conf.UseAppendAction[tuple[SegmentationMethod, ...]], SAID] = ()
    """Where parts come from, in place of the suite's conditions; may be repeated. Without: labels."""
    noise: Annotated[tyro.conf.UseAppendAction[tuple[NoiseModel, ...]], SAID] = ()
    """Noise of the camera, in place of the suite's conditions; may be repeated. Without: carmine."""
    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="STAGE.NAME=VALUE", help_behavior_hint=""),
    ] = ()
    """One setting of all episodes, say `--set noise.translation=0.02`; may be repeated."""
    seeds: Annotated[Count, defaults_to("the suite's")] = None
    """Seeds 0…N−1 of every episode."""
    views: Annotated[Count, defaults_to("the suite's")] = None
    """Views of every episode, the first one too."""
    jobs: Annotated[Count, defaults_to(f"the cores of this machine, {CORES}")] = None
    """Processes of this machine."""
    scheduler: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="ADDRESS"), SAID] = None
    """Run on the workers of this dask.distributed scheduler instead, say tcp://10.0.0.5:8786."""
    retry: Annotated[bool, SAID] = False
    """Run episodes again that failed."""
    reference: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="METHOD"), SAID] = None
    """Method the others are compared with in the figures, in place of the suite's."""
    docs: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.md"), SAID] = None
    """Write the figures as a Markdown document too."""
    general: tyro.conf.OmitArgPrefixes[General] = GENERAL

    def __call__(self) -> int:
        """Run the command."""
        console = Console(
            stderr=True, quiet=self.general.quiet or self.general.json, highlight=False, soft_wrap=True
        )
        suite = None if self.suite is None else self._suite(self.suite)
        code = None if suite is None else fingerprint()
        with ResultStore(self.out / RESULTS, code, collect_provenance().as_strings()) as store:
            try:
                if suite is not None:
                    with store.alone():
                        self._run(suite, store, console)
                return self._tell(store, console)
            except KeyboardInterrupt:
                console.print("interrupted: what is done is kept, start again to go on")
                return 130

    def _suite(self, name: str) -> Suite:
        """The suite with what the options change."""
        suite = find_suite(name)
        if self.planner:
            suite = with_planners(suite, self.planner)
        if self.fusion:
            suite = with_fusions(suite, self.fusion)
        if self.segmentation or self.noise:
            suite = with_conditions(suite, self.segmentation or ("labels",), self.noise or ("carmine",))
        if self.set:
            suite = with_settings(suite, self.set)
        if self.scenes:
            suite = replace(suite, scenes=tuple(find_scenes(self.scenes)))
        return replace(suite, seeds=self.seeds or suite.seeds, views=self.views or suite.views)

    def _run(self, suite: Suite, store: ResultStore, console: Console) -> None:
        """Run what is not done, with a bar."""
        if self.retry:
            store.forget_failures()
        missing = store.plan(suite.name, suite.members())
        total = store.planned(suite.name)
        with EpisodeBar(console, suite.name, total, total - len(missing)) as bar:

            def done(episode: Episode, outcome: Outcome) -> None:
                bar.advance()
                if outcome.error is not None:
                    name = f"{short_name(episode.scene)}, {episode.planner}, seed {episode.seed}"
                    bar.say(f"failed: {name}: {outcome.error}")

            run_all(store, missing, self._executor(bar), done)

    def _executor(self, bar: EpisodeBar) -> Executor:
        if self.scheduler is None:
            return LocalExecutor(self.jobs or CORES)
        if self.jobs is not None:
            raise InputError("--jobs", "a cluster has the workers it has", "leave --jobs or --scheduler out")
        return ClusterExecutor(self.scheduler, bar.say)

    def _tell(self, store: ResultStore, console: Console) -> int:
        """Write tables, figures and pages; say what there is."""
        results = read_results(store)
        reports = report_all(results, self.reference)
        for line in [result.said() for result in results] + write_tables(results, self.out):
            console.print(line, markup=False)
        if reports:
            command = f"caryatid benchmark --out {self.out.name}"
            if self.reference is not None:
                command += f" --reference {shlex.quote(self.reference)}"
            page = write_page(reports, store, self.out, command)
            console.print(f"figures: {page}", markup=False)
            if self.docs is not None:
                write_docs(reports, store, self.docs, f"{command} --docs {self.docs.name}")
        if self.general.json:
            sys.stdout.write(json_text({"results": str(self.out), "suites": figures(reports)}))
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
