"""Steps on disk: `views/NN/step.npz` of a run folder, beside graph.json, view.json and the labels."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, fields
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

PARTS = {"cloud": Cloud, "sphere": ViewSphere, "view": View, "candidates": Candidates, "decision": Decision}
"""The parts of a step that hold arrays."""

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
    if run.record["version"] == 1:
        version = run.record.get("versions", {}).get("caryatid", "0.1.0")
        raise InputError(
            run.folder,
            f"was written by caryatid {version}, which kept no views",
            "make the run again; order, evaluate and export need only its graph",
        )
    return (read_step(view.folder) for view in run.views)


def read_config(run: Run) -> Config:
    """Return the settings a run was made with; settings that no longer exist are passed over.

    Raises:
        InputError: run.json holds no settings, or they are not valid.
    """
    path = str(run.folder / "run.json")
    return changed_settings(Config(), run.record.get("settings", {}), path)


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
    """Arrays are members named `part.field`; all else is in the member `document`."""
    arrays: Arrays = {"labels": step.labels, "visited": step.visited}
    for part in PARTS:
        holder = getattr(step, part)
        held = {} if holder is None else {name: getattr(holder, name) for name in _names(part).values()}
        arrays |= {
            key: held[name]
            for key, name in _names(part).items()
            if name in held and isinstance(held[name], np.ndarray)
        }
    for name in ("cloud.points", "cloud.normals"):
        arrays[name] = arrays[name].astype(np.float32)
    names = ("index", "name", "timings", "angle_travelled", "path_travelled", "stop")
    document: dict[str, Any] = {name: getattr(step, name) for name in names}
    document |= {"cloud.name": step.cloud.name, "sphere.radius": step.sphere.radius}
    if step.candidates is not None:
        document["candidates.rejected"] = step.candidates.rejected
    if step.decision is not None:
        names = ("index", "saliency", "cost", "score", "why", "points_of_interest")
        document["decision"] = {name: getattr(step.decision, name) for name in names}
    if step.robot is not None:
        document["robot"] = step.robot
    arrays["document"] = np.frombuffer(json.dumps(document, default=_plain).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    # Higher levels of compression take longer and save little.
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def _decoded(document: dict[str, Any], arrays: Arrays, folder: Path) -> Step:
    held: dict[str, dict[str, Any]] = {
        part: {name: arrays.pop(key) for key, name in _names(part).items() if key in arrays} for part in PARTS
    }
    for name in ("points_world", "normals_world"):
        held["cloud"][name] = held["cloud"][name].astype(np.float64)
    step = {name: value for name, value in (document | arrays).items() if "." not in name}
    step["graph"] = read_graph(folder / "graph.json")
    step["cloud"] = Cloud(**held["cloud"], name=document["cloud.name"])
    step["sphere"] = ViewSphere(**held["sphere"], radius=document["sphere.radius"])
    step |= {"view": None, "candidates": None, "decision": None}
    if held["view"]:
        step["view"] = View(**held["view"], name=document["name"])
    if held["candidates"]:
        step["candidates"] = Candidates(**held["candidates"], rejected=document["candidates.rejected"])
    if "decision" in document:
        points = (
            _arrays(p) | {"subject": tuple(p["subject"])} for p in document["decision"]["points_of_interest"]
        )
        given = document["decision"] | {"points_of_interest": tuple(PointOfInterest(**p) for p in points)}
        step["decision"] = Decision(**held["decision"], **given)
    if "robot" in document:
        posture = Posture(**_arrays(document["robot"]["posture"]))
        step["robot"] = RobotPose(**_arrays(document["robot"]) | {"posture": posture})
    return Step(**step)


def _names(part: str) -> dict[str, str]:
    """Members that hold the arrays of a part, and the fields they come from."""
    names = (field.name for field in fields(PARTS[part]) if field.init)
    return {f"{part}.{name.removesuffix('_world')}": name for name in names}


def _plain(value: Any) -> Any:
    """What JSON does not know: arrays, NumPy's scalars and dataclasses."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else asdict(value)


def _arrays(given: dict[str, Any]) -> dict[str, Any]:
    return {key: np.array(value) if isinstance(value, list) else value for key, value in given.items()}
