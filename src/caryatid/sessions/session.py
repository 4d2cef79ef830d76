"""A session: a scene model in a folder, to which views are added one by one.

    DIR/session.json           settings, seed, planner and robot
    DIR/views/NNNNNN/          one view: its images, and camera.json; the record
    DIR/reports/NNNNNN.json    an object that the robot removed or moved
    DIR/state/NNNNNN.pickle    the scene after so many views and reports; a cache, which may be deleted
    DIR/lock                   locked by the process that writes

Views and reports are written completely, then renamed into place; removal also starts with a rename.
"""

from __future__ import annotations

import hashlib
import json
import logging
import pickle
import threading
from base64 import b64encode
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from io import BufferedIOBase
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np
from annotated_types import Ge
from filelock import FileLock, Timeout
from numpy.typing import ArrayLike, NDArray
from pydantic import Base64Bytes

from caryatid.config import Config, SegmentationMethod
from caryatid.errors import InputError, NoSurfaceError, PlanningError
from caryatid.exploration import (
    Explorer,
    Step,
    given_candidates,
    next_best_view,
    reason_to_stop,
    used_up,
)
from caryatid.geometry.transforms import Array, as_rigid
from caryatid.graph import Change, SupportGraph
from caryatid.io.graph_json import graph_text, graph_to_json
from caryatid.io.images import png, read_mask
from caryatid.io.json_files import Numbers, parse_json, read_json
from caryatid.io.staging import (
    StagedFolder,
    read_errors,
    recover,
    remove_file,
    remove_folder,
    staged_file,
    sync,
    write_errors,
    write_file,
)
from caryatid.planning.decision import PlanningState
from caryatid.planning.planners import make_planner
from caryatid.robots import HUMANOID, Surroundings, find_robot, view_sphere_of
from caryatid.runtime import fingerprint
from caryatid.scene import KEPT, Scene
from caryatid.segmentation.view_checks import described
from caryatid.sensing.views import View
from caryatid.sessions.captures import CameraRecord, Capture
from caryatid.sessions.next_view import REFUSED, NextView, reached_candidates, table_floor

FORMAT: Final = {"format": "caryatid/session", "version": 1}
"""How session.json begins."""

