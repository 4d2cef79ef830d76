"""A session: a scene model in a folder, to which views are added one by one.

    DIR/session.json           settings, seed, planner and robot
    DIR/views/NNNNNN/          one view: its images, and camera.json; the record
    DIR/state/NNNNNN.pickle    the scene after so many views; a cache, which may go at any time
    DIR/lock                   locked by the process that writes

A view's folder appears whole, once it is on the disk, by a rename, and goes by one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np
from annotated_types import Ge
from filelock import FileLock, Timeout
from numpy.typing import ArrayLike

from caryatid.config import Config, SegmentationMethod
from caryatid.errors import InputError
from caryatid.exploration import reason_to_stop
from caryatid.graph import SupportGraph
from caryatid.io.graph_json import graph_text
from caryatid.io.json_files import parse_json, read_json
from caryatid.io.staging import StagedFolder, clear_partials, remove_folder, sync, write_errors, write_file
from caryatid.planning.planners import make_planner
from caryatid.robots import HUMANOID, find_robot
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.sessions.captures import CameraRecord, Capture
from caryatid.sessions.checks import check_view
from caryatid.sessions.next_view import NextView, Reachable, plan_next
from caryatid.sessions.snapshots import Snapshots, State

FORMAT: Final = "caryatid/session"
VERSION: Final = 1
"""Format of session.json."""


class TakenError(InputError):
    """The folder of a new session holds something already."""


class SessionBusyError(InputError):
    """Another process writes to the session."""


class WrongNumberError(InputError):
    """A view has another number than the next one."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """What a session was begun with.

    Attributes:
        segmentation: `labels`, `auto`, or None to use labels where the first view has them.
        seed: Seed of every random choice.
        planner: Name of the planner that chooses the next view.
        robot: Name of the robot that takes it.
        settings: All settings.
    """

    segmentation: SegmentationMethod | None
    seed: Annotated[int, Ge(0)]
    planner: str
    robot: str
    settings: Config

    def to_json(self) -> dict[str, Any]:
        """Return the document of session.json."""
        return {"format": FORMAT, "version": VERSION, "caryatid": version("caryatid")} | asdict(self)

    @classmethod
    def read(cls, path: Path) -> Beginning:
        """Read session.json.

        Raises:
            InputError: It is missing, of another format, or its settings are not those of this release.
        """
        if not path.is_file():
            raise InputError(path.parent, "holds no session", "begin one with `caryatid session new`")
        document = read_json(path)
        release = document.get("caryatid", "0.1.0")  # the first release did not say which it was
        if document.get("format") != FORMAT or document.get("version") != VERSION:
            reason = f"is no '{FORMAT}' of version {VERSION}; caryatid {release} wrote it"
            raise InputError(path, reason, "use the release that wrote it")
        try:
            return parse_json(cls, document, path)
        except InputError as error:
            reason = f"was begun with caryatid {release} and does not fit this release ({error.reason})"
            remedy = "open it with that release, or add its views to a new session"
            raise InputError(path, reason, remedy) from None


@dataclass(frozen=True, eq=False, slots=True)
class Added:
    """Result of adding a view.

    Attributes:
        number: Number of the view, 0 the first.
        graph: The fused support graph with it.
        changed: Whether it changed the graph.
    """

    number: int
    graph: SupportGraph
    changed: bool


class Session:
    """A scene model in a folder; `begin` or `open` one.

    A view that has been added stays, whatever happens to this process, the machine or its power: it is on
    the disk before `add` returns. There is one writer at a time; others may read meanwhile.
    """

    def __init__(self, path: Path, beginning: Beginning, lock: FileLock | None) -> None:
        self.path = path
        self.beginning = beginning
        self._lock = lock
        if lock is not None:
            for folder in (path, path / "views", path / "state"):
                clear_partials(folder)
        self._snapshots = Snapshots(path / "state", json.dumps(asdict(beginning)))
        self._views = self._kept()
        self._first = self._decoded(0) if self._views else None
        self._state = self._restored(self._views)

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
    ) -> Session:
        """Begin a session in a new or empty folder, to write to it.

        Args:
            path: The folder.
            config: All settings.
            segmentation: `labels` demands them of every view, `auto` ignores them, None takes them where the
                first view has them.
            seed: Seed of every random choice.
            planner: Name of the planner that chooses the next view.
            robot: Name of the robot that takes it, as `find_robot` knows it; it stands by the table, with
                nothing else on its floor.

        Raises:
            InputError: The folder holds something, there is no such planner or robot, or nothing can be
                written there.
        """
        make_planner(planner)
        find_robot(robot)
        folder = Path(path)
        with write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            if (folder / "session.json").exists():
                raise TakenError(folder, "holds a session already", "use that one, or give another folder")
            others = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
            if others - {"views", "state", "lock"}:
                raise TakenError(folder, "already exists and holds other files", "give a new folder")
            for name in ("views", "state"):
                (folder / name).mkdir(exist_ok=True)
        beginning = Beginning(segmentation, seed, planner, robot, config or Config())
        text = json.dumps(beginning.to_json(), indent=1) + "\n"
        write_file(folder / "session.json", text.encode(), durable=True)
        sync(folder.resolve().parent)
        return cls.open(folder)

    @classmethod
    def open(cls, path: str | PathLike[str], *, read_only: bool = False) -> Session:
        """Open a session with all its views.

        Args:
            path: Its folder.
            read_only: Leave the folder as it is; another process may be writing to it.

        Raises:
            SessionBusyError: Another writer has it open.
            InputError: It is no session, or a view is broken.
        """
        folder = Path(path)
        beginning = Beginning.read(folder / "session.json")
        lock = None if read_only else _locked(folder / "lock")
        try:
            return cls(folder, beginning, lock)
        except BaseException:
            if lock is not None:
                lock.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Let others write."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self._views)

    @property
    def scene(self) -> Scene:
        """What is known; not to be updated."""
        return self._state.scene

    @property
    def graph(self) -> SupportGraph:
        """The fused support graph."""
        return self._state.scene.graph

    def add(self, view: View | Capture, number: int | None = None) -> Added:
        """Add a view; when this returns, it is on the disk.

        Args:
            view: A view with a pose, or one that is not decoded yet.
            number: Number the view is meant to have, 0 the first. The last view is not added a second time,
                so a client that missed the answer can send it again. None = the next one.

        Raises:
            WrongNumberError: It would have another number.
            InputError: The view cannot be used; the session is as it was.
            PerceptionError: Nothing can be perceived in it; the session is as it was.
        """
        self._check_writable()
        capture = Capture.of(view) if isinstance(view, View) else view
        if number is not None and number != self.views:
            if number == self.views - 1 and capture.record.digest == self._views[-1].digest:
                return Added(number, self.graph, self._state.changed)
            raise WrongNumberError(
                capture.camera.name, f"is to be view {number}, the next one is view {self.views}"
            )
        decoded = capture.decode(self.beginning.settings.session)
        check_view(decoded, self.scene, self._first)
        state = self._state.after(decoded)
        graph_text(state.scene.graph)  # a view whose graph cannot be written is refused, and not kept
        folder = StagedFolder(self._folder(self.views), durable=True)
        for name, content in capture.files().items():
            folder.write(name, content)
        folder.publish()
        self._views.append(capture.record)
        self._first = self._first or decoded
        self._state = state
        self._snapshots.write(state, [v.digest for v in self._views])
        return Added(self.views - 1, state.scene.graph, state.changed)

    def next(self, candidates: ArrayLike | None = None, path_length: ArrayLike | None = None) -> NextView:
        """Choose where to look next.

        Args:
            candidates: Camera poses (N, 4, 4) that can be reached; None = those the session's robot reaches,
                on a floor with nothing but the table on it.
            path_length: Path length (N,) [m] to each candidate; None = straight lines.

        Raises:
            PlanningError: There is no view yet, or none can be reached.
            InputError: Candidates are no poses.
        """
        beginning, reachable = self.beginning, None
        if candidates is not None:
            lengths = None if path_length is None else np.asarray(path_length, dtype=np.float64)
            reachable = Reachable(np.asarray(candidates, dtype=np.float64).reshape(-1, 4, 4), lengths)
        stop = reason_to_stop(self.views, self._state.changed, beginning.settings.active)
        poses = [v.T_world_camera for v in self._views]
        return plan_next(self.scene, poses, beginning.planner, reachable, stop, beginning.robot)

    def undo(self) -> int:
        """Remove the last view.

        Returns:
            How many views are left.

        Raises:
            InputError: There is none, or an earlier one is broken; the session is as it was.
        """
        self._check_writable()
        if not self._views:
            raise InputError(self.path, "has no views to take back", "add one first")
        left = self._views[:-1]
        state = self._restored(left)
        remove_folder(self._folder(len(left)))
        self._views, self._state = left, state
        self._first = self._first if left else None
        return len(left)

    def _check_writable(self) -> None:
        if self._lock is None:
            raise InputError(self.path, "is closed, or open to be read only", "open it again to change it")

    def _folder(self, number: int) -> Path:
        return self.path / "views" / f"{number:06d}"

    def _kept(self) -> list[CameraRecord]:
        """The cameras of the views that are kept, in order."""
        folders = sorted((self.path / "views").glob("[0-9]*"))
        for number, folder in enumerate(folders):
            if folder != self._folder(number):
                remedy = "put it back, or take the later ones out"
                raise InputError(folder.parent, f"holds no view {number:06d}", remedy)
        return [CameraRecord.read(folder / "camera.json") for folder in folders]

    def _decoded(self, number: int) -> View:
        return Capture.read(self._folder(number)).decode(self.beginning.settings.session)

    def _restored(self, views: Sequence[CameraRecord]) -> State:
        """The state after some views, from the newest usable snapshot and the views after it."""
        digests = [view.digest for view in views]
        state = next(self._snapshots.read(digests), None)
        if state is None:
            b = self.beginning
            state = State(Scene(b.settings, segmentation=b.segmentation, seed=b.seed))
        for number in range(state.scene.views, len(views)):
            state = state.after(self._decoded(number))
            if self._lock is not None and number + 2 >= len(views):
                self._snapshots.write(state, digests[: number + 1])
        return state


def _locked(path: Path) -> FileLock:
    """Become the only writer, until the lock is released or this process ends."""
    lock = FileLock(path, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        remedy = "wait until it is done, or stop it"
        raise SessionBusyError(path.parent, "another writer has this session open", remedy) from None
    except OSError as error:
        reason = f"cannot be locked ({error.strerror or error})"
        raise InputError(path, reason, "give a folder you may write to") from None
    return lock
