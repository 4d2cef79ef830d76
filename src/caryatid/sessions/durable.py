"""Files and folders that are there whole, and stay there when the power goes, or are not there at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from caryatid.io.staging import said_clearly

PARTIAL = ".partial-"
"""What names of files and folders in the making begin with; what a death leaves of them is garbage."""


def write_durably(path: Path, content: bytes) -> None:
    """Write a file that is there whole or not at all; when this returns, it is on the disk.

    Raises:
        InputError: The disk is full or refuses; what was there before is still there.
    """
    partial = _partial(path)
    try:
        with said_clearly(path):
            _write(partial, content)
            partial.replace(path)
            settle(path.parent)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def publish_durably(folder: Path, files: Mapping[str, bytes]) -> None:
    """Make a folder of files that appears whole or not at all; when this returns, it is on the disk.

    Args:
        folder: Where; nothing may be there.
        files: Name → content.

    Raises:
        InputError: The disk is full or refuses; nothing is left behind.
    """
    partial = _partial(folder)
    try:
        with said_clearly(folder):
            partial.mkdir()
            for name, content in files.items():
                _write(partial / name, content)
            settle(partial)
            partial.rename(folder)
            settle(folder.parent)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def remove_durably(folder: Path) -> None:
    """Take a folder away in one step; when this returns, it will not come back.

    Raises:
        InputError: The disk refuses.
    """
    partial = _partial(folder)
    with said_clearly(folder):
        folder.rename(partial)
        settle(folder.parent)
    shutil.rmtree(partial, ignore_errors=True)


def clear_partials(folder: Path) -> None:
    """Remove what deaths left of files and folders in the making; only who holds the lock may."""
    for path in folder.glob(f"{PARTIAL}*"):
        with suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def _partial(path: Path) -> Path:
    return path.with_name(f"{PARTIAL}{path.name}-{secrets.token_hex(4)}")


def _write(path: Path, content: bytes) -> None:
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def settle(folder: Path) -> None:
    """Have the names in a folder written to the disk, where the system can."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
