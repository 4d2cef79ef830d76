"""What run.json and view.json say."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from caryatid.config import Config
from caryatid.evaluation.scores import Score
from caryatid.exploration import Step

PACKAGES = ("mujoco", "numpy", "scipy", "numba", "shapely")
"""Whose versions a run records beside caryatid's and Python's."""


def run_record(
    command: str,
    source: str,
    seed: int,
    options: Mapping[str, Any],
    config: Config,
    steps: Sequence[Mapping[str, Any]],
    scores: Sequence[Score],
) -> dict[str, Any]:
    """What run.json holds.

    Args:
        command: Which command made the run.
        source: What it was made from.
        seed: Seed of every random choice.
        options: Planner, noise, segmentation and so on.
        config: All settings.
        steps: Of each view its number, its timings [s], angle [rad] and path [m] travelled up to it.
        scores: Score after each view, where the truth is known.
    """
    packages = {name: version(name) for name in PACKAGES}
    record: dict[str, Any] = {
        "command": command,
        "source": source,
        "seed": seed,
        "options": dict(options),
        "settings": asdict(config),
        "versions": {"caryatid": version("caryatid"), "python": platform.python_version()} | packages,
        "angle_travelled": steps[-1]["angle_travelled"] if steps else 0.0,
        "path_travelled": steps[-1]["path_travelled"] if steps else 0.0,
        "steps": list(steps),
    }
    if scores:
        record["scores"] = [
            {"precision": s.precision, "recall": s.recall, "f1": s.f1, "mean_iou": s.mean_iou} for s in scores
        ]
    return record


def step_record(step: Step) -> dict[str, Any]:
    """Timings [s], angle [rad] and path [m] of one view."""
    return {
        "view": step.index,
        "timings": step.timings,
        "angle_travelled": step.angle_travelled,
        "path_travelled": step.path_travelled,
        "stop": step.stop,
    }


def kept(views: int, folder: Path, *, reported: bool) -> str:
    """What is kept of an interrupted run, and where."""
    count = "1 view is" if views == 1 else f"{views} views are"
    return f"{count} kept in {folder}, " + ("open its report.html" if reported else "without a report")
