"""PCD files: the header is checked against the data before anything is decoded."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from caryatid.errors import InputError

_SIZES: Final = {"F": (4, 8), "U": (1, 2, 4, 8), "I": (1, 2, 4, 8)}
_ENCODINGS: Final = ("ascii", "binary", "binary_compressed")
_MAX_COMPRESSION: Final = 100
"""LZF writes at most 264 bytes for 3; a header that promises more lies."""
_REMEDY: Final = "export the cloud again"


@dataclass(frozen=True, slots=True)
class Header:
    """The header of a PCD file.

    Attributes:
        fields: Names.
        sizes: Bytes of one value of each field.
        types: F, U or I.
        counts: Values of each field in one point.
        width: Points in a row; all of them where the cloud is not organised.
        height: Rows; 1 where the cloud is not organised.
        points: Points.
        viewpoint: Sensor position [m] and orientation (w, x, y, z).
        data: `ascii`, `binary` or `binary_compressed`.
        offset: Where the data begins [bytes].
    """

    fields: tuple[str, ...]
    sizes: tuple[int, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    width: int
    height: int
    points: int
    viewpoint: tuple[float, ...]
    data: str
    offset: int

    @property
    def point_bytes(self) -> int:
        """Bytes of one point."""
        return sum(size * count for size, count in zip(self.sizes, self.counts, strict=True))


def read_pcd(path: Path) -> tuple[Header, dict[str, NDArray[Any]]]:
    """Read a PCD file: ascii, binary or binary_compressed.

    Returns:
        The header, and each field of one value a point as an array (N,).

    Raises:
        InputError: The file is missing or no PCD, or its header and its data do not agree.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "the file is missing", "give a .pcd or .ply file") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "give a .pcd or .ply file") from error
    header = parse_header(content, path)
    body = content[header.offset :]
    if header.data == "ascii":
        body = _check_ascii(header, body, path)
    elif header.data == "binary":
        _check_binary(header, body, path)
    else:
        _check_compressed(header, body, path)
    return header, _decode(header, body, path)


def parse_header(content: bytes, path: Path) -> Header:
    """Parse the header of a PCD file and check it for agreeing with itself.

    Raises:
        InputError: A line is missing or not valid, numbers of fields differ, or WIDTH × HEIGHT is not POINTS.
    """
    entries: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in entries:
        end = content.find(b"\n", offset)
        if end < 0 or offset > 65536:
            raise InputError(path, "is no PCD: its header has no DATA line", _REMEDY)
        words = content[offset:end].decode("ascii", errors="replace").split()
        offset = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    fields = tuple(entries.get("FIELDS", entries.get("COLUMNS", [])))
    if not {"x", "y", "z"} <= set(fields):
        raise InputError(path, f"has no fields x y z (FIELDS {' '.join(fields)})", _REMEDY)
    header = Header(
        fields=fields,
        sizes=_whole_numbers(entries, "SIZE", path),
        types=tuple(entries.get("TYPE", [])),
        counts=_whole_numbers(entries, "COUNT", path) if "COUNT" in entries else (1,) * len(fields),
        width=_whole_number(entries, "WIDTH", path),
        height=_whole_number(entries, "HEIGHT", path),
        points=_whole_number(entries, "POINTS", path),
        viewpoint=_viewpoint(entries.get("VIEWPOINT", []), path),
        data=" ".join(entries["DATA"]).lower(),
        offset=offset,
    )
    _check_header(header, path)
    return header


def _check_header(header: Header, path: Path) -> None:
    lengths = {len(header.fields), len(header.sizes), len(header.types), len(header.counts)}
    if len(lengths) > 1 or len(set(header.fields) - {"_"}) < len([f for f in header.fields if f != "_"]):
        raise InputError(path, "the header's FIELDS, SIZE, TYPE and COUNT do not agree", _REMEDY)
    for name, kind, size, count in zip(header.fields, header.types, header.sizes, header.counts, strict=True):
        if size not in _SIZES.get(kind, ()) or count < 1:
            raise InputError(path, f"field '{name}' has TYPE {kind}, SIZE {size}, COUNT {count}", _REMEDY)
        if name in ("x", "y", "z") and (kind != "F" or count != 1):
            raise InputError(path, f"field '{name}' is not one floating point number", _REMEDY)
    if header.width * header.height != header.points:
        raise InputError(
            path,
            f"the header lies: WIDTH {header.width} × HEIGHT {header.height} is not POINTS {header.points}",
            _REMEDY,
        )
    if header.points == 0:
        raise InputError(path, "holds no points", "give a cloud with points")
    if header.data not in _ENCODINGS:
        raise InputError(path, f"DATA is '{header.data}'", f"export the cloud as {', '.join(_ENCODINGS)}")


