"""`caryatid benchmark`: compare methods over scenes, sensors and seeds."""

from __future__ import annotations

import os
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from caryatid.cli import options
from caryatid.config.choices import FusionMethod, NoiseModel, Preset, SegmentationMethod
from caryatid.errors import InputError, needs_extra

if TYPE_CHECKING:
    from caryatid.benchmark.episodes import Episode
    from caryatid.benchmark.store import ResultStore

SUITES = (
    "smoke", "fig5", "fig5-paper", "presets", "planners", "path", "ablation", "ablation-attention", "poses",
    "noise", "house", "easy", "heaps", "dismantle", "full",
)  # fmt: skip
"""Names of the suites; the benchmark is imported later."""


@dataclass(frozen=True, kw_only=True)
class Benchmark(options.Command):
    """Compare methods over scenes and seeds, and draw figures.

    Finished episodes are kept: stop at any time, and run the same command to continue. Without --suite,
    redraw the figures of the results in the folder.

    Usage examples:
      caryatid benchmark --suite smoke --out bench
      caryatid benchmark --suite planners --planner support --planner random --out bench
      caryatid benchmark --suite fig5 --scenes my-scenes/ --seeds 1 --out bench
      caryatid benchmark --suite planners --segmentation auto --noise none --out bench
    """

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder of the results; existing results are reused."""
    suite: Annotated[str | None, options.one_of(SUITES), options.shown()] = None
    """Suite of methods, scenes and conditions to run."""
    scenes: Annotated[options.Words, options.shown("SCENE")] = ()
    """Replace the suite's scenes: a built-in name, a scene folder, or a folder of those; may be repeated."""
    planner: options.Several[Annotated[str, options.planner_name()]] = ()
    """Replace the suite's planners; may be repeated. The first is the reference for the others."""
    fusion: options.Several[FusionMethod] = ()
    """Replace the suite's fusion; may be repeated."""
    segmentation: options.Several[SegmentationMethod] = ()
    """Replace the suite's segmentation; may be repeated. Default: labels."""
    noise: options.Several[NoiseModel] = ()
    """Replace the suite's camera noise; may be repeated. Default: carmine."""
    preset: Annotated[Preset | None, options.one_of(Preset), options.shown(default="the suite's")] = None
    """Settings to start from in all episodes: caryatid's defaults, or those of the paper."""
    set: Annotated[options.Words, options.shown("STAGE.NAME=VALUE")] = ()
    """Change one setting of all episodes, such as `--set noise.translation=0.02`; may be repeated."""
    seeds: Annotated[options.OptionalCount, options.shown(default="the suite's")] = None
    """Number of seeds; every episode runs with seeds 0 to N−1."""
    views: Annotated[options.OptionalCount, options.shown(default="the suite's")] = None
    """Number of views of every episode, including the first."""
    jobs: Annotated[options.OptionalCount, options.shown(default="all cores")] = None
    """Number of processes."""
    scheduler: Annotated[str | None, options.shown("ADDRESS")] = None
    """Run on the workers of this dask.distributed scheduler, such as tcp://10.0.0.5:8786."""
    retry: options.Flag = False
    """Run failed episodes again."""
    reference: Annotated[str | None, options.shown("METHOD")] = None
    """Reference method in the figures, instead of the suite's."""
    docs: Annotated[Path | None, options.shown("FILE.md")] = None
    """Also write the results as a Markdown document."""

    def __call__(self) -> None:
        from caryatid.benchmark.report import check_reference
        from caryatid.benchmark.store import RESULTS, ResultStore, collect_provenance, import_pandas
        from caryatid.benchmark.suites import SUITES, change_suite
        from caryatid.cli.output import kept
        from caryatid.runtime import fingerprint

        import_pandas()
        if self.scheduler is not None:
            with needs_extra("cluster", "--scheduler"):  # before anything is written
                import distributed  # noqa: F401
            if self.jobs is not None:
                reason = "cannot be combined with --scheduler, which has its own workers"
                raise InputError("--jobs", reason, "omit one of the two options")
        suite = (
            None
            if self.suite is None
            else change_suite(
                SUITES[self.suite],
                planners=self.planner,
                fusions=self.fusion,
                segmentations=self.segmentation,
                noises=self.noise,
                preset=self.preset,
                settings=self.set,
                scenes=self.scenes,
                seeds=self.seeds,
                views=self.views,
            )
        )
        code = fingerprint() if suite else None
        about = collect_provenance()
        with (
            kept("finished episodes are kept; run the same command to continue"),
            ResultStore(self.out / RESULTS, code, about) as store,
        ):
            missing = store.plan(self.suite or "", suite.members(), retry=self.retry) if suite else []
            check_reference(self.reference, store)
            if self.suite and missing:
                self._run(self.suite, missing, store)
            self._report(store)

    def _run(self, suite: str, missing: list[Episode], store: ResultStore) -> None:
        """Run the missing episodes with a progress bar; without a terminal, print a line every minute."""
        from rich.progress import MofNCompleteColumn, Progress

        from caryatid.benchmark.episodes import short_name
        from caryatid.benchmark.running import run_locally, run_on_cluster

        if self.scheduler is not None:
            episodes = run_on_cluster(missing, self.scheduler, self.output.say)
        else:
            episodes = run_locally(missing, self.jobs or os.cpu_count() or 1)
        total = len({member.episode for member in store.suites[suite]})
        console = self.output.progress
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
                    self.output.say(f"failed: {name}: {outcome.error}")
                if hidden and time.monotonic() - printed >= 60.0:
                    printed = time.monotonic()
                    self.output.say(f"{suite}: {done} of {total} episodes")

    def _report(self, store: ResultStore) -> None:
        """Write tables, figures and pages, and print the summary."""
        from caryatid.benchmark.report import write_report

        results = write_report(store, self.out, reference=self.reference, document=self.docs)
        for result in results:
            failed = f", {len(result.failures)} failed" if result.failures else ""
            self.output.say(f"{result.name}: {result.episodes} of {result.planned} episodes{failed}")
        if results:
            self.output.say(f"figures: {self.out / 'index.html'}")
        suites = {
            each.name: {
                "planned": each.planned,
                "done": each.episodes,
                "failed": len(each.failures),
                "f1": each.f1(),
            }
            for each in results
        }
        self.output.result({"results": str(self.out), "suites": suites}, "")
