"""A finished run as moments: what its folder holds, to be shown at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from caryatid.config import Config
from caryatid.config.settings import changed_settings
from caryatid.geometry.transforms import Array
from caryatid.io.json_files import field, number, numbers, rigid_transform
from caryatid.io.runs import Run
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.viewer.moments import Moment, moment_of_run_view


def moments_of_run(run: Run) -> list[Moment]:
    """What a run folder says of each view: all but clouds, pictures and saliency.

    Raises:
        InputError: A file of the run is broken.
    """
    config = config_of_run(run)
    decisions = [_decision(view.record, f"{run.folder}: view {view.index}") for view in run.views]
    sphere = _sphere([d.T_world_camera for d in decisions if d is not None], config)
    scores = run.record.get("scores") or []
    stops = [step.get("stop") for step in run.record.get("steps") or []]
    moments = []
    visited = np.zeros((0, 3))
    for view, decision in zip(run.views, decisions, strict=True):
        f1 = float(scores[view.index]["f1"]) if view.index < len(scores) else None
        if sphere is not None and view.T_world_camera is not None:
            visited = np.concatenate([visited, sphere.direction_of(view.T_world_camera)[None]])
        if decision is not None and sphere is not None:
            seen_from = [_seen_from(p, sphere) for p in decision.points_of_interest]
            decision = replace(decision, points_of_interest=tuple(seen_from))
        moment = moment_of_run_view(view, decision, f1)
        stop = stops[view.index] if view.index < len(stops) else None
        moments.append(replace(moment, sphere=sphere, visited=visited, stop=stop))
    return moments


def config_of_run(run: Run) -> Config:
    """The settings a run was made with; of one by another release what is the same by name and kind.

    Raises:
        InputError: run.json holds no settings, or they are not valid.
    """
    path = str(run.folder / "run.json")
    settings = field(run.record, "settings", dict, path)
    return changed_settings(Config(), settings, path)


def _decision(record: Mapping[str, Any], source: str) -> Decision | None:
    """The choice of the next view, as far as view.json keeps it."""
    chosen = record.get("next")
    if chosen is None:
        return None
    points = tuple(
        PointOfInterest(
            numbers(p["position"], (3,), source),
            np.array([0.0, 0.0, 1.0]),
            number(p, "saliency", source),
            tuple(field(p, "subject", list, source)),
            field(p, "why", str, source),
        )
        for p in field(chosen, "points_of_interest", list, source)
    )
    T_world_camera = rigid_transform(field(chosen, "T_world_camera", list, source), source)
    saliency, cost, score = (number(chosen, key, source) for key in ("saliency", "cost", "score"))
    return Decision(T_world_camera, 0, saliency, cost, score, field(chosen, "why", str, source), points)


def _sphere(T_world_camera: list[Array], config: Config) -> ViewSphere | None:
    """The view sphere, from the poses (4, 4) chosen on it: where their optical axes come nearest."""
    if not T_world_camera:
        return None
    poses = np.array(T_world_camera)
    eyes, forward = poses[:, :3, 3], poses[:, :3, 2]
    centre = (eyes + config.active.sphere_radius * forward).mean(axis=0)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    if np.linalg.cond(across.sum(axis=0)) < 1e3:
        centre = np.linalg.solve(across.sum(axis=0), (across @ eyes[..., None]).sum(axis=0)[:, 0])
    radius = float(np.linalg.norm(eyes - centre, axis=1).mean())
    sphere = ViewSphere.around(centre, config.active)
    return replace(sphere, radius=radius)


def _seen_from(point: PointOfInterest, sphere: ViewSphere) -> PointOfInterest:
    """Where a point is projected on the sphere: along the line from the centre through it."""
    offset = point.position_world - sphere.centre_world
    length = float(np.linalg.norm(offset))
    return replace(point, direction=offset / length) if length > 1e-6 else point
