"""Folders that appear whole or not at all: written beside their place, renamed when done."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from caryatid.errors import InputError


class StagedFolder:
    """A folder in the making.

    Everything is written into a hidden sibling `.NAME.partial-…`, which `publish` renames to its place and
    `discard` removes, together with parent folders made for it.

    Args:
        folder: Where the folder shall be.
        replaceable: Says of a folder that is there already whether it may be replaced.
        remedy: What to do where it may not.

    Raises:
        InputError: The place is taken by what may not be replaced, or nothing can be written there.
    """

    def __init__(self, folder: Path, replaceable: Callable[[Path], bool], remedy: str) -> None:
        self.folder = folder.resolve()
        self._replaceable = replaceable
        self._remedy = remedy
        self._made: list[Path] = []
        self._open = True
        self._check_place()
        self.partial = self.folder.with_name(
            f".{self.folder.name}.partial-{os.getpid()}-{secrets.token_hex(4)}"
        )
        self._old = self.partial.with_name(f"{self.partial.name}-replaced")
        try:
            with said_clearly(self.folder):
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
            with said_clearly(self.folder):
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
        except InputError:
            self.discard()
            raise

    def remove(self, name: str) -> None:
        """Remove a subfolder, `name` relative to the folder, if it is there."""
        shutil.rmtree(self.partial / name, ignore_errors=True)

    def publish(self) -> None:
        """Put the folder in its place, in place of an older one where that may be replaced.

        Raises:
            InputError: The place has been taken meanwhile, or the disk refuses; nothing is left behind.
        """
        try:
            self._check_place()
            with said_clearly(self.folder):
                if self.folder.exists():
                    self.folder.rename(self._old)
                self.partial.rename(self.folder)
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
            raise InputError(self.folder, "is there already and is no folder", self._remedy)
        with said_clearly(self.folder):
            empty = not any(self.folder.iterdir())
        if not empty and not self._replaceable(self.folder):
            raise InputError(self.folder, "is there already and holds other files", self._remedy)


def write_file(path: Path, content: bytes) -> None:
    """Write one file, whole or not at all; one already there is replaced.

    Raises:
        InputError: It is a folder, or the disk is full or refuses; nothing is left behind.
    """
    if path.is_dir():
        raise InputError(path, "is a folder", "give a file")
    partial = path.with_name(f".{path.name}.partial-{secrets.token_hex(4)}")
    with said_clearly(path):
        try:
            partial.write_bytes(content)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)


@contextmanager
def said_clearly(folder: Path) -> Iterator[None]:
    """Turn an OSError while writing into one sentence that names the folder, the reason and the remedy.

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
        raise InputError(folder, reason, remedy) from error
