"""Run folders, with a folder for each step of a run."""

from __future__ import annotations

import io
import json
import platform
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import PositiveInt

from caryatid.config import Config
from caryatid.config.settings import changed_settings
from caryatid.errors import InputError
from caryatid.exploration import RobotPose, Step
from caryatid.graph import Change, Grasp, SupportGraph, TakeStep
from caryatid.io import images
from caryatid.io.graph_json import graph_text, read_graph
from caryatid.io.json_files import json_text, parse_json, read_json
from caryatid.io.staging import StagedFolder, read_errors, recover
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.robots import Posture
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.support.relations import Effect, Removal

FORMAT: Final = "caryatid/run"
AGAIN: Final = "run caryatid again"
"""Remedy for a broken file of a run."""
PACKAGES = ("caryatid", "mujoco", "numpy", "scipy", "numba", "shapely")
"""Packages whose versions run.json records."""
PARTS = (
    View, Cloud, ViewSphere, Candidates, Decision, PointOfInterest, Posture, RobotPose, Change, TakeStep,
    Grasp, Removal, Effect,
)  # fmt: skip
"""Classes that a step is made of."""


class RunWriter(StagedFolder):
    """Writes a run folder step by step in a `with` block; the folder appears at the end of the block.

    Ctrl-C also ends the block, and keeps the views so far. Any other error leaves nothing behind. An earlier
    run folder is replaced only at the end of the block. A folder with other files is never changed.

    Args:
        folder: RUN.
        config: All settings.
        about: Further entries of run.json: command, source, seed, options.
        stepwise: Publish the folder with the first view and add view by view, so that a kill keeps the views
            so far. An unfinished run of this kind is continued.

    Attributes:
        past: The run that this one continues, or None.
        steps: Entries of run.json for each view: its number, its timings [s], angle and path so far.
        more: More entries of run.json.
        files: Further files of the folder: path in it → content.

    Raises:
        InputError: RUN holds something else, or cannot be written.
    """

    def __init__(
        self, folder: str | Path, config: Config, about: Mapping[str, Any], *, stepwise: bool = False
    ) -> None:
        self._about = json.loads(json_text(dict(about) | {"settings": asdict(config)}))
        self.past = _unfinished(Path(folder), self._about) if stepwise else None
        super().__init__(folder, replaces=_own_files, durable=stepwise, goes_on=self.past is not None)
        self.more: dict[str, Any] = {}
        self.files: dict[str, bytes] = {}
        self._stepwise = stepwise
        self.steps: list[dict[str, Any]] = []
        self._graph = SupportGraph()
        self._scores: list[Mapping[str, Any]] = []
        if self.past is not None:
            self.steps, self._graph = list(self.past.record["steps"]), self.past.graph
            self._scores = list(self.past.record.get("scores", ()))
            # Files listed for a view that a kill prevented may be missing.
            self.written |= {name for name in self.past.record["files"] if (self._place / name).exists()}

    def add(self, step: Step, score: Mapping[str, Any] | None = None) -> None:
        """Write the next view, or the newest one again with its `stop`.

        Points and normals of the cloud are rounded to float32; all else is read back unchanged.

        Args:
            step: The step of this view.
            score: Its score for run.json, if the ground truth is known.

        Raises:
            InputError: Labels exceed 16 bits, or the disk cannot be written.
        """
        if step.stop is not None and self.steps and self.steps[-1]["view"] == step.index:
            del self.steps[-1], self._scores[len(self.steps) :]
        number = len(self.steps)
        labels, folder = step.labels, _view_folder(number)
        if labels.size and not 0 <= labels.min() <= labels.max() <= SUPPORT_LABEL:
            reason = f"labels are not all within 0…{SUPPORT_LABEL}"
            raise InputError(step.name, reason, "number objects from 1, 0 = no object")
        self.write(f"{folder}/graph.json", graph_text(step.graph).encode())
        if labels.ndim == 2:
            self.write(f"{folder}/labels.png", images.png(labels.astype(np.uint16)))
        else:
            self.write(f"{folder}/labels.npy", images.npy(labels.astype(np.int32)))
        document = {"view": number, "name": step.name} | _summary(step)
        self.write(f"{folder}/view.json", json_text(document).encode())
        self.write(f"{folder}/step.npz", _encoded(step))
        names = ("timings", "angle_travelled", "path_travelled", "stop")
        self.steps.append({"view": step.index} | {name: getattr(step, name) for name in names})
        self._graph = step.graph
        self._scores += [] if score is None else [score]
        if self._stepwise:
            self._finish({"unfinished": True} if step.decision is not None else {})

    def __exit__(self, kind: object = BaseException, *error: object) -> None:
        """Write the rest and publish the folder; after an error other than Ctrl-C, remove it."""
        interrupted = kind is KeyboardInterrupt and len(self.steps) > 0
        try:
            if (interrupted or (kind is None and self.steps)) and not self._stepwise:
                self._finish({"interrupted": True} if interrupted else {})
        finally:
            super().__exit__()
        if interrupted:
            count = "1 view is" if len(self.steps) == 1 else f"{len(self.steps)} views are"
            remedy = f"`caryatid report {self.folder}` writes the report"
            if self._stepwise:
                remedy = "run the same command to continue"
            raise KeyboardInterrupt(f"{count} kept in {self.folder}; {remedy}") from None

    def _finish(self, more: dict[str, Any]) -> None:
        """Write the files of the whole run, and publish the folder."""
        count = len(self.steps)
        document = {"format": FORMAT, "version": 2, "views": count} | self._about
        document["date"] = datetime.now(UTC).isoformat(timespec="seconds")
        document["versions"] = {"python": platform.python_version()} | {p: version(p) for p in PACKAGES}
        document |= {name: self.steps[-1][name] for name in ("angle_travelled", "path_travelled")}
        document["steps"] = self.steps
        document |= ({"scores": self._scores} if self._scores else {}) | self.more | more
        self.remove(_view_folder(count))
        for path, content in ({"graph.json": graph_text(self._graph).encode()} | self.files).items():
            self.write(path, content)
        self.files = {}
        # A kill may leave files of the next view, to which nothing refers.
        files = self.written
        if "unfinished" in more:
            names = ("graph.json", "labels.png", "view.json", "step.npz")
            files = files | {lift_file(count)} | {f"{_view_folder(count)}/{name}" for name in names}
        self.write("run.json", json_text(document | {"files": sorted(files)}).encode())
        self.publish()


