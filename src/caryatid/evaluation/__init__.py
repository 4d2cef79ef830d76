"""Scores of support graphs against a ground truth."""

from __future__ import annotations

from caryatid.evaluation.scores import Score, TrueObject, TrueScene, as_scene, score, score_masks
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
    "true_scene_from_simulation",
]
