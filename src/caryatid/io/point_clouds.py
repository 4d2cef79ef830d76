"""Clouds from PCD and PLY files: finite points, with normals, labels and colours where the file has them."""

from __future__ import annotations

import io
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from caryatid.config import CloudConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.datasets import find_sample
from caryatid.io.staging import read_errors
from caryatid.sensing.clouds import estimate_normals
from caryatid.sensing.views import MAX_LABEL, SUPPORT_LABEL, Cloud

Columns = dict[str, NDArray[Any]]
"""Fields of one value per point (N,)."""
NOTHING = (-1.0, SUPPORT_LABEL, 2.0**32 - 1.0)
"""Labels of no object beside 0: −1, in 32 bits without a sign too, and void in 16 bits."""


_PCD_DEFAULTS: Final = {"SIZE": "4", "TYPE": "F", "COUNT": "1"}
"""Lines that PCD files older than 0.7 may lack, and what they say for each field."""


@dataclass(frozen=True, eq=False, slots=True)
class StoredCloud:
    """All points of a file, in its order and in its frame.

    Attributes:
        points: (N, 3) [m]; NaN or infinite where the sensor had no reading.
        normals: (N, 3) as stored, or None.
        labels: Object number of each point (N,), 0 = nothing, or None.
        rgb: (N, 3) uint8, or None.
        T_world_sensor: Pose (4, 4) of the sensor by the file; the identity if it does not say. Some programs
            store points in the frame of the sensor, others in that of the world.
        name: The file.
    """

    points: Array
    normals: Array | None
    labels: NDArray[np.int32] | None
    rgb: NDArray[np.uint8] | None
    T_world_sensor: Array
    name: str

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Which points (N,) are readings: finite, and not at the sensor's own centre."""
        centres = np.zeros(3), self.T_world_sensor[:3, 3]
        apart = [(self.points != centre).any(axis=1) for centre in centres]
        return np.isfinite(self.points).all(axis=1) & apart[0] & apart[1]

    def spread(self, values: NDArray[np.int32]) -> NDArray[np.int32]:
        """Spread values of the readings (M,) over all stored points (N,); 0 without a reading."""
        kept = self.kept
        result = np.zeros(len(kept), dtype=np.int32)
        result[kept] = values
        return result

    def to_cloud(self, config: CloudConfig, T_sensor_file: Array | None = None) -> Cloud:
        """Keep the readings and give them normals.

        Stored normals are used, scaled to length 1. If the file has none, or not for every reading, all are
        estimated from neighbours and point to the sensor.

        Args:
            config: How normals are estimated.
            T_sensor_file: Transform (4, 4) to the frame of the sensor, its viewpoint. None = keep the
                frame of the file; normals are estimated as if the sensor were at the origin.
        """
        kept, T = self.kept, np.eye(4) if T_sensor_file is None else T_sensor_file
        points, eye = transforms.transform(T, self.points[kept]), np.zeros(3)
        normals = None if self.normals is None else transforms.unit(self.normals[kept])
        if normals is None or not (np.isfinite(normals).all() and (normals != 0.0).any(axis=1).all()):
            normals = estimate_normals(points, eye, config.neighbours)
        elif T_sensor_file is not None:
            normals = transforms.rotate(T, normals)
        labels = None if self.labels is None else self.labels[kept]
        rgb = None if self.rgb is None else self.rgb[kept]
        return Cloud(points, normals, labels, rgb, eye if T_sensor_file is not None else None, self.name)


