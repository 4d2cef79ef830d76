"""What `caryatid explore` and `caryatid demo` do: explore, and write a run folder."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from caryatid.commands.explore import Explore
from caryatid.commands.profile import print_profile, profile_record
from caryatid.commands.progress import Progress, summary
from caryatid.commands.records import run_record, step_record, view_record
from caryatid.commands.sources import Source, open_source
from caryatid.config import Config
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import Score, score
from caryatid.exploration import Step, explore
from caryatid.formats.graph_json import graph_to_json
from caryatid.formats.json_files import json_text
from caryatid.formats.runs import RunWriter
from caryatid.kernels.compiling import compile_kernels
from caryatid.report import ViewPage, draw_view, render_report


def run_exploration(options: Explore, config: Config) -> int:
    """Explore and write the run folder; Ctrl-C ends it with the views done so far."""
    progress = Progress(options.general.quiet or options.general.json)
    seed = options.modelling.seed
    with RunWriter(options.out) as writer:
        with progress.working("opening"):
            source = open_source(
                options.source, config, noise=options.noise, segmentation=options.segmentation, seed=seed
            )
        with progress.working("compiling"):
            compile_kernels(progress.say)
        planner, camera = planner_for(
            options.planner, source.camera, source.truth, config, segmentation=options.segmentation, seed=seed
        )
        pages: list[ViewPage] = []
        steps: list[dict[str, Any]] = []
        scores: list[Score] = []
        last: Step | None = None
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
                page = [] if options.no_report else [draw_view(step, config.report)]
                writer.add_view(
                    step.graph,
                    step.labels,
                    name=step.view.name,
                    T_world_camera=step.view.T_world_camera,
                    K=step.view.K,
                    record=view_record(step),
                )
                before, last = last, step
                steps.append(step_record(step))
                pages += page
                scores += scored
                progress.step(step, None if before is None else before.graph, scores)
        except KeyboardInterrupt:
            if last is None:
                raise
            progress.say("interrupted: keeping the views done so far")
        if last is None:
            raise RuntimeError("an exploration that ends has taken a view")
        told = {
            "planner": options.planner,
            "segmentation": options.segmentation,
            "noise": options.noise,
            "early_stop": not options.no_early_stop,
        }
        report = None
        if not options.no_report:
            report = render_report(
                pages,
                title=f"caryatid: {source.name}",
                settings={"source": options.source, "seed": seed}
                | told
                | {"fusion": config.fusion.method, "views": config.active.max_views},
                scores=scores or None,
            )
        record = run_record("explore", options.source, seed, told, config, steps, scores)
        writer.finish(last.graph, record, report)
    if options.general.json:
        document = {"run": str(options.out), "graph": graph_to_json(last.graph)}
        sys.stdout.write(json_text(document | (profile_record(steps) if options.profile else {})))
    count = "1 view" if len(steps) == 1 else f"{len(steps)} views"
    progress.say(f"{source.name}: {summary(last.graph)} after {count}")
    progress.say(f"run: {options.out}" + ("" if options.no_report else ", open its report.html"))
    if options.profile and not options.general.json:
        print_profile(steps)
    return 0


def _scored(step: Step, source: Source) -> list[Score]:
    if source.truth is None:
        return []
    return [score(step.graph, source.truth, np.random.default_rng(0))]
