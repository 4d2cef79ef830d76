"""The sessions of a service: one thread works on them, one request after the other; some are kept open.

A view takes all cores in compiled loops, and not every threading layer of numba may be entered by two threads
at once, so more threads would gain nothing.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

from caryatid.config import Config, SegmentationMethod
from caryatid.errors import CaryatidError, InputError
from caryatid.sessions import Session

T = TypeVar("T")

MAX_VOXELS = 64_000_000
"""Voxels of a session's map [1]; 128 MB, 25 times the default."""
MAX_SPHERE_POINTS = 1_000_000
"""Points of a session's view sphere [1]; 25 times the default."""


class FullError(CaryatidError):
    """Too many requests are waiting."""


class MissingError(CaryatidError):
    """There is no session of that name."""


class SessionPool:
    """The sessions in one folder.

    Args:
        folder: Holds the sessions, each in a folder of its name.
        config: Settings of new sessions.
        open_sessions: Maximum number kept open; of more, the one used longest ago is closed.
        waiting: Maximum number of requests waiting, including the one in work.
    """

    def __init__(self, folder: Path, config: Config, open_sessions: int, waiting: int) -> None:
        self.folder = folder
        self.config = config
        self._max_open = open_sessions
        self._max_waiting = waiting
        self._waiting = 0
        self._counting = Lock()
        self._open: OrderedDict[str, Session] = OrderedDict()
        self._worker: ThreadPoolExecutor | None = None

    def start(self) -> None:
        """Start the thread."""
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="sessions")

    async def do(self, work: Callable[[], T]) -> T:
        """Run some work on the sessions after everything that is waiting already.

        Args:
            work: Called in the thread that works on the sessions.

        Raises:
            FullError: Too many requests are waiting.
        """
        if self._worker is None:
            raise RuntimeError("the pool has not been started")
        with self._counting:
            if self._waiting >= self._max_waiting:
                raise FullError(f"{self._waiting} requests wait already; try again")
            self._waiting += 1
        future = self._worker.submit(work)
        future.add_done_callback(self._done)
        return await asyncio.shield(asyncio.wrap_future(future))

    def stop(self) -> None:
        """Finish what is waiting, and close the sessions."""
        if self._worker is not None:
            self._worker.submit(self._keep_open, 0).result()
            self._worker.shutdown()
            self._worker = None

    def names(self) -> list[str]:
        """Names of all sessions."""
        return sorted(path.parent.name for path in self.folder.glob("*/session.json"))

    def begin(
        self, name: str, config: Config, segmentation: SegmentationMethod | None, seed: int, planner: str
    ) -> Session:
        """Begin a session; the arguments are those of `Session.begin`.

        Raises:
            InputError: There is one of that name, or a setting asks for more memory than a session may have.
        """
        voxels = 1.0
        for length in config.voxels.extent:
            voxels *= length / config.voxels.size
        if voxels > MAX_VOXELS:
            raise InputError("voxels.size", f"makes {voxels:.3g} voxels", f"{MAX_VOXELS} are allowed")
        if config.active.sphere_points > MAX_SPHERE_POINTS:
            reason = f"{config.active.sphere_points} are too many"
            raise InputError("active.sphere_points", reason, f"{MAX_SPHERE_POINTS} are allowed")
        self._open[name] = Session.begin(
            self.folder / name, config, segmentation=segmentation, seed=seed, planner=planner
        )
        self._keep_open(self._max_open)
        return self._open[name]

    def session(self, name: str) -> Session:
        """Return a session, opened from disk where it is not open.

        Raises:
            MissingError: There is none of that name.
            SessionBusyError: Another process has it open.
        """
        if name not in self._open:
            if not (self.folder / name / "session.json").is_file():
                raise MissingError(f"there is no session '{name}'; begin it first")
            self._open[name] = Session.open(self.folder / name)
        self._open.move_to_end(name)
        self._keep_open(self._max_open)
        return self._open[name]

    def _keep_open(self, most: int) -> None:
        while len(self._open) > most:
            self._open.popitem(last=False)[1].close()

    def _done(self, future: Future[Any]) -> None:
        with self._counting:
            self._waiting -= 1
