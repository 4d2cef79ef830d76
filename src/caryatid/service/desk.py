"""Who works on the sessions of a service: one thread, one request after the other, some sessions open.

A view takes all cores in compiled loops, and not every threading layer of numba may be entered by two threads
at once; so there is nothing to be had from more threads. What waits is bounded, and so are the sessions that
are open: the one that was used longest ago is closed, and opened from disk when it is asked for again.
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

MOST_VOXELS = 64_000_000
"""Voxels of a session's map at the most [1]; 128 MB, 25 times the default."""
MOST_VIEWS = 1_000_000
"""Points of a session's view sphere at the most [1]; 25 times the default."""


class FullError(CaryatidError):
    """More requests wait than may."""


class MissingError(CaryatidError):
    """There is no session of that name."""


class Desk:
    """The sessions in one folder.

    Args:
        folder: Where they are, each in a folder of its name.
        config: Settings of new sessions.
        open_sessions: How many are kept open at the most.
        waiting: How many requests may wait, the one that is worked on included.
    """

    def __init__(self, folder: Path, config: Config, open_sessions: int, waiting: int) -> None:
        self.folder = folder
        self.config = config
        self._most_open = open_sessions
        self._most_waiting = waiting
        self._waiting = 0
        self._counting = Lock()
        self._open: OrderedDict[str, Session] = OrderedDict()
        self._worker: ThreadPoolExecutor | None = None

    def start(self) -> None:
        """Begin to work."""
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="sessions")

    async def do(self, work: Callable[[], T]) -> T:
        """Have something done with the sessions, after all that waits already.

        Args:
            work: Called in the thread that works on the sessions.

        Raises:
            FullError: Too much waits already.
        """
        if self._worker is None:
            raise RuntimeError("the desk has not been started")
        with self._counting:
            if self._waiting >= self._most_waiting:
                raise FullError(f"{self._waiting} requests wait already; try again")
            self._waiting += 1
        future = self._worker.submit(work)
        future.add_done_callback(self._done)
        return await asyncio.shield(asyncio.wrap_future(future))

    def stop(self) -> None:
        """Finish what waits, and close the sessions."""
        if self._worker is not None:
            self._worker.submit(self._close_all).result()
            self._worker.shutdown()
            self._worker = None

    def names(self) -> list[str]:
        """Names of all sessions."""
        return sorted(path.parent.name for path in self.folder.glob("*/session.json"))

    def begin(
        self,
        name: str,
        config: Config,
        segmentation: SegmentationMethod | None,
        seed: int,
        planner: str,
    ) -> Session:
        """Begin a session.

        Args:
            name: Of the session.
            config: All stages' settings.
            segmentation: Where parts come from, or None for the first view to say.
            seed: Seed of every random choice.
            planner: Name of who chooses the next view.

        Raises:
            InputError: There is one of that name, or a setting asks for more memory than a session may have.
        """
        voxels = 1.0
        for length in config.voxels.extent:
            voxels *= length / config.voxels.size
        if voxels > MOST_VOXELS:
            raise InputError("voxels.size", f"makes {voxels:.3g} voxels", f"{MOST_VOXELS} are allowed")
        if config.active.sphere_points > MOST_VIEWS:
            given = f"{config.active.sphere_points} are too many"
            raise InputError("active.sphere_points", given, f"{MOST_VIEWS} are allowed")
        session = Session.begin(
            self.folder / name, config, segmentation=segmentation, seed=seed, planner=planner
        )
        self._keep(name, session)
        return session

    def session(self, name: str) -> Session:
        """Return a session, opened from disk where it is not open.

        Raises:
            MissingError: There is none of that name.
            SessionBusyError: Another process has it open.
        """
        if name not in self._open:
            if not (self.folder / name / "session.json").is_file():
                raise MissingError(f"there is no session '{name}'; begin it first")
            self._keep(name, Session.open(self.folder / name))
        self._open.move_to_end(name)
        return self._open[name]

    def _keep(self, name: str, session: Session) -> None:
        self._open[name] = session
        while len(self._open) > self._most_open:
            self._open.popitem(last=False)[1].close()

    def _close_all(self) -> None:
        while self._open:
            self._open.popitem()[1].close()

    def _done(self, future: Future[Any]) -> None:
        with self._counting:
            self._waiting -= 1
