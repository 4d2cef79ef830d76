"""`caryatid explore`: the active vision loop on a scene or a recording, written to a run folder."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import tyro

from caryatid.commands.names import PlannerName
from caryatid.commands.options import SAID, ModellingCommand, OutPath, Views, defaults_to, with_views
from caryatid.commands.progress import Progress, summary
from caryatid.commands.records import run_record, step_record, view_record
from caryatid.commands.sources import Source, open_source
from caryatid.config import Config, NoiseModel, SegmentationMethod
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import Score, score
from caryatid.exploration import Step, explore
from caryatid.formats.graph_json import graph_to_json
from caryatid.formats.json_files import json_text
from caryatid.formats.runs import RunWriter
from caryatid.report import ViewPage, draw_view, render_report


@dataclass(frozen=True, kw_only=True)
class Explore(ModellingCommand):
    """Look around a scene until it is known what holds up what.

    SOURCE is one of
      an MJCF scene: an .xml file, or the folder of a scene.xml; robot and camera are simulated
      the name of a built-in scene: tower, clutter, pile-8-0, dense-12-0, …
      a recording: a folder in the BOP format; the camera can only be where a recorded view is

    To try:
      caryatid explore tower --noise carmine --out run
      caryatid explore scene.xml --views 5 --out run
      caryatid explore recording/ --segmentation auto --out run
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Scene or recording."""
    out: OutPath
    """Run folder to write; a run already there is replaced."""
    views: Annotated[Views, defaults_to(10)] = None
    """Views at the most, the first one too."""
    planner: PlannerName = "support"
    """Who chooses the next view; oracle, which knows the truth, in simulation only."""
    segmentation: Annotated[
        SegmentationMethod | None, tyro.conf.DisallowNone, defaults_to("labels where the source has them")
    ] = None
    """Where parts come from: the masks that are given, or automatic."""
    noise: NoiseModel = "none"
    """Noise of the simulated camera: depth noise and registration error of a Carmine, or none."""
    no_early_stop: Annotated[bool, SAID] = False
    """Go on until the views are used up; without this the loop ends when a view changes nothing."""
    no_report: Annotated[bool, SAID] = False
    """Leave report.html out."""

    def __call__(self) -> int:
        """Run the command."""
        return run_exploration(self, with_views(self.modelling.settings(), self.views))


def run_exploration(options: Explore, config: Config) -> int:
    """Explore and write the run folder; Ctrl-C ends it with the views done so far."""
    progress = Progress(options.general.quiet or options.general.json)
    seed = options.modelling.seed
    with RunWriter(options.out) as writer:
        with progress.working("opening"):
            source = open_source(
                options.source, config, noise=options.noise, segmentation=options.segmentation, seed=seed
            )
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
        sys.stdout.write(json_text({"run": str(options.out), "graph": graph_to_json(last.graph)}))
    count = "1 view" if len(steps) == 1 else f"{len(steps)} views"
    progress.say(f"{source.name}: {summary(last.graph)} after {count}")
    progress.say(f"run: {options.out}" + ("" if options.no_report else ", open its report.html"))
    return 0


def _scored(step: Step, source: Source) -> list[Score]:
    if source.truth is None:
        return []
    return [score(step.graph, source.truth, np.random.default_rng(0))]