@dataclass(frozen=True, eq=False, slots=True)
class RunView:
    """A view of a run.

    Attributes:
        name: The view's name, which identifies a recording's frame.
        graph: The fused graph after this view.
        record: All of view.json.
        folder: Its folder, `views/NN`.
    """

    name: str
    graph: SupportGraph
    record: dict[str, Any]
    folder: Path

    def load_labels(self) -> NDArray[np.int32]:
        """Read the label image (H, W), or the labels (N,) of a cloud's points.

        Raises:
            InputError: The file is missing, broken or of another kind.
        """
        path = self.folder / "labels.npy"
        if not path.exists():
            return images.read_units(self.folder / "labels.png")
        labels = images.read_npy(path)
        if labels.ndim != 1 or labels.dtype.kind not in "iu":
            raise InputError(path, "not an array of integers (N,)", AGAIN)
        return labels.astype(np.int32)


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """A run folder as read.

    Attributes:
        folder: RUN.
        record: All of run.json: settings, seed, versions, source, timings.
        graph: The final fused graph.
        views: The views in their order.
    """

    folder: Path
    record: dict[str, Any]
    graph: SupportGraph
    views: tuple[RunView, ...]


@dataclass(frozen=True, slots=True)
class _Score:
    """An entry of `scores`."""

    f1: float
    precision: float
    recall: float
    matches: dict[str, str] = field(default_factory=dict)
    wrong: list[tuple[str, str]] = field(default_factory=list)
    missing: list[tuple[str, str]] = field(default_factory=list)
    unfound: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _RunFile:
    """run.json; version 1, of caryatid 0.1.0, has no step.npz."""

    format: Literal["caryatid/run"]
    version: Literal[1, 2]
    views: PositiveInt
    source: str
    seed: int
    options: dict[str, Any]
    settings: dict[str, Any] = field(default_factory=dict)
    scores: list[_Score] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    conditions: str | None = None
    source_path: str = ""
    date: str = ""


