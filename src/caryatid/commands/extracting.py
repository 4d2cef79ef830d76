"""What `caryatid extract` does: a scene model from all views, written to a run folder."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from caryatid import frames
from caryatid.commands.extract import Extract
from caryatid.commands.profile import print_profile, profile_record
from caryatid.commands.progress import Progress, summary
from caryatid.commands.records import run_record
from caryatid.commands.sources import CLOUD_SUFFIXES, check_segments, open_recording
from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.formats.graph_json import graph_to_json
from caryatid.formats.json_files import json_text
from caryatid.formats.point_clouds import read_stored_cloud
from caryatid.formats.runs import RunWriter
from caryatid.frames import Array
from caryatid.kernels.compiling import compile_kernels
from caryatid.perception import level_cloud
from caryatid.report import ViewPage, compose_report, draw_model, render_html, store_report
from caryatid.scene import Scene


def run_extraction(options: Extract, config: Config) -> int:
    """Extract the model and write the run folder."""
    seed = options.modelling.seed
    progress = Progress(options.general.quiet or options.general.json)
    name = Path(options.source).name
    with RunWriter(options.out) as writer:
        if Path(options.source).suffix.lower() in CLOUD_SUFFIXES:
            scene, steps, pages = _extract_cloud(options, config, writer, progress)
        else:
            scene, steps, pages = _extract_recording(options, config, writer, progress)
        told = {"segmentation": options.segmentation, "label_divisor": options.label_divisor}
        html = stored = None
        if not options.no_report:
            settings = {"source": options.source, "seed": seed} | told | {"fusion": config.fusion.method}
            said = compose_report(pages, title=f"caryatid: {name}", settings=settings)
            html, stored = render_html(said), store_report(said)
        record = run_record("extract", options.source, seed, told, config, steps, [])
        writer.finish(scene.graph, record, html, stored)
    if options.general.json:
        document = {"run": str(options.out), "graph": graph_to_json(scene.graph)}
        sys.stdout.write(json_text(document | (profile_record(steps) if options.profile else {})))
    progress.say(f"{name}: {summary(scene.graph)}")
    progress.say(f"run: {options.out}" + ("" if options.no_report else ", open its report.html"))
    if options.profile and not options.general.json:
        print_profile(steps)
    return 0


def _extract_cloud(
    options: Extract, config: Config, writer: RunWriter, progress: Progress
) -> tuple[Scene, list[dict[str, Any]], list[ViewPage]]:
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
    return scene, [step], pages


def _extract_recording(
    options: Extract, config: Config, writer: RunWriter, progress: Progress
) -> tuple[Scene, list[dict[str, Any]], list[ViewPage]]:
    with progress.working("reading the recording"):
        recording = open_recording(options.source, config, options.segmentation)
    scene = _new_scene(options, config, progress)
    steps: list[dict[str, Any]] = []
    pages: list[ViewPage] = []
    angle, path = 0.0, 0.0
    T_world_before: Array | None = None
    for index, frame in enumerate(recording.frames):
        view = frame.load()
        graph = scene.update(view)
        labels, T_world_camera, sphere = scene.labels, scene.T_world_camera, scene.sphere
        if labels is None or T_world_camera is None or sphere is None:
            raise RuntimeError("a scene updated with a view has labels, a pose and a sphere")
        if T_world_before is not None:
            directions = sphere.direction_of(np.stack([T_world_before, T_world_camera]))
            angle += float(frames.angle_between(*directions))
            path += float(np.linalg.norm(T_world_camera[:3, 3] - T_world_before[:3, 3]))
        T_world_before = T_world_camera
        writer.add_view(graph, labels, name=view.name, T_world_camera=T_world_camera, K=view.K)
        steps.append(
            {"view": index, "timings": scene.timings, "angle_travelled": angle, "path_travelled": path}
        )
        progress.say(f"view {index:02d}: {summary(graph)}")
        if not options.no_report:
            posed = view.with_pose(T_world_camera)
            page = draw_model(graph, scene.cloud, view=posed, labels=labels, config=config.report)
            page = replace(page, index=index, timings=scene.timings)
            pages.append(replace(page, angle_travelled=angle, path_travelled=path))
    return scene, steps, pages


def _new_scene(options: Extract, config: Config, progress: Progress) -> Scene:
    with progress.working("compiling"):
        compile_kernels(progress.say)
    return Scene(config, segmentation=options.segmentation, seed=options.modelling.seed)
