"""A finished run computed again for what its folder does not hold: clouds, pictures and saliency."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from caryatid.config import Config
from caryatid.io.graph_json import graph_text
from caryatid.io.json_files import field
from caryatid.io.point_clouds import read_stored_cloud
from caryatid.io.runs import Run
from caryatid.scene import Scene
from caryatid.segmentation.observation import level_cloud
from caryatid.viewer.loop import Loop
from caryatid.viewer.moments import Moment, moment_of_scene, shot_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from caryatid.io.datasets import Dataset
    from caryatid.sources import Source

    OpenSource = Callable[..., Source]
    OpenRecording = Callable[..., Dataset]


def replayed(
    run: Run, stored: Sequence[Moment], config: Config, open_source: OpenSource, open_recording: OpenRecording
) -> Iterator[Moment]:
    """Take the views of a run again: the same source, settings and seed give the same graphs.

    Args:
        run: The run.
        stored: Its moments, of its folder.
        config: Its settings.
        open_source: Opens a scene or a recording.
        open_recording: Reads a recording.

    Yields:
        Each moment with all there is to see, as long as its graph is the one stored.

    Raises:
        CaryatidError: The source cannot be opened any more.
    """
    if field(run.record, "command", str, str(run.folder / "run.json")) == "extract":
        moments = _extracted(run, config, open_recording)
    else:
        moments = _explored(run, stored, config, open_source)
    for before, moment in zip(stored, moments, strict=False):
        if graph_text(before.graph) != graph_text(moment.graph):
            return
        yield replace(
            moment,
            graph=before.graph,
            score=before.score,
            stop=before.stop,
            sphere=moment.sphere or before.sphere,
            decision=moment.decision if before.decision is not None else None,
        )


def _explored(
    run: Run, stored: Sequence[Moment], config: Config, open_source: OpenSource
) -> Iterator[Moment]:
    record, path = run.record, str(run.folder / "run.json")
    options: dict[str, Any] = field(record, "options", dict, path)
    seed: int = field(record, "seed", int, path)
    segmentation = options.get("segmentation")
    opening = partial(
        open_source,
        field(record, "source", str, path),
        noise=options.get("noise", "none"),
        segmentation=segmentation,
        seed=seed,
        robot=options.get("robot", "humanoid"),
    )
    planner = options.get("planner", "support")
    yield from Loop(opening, config, planner=planner, segmentation=segmentation, seed=seed).retrace(stored)


def _extracted(run: Run, config: Config, open_recording: OpenRecording) -> Iterator[Moment]:
    record, path = run.record, str(run.folder / "run.json")
    options: dict[str, Any] = field(record, "options", dict, path)
    source: str = field(record, "source", str, path)
    seed: int = field(record, "seed", int, path)
    segmentation = options.get("segmentation")
    scene = Scene(config, segmentation=segmentation, seed=seed)
    if Path(source).suffix.lower() in (".pcd", ".ply"):
        rng = np.random.default_rng(seed)
        cloud = read_stored_cloud(source, options.get("label_divisor", 1)).to_cloud(config.cloud)
        scene.update(level_cloud(cloud, config, segmentation=segmentation, rng=rng))
        yield moment_of_scene(scene)
        return
    for frame in open_recording(source, config, segmentation).frames:
        view = frame.load()
        scene.update(view)
        moment = moment_of_scene(scene)
        if scene.T_world_camera is not None:
            moment = replace(moment, name=view.name, shot=shot_of(view.with_pose(scene.T_world_camera)))
        yield moment
