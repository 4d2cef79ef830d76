"""Files, folders and lines of a log that appear whole or not at all, even if the process is killed.

Files and folders are written beside their final place and then renamed.
"""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import shutil
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, Self

from filelock import FileLock, Timeout

from caryatid.errors import InputError

PARTIAL, REPLACED = ".partial-", "-replaced"
"""Prefix of staged files and folders, suffix of those being replaced; a killed process leaves them."""
PROCESS: Final = secrets.token_hex(4)
"""Tells this process from a killed one with the same id: in a container, each has the same."""
LATER: Final = "delete this line and all later ones"
"""Remedy for a damaged line."""


class StagedFolder:
    """A staged folder, to be used in a `with` block.

    Files are written into a hidden sibling `.partial-NAME-…`, which `publish` renames to its place. Leaving
    the block without `publish` removes the files written, and parent folders made for them.

    Args:
        folder: The folder's final place.
        own: Returns the pattern of the files in an existing folder that may be replaced, or None; a folder
            with any other file does not change.

    Attributes:
        folder: The folder's final place.

    Raises:
        InputError: The place holds something that may not be replaced, or cannot be written.
    """

    def __init__(
        self, folder: str | Path, *, own: Callable[[Path], re.Pattern[str] | None] | None = None
    ) -> None:
        self.folder = Path(folder)
        self._place = Path(os.path.realpath(self.folder))  # unlike `resolve`, takes a link to itself
        self._own = own
        self._partial = _partial(self._place)
        recover(self._place)
        self._made = [parent for parent in self._place.parents if not parent.exists()]
        self._check_place()
        with write_errors(self.folder):
            self._partial.mkdir(parents=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Remove an unpublished folder."""
        shutil.rmtree(self._partial, ignore_errors=True)
        for parent in self._made:
            with suppress(OSError):
                parent.rmdir()

    def write(self, name: str, content: bytes) -> None:
        """Write one file, `name` relative to the folder.

        Raises:
            InputError: The disk cannot be written.
        """
        path = self._partial / name
        with write_errors(self.folder):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def publish(self) -> None:
        """Publish the folder; an older one is replaced if that is allowed.

        Raises:
            InputError: The place has been taken meanwhile, or cannot be written.
        """
        self._check_place()
        old = self._partial.with_name(f"{self._partial.name}{REPLACED}")
        with write_errors(self.folder):
            if self._place.exists():
                self._place.rename(old)
            try:
                self._partial.rename(self._place)
            except BaseException:
                if old.exists():
                    old.rename(self._place)
                raise
        shutil.rmtree(old, ignore_errors=True)

    def _check_place(self) -> None:
        if not os.path.lexists(self._place):
            return
        remedy = "give a new folder"
        if self._own:
            remedy += "; caryatid replaces only folders that it wrote"
        if not self._place.is_dir():
            raise InputError(self.folder, "already exists and is not a directory", remedy)
        own = self._own(self._place) if self._own else None
        with write_errors(self.folder):
            for path in self._place.rglob("*"):
                name = path.relative_to(self._place).as_posix()
                if path.is_symlink() or not (path.is_dir() or (own and own.fullmatch(name))):
                    raise InputError(self.folder, f"already exists and contains other files ({name})", remedy)


def write_file(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write one file, whole or not at all; an existing one is replaced. `durable` waits until it is on disk.

    Raises:
        InputError: It is a folder, or the disk cannot be written; nothing is left behind.
    """
    if path.is_dir():
        raise InputError(path, "is a directory", "give a file")
    recover(path)
    partial = _partial(path)
    with write_errors(path):
        try:
            with partial.open("wb") as file:
                file.write(content)
            if durable:
                sync(partial)
            partial.replace(path)
            if durable:
                sync(path.parent)
        finally:
            partial.unlink(missing_ok=True)


def recover(place: Path) -> None:
    """Remove staged files of killed processes in and beside a folder; restore it if it was being replaced."""
    staged = re.compile(rf"{re.escape(PARTIAL)}(.+)-(\d+)-([0-9a-f]{{8}})[0-9a-f]*({REPLACED})?")
    with suppress(OSError):
        for path in (*place.parent.glob(f"{PARTIAL}*"), *place.rglob(f"{PARTIAL}*")):
            found = staged.fullmatch(path.name)
            if found is None or _runs(int(found[2]), found[3]):
                continue
            if path.parent == place.parent and found[1] != place.name:
                continue
            if found[4] and not place.exists():
                path.rename(place)
            elif path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


@contextmanager
def read_errors(path: Path, remedy: str) -> Iterator[None]:
    """Turn an OSError while reading into one sentence with the path, the reason and this remedy.

    Raises:
        InputError: Instead of the OSError.
    """
    try:
        yield
    except FileNotFoundError:
        raise InputError(path, "the file is missing", remedy) from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", remedy) from error


@contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Turn an OSError while writing into one sentence with the path, the reason and the remedy.

    Raises:
        InputError: Instead of the OSError.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            reason, remedy = "the disk is full", "free some space or write elsewhere; nothing was written"
        else:
            reason = f"cannot be written ({(error.strerror or str(error)).lower()})"
            remedy = "give a writable folder"
        raise InputError(path, reason, remedy) from error


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _partial(path: Path) -> Path:
    return path.with_name(f"{PARTIAL}{path.name}-{os.getpid()}-{PROCESS}{secrets.token_hex(4)}")


def _runs(process: int, token: str) -> bool:
    """Whether a process may still run; false only if it certainly does not."""
    if process == os.getpid():
        return token == PROCESS
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it is another user's
        pass
    return True


class BusyError(InputError):
    """Another process is writing."""


class Log:
    """An append-only log: a file of JSON objects, one a line, each on disk before `append` returns.

    Iterate over it to read its objects. Use it in a `with` block, or close it.

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
                    raise InputError(self.path, f"line {number} is damaged", LATER)
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