def read_stored_cloud(path: str | Path, label_divisor: int = 1) -> StoredCloud:
    """Read all points of a PCD or PLY file.

    Args:
        path: A file that ends in .pcd or .ply, or `sample-cloud`.
        label_divisor: The object number is the field `label` divided by this, rounded down. Data sets that
            number parts of objects need it: mOSD has object = label // 10.

    Raises:
        InputError: The file is missing, of another kind or broken, its header is wrong, it has no readings,
            or its labels are not object numbers.
    """
    path = find_sample(path)
    parse = {".pcd": _parse_pcd, ".ply": _parse_ply}.get(path.suffix.lower())
    if parse is None:
        raise InputError(path, "not a .pcd or .ply file", "convert it to one of these")
    with read_errors(path, "give a .pcd or .ply file"):
        content = path.read_bytes()
    try:
        columns, T_world_sensor = parse(content)
        points = _triple(columns, "x y z")
        if points is None or any(columns[axis].dtype.kind != "f" for axis in "xyz"):
            raise ValueError("no floating-point fields x y z")
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        if hasattr(error, "errors"):
            first = error.errors()[0]
            reason = f"{str(first['loc'][0]).upper()}: {first['msg'].lower()}"
        elif isinstance(error, KeyError):
            reason = f"no {error}"
        raise InputError(path, f"broken file or header: {reason}", "export the cloud again") from error
    normals = _triple(columns, "normal_x normal_y normal_z", "nx ny nz")
    labels = _labels(columns, label_divisor, path)
    stored = StoredCloud(points, normals, labels, _colours(columns), T_world_sensor, path.name)
    if not stored.kept.any():
        raise InputError(path, "has no finite points", "give a cloud with readings")
    return stored


def _parse_pcd(content: bytes) -> tuple[Columns, Array]:
    """The fields and the pose of the sensor (4, 4). Errors are a ValueError, or an exception of pypcd4."""
    from pypcd4.pypcd4 import MetaData, PointCloud

    end = re.search(rb"^DATA\b[^\n]*\n", content[:65536], re.MULTILINE)
    if end is None:
        raise ValueError("no DATA line")
    lines = content[: end.end()].decode("ascii", errors="replace").splitlines()
    header = MetaData.parse_header(_tidy_header(lines))
    if sum(header.count) > 1000:  # the library makes a field of each
        raise ValueError(f"the sum of COUNT, {sum(header.count)}, exceeds 1000")
    dtype = header.build_dtype()
    if header.width * header.height != header.points or header.points == 0:
        raise ValueError(f"WIDTH {header.width} × HEIGHT {header.height}, POINTS {header.points}")
    if not np.isfinite(header.viewpoint).all():
        raise ValueError("VIEWPOINT is not finite")
    body, needed = content[end.end() :], header.points * dtype.itemsize
    promised = needed
    if header.data.value == "ascii":
        body = b"\n".join(b" ".join(row) for line in body.splitlines() if (row := line.split())) + b"\n"
    elif header.data.value == "binary":
        if len(body) - needed >= dtype.itemsize and any(body[needed:]):
            raise ValueError(f"POINTS {header.points}, but more data follows")
    else:
        packed, promised = struct.unpack("<II", body[:8])
    # LZF writes at most 264 bytes for 3.
    if promised != needed or needed > 100 * len(body.strip()):
        raise ValueError(f"POINTS {header.points} take {needed} bytes, {len(body)} bytes follow")
    encoding = header.data
    if encoding.value == "binary_compressed" and packed == promised:  # what did not shrink is stored as it is
        raw, encoding = np.empty(header.points, dtype), type(encoding)("binary")
        starts = 8 + header.points * np.cumsum([0, *(dtype[name].itemsize for name in dtype.names or ())])
        for name, start in zip(dtype.names or (), starts, strict=False):
            raw[name] = np.frombuffer(body, dtype[name], header.points, start)
        body = raw.tobytes()
    file = io.BytesIO(header.compose_header(encoding).encode() + body)
    data = np.atleast_1d(PointCloud.from_fileobj(file).pc_data)
    if len(data) != header.points:
        raise ValueError(f"POINTS {header.points}, but data of {len(data)} points follows")
    *place, w, x, y, z = header.viewpoint
    turn = Rotation.from_quat((x, y, z, w)).as_matrix() if any((w, x, y, z)) else np.eye(3)
    return {name: data[name] for name in dtype.names or ()}, transforms.rigid(turn, place)


