"""`caryatid explore`: the active vision loop on a scene or a recording, written to a run folder."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from caryatid.commands.options import Modelling
from caryatid.commands.progress import Progress, summary
from caryatid.commands.records import run_record, step_record, view_record
from caryatid.commands.sources import Source, open_source
from caryatid.config import Config, NoiseModel, SegmentationMethod
from caryatid.evaluation.scores import Score, score
from caryatid.exploration import Step, explore
from caryatid.formats.graph_json import graph_to_json
from caryatid.formats.json_files import json_text
from caryatid.formats.runs import RunWriter
from caryatid.planners import make_planner
from caryatid.report import ViewPage, draw_view, render_report


@dataclass(frozen=True, kw_only=True)
class Explore(Modelling):
    """Look around a scene until it is known what holds up what.

    SOURCE is an MJCF scene (.xml: simulated robot and camera), the name of a built-in scene, or a recording
    (folder in the BOP format: the camera can only be where a recorded view is).

    Examples: `caryatid explore scene.xml --out run`, `caryatid explore tower --noise carmine --out run`.
    """

    source: Annotated[str, tyro.conf.Positional]
    """What to explore."""
    out: Path
    """Run folder to write; a run already there is replaced."""
    views: int | None = None
    """Views at the most, the first one too. [default: 10]"""
    planner: str = "support"
    """Who chooses the next view: support, paper or random."""
    segmentation: SegmentationMethod | None = None
    """Where parts come from: given labels, or automatic. [default: labels where the source has them]"""
    noise: NoiseModel = "none"
    """Noise of the simulated camera: depth noise and registration error of a Carmine, or none."""
    early_stop: bool = True
    """Look on until the views are used up, also when one changed nothing."""
    report: bool = True
    """Write no report.html."""

    def __call__(self) -> int:
        """Run the command."""
        config = self.settings()
        if self.views is not None:
            config = replace(config, active=replace(config.active, max_views=self.views))
        return run_exploration(self, config)


def run_exploration(options: Explore, config: Config) -> int:
    """Explore and write the run folder; Ctrl-C ends it with the views done so far."""
    progress = Progress(options.quiet or options.json)
    make_planner(options.planner)
    with RunWriter(options.out) as writer:
        with progress.working("opening"):
            source = open_source(options.source, config, noise=options.noise, seed=options.seed)
        pages: list[ViewPage] = []
        steps: list[dict[str, Any]] = []
        scores: list[Score] = []
        last: Step | None = None
        try:
            for step in explore(
                source.camera,
                source.robot,
                planner=options.planner,
                config=config,
                segmentation=options.segmentation,
                seed=options.seed,
                early_stop=options.early_stop,
            ):
                last = step
                scores += _scored(step, source)
                writer.add_view(
                    step.graph,
                    step.labels,
                    name=step.view.name,
                    T_world_camera=step.view.T_world_camera,
                    K=step.view.K,
                    record=view_record(step),
                )
                steps.append(step_record(step))
                if options.report:
                    pages.append(draw_view(step, config.report))
                progress.step(step, scores[-1].f1 if scores else None)
        except KeyboardInterrupt:
            progress.say("interrupted: keeping the views done so far")
            if last is None:
                raise
        assert last is not None
        told = {
            "source": options.source,
            "planner": options.planner,
            "segmentation": options.segmentation,
            "noise": options.noise,
            "seed": options.seed,
            "early_stop": options.early_stop,
        }
        report = None
        if options.report:
            count = len(pages)
            report = render_report(
                pages,
                title=f"caryatid: {source.name}",
                settings=told | {"fusion": config.fusion.method, "views": config.active.max_views},
                scores=scores[:count] if len(scores) >= count > 0 and scores else None,
            )
        writer.finish(last.graph, run_record(config, told, steps, scores), report)
    if options.json:
        sys.stdout.write(json_text({"run": str(options.out), "graph": graph_to_json(last.graph)}) + "\n")
    progress.say(f"{source.name}: {summary(last.graph)} after {len(steps)} views")
    if options.report:
        progress.say(f"report: {options.out / 'report.html'}")
    return 0


def _scored(step: Step, source: Source) -> list[Score]:
    if source.truth is None:
        return []
    return [score(step.graph, source.truth, np.random.default_rng(0))]
