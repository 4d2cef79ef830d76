"""One writer a folder: a lock that is gone when its process is, however that ends."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from caryatid.errors import InputError


class SessionBusyError(InputError):
    """Somebody else writes to the session."""


class FolderLock:
    """Be the only writer of a folder, until `release` or death.

    SQLite locks the file as each system wants it, between processes and within one, and the system lets go
    of it for the dead. Nothing is written to it, and it stays: a file that comes and goes locks nothing.

    Args:
        path: The file to lock; made if missing.

    Raises:
        SessionBusyError: Another writer has it.
        InputError: It cannot be locked.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._lock = sqlite3.connect(path, isolation_level=None, timeout=0.0, check_same_thread=False)
        except sqlite3.Error as error:
            raise InputError(path, f"cannot be opened ({error})", "give a folder you may write to") from None
        try:
            self._lock.execute("PRAGMA journal_mode = MEMORY")
            self._lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.Error as error:
            self._lock.close()
            if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_BUSY:
                remedy = "wait until that is done, or stop it"
                raise SessionBusyError(path.parent, "another writer has this session open", remedy) from None
            raise InputError(path, f"cannot be locked ({error})", "give a folder you may write to") from None

    def release(self) -> None:
        """Let others write."""
        self._lock.close()
