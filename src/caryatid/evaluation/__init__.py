"""Scores against a truth, benchmark and plots."""

from __future__ import annotations

from caryatid.evaluation.scores import (
    Score,
    TrueObject,
    TrueScene,
    as_scene,
    score,
    score_masks,
    score_scenes,
)
from caryatid.evaluation.truths import ViewScore, evaluate_run, read_true_scene, true_scene_from_simulation

__all__ = [
    "Score",
    "TrueObject",
    "TrueScene",
    "ViewScore",
    "as_scene",
    "evaluate_run",
    "read_true_scene",
    "score",
    "score_masks",
    "score_scenes",
    "true_scene_from_simulation",
]
