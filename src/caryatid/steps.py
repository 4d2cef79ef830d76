"""Run folders, with a folder for each step of a run."""

from __future__ import annotations

import json
import platform
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import PositiveInt

from caryatid.config import Config, VoxelConfig
from caryatid.config.settings import changed_settings
from caryatid.errors import GoalError, InputError
from caryatid.exploration import RobotPose, Step
from caryatid.graph import Change, Grasp, SupportGraph, TakeStep
from caryatid.io import images
from caryatid.io.graph_json import graph_text, read_graph
from caryatid.io.json_files import json_text, parse_json, read_json
from caryatid.io.staging import StagedFolder, read_errors, recover
from caryatid.objects.reasons import Option, Reasons
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.robots import Posture
from caryatid.runtime import LIBRARIES
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.support.relations import Effect, Removal

FORMAT: Final = "caryatid/run"
AGAIN: Final = "run caryatid again"
"""Remedy for a broken file of a run."""
OWN_FILES: Final = re.compile(
    r"(run|graph)\.json|report\.html|lifts/\d+\.png|views/\d+/(graph\.json|view\.json|labels\.(png|npy)|step\.npz)"
)
"""Files of a run folder."""
PARTS = (
    View, Cloud, ViewSphere, Candidates, Decision, PointOfInterest, Posture, RobotPose, Change, TakeStep,
    Grasp, Removal, Effect, Reasons, Option, VoxelMap, VoxelConfig,
)  # fmt: skip
"""Classes that a step is made of."""


class RunWriter(StagedFolder):
    """Writes a run folder step by step in a `with` block; the folder appears at the end of the block.

    Ctrl-C also ends the block, and keeps the views so far. A goal that no view shows ends it too. Any other
    error leaves nothing behind. An earlier run folder is replaced only when this one appears. A folder with
    other files is never changed.

    Args:
        folder: RUN.
        config: All settings.
        about: Further entries of run.json: command, source, seed, options.

    Attributes:
        steps: Entries of run.json for each view: its number, its timings [s], angle and path so far.
        more: More entries of run.json.
        files: Further files of the folder: path in it → content.

    Raises:
        InputError: RUN holds something else, or cannot be written.
    """

    def __init__(self, folder: str | Path, config: Config, about: Mapping[str, Any]) -> None:
        self._about = json.loads(json_text(dict(about) | {"settings": asdict(config)}))
        super().__init__(folder, own=lambda place: OWN_FILES if is_run(place) else None)
        self._date = datetime.now(UTC).isoformat(timespec="seconds")
        self.steps: list[dict[str, Any]] = []
        self._scores: list[Mapping[str, Any]] = []
        self.more: dict[str, Any] = {}
        self.files: dict[str, bytes] = {}

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
        number, labels = len(self.steps), step.labels
        if labels.size and not 0 <= labels.min() <= labels.max() <= SUPPORT_LABEL:
            reason = f"labels are not all within 0…{SUPPORT_LABEL}"
            raise InputError(step.name, reason, "number objects from 1, 0 = no object")
        document = {"view": number, "name": step.name} | _summary(step)
        stored = _with_cloud(step, np.float32)
        parts = {f.name: getattr(stored, f.name) for f in fields(stored) if f.name != "graph"}
        graph, about = graph_text(step.graph).encode(), json_text(document).encode()
        files = {"graph.json": graph, "view.json": about, "step.npz": images.pack(parts)}
        if labels.ndim == 2:
            files["labels.png"] = images.png(labels.astype(np.uint16))
        else:
            files["labels.npy"] = images.npy(labels.astype(np.int32))
        for name, content in files.items():
            self.write(f"{_view_folder(number)}/{name}", content)
        names = ("timings", "angle_travelled", "path_travelled", "stop")
        self.steps.append({"view": step.index} | {name: getattr(step, name) for name in names})
        self._scores += [] if score is None else [score]
        self.files["graph.json"] = graph

    def __exit__(self, kind: object = BaseException, *error: object) -> None:
        """Write the rest and publish the folder; after an error, remove what was written."""
        interrupted = kind is KeyboardInterrupt and len(self.steps) > 0
        try:
            if kind in (None, GoalError) and self.steps:
                self._finish({})
            elif interrupted:
                self._finish({"interrupted": True})
        finally:
            super().__exit__()
        if interrupted:
            count = "1 view is" if len(self.steps) == 1 else f"{len(self.steps)} views are"
            remedy = f"`caryatid report {self.folder}` writes the report"
            raise KeyboardInterrupt(f"{count} kept in {self.folder}; {remedy}") from None

    def _finish(self, more: dict[str, Any]) -> None:
        """Write the files of the whole run, run.json last, and publish the folder."""
        document = {"format": FORMAT, "version": 2, "views": len(self.steps)} | self._about
        document["date"] = self._date
        packages = {name: version(name) for name in ("caryatid", *LIBRARIES)}
        document["versions"] = {"python": platform.python_version()} | packages
        document |= {name: self.steps[-1][name] for name in ("angle_travelled", "path_travelled")}
        document["steps"] = self.steps
        document |= ({"scores": self._scores} if self._scores else {}) | self.more | more
        shutil.rmtree(self._partial / _view_folder(len(self.steps)), ignore_errors=True)  # of Ctrl-C
        self.files["run.json"] = json_text(document).encode()
        for path, content in self.files.items():
            self.write(path, content)
        self.files = {}
        self.publish()


