"""Scores of support graphs against a ground truth."""

from __future__ import annotations

from caryatid.evaluation.scores import Score, TrueScene, as_scene, score, score_masks
from caryatid.evaluation.truths import evaluate_run, true_scene_from_simulation

__all__ = [
    "Score", "TrueScene", "as_scene", "evaluate_run", "score", "score_masks",
    "true_scene_from_simulation",
]  # fmt: skip
