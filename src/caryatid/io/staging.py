"""Files and folders that appear whole or not at all: written beside their final place and then renamed."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
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
        own: Returns the pattern of the files in an existing folder that may be replaced, or None; a folder
            with any other file does not change.
        published: The folder is already in its place, and files are added to it.

    Attributes:
        folder: The folder's final place.
        published: Whether it is in its place.

    Raises:
        InputError: The place holds something that may not be replaced, or cannot be written.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        own: Callable[[Path], re.Pattern[str] | None] | None = None,
        published: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self.published = published
        self._place = Path(os.path.realpath(self.folder))  # unlike `resolve`, takes a link to itself
        self._own = own
        self._partial = _partial(self._place)
        recover(self._place)
        self._made = [parent for parent in self._place.parents if not parent.exists()]
        if not published:
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
        path = (self._place if self.published else self._partial) / name
        with write_errors(self.folder):
            path.parent.mkdir(parents=True, exist_ok=True)
            if self.published:
                write_file(path, content)
            else:
                path.write_bytes(content)

    def publish(self) -> None:
        """Publish the folder, unless it is published; an older one is replaced if that is allowed.

        Raises:
            InputError: The place has been taken meanwhile, or cannot be written.
        """
        if self.published:
            return
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
        self.published = True
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
        pass
    return True
