"""An append-only log: a file of JSON objects, one a line, each on disk before `append` returns."""

from __future__ import annotations

import errno
import json
import os
from base64 import b64encode
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Self

from filelock import FileLock, Timeout

from caryatid.errors import InputError
from caryatid.io.staging import read_errors, sync, write_errors

LATER: Final = "delete this line and all later ones"
"""Remedy for a damaged line."""


class BusyError(InputError):
    """Another process is writing."""


class Log:
    """A log; iterate over it to read its objects. Use it in a `with` block, or close it.

    A line that a kill left incomplete does not count, and the next one replaces it.

    Args:
        path: Its file; a writer creates it.
        what: What the file is, for the error about another file.
        write: Whether to append. Only one process does at a time; others may read meanwhile.

    Attributes:
        path: Its file.
        writable: Whether it is open for writing.

    Raises:
        BusyError: Another process is writing.
        InputError: The file cannot be written; in iteration: cannot be read, or is not a log.
    """

    def __init__(self, path: Path, what: str, *, write: bool = False) -> None:
        self.path = path
        self.writable = write
        self._what = what
        if not write:
            return
        self._lock = FileLock(f"{path}.lock", timeout=0, thread_local=False)
        with write_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire()
                self._file = path.open("ab", buffering=0)
                self._size = path.read_bytes().rfind(b"\n") + 1
            except Timeout:
                remedy = "wait until it finishes, or stop it"
                raise BusyError(path, "in use by another process", remedy) from None
            except OSError:
                self._lock.release()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        with read_errors(self.path, "restore this file"), self.path.open("rb") as file:
            for number, line in enumerate(file, start=1):
                whole = line.endswith(b"\n")
                try:
                    document = json.loads(line) if whole else {}
                except (ValueError, RecursionError):
                    document = None
                if not isinstance(document, dict) or not line.startswith(b"{"):
                    if number == 1:
                        raise InputError(self.path, f"is not a {self._what}", "choose another folder")
                    reason = f"line {number} is damaged"
                    raise InputError(self.path, reason, LATER)
                if whole:
                    yield document

    def append(self, document: Mapping[str, Any]) -> None:
        """Append an object; when this returns, it is on disk. After an error, the log is as before.

        Arrays become lists, bytes base64.

        Raises:
            InputError: The disk cannot be written.
        """
        assert self.writable, "this log was opened for reading"
        line = json.dumps(document, default=_plain).encode() + b"\n"
        with write_errors(self.path):
            self._file.truncate(self._size)
            try:
                if self._file.write(line) < len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(self._file.fileno())
                if self._size == 0:
                    sync(self.path.parent)
            except OSError:
                self._file.truncate(self._size)
                raise
        self._size += len(line)

    def close(self) -> None:
        """Let other processes write."""
        if self.writable:
            self.writable = False
            self._file.close()
            self._lock.release()


def _plain(value: Any) -> Any:
    return b64encode(value).decode() if isinstance(value, bytes) else value.tolist()