KNOWN: Final = {
    ("builtins", "set"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}
"""What a snapshot may contain of other packages."""
ORIGINS: Final = {"config", "geometry", "graph", "objects", "scene", "segmentation", "sensing"}
"""Parts of caryatid whose types it may contain. No other type is restored: a foreign session runs no code."""


class SessionConflictError(InputError):
    """The session is not in the state that the request expects: its folder is taken, or views differ."""


class SessionBusyError(SessionConflictError):
    """Another process is writing to the session."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """Options of a session.

    Attributes:
        segmentation: `labels`, `auto`, or None to use labels if the first view has them.
        seed: Seed of every random choice.
        planner: Name of the planner that chooses the next view.
        robot: Name of the robot that takes it.
        settings: All settings.
        ignore: PNG whose pixels other than 0 are ignored in every view, or None.
    """

    segmentation: SegmentationMethod | None
    seed: Annotated[int, Ge(0)]
    planner: str
    robot: str
    settings: Config
    ignore: Base64Bytes | None = None

    def to_json(self) -> str:
        """Return the text of session.json."""
        document = FORMAT | {"caryatid": version("caryatid")} | asdict(self)
        return json.dumps(document, indent=1, default=lambda image: b64encode(image).decode()) + "\n"

    @classmethod
    def read(cls, path: Path) -> Beginning:
        """Read session.json.

        Raises:
            InputError: It is missing, of another format, or has settings unknown to this release.
        """
        if not path.is_file():
            raise InputError(path.parent, "not a session", "create one with `caryatid session new`")
        document = read_json(path)
        release = document.get("caryatid", "0.1.0")  # the first release did not say which it was
        try:
            if not FORMAT.items() <= document.items():
                raise InputError(path, f"wrong format, expected {FORMAT}")
            return parse_json(cls, document, path)
        except InputError as error:
            reason = f"created by caryatid {release}, incompatible with this release ({error.reason})"
            remedy = "open it with that release, or add its views to a new session"
            raise InputError(path, reason, remedy) from None


@dataclass(frozen=True, eq=False, slots=True)
class Added:
    """Result of adding a view.

    Attributes:
        number: Number of the view, from 0.
        graph: The fused support graph with it.
        changed: Whether it changed the graph.
        T_world_camera: Registered camera pose (4, 4), or None while the view waits.
        warnings: What may be wrong with the view, or why it waits; one sentence each.
        changes: Changes of objects since the previous view, seen or reported.
    """

    number: int
    graph: SupportGraph
    changed: bool
    T_world_camera: Array | None = None
    warnings: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the answer of `caryatid session add` and of the service."""
        pose = None if self.T_world_camera is None else self.T_world_camera.tolist()
        document = {"view": self.number, "changed": self.changed, "T_world_camera": pose}
        known = {"warnings": list(self.warnings), "changes": [asdict(change) for change in self.changes]}
        return document | known | {"graph": graph_to_json(self.graph)}


@dataclass(frozen=True, eq=False, slots=True)
class Moved:
    """moved.json: the motion of an object.

    Attributes:
        T: Rigid transform (4, 4) in the world frame [m].
    """

    T: Annotated[Array, Numbers(4, 4, rigid=True)]


@dataclass(frozen=True, eq=False, slots=True)
class Report:
    """Report of an object that the robot removed or moved.

    Attributes:
        object: Id of the object.
        after: Number of views before the report.
        T: The object's motion as a rigid transform (4, 4) in the world frame, or None if it was removed.
    """

    object: str
    after: Annotated[int, Ge(0)]
    T: Annotated[Array, Numbers(4, 4, rigid=True)] | None = None

    def to_json(self) -> bytes:
        """Return the content of its file."""
        return (json.dumps(asdict(self), default=np.ndarray.tolist) + "\n").encode()

    def apply(self, scene: Scene) -> None:
        """Apply the report to a scene.

        Raises:
            InputError: The scene does not have the object.
        """
        if self.T is None:
            scene.removed(self.object)
        else:
            scene.moved(self.object, self.T)


Event = CameraRecord | Report
"""A view, or a report."""


class Session:
    """A scene model in a folder, created by `begin` or opened by `open`.

    A view is on disk before `add` returns, and a report before `take` returns, so no crash or power failure
    loses it. Only one process writes at a time; others may read meanwhile.

    Attributes:
        path: The folder.
        beginning: Options of the session.
        scene: The scene model; do not update it.
    """

    def __init__(self, path: Path, beginning: Beginning, lock: FileLock | None) -> None:
        self.path = path
        self.beginning = beginning
        self._lock = lock
        mask = beginning.ignore
        most, name = beginning.settings.recording.max_pixels, f"{path / 'session.json'}: ignore"
        self._ignored = None if mask is None else read_mask(mask, name, most)
        if lock is not None:
            recover(path)
        self._events = self._kept()
        self._first = self._decoded(0) if self._records else None
        self.scene = self._after(self._events)
        waiting = self.scene.waiting
        self._warnings: Sequence[str] = [KEPT % "no view shows a support surface yet"] if waiting else []

    @classmethod
    def begin(
        cls,
        path: str | PathLike[str],
        config: Config | None = None,
        *,
        segmentation: SegmentationMethod | None = None,
        seed: int = 0,
        planner: str = "support",
        robot: str = HUMANOID,
        ignore: NDArray[np.bool_] | None = None,
    ) -> Session:
        """Create a session in a new or empty folder, and open it for writing.

        Args:
            path: The folder.
            config: All settings.
            segmentation: `labels` requires them in every view, `auto` ignores them, None uses them if the
                first view has them.
            seed: Seed of every random choice.
            planner: Name of the planner that chooses the next view.
            robot: Name of the robot that takes it, as for `find_robot`; the table is the only obstacle on
                its floor.
            ignore: Pixels (H, W) to ignore in every view, such as those of the robot's arm, or None.

        Raises:
            InputError: The folder is not empty or cannot be written, the planner or robot is unknown, or an
                option of the scene is invalid.
        """
        make_planner(planner)
        find_robot(robot)
        mask = None if ignore is None else png(np.asarray(ignore, dtype=np.uint8))
        Scene(config, segmentation=segmentation, seed=seed)  # refuse what a scene refuses
        beginning = Beginning(segmentation, int(seed), planner, robot, config or Config(), mask)
        folder = Path(path)
        with write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            known = *folder.iterdir(), *folder.glob("views/*")
            taken = any(p.name not in ("views", "lock") and p.name[0] != "." for p in known)
        path = folder / "session.json"
        conflict = "already contains a session or other files", "use that session, or give a new folder"
        if taken:
            raise SessionConflictError(folder, *conflict)
        with ExitStack() as failure:
            lock = failure.enter_context(_locked(folder / "lock"))
            if path.exists():
                raise SessionConflictError(folder, *conflict)
            with write_errors(folder):
                (folder / "views").mkdir(exist_ok=True)
            write_file(path, beginning.to_json().encode(), durable=True)
            sync(folder.resolve().parent)
            session = cls(folder, beginning, lock)
            failure.pop_all()
            return session

    @classmethod
    def open(cls, path: str | PathLike[str], *, read_only: bool = False) -> Session:
        """Open a session with all its views.

        Args:
            path: Folder of the session.
            read_only: Do not write; another process may be writing to it.

        Raises:
            SessionBusyError: Another process has it open for writing.
            InputError: The folder is not a session, or a view is broken.
        """
        folder = Path(path)
        beginning = Beginning.read(folder / "session.json")
        if read_only:
            with suppress(InputError):  # a writer may have undone a view just now
                return cls(folder, beginning, None)
            return cls(folder, beginning, None)
        with ExitStack() as failure:
            session = cls(folder, beginning, failure.enter_context(_locked(folder / "lock")))
            failure.pop_all()
            return session

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock, so that other processes can write."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    @property
    def _records(self) -> list[CameraRecord]:
        return [event for event in self._events if isinstance(event, CameraRecord)]

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self._records)

    @property
    def reports(self) -> int:
        """Number of reports."""
        return len(self._events) - self.views

    @property
    def graph(self) -> SupportGraph:
        """The fused support graph."""
        return self.scene.graph

    def add(self, view: View | Capture, number: int | None = None) -> Added:
        """Add a view; once this returns, the view is on disk.

        Args:
            view: A view, decoded or not. Only the first view may lack a pose.
            number: Number of the view, from 0; None = the next one. The last view is not added twice, so a
                client that missed the answer can send it again.

        Raises:
            SessionConflictError: The view would get another number.
            InputError: The view cannot be used; the session does not change.
            PerceptionError: It has no readings; the session does not change.
        """
        self._check_writable()
        capture = Capture.of(view) if isinstance(view, View) else view
        record = capture.record
        if number is not None and number != self.views:
            if not 0 <= number == self.views - 1 or record.digest != self._records[-1].digest:
                reason = f"has number {number}, but the next view is {self.views}"
                raise SessionConflictError(record.name, reason)
            return self._added()
        decoded = self._decode(capture)
        self._check_alike(decoded)
        scene = self.scene.copy()
        with _collected_warnings() as warnings:
            graph_text(scene.update(decoded))  # reject a view whose graph cannot be written
        with StagedFolder(self._folder(self.views), durable=True) as folder:
            for name, content in capture.files().items():
                folder.write(name, content)
            folder.publish()
        self._keep(record, scene)
        self._first = self._first or decoded
        self._warnings = warnings
        return self._added()

    def take(self, object_id: str, T: ArrayLike | None = None, number: int | None = None) -> SupportGraph:
        """Report that the robot removed or moved an object; once this returns, the report is on disk.

        Args:
            object_id: Id of the object.
            T: The object's motion as a rigid transform (4, 4) in the world frame; None = removed.
            number: Number of the report, from 0; None = the next one. The newest report is not repeated, so a
                client that missed the answer can send it again.

        Returns:
            The graph without the object, or with it at its new pose.

        Raises:
            SessionConflictError: The report would get another number.
            InputError: The object is unknown, or T is not a rigid transform; the session does not change.
        """
        self._check_writable()
        report = Report(object_id, self.views, None if T is None else as_rigid(T, "T"))
        if number is not None and number != self.reports:
            newest = self._events[-1] if 0 <= number == self.reports - 1 else None
            if not isinstance(newest, Report) or newest.to_json() != report.to_json():
                reason = f"has number {number}, but the next report is {self.reports}"
                raise SessionConflictError("report", reason)
            return self.graph
        scene = self.scene.copy()
        report.apply(scene)
        graph_text(scene.graph)
        with write_errors(self.path):
            (self.path / "reports").mkdir(exist_ok=True)
            sync(self.path)
        write_file(self._report(self.reports), report.to_json(), durable=True)
        self._keep(report, scene)
        return self.graph

    def _keep(self, event: Event, scene: Scene) -> None:
        """Continue with a scene that was updated with an event, which is on disk."""
        self._events.append(event)
        self.scene = scene
        self._write_snapshot(scene, self._events)

    def next(
        self,
        candidates: ArrayLike | None = None,
        path_length: ArrayLike | None = None,
        *,
        refused: Iterable[ArrayLike] = (),
    ) -> NextView:
        """Plan the next best view.

        Args:
            candidates: Reachable camera poses (N, 4, 4); None = those that the session's robot reaches, with
                the table as the only obstacle.
            path_length: Path length (N,) [m] to each candidate; None = straight lines.
            refused: Camera poses (4, 4) of earlier answers to which the robot cannot go; not with candidates.

        Raises:
            PlanningError: The session has no views, or no view is reachable.
            InputError: The candidates are not poses, or refused poses are given with them.
        """
        sphere, robot = self.scene.sphere, None
        if sphere is None:
            raise PlanningError("no view shows a table top yet; add one that does")
        poses = [record.T_world_camera for record in self._records]
        T_world_cameras = np.stack([self.scene.T_world_cameras[0] if T is None else T for T in poses])
        if candidates is not None:
            reachable = given_candidates(candidates, path_length, T_world_cameras[-1], sphere)
        else:
            place = Surroundings(sphere.centre_world, table_floor(self.scene), self.scene.config)
            robot = find_robot(self.beginning.robot)(place)
            sphere = view_sphere_of(robot, sphere)
            reachable = reached_candidates(robot, T_world_cameras[-1], sphere)
        for number, T in enumerate(refused):
            if robot is None:
                raise InputError("refused", "is given with candidates", "omit them from the candidates")
            reachable = reachable.without(as_rigid(T, f"refused[{number}]"), REFUSED)
        visited = sphere.direction_of(T_world_cameras)
        planner = make_planner(self.beginning.planner)
        decision = next_best_view(self.scene, robot, visited, candidates=reachable, planner=planner)
        assert self.scene.voxels is not None
        state = PlanningState(
            self.scene.graph, sphere, self.scene.voxels, visited, reachable, self.scene.config.active
        )
        reports = [number for number, event in enumerate(self._events, start=1) if isinstance(event, Report)]
        stop = used_up(len(self._events) - max(reports, default=0), state.config)
        stop = stop or reason_to_stop(state, self.scene.changed, planner, decision)
        return NextView(self.views, decision, stop)

    def replay(self) -> Iterator[Step]:
        """Compute the views again, and yield a step after each; the last one has the graph as it is now.

        Raises:
            InputError: No view shows a support surface, or a view is broken.
        """
        b, number, newest = self.beginning, 0, None
        explorer = Explorer(config=b.settings, segmentation=b.segmentation, seed=b.seed)
        scene = explorer.scene
        for event in self._events:
            if isinstance(event, Report):
                event.apply(scene)
                continue
            with suppress(NoSurfaceError):  # the view is kept until a later one shows the surface
                for step in explorer.looks(self._decoded(number)):
                    if newest is not None:
                        yield newest
                    newest = step
            number += 1
        if newest is None:
            raise InputError(self.path, "no view shows a table top yet", "add one that does")
        reported = "; ".join(str(change) for change in scene.changes if change.view == scene.views)
        stop = f"after the last view, {reported}" if reported else None
        yield replace(newest, graph=scene.graph, cloud=scene.cloud, stop=stop)

    def undo(self) -> int:
        """Undo the last view, or the last report after it.

        Returns:
            Number of views left.

        Raises:
            InputError: The session has no views, or an earlier one is broken; the session does not change.
        """
        self._check_writable()
        if not self._events:
            raise SessionConflictError(self.path, "has nothing to undo", "add a view first")
        left = self._events[:-1]
        scene = self._after(left)
        if isinstance(self._events[-1], Report):
            remove_file(self._report(len(left) - self.views))
        else:
            remove_folder(self._folder(self.views - 1))
        self._events, self.scene, self._warnings = left, scene, []
        self._first = self._first if self._records else None
        return self.views

    def _added(self) -> Added:
        scene, warnings = self.scene, tuple(self._warnings)
        pose, changes = (None, ()) if scene.waiting else (scene.T_world_camera, scene.new_changes)
        return Added(self.views - 1, self.graph, scene.changed, pose, warnings, changes)

    def _check_writable(self) -> None:
        if self._lock is None:
            raise InputError(self.path, "is closed or read-only", "open it for writing")

    def _check_alike(self, view: View) -> None:
        """Reject a view whose labels or camera do not match those of the first view."""
        first = self._first
        if self.beginning.segmentation == "labels" and view.labels is None:
            remedy = "give a label image, or create a session with --segmentation auto"
            raise InputError(view.name, "has no labels", remedy)
        if first is None:
            return
        same_size = view.depth.shape == first.depth.shape
        if not same_size or not np.allclose(view.K, first.K, atol=1e-3 * float(first.K[0, 0])):
            reason = f"its camera has {described(view)}, but that of earlier views has {described(first)}"
            raise InputError(view.name, reason, "use the same camera, or create a new session")

    def _folder(self, number: int) -> Path:
        return self.path / "views" / f"{number:06d}"

    def _report(self, number: int) -> Path:
        return self.path / "reports" / f"{number:06d}.json"

    def _kept(self) -> list[Event]:
        folders, reported = _numbered(self.path / "views"), self.path / "reports"
        files = _numbered(reported) if reported.exists() else []
        for found, place, what in ((folders, self._folder, "view"), (files, self._report, "report")):
            for number, path in enumerate(found):
                if path != place(number):
                    remedy = "restore it, or delete the later ones"
                    raise InputError(path.parent, f"{what} {number:06d} is missing", remedy)
        records = [CameraRecord.read(folder / "camera.json") for folder in folders]
        remedy = "delete this report and all later ones from the session folder"
        reports = [parse_json(Report, read_json(path, remedy), path, remedy) for path in files]
        if self._lock is not None and any(report.after > len(records) for report in reports):
            reason, remedy = "some belong to missing views", "restore these views, or delete these reports"
            raise InputError(self.path / "reports", reason, remedy)
        events: list[Event] = []
        # Reports of views that another process has just added are left to the next reader.
        for number in range(len(records) + 1):
            events += [report for report in reports if report.after == number]
            events += records[number : number + 1]
        return events

    def _decoded(self, number: int) -> View:
        return self._decode(Capture.read(self._folder(number)))

    def _decode(self, capture: Capture) -> View:
        view = capture.decode(self.beginning.settings.recording.max_pixels)
        return view if self._ignored is None else replace(view, ignored=self._ignored)

    def _after(self, events: Sequence[Event]) -> Scene:
        """The scene after some events, from the newest usable snapshot and what came after it."""
        b = self.beginning
        done, scene = self._read_snapshot(events)
        scene = scene or Scene(b.settings, segmentation=b.segmentation, seed=b.seed)
        views = sum(isinstance(event, CameraRecord) for event in events[:done])
        for number, event in enumerate(events[done:], start=done):
            if isinstance(event, Report):
                event.apply(scene)
            else:
                scene.update(self._decoded(views))
                views += 1
            if self._lock is not None:
                self._write_snapshot(scene, events[: number + 1])
        return scene

    def _read_snapshot(self, events: Sequence[Event]) -> tuple[int, Scene | None]:
        """The newest snapshot that this code made of the first of these events, and their number."""
        for number in range(len(events), 0, -1):
            # A damaged file may raise anything, and the events are still there.
            with suppress(Exception), self._snapshot(number).open("rb") as file:
                if file.read(32) == self._seal(events[:number], file):
                    file.seek(32)
                    scene = _Unpickler(file).load()
                    if isinstance(scene, Scene):
                        return number, scene
        return 0, None

    def _write_snapshot(self, scene: Scene, events: Sequence[Event]) -> None:
        """Keep the scene of all events and the seven before it; a failure costs only time."""
        with suppress(Exception):
            path = self._snapshot(len(events))
            path.parent.mkdir(exist_ok=True)
            with staged_file(path) as file:
                file.write(bytes(32))
                pickle.dump(scene, file, protocol=5)
                file.seek(32)
                seal = self._seal(events, file)
                file.seek(0)
                file.write(seal)
            kept = {self._snapshot(len(events) - back) for back in range(8)}
            for older in set(path.parent.iterdir()) - kept:
                older.unlink()

    def _snapshot(self, events: int) -> Path:
        return self.path / "state" / f"{events:06d}.pickle"

    def _seal(self, events: Sequence[Event], file: BufferedIOBase) -> bytes:
        """Digest of the code and the events that made a snapshot, and of the rest of its file."""
        told = (e.digest if isinstance(e, CameraRecord) else e.to_json().decode() for e in events)
        made_of = " ".join((fingerprint(), self.beginning.to_json(), *told))
        digest = hashlib.sha256(made_of.encode() + b"\0")
        return hashlib.file_digest(file, lambda: digest).digest()


