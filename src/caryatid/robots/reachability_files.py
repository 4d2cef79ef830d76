"""Maps of what an arm reaches, as .npz files: sampled once, used wherever the arm stands."""

from __future__ import annotations

import io
import os
import secrets
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from caryatid.errors import InputError
from caryatid.io.staging import write_errors
from caryatid.robots.reachability import ReachabilityMap

FORMAT, VERSION = "caryatid/reachability", 1
"""What the file says it is."""

MAX_BYTES = 2**31
"""A larger map is refused before it is unpacked; 3 m of cells of 2 cm with 600 directions are as much."""

REMEDY = "sample it again and write it with write_reachability"
"""What to do where a file is broken."""


def write_reachability(path: str | os.PathLike[str], reachability: ReachabilityMap) -> None:
    """Write a map; the file appears whole or not at all, and the same map gives the same bytes.

    Args:
        path: The file, `.npz`.
        reachability: The map.

    Raises:
        InputError: The file cannot be written.
    """
    file = Path(path)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        format=np.array(FORMAT),
        version=np.array(VERSION),
        reached=reachability.reached,
        origin_base=reachability.origin_base,
        cell=np.array(reachability.cell),
        fresh=np.array(reachability.fresh),
    )
    partial = file.with_name(f".{file.name}.partial-{secrets.token_hex(4)}")
    try:
        with write_errors(file):
            partial.write_bytes(buffer.getvalue())
            partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def read_reachability(path: str | os.PathLike[str]) -> ReachabilityMap:
    """Read a map.

    Raises:
        InputError: The file is missing, damaged, something else, or from another version.
    """
    file = Path(path)
    try:
        with zipfile.ZipFile(file) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            raise InputError(file, f"would unpack to {size / 2**30:.1f} GiB", "sample it with larger cells")
        with np.load(file, allow_pickle=False) as stored:
            held = {name: stored[name] for name in stored.files}
    except FileNotFoundError:
        raise InputError(file, "the file is missing", REMEDY) from None
    except OSError as error:
        raise InputError(file, f"cannot be read ({error.strerror})", "give a file you may read") from error
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, RuntimeError, MemoryError) as error:
        raise InputError(file, f"is no readable .npz: {error}", REMEDY) from None
    return _checked(held, file)


def _checked(held: dict[str, Any], file: Path) -> ReachabilityMap:
    """Make a map of the arrays of a file, if they are those of one."""
    if "format" not in held or str(held["format"]) != FORMAT:
        raise InputError(file, f"is no map of what an arm reaches, its format is not '{FORMAT}'", REMEDY)
    wanted = ("version", "reached", "origin_base", "cell", "fresh")
    if missing := [name for name in wanted if name not in held]:
        raise InputError(file, f"holds no {missing[0]}", REMEDY)
    if held["version"].shape != () or held["version"] != VERSION:
        raise InputError(file, f"has version {held['version']}, not {VERSION}", REMEDY)
    reached, origin = held["reached"], held["origin_base"]
    if reached.ndim != 4 or reached.dtype != np.uint8 or reached.size == 0:
        raise InputError(
            file, f"its map is {reached.dtype} of shape {reached.shape}, not uint8 (X, Y, Z, D)", REMEDY
        )
    numbers = [("origin_base", origin, (3,)), ("cell", held["cell"], ()), ("fresh", held["fresh"], ())]
    for name, value, shape in numbers:
        if value.shape != shape or value.dtype.kind != "f" or not np.isfinite(value).all():
            raise InputError(file, f"its {name} is not a finite number of shape {shape}", REMEDY)
    if held["cell"] <= 0.0:
        raise InputError(file, f"its cells are {held['cell']:g} m wide", REMEDY)
    return ReachabilityMap(reached, origin.astype(np.float64), float(held["cell"]), float(held["fresh"]))