@dataclass(frozen=True, slots=True)
class _ViewFile:
    name: str


def read_run(folder: str | Path) -> Run:
    """Read a run folder; label images are read when needed.

    Raises:
        InputError: It is not a run folder, or a file in it is missing or broken.
    """
    folder = Path(folder)
    remedy = "give a run folder, as written by explore, extract or clear, or a session"
    if not _exists(folder):
        raise InputError(folder, "not a folder" if folder.exists() else "no such folder", remedy)
    path = folder / "run.json"
    if not path.exists():
        raise InputError(folder, "not a run or session", remedy)
    record = read_json(path, remedy)
    file = parse_json(_RunFile, record, path, AGAIN)
    if file.scores and len(file.scores) != file.views:
        raise InputError(path, f"the number of scores, {len(file.scores)}, is not that of views", AGAIN)
    views = tuple(_read_view(folder / _view_folder(index)) for index in range(file.views))
    return Run(folder, record, read_graph(folder / "graph.json"), views)


def read_steps(run: Run) -> Iterator[Step]:
    """Read the steps of a run, one after the other.

    Raises:
        InputError: A step is missing or broken, or the run was written by a version that kept no steps.
    """
    if run.record["version"] == 1:
        ours = run.record.get("versions", {}).get("caryatid", "0.1.0")
        reason = f"written by caryatid {ours}, which did not store views"
        remedy = "repeat the run; order, evaluate and export need only its graph"
        raise InputError(run.folder, reason, remedy)
    return (_read_step(view.folder) for view in run.views)


def read_config(run: Run) -> Config:
    """Return the settings of a run.

    Raises:
        InputError: The settings are not valid.
    """
    return changed_settings(Config(), run.record.get("settings", {}), str(run.folder / "run.json"))


def is_run(folder: Path) -> bool:
    """Whether a folder was written by `RunWriter`, whatever its version."""
    try:
        return _exists(folder) and read_json(folder / "run.json").get("format") == FORMAT
    except InputError:
        return False


def is_session(folder: Path) -> bool:
    """Whether a folder is a session, which other commands than `caryatid session` read as a run."""
    return (folder / "session.json").is_file()


def _exists(folder: Path) -> bool:
    """Whether a folder exists; if a kill while it was being replaced hid it, it is restored."""
    if not folder.is_dir():
        recover(folder)
    return folder.is_dir()


def _own_files(folder: Path) -> set[str]:
    """Files of a run folder that may be replaced: those that run.json lists, and those made from them."""
    if not is_run(folder):
        return set()
    files = read_json(folder / "run.json").get("files")
    if files is None:
        reason = "contains a run of an earlier caryatid, which does not list its files"
        raise InputError(folder, reason, "move or delete the folder, or give a new one")
    return {"run.json", "report.html", *map(str, files)}


def _unfinished(folder: Path, about: Mapping[str, Any]) -> Run | None:
    """The unfinished run in a folder if it has the same command and settings, or None."""
    if not is_run(folder):
        return None
    record = read_json(folder / "run.json")
    return read_run(folder) if record.get("unfinished") and about.items() <= record.items() else None


def lift_file(index: int) -> str:
    """Picture of the lift after a view."""
    return f"lifts/{index:02d}.png"


def _view_folder(index: int) -> str:
    return f"views/{index:02d}"


def _read_view(folder: Path) -> RunView:
    path = folder / "view.json"
    record = read_json(path, AGAIN)
    name = parse_json(_ViewFile, record, path, AGAIN).name
    return RunView(name, read_graph(folder / "graph.json"), record, folder)


