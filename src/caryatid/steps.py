"""Steps on disk: `views/NN/step.npz` of a run folder, beside graph.json, view.json and the labels."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.config import Config
from caryatid.config.settings import changed_settings
from caryatid.errors import InputError
from caryatid.exploration import RobotPose, Step
from caryatid.io.graph_json import read_graph
from caryatid.io.runs import Run, RunWriter
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.robots import Posture
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import Cloud, View

COMPRESSION = 1
"""Level of zlib: higher ones take longer and save little."""

ARRAYS = {
    "view": ("depth", "K", "T_world_camera", "rgb", "labels", "normals_camera"),
    "candidates": ("T_world_camera", "directions", "path_length", "indices"),
    "decision": ("T_world_camera", "candidate_saliency", "sphere_saliency"),
}
"""The arrays of each part of a step, by the names of the fields."""

Arrays = dict[str, NDArray[Any]]


def write_step(writer: RunWriter, step: Step) -> None:
    """Write the next view of a run folder.

    Points and normals of the cloud are rounded to float32; all else comes back as it was.

    Raises:
        InputError: Labels leave 16 bits, or the disk is full or refuses; nothing is left behind.
    """
    view = step.view
    writer.add_view(
        step.graph,
        step.labels,
        name=step.name,
        T_world_camera=None if view is None else view.T_world_camera,
        K=None if view is None else view.K,
        record=_summary(step),
        step=_encoded(step),
    )


def read_step(folder: Path) -> Step:
    """Read a step back.

    Args:
        folder: `views/NN` of a run folder.

    Raises:
        InputError: step.npz or graph.json is missing or broken.
    """
    path = folder / "step.npz"
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        document = json.loads(arrays.pop("document").tobytes())
        return _decoded(document, arrays, folder)
    except FileNotFoundError:
        raise InputError(path, "the file is missing", "explore again") from None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(path, f"is not a step of a run ({error})", "explore again") from error


def read_steps(run: Run) -> Iterator[Step]:
    """Read the steps of a run, one after the other.

    Raises:
        InputError: A step is missing or broken, or the run was written by a version that kept no steps.
    """
    check_steps(run)
    return (read_step(view.folder) for view in run.views)


def read_config(run: Run) -> Config:
    """Return the settings a run was made with; settings that no longer exist are passed over.

    Raises:
        InputError: run.json holds no settings, or they are not valid.
    """
    path = str(run.folder / "run.json")
    return changed_settings(Config(), run.record.get("settings", {}), path)


def check_steps(run: Run) -> None:
    """Refuse a run folder without steps.

    Raises:
        InputError: It was written by a version that kept none.
    """
    if run.record["version"] == 1:
        version = run.record.get("versions", {}).get("caryatid", "0.1.0")
        raise InputError(
            run.folder,
            f"was written by caryatid {version}, which kept no views",
            "make the run again; order, evaluate and export need only its graph",
        )


def _summary(step: Step) -> dict[str, Any]:
    """What view.json says of the candidates and of the choice of the next view."""
    record: dict[str, Any] = {}
    if step.candidates is not None:
        record["candidates"] = {"reachable": len(step.candidates), "rejected": step.candidates.rejected}
    if step.decision is not None:
        d = step.decision
        points = [
            {"position": p.position_world, "saliency": p.saliency, "subject": list(p.subject), "why": p.why}
            for p in d.points_of_interest
        ]
        figures = {key: getattr(d, key) for key in ("T_world_camera", "saliency", "cost", "score", "why")}
        record["next"] = figures | {"points_of_interest": points}
        if d.candidate_saliency is not None:
            quartiles = np.quantile(d.candidate_saliency, (0.0, 0.25, 0.5, 0.75, 1.0))
            record["next"]["candidate_saliency_quartiles"] = quartiles
    return record


def _encoded(step: Step) -> bytes:
    arrays: dict[str, Any] = {
        "labels": step.labels,
        "visited": step.visited,
        "cloud.points": step.cloud.points_world.astype(np.float32),
        "cloud.normals": step.cloud.normals_world.astype(np.float32),
        "cloud.labels": step.cloud.labels,
        "cloud.rgb": step.cloud.rgb,
        "cloud.viewpoint": step.cloud.viewpoint_world,
        "sphere.centre": step.sphere.centre_world,
        "sphere.directions": step.sphere.directions,
    }
    document: dict[str, Any] = {
        "index": step.index,
        "name": step.name,
        "timings": step.timings,
        "angle_travelled": step.angle_travelled,
        "path_travelled": step.path_travelled,
        "stop": step.stop,
        "cloud.name": step.cloud.name,
        "sphere.radius": step.sphere.radius,
    }
    if step.view is not None:
        arrays |= _fields("view", step.view)
    if step.candidates is not None:
        arrays |= _fields("candidates", step.candidates)
        document["candidates.rejected"] = step.candidates.rejected
    if step.decision is not None:
        d = step.decision
        arrays |= _fields("decision", d)
        document["decision"] = {key: getattr(d, key) for key in ("index", "saliency", "cost", "score", "why")}
        document["decision"]["points_of_interest"] = [_lists(asdict(p)) for p in d.points_of_interest]
    if step.robot is not None:
        document["robot"] = _lists(asdict(step.robot) | {"posture": _lists(asdict(step.robot.posture))})
    arrays |= {"document": np.frombuffer(_json(document), dtype=np.uint8)}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=COMPRESSION) as archive:
        for name, array in arrays.items():
            if array is not None:
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def _decoded(document: dict[str, Any], arrays: Arrays, folder: Path) -> Step:
    cloud = Cloud(
        arrays["cloud.points"].astype(np.float64),
        arrays["cloud.normals"].astype(np.float64),
        arrays.get("cloud.labels"),
        arrays.get("cloud.rgb"),
        arrays.get("cloud.viewpoint"),
        document["cloud.name"],
    )
    view = candidates = decision = robot = None
    if "view.depth" in arrays:
        view = View(**_group(arrays, "view"), name=document["name"])
    if "candidates.directions" in arrays:
        rejected = document["candidates.rejected"]
        candidates = Candidates(**_group(arrays, "candidates"), rejected=rejected)
    if "decision" in document:
        points = tuple(_point_of_interest(p) for p in document["decision"].pop("points_of_interest"))
        decision = Decision(**document["decision"], **_group(arrays, "decision"), points_of_interest=points)
    if "robot" in document:
        given = document["robot"]
        posture = given["posture"] | {"platform_world": np.array(given["posture"]["platform_world"])}
        T_world_camera = np.array(given["T_world_camera"])
        robot = RobotPose(**given | {"posture": Posture(**posture), "T_world_camera": T_world_camera})
    return Step(
        document["index"],
        document["name"],
        view,
        arrays["labels"],
        read_graph(folder / "graph.json"),
        cloud,
        ViewSphere(arrays["sphere.centre"], document["sphere.radius"], arrays["sphere.directions"]),
        arrays["visited"],
        candidates,
        decision,
        document["timings"],
        document["angle_travelled"],
        document["path_travelled"],
        document["stop"],
        robot,
    )


def _fields(name: str, holder: object) -> dict[str, Any]:
    return {f"{name}.{field}": getattr(holder, field) for field in ARRAYS[name]}


def _group(arrays: Arrays, name: str) -> dict[str, Any]:
    """Arrays called `name.…`, by the rest of their names."""
    return {key.partition(".")[2]: value for key, value in arrays.items() if key.startswith(f"{name}.")}


def _json(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, default=lambda number: number.item()).encode()


def _lists(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in fields.items()}


def _point_of_interest(given: dict[str, Any]) -> PointOfInterest:
    arrays = {key: np.array(given[key]) for key in ("position_world", "direction")}
    return PointOfInterest(**given | arrays | {"subject": tuple(given["subject"])})
