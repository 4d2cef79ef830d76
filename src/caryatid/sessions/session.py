"""A session: a scene model in a folder, to which views are added one by one.

    DIR/session.jsonl          a log: the options, then a line per view, report of a change, and undo
    DIR/views/NNNNNN.npz       one view, decoded

A view counts when its line is in the log, which is written after its file.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from annotated_types import Ge
from numpy.typing import ArrayLike, NDArray
from pydantic import Base64Bytes

from caryatid import exploration
from caryatid.config import Config, SegmentationMethod
from caryatid.errors import InputError, NoSurfaceError, PlanningError
from caryatid.exploration import Explorer, Step
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array, as_rigid
from caryatid.graph import SupportGraph
from caryatid.io.graph_json import graph_text
from caryatid.io.images import pack, png, read_mask, unpack
from caryatid.io.json_files import Numbers, parse_json
from caryatid.io.staging import LATER, Log, read_errors, recover, sync, write_errors, write_file
from caryatid.planning.candidates import Candidates
from caryatid.planning.planners import make_planner
from caryatid.robots import HUMANOID, Robot, Surroundings, find_robot, view_sphere_of
from caryatid.robots.floor import STEP, FloorGrid
from caryatid.robots.protocol import straight_lengths
from caryatid.runtime.parallel import check_budget, in_background
from caryatid.scene import KEPT, Scene
from caryatid.segmentation.diagnosis import describe_camera
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import View
from caryatid.sessions.messages import Added, Capture, NextView

SESSION_FILE: Final = "session.jsonl"
"""Name of the log."""
FORMAT: Final = {"format": "caryatid/session", "version": 2}
"""How the first line begins."""
NO_SESSION: Final = "not a session", "create one with `caryatid session new`"
"""Reason and remedy for another folder."""
RESTORE: Final = "restore this file, or delete this view and all later lines from the log"
"""Remedy for a damaged view."""
ANOTHER_RELEASE: Final = "open it with that release, or add its views to a new session"
"""Remedy for a session of another release."""
REFUSED = "the robot cannot go there"
"""Reason to reject a view that a client refuses."""


def is_session(folder: Path) -> bool:
    """Whether a folder is a session, perhaps of an earlier release."""
    return any((folder / name).is_file() for name in (SESSION_FILE, "session.json"))


class SessionConflictError(InputError):
    """The session is not in the state that the request expects: its folder is taken, or views differ."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """Options of a session, as in `Session.begin`; pixels of `ignore`, a PNG, other than 0 are ignored."""

    segmentation: SegmentationMethod | None
    seed: Annotated[int, Ge(0)]
    planner: str
    robot: str
    settings: Config
    ignore: Base64Bytes | None = None

    @classmethod
    def read(cls, line: Mapping[str, Any] | None, path: Path) -> Beginning:
        """Read the first line of a session.

        Raises:
            InputError: It is missing, of another format, or has settings unknown to this release.
        """
        if line is None:
            raise InputError(path.parent, *NO_SESSION)
        try:
            if not FORMAT.items() <= line.items():
                raise InputError(path, f"wrong format, expected {FORMAT}")
            return parse_json(cls, line, path)
        except InputError as error:
            by = f"created by caryatid {line.get('caryatid')}"
            reason = f"{by}, incompatible with this release ({error.reason})"
            raise InputError(path, reason, ANOTHER_RELEASE) from None


@dataclass(frozen=True, eq=False, slots=True)
class Event:
    """A line after the first.

    Attributes:
        kind: A view, a report that the robot removed or moved an object, or undo of the event before.
        name: Name of the view, or id of the object.
        number: Number of the view, which names its file.
        digest: Digest of this file.
        T: Camera pose (4, 4) of the view, if given; or motion (4, 4) of the object, if it was not removed.
    """

    kind: Literal["view", "report", "undo"]
    name: str = ""
    number: Annotated[int, Ge(0)] = 0
    digest: str = ""
    T: Annotated[Array, Numbers(4, 4, rigid=True)] | None = None


class Session:
    """A scene model in a folder, created by `begin` or opened by `open`.

    A view is on disk before `add` returns, and a report before `take` returns, so no crash or power failure
    loses it. Only one process writes at a time; others may read meanwhile.

    Attributes:
        path: The folder.
        beginning: Options of the session.
        scene: The scene model; do not update it.
    """

    def __init__(self, path: Path, log: Log) -> None:
        self.path = path
        self._open: tuple[str, Future[tuple[Scene, list[str]]]] | None = None
        self._log = log
        with ExitStack() as failure:
            failure.callback(log.close)
            lines = iter(log)
            self.beginning = Beginning.read(next(lines, None), log.path)
            self._events: list[Event] = []
            for number, line in enumerate(lines, start=2):
                event = parse_json(Event, line, f"{log.path}: line {number}", LATER)
                if event.kind == "undo":
                    del self._events[-1:]
                else:
                    self._events.append(event)
            mask = self.beginning.ignore
            most, name = self.beginning.settings.recording.max_pixels, f"{log.path}: ignore"
            self._ignored = None if mask is None else read_mask(mask, name, most)
            if log.writable:
                recover(path)
            self._first = self._read_view(self._views[0]) if self._views else None
            self.scene = self._after(self._events)
            failure.pop_all()
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
            sync(folder.resolve().parent)
            taken = any(not p.name.startswith(SESSION_FILE) for p in folder.iterdir())
        file = folder / SESSION_FILE
        conflict = "already contains a session or other files", "use that session, or give a new folder"
        if taken or (file.exists() and any(Log(file, "session"))):
            raise SessionConflictError(folder, *conflict)
        with ExitStack() as failure:
            log = failure.enter_context(Log(file, "session", write=True))
            if any(log):
                raise SessionConflictError(folder, *conflict)
            log.append(FORMAT | {"caryatid": version("caryatid")} | asdict(beginning))
            failure.pop_all()
            return cls(folder, log)

    @classmethod
    def open(cls, path: str | PathLike[str], *, read_only: bool = False) -> Session:
        """Open a session with all its views.

        Args:
            path: Folder of the session.
            read_only: Do not write; another process may be writing to it.

        Raises:
            BusyError: Another process has it open for writing.
            InputError: The folder is not a session, or a view is broken.
        """
        folder = Path(path)
        if not (folder / SESSION_FILE).is_file():
            if is_session(folder):
                raise InputError(folder, "is a session of an earlier caryatid", ANOTHER_RELEASE)
            raise InputError(folder, *NO_SESSION)
        if read_only:
            with suppress(InputError):  # a writer may have replaced an undone view just now
                return cls(folder, Log(folder / SESSION_FILE, "session"))
        return cls(folder, Log(folder / SESSION_FILE, "session", write=not read_only))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Let other processes write."""
        self._log.close()

    @property
    def _views(self) -> list[Event]:
        return [event for event in self._events if event.kind == "view"]

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self._views)

    @property
    def reports(self) -> int:
        """Number of reports."""
        return len(self._events) - self.views

    @property
    def graph(self) -> SupportGraph:
        """The fused support graph."""
        return self.scene.graph

    def add(self, view: View | Capture, number: int | None = None, *, budget: float | None = None) -> Added:
        """Add a view; once this returns, the view is on disk, unless the answer is `open`.

        Args:
            view: A view, decoded or not. Only the first view may lack a pose.
            number: Number of the view, from 0; None = the next one. The last view is not added twice, so a
                client that missed the answer can send it again.
            budget: Time after which this returns [s]; None = the view is in the model first. The work goes
                on in the background, and the view has to be given again to be added.

        Raises:
            SessionConflictError: The view would get another number, or another one is open.
            InputError: The view cannot be used; the session does not change.
            PerceptionError: It has no readings; the session does not change.
        """
        self._check_writable()
        if isinstance(view, Capture):
            view = view.decode(self.beginning.settings.recording.max_pixels)
        view = view if self._ignored is None else replace(view, ignored=self._ignored)
        event, content = self._packed(view)
        if number is not None and number != self.views:
            if not 0 <= number == self.views - 1 or event.digest != self._views[-1].digest:
                reason = f"has number {number}, but the next view is {self.views}"
                raise SessionConflictError(view.name, reason)
            return self._added()
        self._check_alike(view)
        budget = check_budget(budget)
        if self._open is not None and self._open[0] != event.digest:
            self._check_not_open()
        if self._open is None and budget is None:
            scene, warnings = self._update_copy(view)
        else:
            job = in_background(self._update_copy, view) if self._open is None else self._open[1]
            self._open = event.digest, job
            if not wait([job], budget).done:
                return replace(self._added(), number=self.views, open=True)
            self._open = None
            scene, warnings = job.result()
        self._add(view, event, content, scene)
        self._warnings = warnings
        return self._added()

    def _update_copy(self, view: View) -> tuple[Scene, list[str]]:
        """Add a view to a copy of the scene, whose graph can be written; return it and the warnings."""
        scene = self.scene.copy()
        with _collected_warnings() as warnings:
            graph_text(scene.update(view))
        return scene, warnings

    @property
    def is_busy(self) -> bool:
        """Whether a view is being added in the background."""
        return self._open is not None and not self._open[1].done()

    def _check_not_open(self) -> None:
        """Refuse what would overtake an open view; one that nobody asked for again is dropped."""
        if self.is_busy:
            reason = f"view {self.views} is still being added"
            raise SessionConflictError(self.path, reason, "send that view again until it is added")
        self._open = None

    def keep(self, view: View, scene: Scene) -> None:
        """Add a view with which a copy of the scene was updated; once this returns, the view is on disk.

        Raises:
            InputError: The view cannot be kept; the session does not change.
        """
        self._check_writable()
        self._check_not_open()
        self._check_alike(view)
        graph_text(scene.graph)
        self._add(view, *self._packed(view), scene)

    def _packed(self, view: View) -> tuple[Event, bytes]:
        """The line of the next view, and the content of its file."""
        content = pack(replace(view, name=""))
        name = view.name.encode(errors="replace").decode()  # that of a file may not be text
        digest = hashlib.sha256(content).hexdigest()
        return Event("view", name, self.views, digest, view.T_world_camera), content

    def _add(self, view: View, event: Event, content: bytes, scene: Scene) -> None:
        """Write the file of a view and its line, and continue with the scene after it."""
        path = self._file(event)
        with write_errors(self.path):
            path.parent.mkdir(exist_ok=True)
            sync(self.path)
        write_file(path, content, durable=True)
        self._keep(event, scene)
        self._first = self._first or view

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
            SessionConflictError: The report would get another number, or a view is open.
            InputError: The object is unknown, or T is not a rigid transform; the session does not change.
        """
        self._check_writable()
        self._check_not_open()
        event = Event("report", object_id, T=None if T is None else as_rigid(T, "T"))
        if number is not None and number != self.reports:
            if not 0 <= number == self.reports - 1 or _told(self._events[-1]) != _told(event):
                reason = f"has number {number}, but the next report is {self.reports}"
                raise SessionConflictError("report", reason)
            return self.graph
        scene = self.scene.copy()
        self._apply(event, scene)
        graph_text(scene.graph)
        self._keep(event, scene)
        return self.graph

    def _keep(self, event: Event, scene: Scene) -> None:
        """Log an event, and continue with the scene after it."""
        self._log.append(asdict(event))
        self._events.append(event)
        self.scene = scene

    def next(
        self,
        candidates: ArrayLike | None = None,
        path_length: ArrayLike | None = None,
        *,
        refused: Iterable[ArrayLike] | None = None,
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
        first = self.scene.T_world_cameras[0]
        T_world_cameras = np.stack([first if event.T is None else event.T for event in self._views])
        if candidates is not None:
            reachable = exploration.given_candidates(candidates, path_length, T_world_cameras[-1], sphere)
        else:
            place = Surroundings(sphere.centre_world, table_floor(self.scene), self.scene.config)
            robot = find_robot(self.beginning.robot)(place)
            sphere = view_sphere_of(robot, sphere)
            reachable = reached_candidates(robot, T_world_cameras[-1], sphere)
        for number, T in enumerate([] if refused is None else refused):
            if robot is None:
                raise InputError("refused", "is given with candidates", "omit them from the candidates")
            reachable = reachable.without(as_rigid(T, f"refused[{number}]"), REFUSED)
        visited = sphere.direction_of(T_world_cameras)
        decision = exploration.next_best_view(
            self.scene, robot, visited, candidates=reachable, planner=self.beginning.planner
        )
        reports = [number for number, event in enumerate(self._events, start=1) if event.kind == "report"]
        views = len(self._events) - max(reports, default=0)
        stop = exploration.used_up(views, self.scene.config.active) or decision.stop
        return NextView(self.views, decision, stop)

    def replay(self) -> Iterator[Step]:
        """Compute the views again, and yield a step after each; the last one has the graph as it is now.

        Raises:
            InputError: No view shows a support surface, or a view is broken.
        """
        b, newest = self.beginning, None
        explorer = Explorer(config=b.settings, segmentation=b.segmentation, seed=b.seed)
        scene = explorer.scene
        for event in self._events:
            if event.kind == "report":
                self._apply(event, scene)
                continue
            with suppress(NoSurfaceError):  # the view is kept until a later one shows the surface
                for step in explorer.looks(self._read_view(event)):
                    if newest is not None:
                        yield newest
                    newest = step
        if newest is None:
            raise InputError(self.path, "no view shows a table top yet", "add one that does")
        reported = "; ".join(str(change) for change in scene.changes if change.view == scene.views)
        stop = f"after the last view, {reported}" if reported else None
        yield explorer.conclude_step(replace(newest, graph=scene.graph, cloud=scene.cloud, stop=stop))

    def undo(self) -> int:
        """Undo the last view, or the last report after it, and return the number of views left.

        Raises:
            InputError: The session has no views, or an earlier one is broken; the session does not change.
        """
        self._check_writable()
        self._check_not_open()
        if not self._events:
            raise SessionConflictError(self.path, "has nothing to undo", "add a view first")
        left = self._events[:-1]
        scene = self._after(left)
        self._log.append(asdict(Event("undo")))
        self._events, self.scene, self._warnings = left, scene, []
        self._first = self._first if self.views else None
        return self.views

    def _added(self) -> Added:
        scene, warnings = self.scene, tuple(self._warnings)
        pose, changes = (None, ()) if scene.waiting else (scene.T_world_camera, scene.new_changes)
        return Added(self.views - 1, self.graph, scene.changed, pose, warnings, changes)

    def _check_writable(self) -> None:
        if not self._log.writable:
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
            one, other = describe_camera(view), describe_camera(first)
            reason = f"its camera has {one}, but that of earlier views has {other}"
            raise InputError(view.name, reason, "use the same camera, or create a new session")

    def _file(self, event: Event) -> Path:
        return self.path / f"views/{event.number:06d}.npz"

    def _read_view(self, event: Event) -> View:
        """Read a view.

        Raises:
            InputError: Its file is missing, or has changed.
        """
        path = self._file(event)
        with read_errors(path, RESTORE):
            content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != event.digest:
            raise InputError(path, "has changed since it was written", RESTORE)
        return replace(unpack(content, (View,)), name=event.name)

    def _apply(self, event: Event, scene: Scene) -> None:
        if event.kind == "view":
            scene.update(self._read_view(event))
        elif event.T is None:
            scene.removed(event.name)
        else:
            scene.moved(event.name, event.T)

    def _after(self, events: Sequence[Event]) -> Scene:
        """The scene after some events, computed from their views."""
        b = self.beginning
        scene = Scene(b.settings, segmentation=b.segmentation, seed=b.seed)
        with _muted():
            for event in events:
                self._apply(event, scene)
        return scene


def table_floor(scene: Scene) -> FloorGrid:
    """The floor around the support surfaces of a scene; the area under the main one is blocked.

    Of several, the lowest is the floor itself if it is at its height.
    """
    assert scene.surface is not None
    assert scene.sphere is not None
    shape = scene.surface.shape
    top = float(scene.surface.point_world[2])
    T_world_box = transforms.rigid(shape.T_world_object[:3, :3], (*shape.T_world_object[:2, 3], top / 2.0))
    extents = np.array([*shape.extents[:2], max(abs(top), 2.0 * STEP)])
    surfaces = scene.graph.support_surfaces
    boxes = [Box(T_world_box, extents), *(o.shape for o in surfaces[1:] if isinstance(o.shape, Box))]
    heights = [top, *(float(o.centre_world[2]) for o in surfaces[1:])]
    if len(boxes) > 1 and min(heights) <= STEP:
        del boxes[int(np.argmin(heights))]
    return FloorGrid.from_boxes(boxes, scene.config.robot, scene.sphere.centre_world[:2])


def reached_candidates(robot: Robot, T_world_camera: Array, sphere: ViewSphere) -> Candidates:
    """Views that a robot can reach from its camera pose (4, 4), with or without its roll.

    If the robot cannot hold that pose, paths are straight lines.
    """
    for T in (T_world_camera, transforms.look_at(T_world_camera[:3, 3], sphere.centre_world)):
        with suppress(PlanningError):
            robot.move_to(T)
            return exploration.reachable_views(robot, sphere)
    found = exploration.reachable_views(robot, sphere)
    return found.from_elsewhere(straight_lengths(T_world_camera, found.T_world_camera))


def _told(event: Event) -> str:
    """What tells an event from others."""
    return event.digest or f"{event.name} {None if event.T is None else event.T.tolist()}"


@contextmanager
def _muted() -> Iterator[None]:
    """Keep what this thread logs from all handlers: it was logged when the views were added."""
    handlers, muted = logging.getLogger("caryatid").handlers + logging.root.handlers, threading.get_ident()

    def is_other(record: logging.LogRecord) -> bool:
        return record.thread != muted

    for handler in handlers:
        handler.addFilter(is_other)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(is_other)


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
