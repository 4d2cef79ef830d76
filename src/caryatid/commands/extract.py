"""`caryatid extract`: the scene model from all views of a recording, or from one cloud; no planning."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from caryatid import frames
from caryatid.commands.options import SAID, ModellingCommand, OutPath, defaults_to, whole_number
from caryatid.commands.progress import Progress, summary
from caryatid.commands.records import run_record
from caryatid.commands.sources import CLOUD_SUFFIXES, check_segments, open_recording
from caryatid.config import Config, SegmentationMethod
from caryatid.errors import InputError
from caryatid.formats.graph_json import graph_to_json
from caryatid.formats.json_files import json_text
from caryatid.formats.point_clouds import read_stored_cloud
from caryatid.formats.runs import RunWriter
from caryatid.frames import Array
from caryatid.perception import level_cloud
from caryatid.report import ViewPage, draw_model, render_report
from caryatid.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Extract(ModellingCommand):
    """Extract shapes and support graph from all views of a recording, or from one cloud.

    To try:
      caryatid extract recording/ --out run
      caryatid extract table.pcd --segmentation auto --out run
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Recording (folder in the BOP format) or cloud (.pcd, .ply)."""
    out: OutPath
    """Run folder to write; a run already there is replaced."""
    segmentation: Annotated[
        SegmentationMethod | None, tyro.conf.DisallowNone, defaults_to("labels where the source has them")
    ] = None
    """Where parts come from: the masks or labels that are given, or automatic."""
    label_divisor: Annotated[int, whole_number(1)] = 1
    """For clouds whose labels number parts: object = label // N."""
    no_report: Annotated[bool, SAID] = False
    """Leave report.html out."""

    def __call__(self) -> int:
        """Run the command."""
        config = self.modelling.settings()
        seed = self.modelling.seed
        progress = Progress(self.general.quiet or self.general.json)
        scene = Scene(config, segmentation=self.segmentation, seed=seed)
        name = Path(self.source).name
        with RunWriter(self.out) as writer:
            if Path(self.source).suffix.lower() in CLOUD_SUFFIXES:
                steps, pages = self._extract_cloud(scene, writer, config, progress)
            else:
                steps, pages = self._extract_recording(scene, writer, config, progress)
            told = {"segmentation": self.segmentation, "label_divisor": self.label_divisor}
            report = None
            if not self.no_report:
                settings = {"source": self.source, "seed": seed} | told | {"fusion": config.fusion.method}
                report = render_report(pages, title=f"caryatid: {name}", settings=settings)
            record = run_record("extract", self.source, seed, told, config, steps, [])
            writer.finish(scene.graph, record, report)
        if self.general.json:
            sys.stdout.write(json_text({"run": str(self.out), "graph": graph_to_json(scene.graph)}))
        progress.say(f"{name}: {summary(scene.graph)}")
        progress.say(f"run: {self.out}" + ("" if self.no_report else ", open its report.html"))
        return 0

    def _extract_cloud(
        self, scene: Scene, writer: RunWriter, config: Config, progress: Progress
    ) -> tuple[list[dict[str, Any]], list[ViewPage]]:
        with progress.working("reading the cloud"):
            stored = read_stored_cloud(self.source, self.label_divisor)
            if self.segmentation == "labels" and stored.labels is None:
                raise InputError(self.source, "has no field label", "use --segmentation auto")
            if self.segmentation != "auto" and stored.labels is not None:
                check_segments(self.source, Counter(stored.labels[stored.kept].tolist()), config)
            rng = np.random.default_rng(self.modelling.seed)
            cloud = stored.to_cloud(config.cloud)
            cloud = level_cloud(cloud, config, segmentation=self.segmentation, rng=rng)
        with progress.working("extracting"):
            graph = scene.update(cloud)
        if scene.labels is None:
            raise RuntimeError("an updated scene has labels")
        writer.add_view(graph, stored.spread(scene.labels), name=stored.name)
        step = {"view": 0, "timings": scene.timings, "angle_travelled": 0.0, "path_travelled": 0.0}
        return [step], [] if self.no_report else [draw_model(graph, scene.cloud, config=config.report)]

    def _extract_recording(
        self, scene: Scene, writer: RunWriter, config: Config, progress: Progress
    ) -> tuple[list[dict[str, Any]], list[ViewPage]]:
        with progress.working("reading the recording"):
            recording = open_recording(self.source, config, self.segmentation)
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
                {
                    "view": index,
                    "timings": scene.timings,
                    "angle_travelled": angle,
                    "path_travelled": path,
                }
            )
            progress.say(f"view {index:02d}: {summary(graph)}")
            if not self.no_report:
                posed = view.with_pose(T_world_camera)
                page = draw_model(graph, scene.cloud, view=posed, labels=labels, config=config.report)
                page = replace(page, index=index, timings=scene.timings)
                pages.append(replace(page, angle_travelled=angle, path_travelled=path))
        return steps, pages
