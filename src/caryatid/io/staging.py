"""Files and folders that appear whole or not at all: written beside their place, renamed when done."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from caryatid.errors import InputError

PARTIAL = ".partial-"
"""Beginning of the names of files and folders in the making; a killed process leaves them behind."""


class StagedFolder:
    """A folder in the making.

    Everything is written into a hidden sibling `.partial-NAME-…`, which `publish` renames to its place and
    `discard` removes, together with parent folders made for it.

    Args:
        folder: Where the folder shall be.
        replaceable: Whether a folder that is there already may be replaced.
        remedy: What to do where it may not.
        durable: Wait until every file, and the folder itself, is on the disk.

    Raises:
        InputError: The place is taken by something that may not be replaced, or cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        replaceable: Callable[[Path], bool] = lambda _: False,
        remedy: str = "give a new folder",
        *,
        durable: bool = False,
    ) -> None:
        self.folder = folder.resolve()
        self._replaceable = replaceable
        self._remedy = remedy
        self._durable = durable
        self._made: list[Path] = []
        self._open = True
        self._check_place()
        self.partial = _partial(self.folder)
        self._old = self.partial.with_name(f"{self.partial.name}-replaced")
        try:
            with write_errors(self.folder):
                for parent in reversed(self.folder.parents):
                    if not parent.exists():
                        parent.mkdir()
                        self._made.append(parent)
                self.partial.mkdir()
        except BaseException:
            self.discard()
            raise

    def write(self, name: str, content: bytes) -> None:
        """Write one file, `name` relative to the folder.

        An interrupt leaves the folder open, with this file perhaps half written.

        Raises:
            InputError: The disk is full or refuses; the whole folder is discarded then.
            ValueError: The folder has been published or discarded.
        """
        if not self._open:
            raise ValueError(f"{self.folder} has been published or discarded")
        path = self.partial / name
        try:
            with write_errors(self.folder):
                path.parent.mkdir(parents=True, exist_ok=True)
                _write(path, content, self._durable)
        except InputError:
            self.discard()
            raise

    def remove(self, name: str) -> None:
        """Remove a subfolder, `name` relative to the folder, if it is there."""
        shutil.rmtree(self.partial / name, ignore_errors=True)

    def publish(self) -> None:
        """Put the folder in its place, replacing an older one where that is allowed.

        Raises:
            InputError: The place has been taken meanwhile, or the disk refuses; nothing is left behind.
        """
        try:
            self._check_place()
            with write_errors(self.folder):
                if self._durable:
                    sync(self.partial)
                if self.folder.exists():
                    self.folder.rename(self._old)
                self.partial.rename(self.folder)
                if self._durable:
                    try:
                        sync(self.folder.parent)
                    except OSError:
                        self.folder.rename(self.partial)
                        raise
        except BaseException:
            self.discard()
            raise
        self._open = False
        shutil.rmtree(self._old, ignore_errors=True)

    def discard(self) -> None:
        """Remove what has been written and leave the place as it was; does nothing after `publish`."""
        self._open = False
        with suppress(OSError):
            if self._old.exists() and not self.folder.exists():
                self._old.rename(self.folder)
        shutil.rmtree(self.partial, ignore_errors=True)
        for parent in reversed(self._made):
            with suppress(OSError):
                parent.rmdir()

    def _check_place(self) -> None:
        if not os.path.lexists(self.folder):
            return
        if not self.folder.is_dir():
            raise InputError(self.folder, "already exists and is not a folder", self._remedy)
        with write_errors(self.folder):
            empty = not any(self.folder.iterdir())
        if not empty and not self._replaceable(self.folder):
            raise InputError(self.folder, "already exists and holds other files", self._remedy)


def write_file(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write one file, whole or not at all; an existing one is replaced.

    Args:
        path: The file.
        content: Its bytes.
        durable: Wait until it is on the disk.

    Raises:
        InputError: It is a folder, or the disk is full or refuses; nothing is left behind.
    """
    if path.is_dir():
        raise InputError(path, "is a folder", "give a file")
    partial = _partial(path)
    with write_errors(path):
        try:
            _write(partial, content, durable)
            partial.replace(path)
            if durable:
                sync(path.parent)
        finally:
            partial.unlink(missing_ok=True)


def remove_folder(folder: Path) -> None:
    """Remove a folder in one step; once this returns it will not come back.

    Raises:
        InputError: The disk refuses.
    """
    partial = _partial(folder)
    with write_errors(folder):
        folder.rename(partial)
        sync(folder.parent)
    shutil.rmtree(partial, ignore_errors=True)


def clear_partials(folder: Path) -> None:
    """Remove what killed processes left in the making; for the only writer of the folder."""
    for path in folder.glob(f"{PARTIAL}*"):
        with suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


@contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Turn an OSError while writing into one sentence with the path, the reason and the remedy.

    Raises:
        InputError: In place of the OSError.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            reason, remedy = "the disk is full", "free some space or write elsewhere; nothing was left behind"
        else:
            reason = f"cannot be written ({(error.strerror or str(error)).lower()})"
            remedy = "give a folder you may write to"
        raise InputError(path, reason, remedy) from error


def _partial(path: Path) -> Path:
    return path.with_name(f"{PARTIAL}{path.name}-{secrets.token_hex(4)}")


def _write(path: Path, content: bytes, durable: bool) -> None:
    path.write_bytes(content)
    if durable:
        sync(path)


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk, where the system can."""
    if os.name == "nt":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