@dataclass(frozen=True, eq=False)
class RunView:
    """A view of a run, whose files are read when needed; a missing or broken one raises `InputError`.

    Attributes:
        folder: Its folder, `views/NN`.
    """

    folder: Path

    @cached_property
    def record(self) -> dict[str, Any]:
        """All of view.json."""
        return read_json(self.folder / "view.json", AGAIN)

    @property
    def name(self) -> str:
        """The view's name, which identifies a recording's frame."""
        return parse_json(_ViewFile, self.record, self.folder / "view.json", AGAIN).name

    @cached_property
    def graph(self) -> SupportGraph:
        """The fused graph after this view."""
        return read_graph(self.folder / "graph.json")

    def load_labels(self) -> NDArray[np.int32]:
        """Read the label image (H, W), or the labels (N,) of a cloud's points.

        Raises:
            InputError: The file is missing or broken.
        """
        path = self.folder / "labels.npy"
        if not path.exists():
            return images.read_units(self.folder / "labels.png")
        labels = images.read_npy(path)
        if labels.ndim != 1 or labels.dtype.kind not in "iu":
            raise InputError(path, "not an array of integers (N,)", AGAIN)
        return labels.astype(np.int32)

    def load_step(self) -> Step:
        """Read the whole step.

        Raises:
            InputError: The file is missing or broken.
        """
        path, remedy = self.folder / "step.npz", "explore again"
        with read_errors(path, remedy):
            content = path.read_bytes()
        try:
            return _with_cloud(Step(**images.unpack(content, PARTS), graph=self.graph), np.float64)
        except Exception as error:  # a damaged archive raises almost anything
            raise InputError(path, f"not a step of a run ({' '.join(str(error).split())})", remedy) from error


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
    """run.json; runs of version 1, of caryatid 0.1.0, kept no steps."""

    format: Literal["caryatid/run"]
    version: Literal[2]
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
    """Read a run folder; the files of its views are read when needed.

    Raises:
        InputError: It is not a run folder, or a file of the whole run is missing or broken.
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
    views = tuple(RunView(folder / _view_folder(index)) for index in range(file.views))
    return Run(folder, record, views[-1].graph, views)


def read_steps(run: Run) -> Iterator[Step]:
    """Read the steps of a run, one after the other.

    Raises:
        InputError: A step is missing or broken.
    """
    return (view.load_step() for view in run.views)


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


def _exists(folder: Path) -> bool:
    """Whether a folder exists; if a kill while it was being replaced hid it, it is restored."""
    if not folder.is_dir():
        recover(folder)
    return folder.is_dir()


def _view_folder(index: int) -> str:
    return f"views/{index:02d}"


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


def _with_cloud(step: Step, dtype: type[np.floating[Any]]) -> Step:
    """The step with points and normals of another precision."""
    cloud = step.cloud
    points_world, normals_world = cloud.points_world.astype(dtype), cloud.normals_world.astype(dtype)
    return replace(step, cloud=replace(cloud, points_world=points_world, normals_world=normals_world))
