"""What `caryatid explore`, `demo` and `dismantle` do: explore, and write a run folder."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from caryatid.cli.dismantle import Dismantle
from caryatid.cli.explore import Explore
from caryatid.cli.profile import print_profile, profile_record
from caryatid.cli.progress import Progress, summary
from caryatid.cli.records import kept, run_record, step_record
from caryatid.cli.report_texts import report_in_time
from caryatid.config import Config
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import Score, score
from caryatid.exploration import Step, explore
from caryatid.io.graph_json import graph_to_json
from caryatid.io.json_files import json_text
from caryatid.io.runs import RunWriter
from caryatid.runtime.compiling import compile_kernels
from caryatid.runtime.interrupts import (
    Interrupted,
    interrupted,
    interruptible,
    interrupts_held,
    note_interrupts,
)
from caryatid.sources import Source, open_source
from caryatid.steps import write_step
from caryatid.viz import Figure, ViewPage, draw_view

if TYPE_CHECKING:
    from caryatid.cli.watching import Watcher

Exploring = Explore | Dismantle
"""Options of the commands that explore."""


@dataclass(slots=True)
class Exploration:
    """What an exploration has come to.

    Attributes:
        source: What was explored.
        last: The newest step, or None before the first.
        pages: The views as the report shows them.
        steps: What run.json says of them.
        scores: Score after each view, where the truth is known.
        interrupted: Ctrl-C ended it.
        reported: It has a report.
    """

    source: Source
    last: Step | None = None
    pages: list[ViewPage] = field(default_factory=list)
    steps: list[dict[str, Any]] = field(default_factory=list)
    scores: list[Score] = field(default_factory=list)
    interrupted: bool = False
    reported: bool = False

    @property
    def end(self) -> Step:
        """The newest step."""
        if self.last is None:
            raise RuntimeError("an exploration that ends has taken a view")
        return self.last


@interruptible()
def run_exploration(options: Explore, config: Config) -> int:
    """Explore and write the run folder; Ctrl-C ends it with the views done so far."""
    progress = Progress(options.general.quiet or options.general.json)
    with _watched(options, config, progress) as watcher:
        _explore_into(options, config, progress, watcher)
    return 0


def _explore_into(options: Explore, config: Config, progress: Progress, watcher: Watcher | None) -> None:
    with RunWriter(options.out) as writer:
        done = look_around(options, config, progress, writer, report=not options.no_report, watcher=watcher)
        finish_run("explore", options, config, done, writer, report=not options.no_report)
    if done.interrupted:
        raise Interrupted(kept(len(done.steps), options.out, reported=done.reported))
    if options.general.json:
        document = {"run": str(options.out), "graph": graph_to_json(done.end.graph)}
        sys.stdout.write(json_text(document | (profile_record(done.steps) if options.profile else {})))
    count = "1 view" if len(done.steps) == 1 else f"{len(done.steps)} views"
    progress.say(f"{done.source.name}: {summary(done.end.graph)} after {count}")
    progress.say(f"run: {options.out}" + ("" if options.no_report else ", open its report.html"))
    if options.profile and not options.general.json:
        print_profile(done.steps)


def _watched(options: Explore, config: Config, progress: Progress) -> AbstractContextManager[Watcher | None]:
    if not options.view:
        return nullcontext()
    from caryatid.cli.viewing import wait_for_interrupt
    from caryatid.cli.watching import watched

    return watched(options.source, config, progress, wait_for_interrupt)


def look_around(
    options: Exploring,
    config: Config,
    progress: Progress,
    writer: RunWriter | None,
    *,
    report: bool,
    watcher: Watcher | None = None,
) -> Exploration:
    """Explore; every view is drawn and written as soon as it is there.

    Args:
        options: What to explore, and how.
        config: All settings.
        progress: Told of each view.
        writer: Takes the views, or None where no run is wanted.
        report: Draw the views.
        watcher: Shows the views, or None.

    Raises:
        KeyboardInterrupt: Before the first view; later an interrupt ends the exploration, and after it
            interrupts are only noted.
    """
    seed = options.modelling.seed
    with progress.working("opening"):
        source = open_source(
            options.source,
            config,
            noise=options.noise,
            segmentation=options.segmentation,
            seed=seed,
            robot=options.robot,
        )
    with progress.working("compiling"):
        compile_kernels(progress.say)
    planner, camera = planner_for(
        options.planner, source.camera, source.truth, config, segmentation=options.segmentation, seed=seed
    )
    done = Exploration(source)
    try:
        for step in explore(
            camera,
            source.robot,
            planner=planner,
            config=config,
            segmentation=options.segmentation,
            seed=seed,
            early_stop=not options.no_early_stop,
        ):
            scored = _scored(step, source)
            if watcher is not None:
                watcher.show(step, source, scored[-1].f1 if scored else None)
            page = [draw_view(step, config.report)] if report else []
            with interrupts_held():
                if writer is not None:
                    write_step(writer, step)
                before, done.last = done.last, step
                done.steps.append(step_record(step))
                done.pages += page
                done.scores += scored
            progress.step(step, None if before is None else before.graph, done.scores)
        note_interrupts()
    except KeyboardInterrupt:
        if done.last is None:
            raise
        note_interrupts()
        done.interrupted = True
    return done


def finish_run(
    command: str,
    options: Exploring,
    config: Config,
    done: Exploration,
    writer: RunWriter,
    *,
    report: bool,
    more: dict[str, Any] | None = None,
    strip: tuple[Figure, ...] = (),
) -> None:
    """Write what a run folder holds beside its views, and put it in its place.

    Args:
        command: Which command made the run.
        options: What was explored, and how.
        config: All settings.
        done: The exploration.
        writer: Has taken its views.
        report: Write report.html, and report.json.
        more: What else run.json is to hold.
        strip: Pictures for the end of the report.
    """
    told = {
        "planner": options.planner,
        "robot": options.robot,
        "segmentation": options.segmentation,
        "noise": options.noise,
        "early_stop": not options.no_early_stop,
    }
    seed = options.modelling.seed
    html = stored = None
    if report:
        settings = {"source": options.source, "seed": seed} | told
        settings |= {"fusion": config.fusion.method, "views": config.active.max_views}
        html, stored = report_in_time(
            done.pages, done.source.name, settings, scores=done.scores or None, strip=strip
        )
    done.reported = html is not None
    done.interrupted |= interrupted()
    record = run_record(command, options.source, seed, told, config, done.steps, done.scores)
    if done.interrupted:
        record["interrupted"] = True
    try:
        with interrupts_held():
            writer.finish(done.end.graph, record | (more or {}), html, stored)
    except KeyboardInterrupt:
        done.interrupted = True


def _scored(step: Step, source: Source) -> list[Score]:
    if source.truth is None:
        return []
    return [score(step.graph, source.truth, np.random.default_rng(0))]