def _numbered(folder: Path) -> list[Path]:
    """The numbered files and folders in a folder, in order."""
    with read_errors(folder, "restore this folder"):
        return sorted(p for p in folder.iterdir() if p.name[0].isdigit())


def _locked(path: Path) -> FileLock:
    """Lock out other writers until the lock is released or this process ends."""
    lock = FileLock(path, timeout=0, thread_local=False)
    with write_errors(path):
        try:
            lock.acquire()
        except Timeout:
            remedy = "wait until it finishes, or stop it"
            raise SessionBusyError(path.parent, "in use by another process", remedy) from None
    return lock


class _Unpickler(pickle.Unpickler):
    """Restores only arrays and the parts of a scene."""

    def find_class(self, module: str, name: str) -> Any:
        known, origin = (module, name) in KNOWN, module.split(".")[:2]
        if known or (origin[0] == "caryatid" and origin[-1] in ORIGINS):
            found = super().find_class(module, name)
            if known or (isinstance(found, type) and found.__module__ == module):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is not part of a scene")


@contextmanager
def _collected_warnings() -> Iterator[list[str]]:
    """Collect the package's warnings that this thread logs."""
    texts: list[str] = []
    handler, thread = logging.Handler(logging.WARNING), threading.get_ident()
    handler.addFilter(lambda record: record.thread == thread)
    handler.emit = lambda record: texts.append(record.getMessage())  # type: ignore[method-assign]
    log = logging.getLogger("caryatid")
    log.addHandler(handler)
    try:
        yield texts
    finally:
        log.removeHandler(handler)
