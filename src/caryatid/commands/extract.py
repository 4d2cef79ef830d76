"""`caryatid extract`: the scene model from all views of a recording, or from one cloud; no planning."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from caryatid.commands.options import Modelling
from caryatid.commands.progress import Progress, summary
from caryatid.commands.records import run_record
from caryatid.commands.sources import CLOUD_SUFFIXES, check_labels
from caryatid.config import Config, SegmentationMethod
from caryatid.formats.bop import read_recording
from caryatid.formats.graph_json import graph_to_json
from caryatid.formats.json_files import json_text
from caryatid.formats.point_clouds import read_stored_cloud
from caryatid.formats.runs import RunWriter
from caryatid.perception import level_cloud
from caryatid.recording_camera import RecordingCamera
from caryatid.report import draw_model, render_report
from caryatid.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Extract(Modelling):
    """Extract shapes and support graph from all views of a recording, or from one cloud.

    Examples: `caryatid extract recording/ --out run`, `caryatid extract table.pcd --out run`.
    """

    source: Annotated[str, tyro.conf.Positional]
    """Recording (folder in the BOP format) or cloud (.pcd, .ply)."""
    out: Path
    """Run folder to write; a run already there is replaced."""
    segmentation: SegmentationMethod | None = None
    """Where parts come from: given labels, or automatic. [default: labels where the source has them]"""
    label_divisor: int = 1
    """Clouds whose labels number parts: object = label // divisor."""
    report: bool = True
    """Write no report.html."""

    def __call__(self) -> int:
        """Run the command."""
        config = self.settings()
        progress = Progress(self.quiet or self.json)
        scene = Scene(config, segmentation=self.segmentation, seed=self.seed)
        with RunWriter(self.out) as writer:
            if Path(self.source).suffix.lower() in CLOUD_SUFFIXES:
                timings, pages = self._extract_cloud(scene, writer, config, progress)
            else:
                timings, pages = self._extract_recording(scene, writer, config, progress)
            told = {"source": self.source, "segmentation": self.segmentation, "seed": self.seed}
            steps = [{"view": k, "timings": t, "path_travelled": 0.0} for k, t in enumerate(timings)]
            report = None
            if self.report:
                settings = told | {"fusion": config.fusion.method}
                report = render_report(pages, title=f"caryatid: {Path(self.source).name}", settings=settings)
            writer.finish(scene.graph, run_record(config, told, steps, []), report)
        if self.json:
            sys.stdout.write(json_text({"run": str(self.out), "graph": graph_to_json(scene.graph)}) + "\n")
        progress.say(f"{Path(self.source).name}: {summary(scene.graph)}")
        if self.report:
            progress.say(f"report: {self.out / 'report.html'}")
        return 0

    def _extract_cloud(
        self, scene: Scene, writer: RunWriter, config: Config, progress: Progress
    ) -> tuple[list[dict[str, float]], list[Any]]:
        with progress.working("reading the cloud"):
            stored = read_stored_cloud(self.source, self.label_divisor)
            rng = np.random.default_rng(self.seed)
            cloud = stored.to_cloud(config.cloud)
            cloud = level_cloud(cloud, config, segmentation=self.segmentation, rng=rng)
        with progress.working("extracting"):
            graph = scene.update(cloud)
        assert scene.labels is not None
        writer.add_view(graph, stored.spread(scene.labels), name=Path(self.source).name)
        return [scene.timings], [draw_model(graph, scene.cloud, config=config.report)]

    def _extract_recording(
        self, scene: Scene, writer: RunWriter, config: Config, progress: Progress
    ) -> tuple[list[dict[str, float]], list[Any]]:
        recording = read_recording(self.source)
        check_labels(self.source, recording, self.segmentation)
        RecordingCamera(recording)
        timings, pages = [], []
        for index, frame in enumerate(recording.frames):
            view = frame.load()
            graph = scene.update(view)
            assert scene.labels is not None
            pose = scene.T_world_camera
            assert pose is not None
            writer.add_view(graph, scene.labels, name=view.name, T_world_camera=pose, K=view.K)
            timings.append(scene.timings)
            progress.say(f"view {index + 1} of {len(recording)}: {summary(graph)}")
            if self.report:
                page = draw_model(
                    graph, scene.cloud, view=view.with_pose(pose), labels=scene.labels, config=config.report
                )
                pages.append(replace(page, index=index, timings=scene.timings))
        return timings, pages
