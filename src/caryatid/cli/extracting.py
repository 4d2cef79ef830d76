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
from caryatid.cli.records import kept, run_record
from caryatid.cli.report_texts import report_in_time
from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.geometry import transforms
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
from caryatid.scene import Scene
from caryatid.segmentation.perception import level_cloud
from caryatid.sensing.views import View
from caryatid.sources import CLOUD_SUFFIXES, check_segments, open_recording
from caryatid.viz import ViewPage, draw_model


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
    scene = _new_scene(options, config, progress)
    with progress.working("extracting"):
        rng = np.random.default_rng(options.modelling.seed)
        cloud = stored.to_cloud(config.cloud)
        cloud = level_cloud(cloud, config, segmentation=options.segmentation, rng=rng)
        graph = scene.update(cloud)
    if scene.labels is None:
        raise RuntimeError("an updated scene has labels")
    writer.add_view(graph, stored.spread(scene.labels), name=stored.name)
    step = {"view": 0, "timings": scene.timings, "angle_travelled": 0.0, "path_travelled": 0.0}
    pages = [] if options.no_report else [draw_model(graph, scene.cloud, config=config.report)]
    return Extraction(graph, [step], pages)


def _extract_recording(options: Extract, config: Config, writer: RunWriter, progress: Progress) -> Extraction:
    with progress.working("reading the recording"):
        recording = open_recording(options.source, config, options.segmentation)
    scene = _new_scene(options, config, progress)
    done = Extraction()
    try:
        for frame in recording.frames:
            _take_in(frame.load(), scene, done, options, config, writer)
            progress.say(f"view {len(done.steps) - 1:02d}: {summary(done.graph)}")
        note_interrupts()
    except KeyboardInterrupt:
        if not done.steps:
            raise
        note_interrupts()
        done.interrupted = True
    return done


def _take_in(
    view: View, scene: Scene, done: Extraction, options: Extract, config: Config, writer: RunWriter
) -> None:
    """Update the scene with a view, and write what came of it."""
    T_world_before = scene.T_world_camera
    graph = scene.update(view)
    labels, T_world_camera, sphere = scene.labels, scene.T_world_camera, scene.sphere
    if labels is None or T_world_camera is None or sphere is None:
        raise RuntimeError("a scene updated with a view has labels, a pose and a sphere")
    angle, path = 0.0, 0.0
    if T_world_before is not None:
        before = done.steps[-1]
        directions = sphere.direction_of(np.stack([T_world_before, T_world_camera]))
        angle = before["angle_travelled"] + float(transforms.angle_between(*directions))
        path = float(np.linalg.norm(T_world_camera[:3, 3] - T_world_before[:3, 3]))
        path += before["path_travelled"]
    step = {"view": len(done.steps), "timings": scene.timings}
    step |= {"angle_travelled": angle, "path_travelled": path}
    pages = []
    if not options.no_report:
        posed = view.with_pose(T_world_camera)
        page = draw_model(graph, scene.cloud, view=posed, labels=labels, config=config.report)
        page = replace(page, index=len(done.steps), timings=scene.timings)
        pages.append(replace(page, angle_travelled=angle, path_travelled=path))
    with interrupts_held():
        writer.add_view(graph, labels, name=view.name, T_world_camera=T_world_camera, K=view.K)
        done.graph = graph
        done.steps.append(step)
        done.pages += pages


def _new_scene(options: Extract, config: Config, progress: Progress) -> Scene:
    with progress.working("compiling"):
        compile_kernels(progress.say)
    return Scene(config, segmentation=options.segmentation, seed=options.modelling.seed)
