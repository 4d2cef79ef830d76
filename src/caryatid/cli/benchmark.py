"""`caryatid benchmark`: methods compared over scenes, sensors and seeds."""

from __future__ import annotations

import os
import shlex
import time
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from caryatid.cli import options
from caryatid.config.choices import FusionMethod, NoiseModel, SegmentationMethod
from caryatid.errors import InputError

if TYPE_CHECKING:
    from caryatid.benchmark.store import ResultStore
    from caryatid.benchmark.suites import Suite

SUITES = (
    "smoke", "fig5", "planners", "path", "ablation", "ablation-attention", "poses", "noise", "dismantle",
    "full",
)  # fmt: skip
"""Names of the suites; the benchmark is imported later."""


@dataclass(frozen=True, kw_only=True)
class Benchmark(options.Command):
    """Compare methods over scenes and seeds, with figures.

    Every finished episode is kept: stop at any time and start again. Without --suite nothing is run, and the
    figures of the results in the folder are drawn again.

    To try:
      caryatid benchmark --suite smoke --out bench
      caryatid benchmark --suite planners --planner support --planner random --out bench
      caryatid benchmark --suite fig5 --scenes my-scenes/ --seeds 1 --out bench
      caryatid benchmark --suite planners --segmentation auto --noise none --out bench
    """

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder of the results; earlier ones are used."""
    suite: Annotated[str | None, options.one_of(SUITES), options.shown()] = None
    """What to compare."""
    scenes: Annotated[options.Words, options.shown("SCENE")] = ()
    """Scenes instead of the suite's: a built-in name, a scene folder, a folder of them; may be repeated."""
    planner: Annotated[
        tyro.conf.UseAppendAction[tuple[Annotated[str, options.planner_name()], ...]], options.shown()
    ] = ()
    """Planner instead of the suite's methods; may be repeated. The others are compared with the first."""
    fusion: Annotated[tyro.conf.UseAppendAction[tuple[FusionMethod, ...]], options.shown()] = ()
    """Fusion instead of the suite's; may be repeated."""
    segmentation: Annotated[tyro.conf.UseAppendAction[tuple[SegmentationMethod, ...]], options.shown()] = ()
    """Segmentation instead of the suite's conditions; may be repeated. Default: labels."""
    noise: Annotated[tyro.conf.UseAppendAction[tuple[NoiseModel, ...]], options.shown()] = ()
    """Noise of the camera, instead of the suite's conditions; may be repeated. Default: carmine."""
    set: Annotated[options.Words, options.shown("STAGE.NAME=VALUE")] = ()
    """One setting of all episodes, such as `--set noise.translation=0.02`; may be repeated."""
    seeds: Annotated[options.OptionalCount, options.shown(default="the suite's")] = None
    """Seeds 0…N−1 of every episode."""
    views: Annotated[options.OptionalCount, options.shown(default="the suite's")] = None
    """Views of every episode, including the first."""
    jobs: Annotated[options.OptionalCount, options.shown(default="all cores")] = None
    """Number of processes."""
    scheduler: Annotated[str | None, options.shown("ADDRESS")] = None
    """Run on the workers of this dask.distributed scheduler instead, such as tcp://10.0.0.5:8786."""
    retry: options.Flag = False
    """Run failed episodes again."""
    reference: Annotated[str | None, options.shown("METHOD")] = None
    """Method the others are compared with in the figures, instead of the suite's."""
    docs: Annotated[Path | None, options.shown("FILE.md")] = None
    """Write the figures as a Markdown document too."""

    def __call__(self) -> None:
        from caryatid.benchmark.store import RESULTS, ResultStore, collect_provenance, import_pandas
        from caryatid.runtime.fingerprint import fingerprint

        import_pandas()
        path = self.out / RESULTS
        if self.scheduler is not None and self.jobs is not None:
            raise InputError("--jobs", "a cluster has its own workers", "leave --jobs or --scheduler out")
        suite = None if self.suite is None else self._suite(self.suite)
        if suite is not None:
            self._check(suite, path)
        code = None if suite is None else fingerprint()
        with ResultStore(path, code, collect_provenance()) as store:
            try:
                if suite is not None:
                    self._run(suite, store)
                self._report(store)
            except KeyboardInterrupt:
                raise KeyboardInterrupt("what is done is kept, start again to continue") from None

    def _suite(self, name: str) -> Suite:
        """The suite with what the options change."""
        from caryatid.benchmark import suites
        from caryatid.benchmark.episodes import find_scenes

        suite = suites.change_suite(
            suites.SUITES[name],
            planners=self.planner,
            fusions=self.fusion,
            segmentations=self.segmentation,
            noises=self.noise,
            settings=self.set,
        )
        scenes = tuple(find_scenes(self.scenes)) if self.scenes else suite.scenes
        seeds, views = self.seeds or suite.seeds, self.views or suite.views
        return replace(suite, scenes=scenes, seeds=seeds, views=views)

    def _check(self, suite: Suite, path: Path) -> None:
        """Refuse an unknown reference, or a cluster that does not answer, before anything is written."""
        from caryatid.benchmark.report import check_reference
        from caryatid.benchmark.running import connect
        from caryatid.benchmark.store import ResultStore

        methods = {member.method: None for member in suite.members()}
        if path.is_file() and path.stat().st_size:
            with ResultStore(path) as store:
                methods |= {member.method: None for members in store.suites.values() for member in members}
        elif self.scheduler is not None:
            connect(self.scheduler).close()
        check_reference(self.reference, methods)

    def _run(self, suite: Suite, store: ResultStore) -> None:
        """Run the missing episodes with a progress bar; without a terminal, print a line every minute."""
        from rich.progress import MofNCompleteColumn, Progress

        from caryatid.benchmark.episodes import short_name
        from caryatid.benchmark.running import run_locally, run_on_cluster
        from caryatid.runtime.compiling import compile_kernels

        missing = store.plan(suite.name, suite.members(), retry=self.retry)
        if not missing:
            return
        if self.scheduler is not None:
            episodes = run_on_cluster(missing, self.scheduler, self.output.say)
        else:
            compile_kernels()
            episodes = run_locally(missing, self.jobs or os.cpu_count() or 1)
        total = len({member.episode for member in store.suites[suite.name]})
        console = self.output.progress
        hidden = console.quiet or not console.is_interactive
        columns = (*Progress.get_default_columns(), MofNCompleteColumn())
        bar = Progress(*columns, console=console, disable=hidden, speed_estimate_period=600.0)
        task = bar.add_task(suite.name, total=total, completed=total - len(missing))
        printed = time.monotonic()
        with bar, closing(episodes) as outcomes:
            for done, (episode, outcome) in enumerate(outcomes, start=total - len(missing) + 1):
                store.add(episode, outcome)
                bar.advance(task)
                if outcome.error is not None:
                    name = f"{short_name(episode.scene)}, {episode.planner}, seed {episode.seed}"
                    self.output.say(f"failed: {name}: {outcome.error}")
                if hidden and time.monotonic() - printed >= 60.0:
                    printed = time.monotonic()
                    self.output.say(f"{suite.name}: {done} of {total} episodes")

    def _report(self, store: ResultStore) -> None:
        """Write tables, figures and pages, and print what there is."""
        from caryatid.benchmark import report

        results = report.summarise_store(store, self.reference)
        for result in results:
            failed = f", {len(result.failures)} failed" if result.failures else ""
            self.output.say(f"{result.name}: {result.episodes} of {result.planned} episodes{failed}")
        for line in report.write_tables(store, self.out):
            self.output.say(line)
        if results:
            command = f"caryatid benchmark --out {self.out.name}"
            if self.reference is not None:
                command += f" --reference {shlex.quote(self.reference)}"
            report.write_results(results, store.about, self.out / "summary.json.gz")
            page = report.write_page(results, store.about, self.out, command)
            self.output.say(f"figures: {page}")
            if self.docs is not None:
                report.write_document(results, store.about, self.docs, f"{command} --docs {self.docs.name}")
        if self.output.json:
            suites = {
                result.name: {
                    "planned": result.planned,
                    "done": result.episodes,
                    "failed": len(result.failures),
                    "f1": result.f1(),
                }
                for result in results
            }
            self.output.result({"results": str(self.out), "suites": suites})
