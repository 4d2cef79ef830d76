"""What `caryatid extract` does: a scene model from all views, written to a run folder."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from caryatid.cli.extract import Extract
from caryatid.cli.profile import print_profile, profile_record
from caryatid.cli.progress import Progress, summary
from caryatid.cli.records import kept, run_record, step_record
from caryatid.cli.report_texts import report_in_time
from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.exploration import Explorer, Step
from caryatid.graph import SupportGraph
from caryatid.io.graph_json import graph_to_json
from caryatid.io.json_files import json_text
from caryatid.io.point_clouds import read_stored_cloud
from caryatid.io.runs import RunWriter
from caryatid.runtime.compiling import compile_kernels
from caryatid.runtime.interrupts import (
    Interrupted,
    interrupted,
    interruptible,
    interrupts_held,
    note_interrupts,
)
from caryatid.segmentation.perception import level_cloud
from caryatid.sources import CLOUD_SUFFIXES, check_segments, open_recording
from caryatid.steps import write_step
from caryatid.viz import ViewPage, draw_view


@dataclass(slots=True)
class Extraction:
    """What an extraction has come to.

    Attributes:
        graph: The graph after the newest view.
        steps: What run.json says of the views.
        pages: The views as the report shows them.
        interrupted: Ctrl-C ended it.
    """

    graph: SupportGraph = field(default_factory=SupportGraph)
    steps: list[dict[str, Any]] = field(default_factory=list)
    pages: list[ViewPage] = field(default_factory=list)
    interrupted: bool = False


@interruptible()
def run_extraction(options: Extract, config: Config) -> int:
    """Extract the model and write the run folder; Ctrl-C ends it with the views done so far."""
    seed = options.modelling.seed
    progress = Progress(options.general.quiet or options.general.json)
    name = Path(options.source).name
    with RunWriter(options.out) as writer:
        if Path(options.source).suffix.lower() in CLOUD_SUFFIXES:
            done = _extract_cloud(options, config, writer, progress)
        else:
            done = _extract_recording(options, config, writer, progress)
        told = {"segmentation": options.segmentation, "label_divisor": options.label_divisor}
        html = stored = None
        if not options.no_report:
            settings = {"source": options.source, "seed": seed} | told | {"fusion": config.fusion.method}
            html, stored = report_in_time(done.pages, name, settings)
        done.interrupted |= interrupted()
        record = run_record("extract", options.source, seed, told, config, done.steps, [])
        if done.interrupted:
            record["interrupted"] = True
        try:
            with interrupts_held():
                writer.finish(done.graph, record, html, stored)
        except KeyboardInterrupt:
            done.interrupted = True
    if done.interrupted:
        raise Interrupted(kept(len(done.steps), options.out, reported=html is not None))
    if options.general.json:
        document = {"run": str(options.out), "graph": graph_to_json(done.graph)}
        sys.stdout.write(json_text(document | (profile_record(done.steps) if options.profile else {})))
    progress.say(f"{name}: {summary(done.graph)}")
    progress.say(f"run: {options.out}" + ("" if options.no_report else ", open its report.html"))
    if options.profile and not options.general.json:
        print_profile(done.steps)
    return 0


def _extract_cloud(options: Extract, config: Config, writer: RunWriter, progress: Progress) -> Extraction:
    with progress.working("reading the cloud"):
        stored = read_stored_cloud(options.source, options.label_divisor)
        if options.segmentation == "labels" and stored.labels is None:
            raise InputError(options.source, "has no field label", "use --segmentation auto")
        if options.segmentation != "auto" and stored.labels is not None:
            check_segments(options.source, Counter(stored.labels[stored.kept].tolist()), config)
    explorer = _explorer(options, config, progress)
    done = Extraction()
    with progress.working("extracting"):
        rng = np.random.default_rng(options.modelling.seed)
        cloud = stored.to_cloud(config.cloud)
        step = explorer.look(level_cloud(cloud, config, segmentation=options.segmentation, rng=rng))
        _keep(replace(step, labels=stored.spread(step.labels)), done, options, config, writer)
    return done


def _extract_recording(options: Extract, config: Config, writer: RunWriter, progress: Progress) -> Extraction:
    with progress.working("reading the recording"):
        recording = open_recording(options.source, config, options.segmentation)
    explorer = _explorer(options, config, progress)
    done = Extraction()
    try:
        for frame in recording.frames:
            _keep(explorer.look(frame.load()), done, options, config, writer)
            progress.say(f"view {len(done.steps) - 1:02d}: {summary(done.graph)}")
        note_interrupts()
    except KeyboardInterrupt:
        if not done.steps:
            raise
        note_interrupts()
        done.interrupted = True
    return done


def _keep(step: Step, done: Extraction, options: Extract, config: Config, writer: RunWriter) -> None:
    pages = [] if options.no_report else [draw_view(step, config.report)]
    with interrupts_held():
        write_step(writer, step)
        done.graph = step.graph
        done.steps.append(step_record(step))
        done.pages += pages


def _explorer(options: Extract, config: Config, progress: Progress) -> Explorer:
    with progress.working("compiling"):
        compile_kernels(progress.say)
    return Explorer(config=config, segmentation=options.segmentation, seed=options.modelling.seed)