def _check_ascii(header: Header, body: bytes, path: Path) -> bytes:
    """Return the rows with one space between numbers, after checking how many there are."""
    rows = [row for row in (line.split() for line in body.splitlines()) if row]
    if len(rows) != header.points:
        raise _lie(path, header.points, f"{len(rows)} lines of data follow")
    columns = sum(header.counts)
    for index, row in enumerate(rows):
        if len(row) != columns:
            raise InputError(path, f"point {index} has {len(row)} numbers, not {columns}", _REMEDY)
    return b"\n".join(b" ".join(row) for row in rows) + b"\n"


def _check_binary(header: Header, body: bytes, path: Path) -> None:
    expected = header.points * header.point_bytes
    rest = body[expected:]
    if len(body) < expected or (len(rest) >= header.point_bytes and any(rest)):
        raise _lie(
            path, header.points, f"{expected} bytes of data would have to follow, there are {len(body)}"
        )


def _check_compressed(header: Header, body: bytes, path: Path) -> None:
    expected = header.points * header.point_bytes
    compressed, uncompressed = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, 0)
    if uncompressed != expected:
        raise _lie(path, header.points, f"they take {expected} bytes, the data unpacks to {uncompressed}")
    if compressed > len(body) - 8:
        raise _lie(
            path,
            header.points,
            f"{compressed} compressed bytes would have to follow, there are {len(body) - 8}",
        )
    if uncompressed > _MAX_COMPRESSION * compressed:
        raise _lie(path, header.points, f"{compressed} compressed bytes cannot hold them")


def _decode(header: Header, body: bytes, path: Path) -> dict[str, NDArray[Any]]:
    from pypcd4 import PointCloud

    lines = (
        "VERSION 0.7",
        f"FIELDS {' '.join(header.fields)}",
        f"SIZE {' '.join(map(str, header.sizes))}",
        f"TYPE {' '.join(header.types)}",
        f"COUNT {' '.join(map(str, header.counts))}",
        f"WIDTH {header.width}",
        f"HEIGHT {header.height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {header.points}",
        f"DATA {header.data}",
    )
    try:
        data = PointCloud.from_fileobj(io.BytesIO("\n".join(lines).encode() + b"\n" + body)).pc_data
    except Exception as error:
        raise InputError(path, f"the data cannot be decoded ({_one_line(error)})", _REMEDY) from error
    data = np.atleast_1d(data)
    names = data.dtype.names or ()
    return {name: data[name] for name in header.fields if name in names}


def _viewpoint(words: list[str], path: Path) -> tuple[float, ...]:
    if not words:
        return (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    try:
        viewpoint = tuple(float(word) for word in words)
    except ValueError:
        viewpoint = ()
    if len(viewpoint) != 7 or not np.isfinite(viewpoint).all():
        raise InputError(path, f"VIEWPOINT {' '.join(words)} is not seven numbers", _REMEDY)
    return viewpoint


def _whole_numbers(entries: dict[str, list[str]], key: str, path: Path) -> tuple[int, ...]:
    words = entries.get(key, [])
    if not words or not all(word.isascii() and word.isdigit() and len(word) <= 12 for word in words):
        raise InputError(path, f"the header's {key} is '{' '.join(words)}', not whole numbers", _REMEDY)
    return tuple(int(word) for word in words)


def _whole_number(entries: dict[str, list[str]], key: str, path: Path) -> int:
    values = _whole_numbers(entries, key, path)
    if len(values) != 1:
        raise InputError(path, f"the header's {key} is not one number", _REMEDY)
    return values[0]


def _lie(path: Path, points: int, why: str) -> InputError:
    return InputError(path, f"the header lies or the file is truncated: POINTS {points}, but {why}", _REMEDY)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
