"""The sessions of a service: one thread works on them, one request after the other; some are kept open.

A view takes all cores in compiled loops, and not every threading layer of numba may be entered by two threads
at once, so more threads would gain nothing.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from math import prod
from pathlib import Path
from typing import Any, TypeVar

from caryatid.config import Config
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
    """The sessions in one folder. Of its methods only `do` is called by others than the thread of the pool.

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
        self._open: OrderedDict[str, Session] = OrderedDict()

    def __enter__(self) -> None:
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="sessions")

    def __exit__(self, *error: object) -> None:
        """Finish what is waiting, and close the sessions."""
        self._worker.submit(self._keep_open, 0).result()
        self._worker.shutdown()

    async def do(self, work: Callable[[], T]) -> T:
        """Run some work on the sessions after everything that is waiting already.

        Args:
            work: Called in the thread of the pool; done to its end even if nobody waits for it any more.

        Raises:
            FullError: Too many requests are waiting.
        """
        if self._waiting >= self._max_waiting:
            raise FullError(f"{self._waiting} requests wait already; try again")
        self._waiting += 1
        future = asyncio.get_running_loop().run_in_executor(self._worker, work)
        future.add_done_callback(self._done)
        return await asyncio.shield(future)

    def names(self) -> list[str]:
        """Names of all sessions."""
        return sorted(path.parent.name for path in self.folder.glob("*/session.json"))

    def begin(self, name: str, config: Config, **options: Any) -> Session:
        """Begin a session; the options are those of `Session.begin`.

        Raises:
            InputError: There is one of that name, or a setting asks for more memory than a session may have.
        """
        voxels = prod(length / config.voxels.size for length in config.voxels.extent)
        if voxels > MAX_VOXELS:
            raise InputError("voxels.size", f"makes {voxels:.3g} voxels", f"{MAX_VOXELS} are allowed")
        if config.active.sphere_points > MAX_SPHERE_POINTS:
            reason = f"{config.active.sphere_points} are too many"
            raise InputError("active.sphere_points", reason, f"{MAX_SPHERE_POINTS} are allowed")
        return self._opened(name, Session.begin(self.folder / name, config, **options))

    def session(self, name: str) -> Session:
        """Return a session, opened from disk where it is not open.

        Raises:
            MissingError: There is none of that name.
            SessionBusyError: Another process has it open.
        """
        if name not in self._open and not (self.folder / name / "session.json").is_file():
            raise MissingError(f"there is no session '{name}'; begin it first")
        return self._opened(name, self._open.get(name) or Session.open(self.folder / name))

    def _opened(self, name: str, session: Session) -> Session:
        """Keep a session open, as the one used last."""
        self._open[name] = session
        self._open.move_to_end(name)
        self._keep_open(self._max_open)
        return session

    def _keep_open(self, most: int) -> None:
        while len(self._open) > most:
            self._open.popitem(last=False)[1].close()

    def _done(self, future: asyncio.Future[Any]) -> None:
        self._waiting -= 1
