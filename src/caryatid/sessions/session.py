"""A session: views are added one by one, and after each of them graph and next view can be had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid.config import Config, SegmentationMethod
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.objects.change import changed
from caryatid.planning.planners import make_planner
from caryatid.robots.registry import HUMANOID, find_robot
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.sessions.captures import Capture, Entry
from caryatid.sessions.checks import check_camera, check_labels, check_pose, check_same_camera
from caryatid.sessions.durable import clear_partials
from caryatid.sessions.folder import Beginning, SessionFolder, begin, chain
from caryatid.sessions.lock import FolderLock
from caryatid.sessions.next_view import NextView, plan_next
from caryatid.sessions.snapshots import Snapshots, State


class WrongNumberError(InputError):
    """A view was to be another one than the next."""


@dataclass(frozen=True, eq=False, slots=True)
class Added:
    """What came of a view.

    Attributes:
        number: Which view it is, 0 the first.
        graph: The fused support graph with it.
        changed: Whether it changed the graph.
    """

    number: int
    graph: SupportGraph
    changed: bool


@dataclass(frozen=True, eq=False, slots=True)
class _Camera:
    """What all views of a session share: pinhole matrix, size [px], and whether they have labels."""

    K: Array
    size: tuple[int, int]
    labelled: bool

    @classmethod
    def of(cls, view: View) -> _Camera:
        height, width = view.depth.shape
        return cls(view.K, (height, width), view.labels is not None)


class Session:
    """A scene model in a folder; `begin` or `open` one.

    A view that has been added stays, whatever happens to this process, the machine or its power: it is on
    the disk before `add` returns. Whoever writes is alone; others may read meanwhile.
    """

    def __init__(self, folder: SessionFolder, lock: FolderLock | None) -> None:
        self._folder = folder
        self._lock = lock
        b = folder.beginning
        if lock is not None:
            for place in (folder.path, folder.views, folder.state):
                clear_partials(place)
        self._views = folder.entries()
        self._snapshots = Snapshots(folder.state, b.digest, b.config, b.segmentation, b.seed)
        self._camera = _Camera.of(self._decoded(0)) if self._views else None
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
            planner: Name of who chooses the next view.
            robot: Name of who takes it, as `find_robot` knows it; it stands by the table, and there is
                nothing else on its floor.

        Raises:
            InputError: The place is taken, there is no such planner or robot, or nothing can be written
                there.
        """
        make_planner(planner)
        find_robot(robot)
        folder = begin(Path(path), Beginning(config or Config(), segmentation, seed, planner, robot))
        return cls(folder, FolderLock(folder.lock))

    @classmethod
    def open(cls, path: str | PathLike[str], *, read_only: bool = False) -> Session:
        """Open a session with all its views.

        Args:
            path: Its folder.
            read_only: Leave the folder as it is, and do not mind who else has it open.

        Raises:
            SessionBusyError: Another writer has it open.
            InputError: It is no session, or a view is broken.
        """
        folder = SessionFolder(Path(path))
        lock = None if read_only else FolderLock(folder.lock)
        try:
            return cls(folder, lock)
        except BaseException:
            if lock is not None:
                lock.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let others write."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    @property
    def path(self) -> Path:
        """Its folder."""
        return self._folder.path

    @property
    def beginning(self) -> Beginning:
        """What it was begun with."""
        return self._folder.beginning

    @property
    def views(self) -> int:
        """How many views it has."""
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
        """Take in a view; when this returns, it is on the disk.

        Args:
            view: A view with a pose, or one that is not decoded yet.
            number: Which view it is to be, 0 the first. A view that is the last one already is not added
                again, so that whoever did not hear the answer can ask again. None = the next one.

        Raises:
            WrongNumberError: It would not be that one.
            InputError: The view cannot be used; the session is as it was.
            PerceptionError: There is nothing to be seen in it; the session is as it was.
        """
        self._writing()
        capture = Capture.of(view) if isinstance(view, View) else view
        if number is not None and number != self.views:
            if number == self.views - 1 and capture.digest == self._views[-1].digest:
                return Added(number, self.graph, self._state.changed)
            raise WrongNumberError(capture.name, f"is to be view {number}, the next one is view {self.views}")
        decoded = capture.decode(self.beginning.config.session)
        self._check(decoded)
        scene = self._state.scene.copy()
        before = scene.graph
        graph = scene.update(decoded)
        state = State(scene, changed(before, graph, scene.config.fusion))
        self._folder.append(self.views, capture)
        self._views.append(capture.entry)
        self._camera = self._camera or _Camera.of(decoded)
        self._state = state
        self._snapshots.write(state, chain([v.digest for v in self._views]))
        return Added(self.views - 1, graph, state.changed)

    def next(
        self,
        candidates: ArrayLike | None = None,
        path_length: Sequence[float] | NDArray[np.float64] | None = None,
    ) -> NextView:
        """Choose where to look next.

        Args:
            candidates: Camera poses (N, 4, 4) that can be reached; None = those the session's robot reaches,
                on a floor with nothing but the table on it.
            path_length: Way (N,) [m] to each candidate; None = straight lines.

        Raises:
            PlanningError: There is no view yet, or none can be reached.
            InputError: Candidates are no poses.
        """
        begun = self.beginning
        config = begun.config
        stop = None
        if self.views >= config.active.max_views:
            stop = f"{config.active.max_views} views were asked for"
        elif self.views > 1 and not self._state.changed:
            stop = "the last view changed nothing"
        reach = None
        if candidates is not None:
            poses = np.asarray(candidates, dtype=np.float64).reshape(-1, 4, 4)
            reach = poses, None if path_length is None else np.asarray(path_length, dtype=np.float64)
        poses_so_far = [v.T_world_camera for v in self._views]
        return plan_next(self.scene, poses_so_far, begun.planner, reach, stop, begun.robot)

    def undo(self) -> int:
        """Take the last view back; returns how many are left.

        Raises:
            InputError: There is none, or an earlier one is broken; the session is as it was.
        """
        self._writing()
        if not self._views:
            raise InputError(self.path, "has no views to take back", "add one first")
        left = self._views[:-1]
        state = self._restored(left)
        self._folder.drop(len(left))
        self._views, self._state = left, state
        self._camera = self._camera if left else None
        return len(left)

    def _writing(self) -> None:
        if self._lock is None:
            raise InputError(self.path, "is closed, or open to be read only", "open it again to change it")

    def _check(self, view: View) -> None:
        """Refuse what cannot be a view of this session."""
        check_camera(view, self.beginning.config)
        camera = self._camera
        if camera is not None:
            check_same_camera(view, camera.K, camera.size)
        check_labels(view, self.beginning.segmentation, None if camera is None else camera.labelled)
        check_pose(view, self.scene)

    def _decoded(self, number: int) -> View:
        return Capture.read(self._folder.view(number)).decode(self.beginning.config.session)

    def _restored(self, views: Sequence[Entry]) -> State:
        """What is known after some views, from the last snapshot that can be trusted and those after it."""
        digests = [v.digest for v in views]
        state = None
        for number in self._snapshots.numbers():
            if number <= len(digests):
                state = self._snapshots.read(number, chain(digests[:number]))
                if state is not None:
                    break
        if state is None:
            b = self.beginning
            state = State(Scene(b.config, segmentation=b.segmentation, seed=b.seed), changed=False)
        scene, before = state.scene, state.scene.views
        for number in range(before, len(digests)):
            graph = scene.graph
            state = State(scene, changed(graph, scene.update(self._decoded(number)), scene.config.fusion))
            if self._lock is not None and number + 2 >= len(digests):
                self._snapshots.write(state, chain(digests[: number + 1]))
        return state