def _tidy_header(lines: list[str]) -> list[str]:
    """A header as pypcd4 takes it, of one that PCL takes: padding without names, older versions, defaults."""
    rows = (line.partition("#")[0].split() for line in lines)
    words = {row[0].upper(): row[1:] for row in rows if row}
    names = words.get("FIELDS") or words.pop("COLUMNS", [])
    table = [names, *(words.get(key, [default] * len(names)) for key, default in _PCD_DEFAULTS.items())]
    if len({len(column) for column in table}) > 1:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT do not agree")
    fields = [field for field in zip(*table, strict=True) if field[3] != "0"]
    for column, key in enumerate(("FIELDS", *_PCD_DEFAULTS)):
        words[key] = [field[column] for field in fields]
    words["FIELDS"] = [f"padding{n}" if name == "_" else name for n, name in enumerate(words["FIELDS"])]
    if words.get("VERSION") in (["0.5"], [".5"], ["0.6"], [".6"]):
        del words["VERSION"]
    words.setdefault("WIDTH", words.get("POINTS", []))
    return [" ".join((key, *rest)) for key, rest in words.items()]


def _parse_ply(content: bytes) -> tuple[Columns, Array]:
    """The fields, and the identity as the pose of the sensor; like `_parse_pcd`."""
    from trimesh.exchange.ply import _parse_header, load_ply

    file = io.BytesIO(content)
    elements, is_ascii, _ = _parse_header(file)
    kinds = list(elements["vertex"]["properties"].values())
    if not is_ascii and next(iter(elements)) == "vertex" and "LIST" not in "".join(kinds):
        # Without what follows the points, because trimesh takes only lists of one length, as of triangles.
        start = file.tell()
        head = re.sub(rb"(?ms)^element (?!vertex).*?(?=^end_header)", b"", content[:start])
        if len(head) < start:
            size = elements["vertex"]["length"] * np.dtype(",".join(kinds)).itemsize
            content = head + content[start : start + size]
    loaded = load_ply(io.BytesIO(content), fix_texture=False, skip_materials=True)
    vertex = loaded["metadata"]["_ply_raw"]["vertex"]
    data = vertex["data"]
    names = data.keys() if isinstance(data, dict) else data.dtype.names
    columns = {name.lower(): np.asarray(data[name]).reshape(len(data[name]), -1)[:, 0] for name in names}
    if any(len(column) != vertex["length"] for column in columns.values()):
        raise ValueError(f"fewer than {vertex['length']} points")
    return columns, np.eye(4)


def _triple(columns: Columns, *choices: str) -> Array | None:
    """The first three fields that all exist, as (N, 3)."""
    for names in map(str.split, choices):
        if columns.keys() >= set(names):
            return np.stack([columns[name].astype(np.float64) for name in names], axis=-1)
    return None


def _labels(columns: Columns, divisor: int, path: Path) -> NDArray[np.int32] | None:
    if "label" not in columns:
        return None
    raw = columns["label"].astype(np.float64)
    raw[np.isin(raw, NOTHING)] = 0.0
    labels = raw // divisor
    if not ((raw >= 0.0) & (raw == np.floor(raw)) & (labels <= MAX_LABEL)).all():
        reason = f"labels are not all integers from 0 to {divisor * (MAX_LABEL + 1) - 1}"
        raise InputError(path, reason, "number objects from 1")
    return labels.astype(np.int32)


def _colours(columns: Columns) -> NDArray[np.uint8] | None:
    for name in ("rgb", "rgba"):
        if name in columns and columns[name].dtype.itemsize == 4:
            packed = np.ascontiguousarray(columns[name]).view(np.uint32)
            return np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=-1).astype(np.uint8)
    colours = _triple(columns, "red green blue")
    if colours is None:
        return None
    if columns["red"].dtype.kind == "f" and np.nanmax(colours, initial=0.0) <= 1.0:
        colours = colours * 255.0
    return np.clip(np.nan_to_num(colours), 0.0, 255.0).astype(np.uint8)
