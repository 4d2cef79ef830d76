"""Running one episode: explore a scene, score every view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caryatid.benchmark.records import Episode, Outcome, ViewRow
from caryatid.benchmark.scenes import opened
from caryatid.benchmark.taking import AFTER, take_apart
from caryatid.config import Config
from caryatid.config.settings import read_settings
from caryatid.errors import in_one_line
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import Score, score
from caryatid.evaluation.truths import SEED
from caryatid.exploration import Step, explore
from caryatid.simulation.stage import set_stage


def run_episode(episode: Episode) -> Outcome:
    """Run an episode; whatever goes wrong is part of the outcome.

    Views that can no longer be reached repeat the row of the last one that was: the graph stays as it is.
    """
    try:
        return Outcome(_rows(episode))
    except Exception as error:
        return Outcome((), in_one_line(error))


def settings_of(episode: Episode) -> Config:
    """The configuration an episode is run with.

    Raises:
        InputError: A setting does not exist or its value is not valid.
    """
    config = read_settings(None, episode.settings)
    return replace(
        config,
        fusion=replace(config.fusion, method=episode.fusion),
        active=replace(config.active, max_views=episode.views),
    )


def _rows(episode: Episode) -> tuple[ViewRow, ...]:
    config = settings_of(episode)
    scene, truth = opened(episode.scene, episode.content)
    stage = set_stage(scene, config, noise=episode.noise, seed=episode.seed)
    rows: list[ViewRow] = []
    planning, taken = 0.0, (0.0, 0.0)
    planner, camera = planner_for(
        episode.planner, stage.camera, truth, config, segmentation=episode.segmentation, seed=episode.seed
    )
    for step in explore(
        camera,
        stage.robot,
        planner=planner,
        config=config,
        segmentation=episode.segmentation,
        seed=episode.seed,
        early_stop=False,
    ):
        row = _row(step, score(step.graph, truth, np.random.default_rng(SEED)), planning)
        if episode.order and row.view in AFTER:
            taken = take_apart(scene, step.graph, truth, episode.order, config, episode.seed)
        rows.append(replace(row, unharmed=taken[0], lifts=taken[1]))
        planning = step.timings["plan"]
    last = rows[-1]
    missing = range(last.view + 1, episode.views + 1)
    return tuple(
        rows + [replace(last, view=v, planning_seconds=0.0, perception_seconds=0.0) for v in missing]
    )


def _row(step: Step, s: Score, planning: float) -> ViewRow:
    stages = sum(seconds for stage, seconds in step.timings.items() if stage not in ("capture", "plan"))
    return ViewRow(
        view=step.index + 1,
        precision=s.precision,
        recall=s.recall,
        f1=s.f1,
        vertex_precision=s.vertex_precision,
        vertex_recall=s.vertex_recall,
        vertex_f1=_f1(s.vertex_precision, s.vertex_recall),
        edge_precision=s.edge_precision,
        edge_recall=s.edge_recall,
        edge_f1=_f1(s.edge_precision, s.edge_recall),
        mean_iou=s.mean_iou,
        angle=step.angle_travelled,
        path=step.path_travelled,
        planning_seconds=planning,
        perception_seconds=stages,
    )


def _f1(precision: float, recall: float) -> float:
    return 2.0 * precision * recall / (precision + recall) if precision + recall > 0.0 else 0.0