def _summary(step: Step) -> dict[str, Any]:
    """Entries of view.json about the camera, the candidates and the choice of the next view."""
    record: dict[str, Any] = {key: getattr(step.view, key, None) for key in ("T_world_camera", "K")}
    record["changes"] = [asdict(change) for change in step.changes]
    if step.lift is not None:
        record["lift"] = step.lift.to_json()
    if step.removal is not None:
        record["removal"] = step.removal.to_json()
    if step.candidates is not None:
        record["candidates"] = {"reachable": len(step.candidates), "rejected": step.candidates.rejected}
    if step.decision is not None:
        decision = step.decision
        names = ("T_world_camera", "saliency", "cost", "score", "why")
        record["next"] = {name: getattr(decision, name) for name in names}
        record["next"]["waypoints"] = [posture.to_json() for posture in decision.waypoints]
        record["next"]["points_of_interest"] = [
            {"position": p.position_world, "saliency": p.saliency, "subject": p.subject, "why": p.why}
            for p in decision.points_of_interest
        ]
        if decision.candidate_saliency is not None:
            quartiles = np.quantile(decision.candidate_saliency, (0.0, 0.25, 0.5, 0.75, 1.0))
            record["next"]["candidate_saliency_quartiles"] = quartiles
    return record


def _encoded(step: Step) -> bytes:
    """Content of step.npz: a step as JSON in the member `document`, and each larger array as a member."""
    arrays: dict[str, NDArray[Any]] = {}

    def encoded(value: Any, path: str) -> Any:
        match value:
            case np.ndarray() if 0 < value.size <= 16 and value.dtype == np.float64:
                return {"$array": value.tolist()}
            case np.ndarray():
                arrays[path] = value
                return {"$array": path}
            case np.generic():
                return value.item()
            case Mapping():
                return {key: encoded(item, f"{path}.{key}") for key, item in value.items()}
            case tuple():
                return [encoded(item, f"{path}.{number}") for number, item in enumerate(value)]
        if isinstance(value, PARTS):
            members = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
            return {"$kind": type(value).__name__} | encoded(members, path)
        return value

    step = _with_cloud(step, np.float32)
    names = [f.name for f in fields(step) if f.name != "graph"]
    document = json.dumps({name: encoded(getattr(step, name), name) for name in names})
    arrays["document"] = np.frombuffer(document.encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    # Higher levels of compression take longer and save little.
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def _read_step(folder: Path) -> Step:
    """The step in a folder `views/NN`."""
    path, remedy = folder / "step.npz", "explore again"
    with read_errors(path, remedy):
        content = path.read_bytes()
    try:
        arrays = dict(np.load(io.BytesIO(content), allow_pickle=False))
        document = json.loads(arrays.pop("document").tobytes())
        step = Step(**_decoded(document, arrays), graph=read_graph(folder / "graph.json"))
        return _with_cloud(step, np.float64)
    except Exception as error:  # a damaged archive raises almost anything
        raise InputError(path, f"not a step of a run ({' '.join(str(error).split())})", remedy) from error


def _decoded(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Rebuild what `_encoded` wrote."""
    match value:
        case {"$array": str(name)}:
            return arrays[name]
        case {"$array": numbers}:
            return np.array(numbers)
        case {"$kind": kind, **members}:
            (part,) = (part for part in PARTS if part.__name__ == kind)
            return part(**_decoded(members, arrays))
        case dict():
            return {key: _decoded(item, arrays) for key, item in value.items()}
        case list():
            return tuple(_decoded(item, arrays) for item in value)
    return value


def _with_cloud(step: Step, dtype: type[np.floating[Any]]) -> Step:
    """The step with points and normals of another precision."""
    cloud = step.cloud
    points_world, normals_world = cloud.points_world.astype(dtype), cloud.normals_world.astype(dtype)
    return replace(step, cloud=replace(cloud, points_world=points_world, normals_world=normals_world))
