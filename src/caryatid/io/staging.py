"""Files and folders that appear whole or not at all: written beside their final place and then renamed."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from io import BufferedRandom
from pathlib import Path
from typing import Self

from caryatid.errors import InputError

PARTIAL, REPLACED = ".partial-", "-replaced"
"""Prefix of staged files and folders, suffix of those being replaced; a killed process leaves them."""


class StagedFolder:
    """A staged folder, to be used in a `with` block.

    Files are written into a hidden sibling `.partial-NAME-…`, which `publish` renames to its place. Files
    written later go straight there. Leaving the block without `publish` removes the files written, and parent
    folders made for them.

    Args:
        folder: The folder's final place.
        replaces: Returns the paths of the files in an existing folder that may be replaced; a folder with
            any other file does not change. None replaces no file.
        durable: Wait until every file, and the folder itself, is on disk.
        goes_on: The folder is already in its place, and files are added to it.

    Attributes:
        folder: The folder's final place.
        published: Whether it is in its place.
        written: Paths of the files written so far.

    Raises:
        InputError: The place holds something that may not be replaced, or cannot be written.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        replaces: Callable[[Path], Collection[str]] | None = None,
        durable: bool = False,
        goes_on: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self.published = goes_on
        self._place = Path(os.path.realpath(self.folder))  # unlike `resolve`, takes a link to itself
        self._replaces, self._durable = replaces, durable
        self._partial = _partial(self._place)
        self._old = self._partial.with_name(f"{self._partial.name}{REPLACED}")
        self.written: set[str] = set()
        recover(self._place)
        self._made = [parent for parent in self._place.parents if not parent.exists()]
        if goes_on:
            return
        self._check_place()
        try:
            with write_errors(self.folder):
                self._partial.mkdir(parents=True)
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Remove an unpublished folder, and restore the one it was to replace."""
        with suppress(OSError):
            if self._old.exists() and not self._place.exists():
                self._old.rename(self._place)
        shutil.rmtree(self._partial, ignore_errors=True)
        for parent in self._made:
            with suppress(OSError):
                parent.rmdir()

    def write(self, name: str, content: bytes) -> None:
        """Write one file, `name` relative to the folder.

        Raises:
            InputError: The disk cannot be written.
        """
        path = (self._place if self.published else self._partial) / name
        with write_errors(self.folder):
            path.parent.mkdir(parents=True, exist_ok=True)
            if self.published:
                write_file(path, content, durable=self._durable)
            else:
                _write(path, content, self._durable)
        self.written.add(name)

    def remove(self, name: str) -> None:
        """Remove a subfolder, `name` relative to the folder, if it exists."""
        shutil.rmtree(self._partial / name, ignore_errors=True)

    def publish(self) -> None:
        """Publish the folder, unless it is published; an older one is replaced if that is allowed.

        Raises:
            InputError: The place has been taken meanwhile, or cannot be written.
        """
        if self.published:
            return
        self._check_place()
        with write_errors(self.folder):
            if self._durable:
                sync(self._partial)
            if self._place.exists():
                self._place.rename(self._old)
            self._partial.rename(self._place)
            try:
                if self._durable:
                    sync(self._place.parent)
            except OSError:
                self._place.rename(self._partial)
                raise
        self.published = True
        shutil.rmtree(self._old, ignore_errors=True)

    def _check_place(self) -> None:
        if not os.path.lexists(self._place):
            return
        remedy = "give a new folder"
        if self._replaces:
            remedy += "; caryatid replaces only folders that it wrote"
        if not self._place.is_dir():
            raise InputError(self.folder, "already exists and is not a directory", remedy)
        own = self._replaces(self._place) if self._replaces else ()
        with write_errors(self.folder):
            for path in self._place.rglob("*"):
                name = path.relative_to(self._place).as_posix()
                if name not in own and (path.is_symlink() or not path.is_dir()):
                    raise InputError(self.folder, f"already exists and contains other files ({name})", remedy)


def write_file(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write one file, whole or not at all; an existing one is replaced. `durable` waits until it is on disk.

    Raises:
        InputError: It is a folder, or the disk cannot be written; nothing is left behind.
    """
    with staged_file(path, durable=durable) as file:
        file.write(content)


@contextmanager
def staged_file(path: Path, *, durable: bool = False) -> Iterator[BufferedRandom]:
    """Open a file to write and read; it takes its place, whole, when the block ends, as with `write_file`.

    Raises:
        InputError: As `write_file`.
    """
    if path.is_dir():
        raise InputError(path, "is a directory", "give a file")
    recover(path)
    partial = _partial(path)
    with write_errors(path):
        try:
            with partial.open("w+b") as file:
                yield file
            if durable:
                sync(partial)
            partial.replace(path)
            if durable:
                sync(path.parent)
        finally:
            partial.unlink(missing_ok=True)


def remove_folder(folder: Path) -> None:
    """Remove a folder in one step; when this returns, the removal is on disk.

    Raises:
        InputError: The disk cannot be written.
    """
    partial = _partial(folder)
    with write_errors(folder):
        folder.rename(partial)
        sync(folder.parent)
    shutil.rmtree(partial, ignore_errors=True)


def remove_file(path: Path) -> None:
    """Remove a file; when this returns, the removal is on disk.

    Raises:
        InputError: The disk cannot be written.
    """
    with write_errors(path):
        path.unlink()
        sync(path.parent)


def recover(place: Path) -> None:
    """Remove staged files of killed processes in and beside a folder; restore it if it was being replaced."""
    staged = re.compile(rf"{re.escape(PARTIAL)}(.+)-(\d+)-[0-9a-f]{{8}}({REPLACED})?")
    with suppress(OSError):
        for path in (*place.parent.glob(f"{PARTIAL}*"), *place.rglob(f"{PARTIAL}*")):
            found = staged.fullmatch(path.name)
            if found is None or _runs(int(found[2])):
                continue
            if path.parent == place.parent and found[1] != place.name:
                continue
            if found[3] and not place.exists():
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
    return path.with_name(f"{PARTIAL}{path.name}-{os.getpid()}-{secrets.token_hex(4)}")


def _runs(process: int) -> bool:
    """Whether a process may still run; false only if it certainly does not."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it is another user's
        return True
    return True


def _write(path: Path, content: bytes, durable: bool) -> None:
    path.write_bytes(content)
    if durable:
        sync(path)
