"""The sessions of a service: one thread works on them, one request after the other; some are kept open.

A view takes all cores in compiled loops, and not every threading layer of numba may be entered by two threads
at once, so more threads would gain nothing.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from math import prod
from pathlib import Path
from typing import Any

from caryatid.config import Config
from caryatid.errors import CaryatidError, InputError
from caryatid.sessions import Session


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
        self._open: dict[str, Session] = {}

    async def __aenter__(self) -> None:
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="sessions")

    async def __aexit__(self, *error: object) -> None:
        """Finish what is waiting, and close the sessions."""
        self._worker.shutdown()
        self._close_all_but(0)

    async def do(self, work: Callable[[], Any]) -> Any:
        """Run some work on the sessions, in the thread of the pool, after everything that is waiting already.

        Raises:
            FullError: Too many requests are waiting.
        """
        if self._waiting >= self._max_waiting:
            raise FullError(f"{self._waiting} requests wait already; try again")
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._worker, work)
        finally:
            self._waiting -= 1

    def names(self) -> list[str]:
        """Names of all sessions."""
        return sorted(path.parent.name for path in self.folder.glob("*/session.json"))

    def begin(self, name: str, config: Config, **options: Any) -> Session:
        """Begin a session; the options are those of `Session.begin`.

        Raises:
            InputError: There is one of that name, or a setting asks for more memory than a session may have.
        """
        # 25 times the defaults: 128 MB of voxels.
        if prod(length / config.voxels.size for length in config.voxels.extent) > 64e6:
            raise InputError("voxels.size", "makes too many voxels", "64 million are allowed")
        if config.active.sphere_points > 1_000_000:
            raise InputError("active.sphere_points", "is too large", "1 million are allowed")
        return self._opened(name, Session.begin(self.folder / name, config, **options))

    def session(self, name: str) -> Session:
        """Return a session, opened from disk where it is not open.

        Raises:
            MissingError: There is none of that name.
            SessionBusyError: Another process has it open.
        """
        if name in self._open:
            return self._opened(name, self._open.pop(name))
        if not (self.folder / name / "session.json").is_file():
            raise MissingError(f"there is no session '{name}'; begin it first")
        return self._opened(name, Session.open(self.folder / name))

    def _opened(self, name: str, session: Session) -> Session:
        """Keep a session open, as the one used last."""
        self._open[name] = session
        self._close_all_but(self._max_open)
        return session

    def _close_all_but(self, most: int) -> None:
        while len(self._open) > most:
            self._open.pop(next(iter(self._open))).close()
