"""Clouds from PCD and PLY files: finite points with normals, labels and colours where the file has them."""

from __future__ import annotations

import io
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from caryatid.config import CloudConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.clouds import estimate_normals
from caryatid.sensing.views import SUPPORT_LABEL, Cloud

REMEDY: Final = "export the cloud again"
MISSING: Final = "give a .pcd or .ply file"
MAX_COMPRESSION: Final = 100
"""Bytes of points one byte of a file can hold: LZF writes at most 264 for 3."""


@dataclass(frozen=True, eq=False, slots=True)
class StoredCloud:
    """All points of a file, in its order and in its frame.

    Attributes:
        points: (N, 3) [m]; NaN or infinite where the sensor had no reading.
        normals: (N, 3) as stored, or None.
        labels: Object number of each point (N,), 0 = nothing, or None.
        rgb: (N, 3) uint8, or None.
        viewpoint: Where the sensor was (3,) [m]; the origin where the file does not say.
        size: Width and height of an organised cloud, or None.
        name: The file.
    """

    points: Array
    normals: Array | None
    labels: NDArray[np.int32] | None
    rgb: NDArray[np.uint8] | None
    viewpoint: Array
    size: tuple[int, int] | None
    name: str

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Which points (N,) are readings: finite, and not in the sensor's own centre."""
        return np.isfinite(self.points).all(axis=1) & (self.points != self.viewpoint).any(axis=1)

    def spread(self, values: NDArray[np.int32]) -> NDArray[np.int32]:
        """Give every stored point (N,) the value of its reading (M,); 0 where there was no reading."""
        kept = self.kept
        result = np.zeros(len(kept), dtype=np.int32)
        result[kept] = values
        return result

    def to_cloud(self, config: CloudConfig) -> Cloud:
        """Keep the readings and give them normals.

        Stored normals are taken as they are, scaled to length 1; where the file has none, or not for every
        reading, all are estimated from neighbours and point to the viewpoint.

        Args:
            config: Neighbours a normal is estimated from.

        Returns:
            The readings in the file's frame, in the file's order.
        """
        kept = self.kept
        points = self.points[kept]
        normals = None if self.normals is None else transforms.unit(self.normals[kept])
        if normals is None or not (np.isfinite(normals).all() and (normals != 0.0).any(axis=1).all()):
            normals = estimate_normals(points, self.viewpoint, config.neighbours)
        return Cloud(
            points,
            normals,
            None if self.labels is None else self.labels[kept],
            None if self.rgb is None else self.rgb[kept],
            self.viewpoint,
            self.name,
        )


def read_cloud(path: str | Path, config: CloudConfig, label_divisor: int = 1) -> Cloud:
    """Read the readings of a PCD or PLY file, with normals; see `read_stored_cloud`.

    Args:
        path: The file.
        config: How normals are estimated, and what is too far.
        label_divisor: Labels are divided by this: 10 where a part's label is 10 · object + part.

    Raises:
        InputError: The file is missing or broken, or holds no readings.
    """
    return read_stored_cloud(path, label_divisor).to_cloud(config)


def read_stored_cloud(path: str | Path, label_divisor: int = 1) -> StoredCloud:
    """Read all points of a PCD or PLY file.

    Args:
        path: A file that ends in .pcd or .ply.
        label_divisor: The object number is the field `label` divided by this, rounded down. 1 takes the field
            as it is; sets that number the parts of objects, as mOSD does with object = label // 10, need 10.

    Raises:
        InputError: The file is missing, of another kind, broken, its header lies, it holds no readings, or
            its labels are no object numbers.
    """
    path = Path(path)
    if label_divisor < 1:
        raise InputError("label_divisor", f"is {label_divisor}", "give 1 or more")
    match path.suffix.lower():
        case ".pcd":
            columns, viewpoint, size = _read_pcd(path)
        case ".ply":
            columns, viewpoint, size = _read_ply(path), np.zeros(3), None
        case _:
            raise InputError(path, "is no .pcd or .ply file", "convert it to one of these")
    stored = StoredCloud(
        points=_stack(columns, ("x", "y", "z")),
        normals=_normals(columns),
        labels=_labels(columns, label_divisor, path),
        rgb=_colours(columns),
        viewpoint=viewpoint,
        size=size,
        name=path.name,
    )
    if not stored.kept.any():
        raise InputError(path, "has no finite points", "give a cloud with readings")
    return stored


def _read_pcd(path: Path) -> tuple[dict[str, NDArray[Any]], Array, tuple[int, int] | None]:
    """Fields of one value per point (N,), viewpoint (3,), and width and height of an organised cloud."""
    from pypcd4.pypcd4 import MetaData, PointCloud

    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "the file is missing", MISSING) from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", MISSING) from error
    end = re.search(rb"^DATA\b[^\n]*\n", content[:65536], re.MULTILINE)
    if end is None:
        raise InputError(path, "is no PCD: its header has no DATA line", REMEDY)
    lines = content[: end.end()].decode("ascii", errors="replace").splitlines()
    if not any(line.startswith("COUNT") for line in lines):
        fields = next((line.split()[1:] for line in lines if line.startswith("FIELDS")), [])
        lines.insert(0, f"COUNT {' '.join('1' for _ in fields)}")
    try:
        header = MetaData.parse_header(lines)
        dtype = header.build_dtype()
    except Exception as error:
        raise InputError(path, f"the header is not valid ({_reason(error)})", REMEDY) from None
    if not len(header.fields) == len(header.size) == len(header.type) == len(header.count):
        raise InputError(path, "the header's FIELDS, SIZE, TYPE and COUNT do not agree", REMEDY)
    names = dtype.names or ()
    if any(axis not in names or dtype[axis].kind != "f" for axis in "xyz"):
        raise InputError(path, "has no fields x y z of floating point numbers", REMEDY)
    if header.points == 0:
        raise InputError(path, "holds no points", "give a cloud with points")
    if header.width * header.height != header.points:
        size = f"WIDTH {header.width} × HEIGHT {header.height}"
        raise InputError(path, f"the header lies: {size} is not POINTS {header.points}", REMEDY)
    body, needed = content[end.end() :], header.points * dtype.itemsize
    if header.data.value == "ascii":
        body = b"\n".join(b" ".join(row) for line in body.splitlines() if (row := line.split())) + b"\n"
    compressed = header.data.value == "binary_compressed"
    promised = struct.unpack("<II", body[:8])[1] if compressed and len(body) >= 8 else needed
    rest = body[needed:] if header.data.value == "binary" else b""
    try:
        if promised != needed or needed > MAX_COMPRESSION * len(body.strip()):
            raise ValueError(f"they take {needed} bytes, {len(body)} bytes follow")
        if len(rest) >= dtype.itemsize and any(rest):
            raise ValueError("more data follows")
        text = header.compose_header().encode()
        data = np.atleast_1d(PointCloud.from_fileobj(io.BytesIO(text + body)).pc_data)
        if len(data) != header.points:
            raise ValueError(f"data of {len(data)} points follows")
    except Exception as error:
        reason = f"the header lies or the file is truncated: POINTS {header.points}, but {_reason(error)}"
        raise InputError(path, reason, REMEDY) from None
    viewpoint = np.array(header.viewpoint[:3], dtype=np.float64)
    if not np.isfinite(viewpoint).all():
        raise InputError(path, "VIEWPOINT is not finite", REMEDY)
    size_px = (header.width, header.height) if header.height > 1 else None
    return {name: data[name] for name in header.fields if name in names}, viewpoint, size_px


def _read_ply(path: Path) -> dict[str, NDArray[Any]]:
    from trimesh.exchange.ply import load_ply

    try:
        with path.open("rb") as file:
            vertex = load_ply(file, fix_texture=False, skip_materials=True)["metadata"]["_ply_raw"]["vertex"]
    except FileNotFoundError:
        raise InputError(path, "the file is missing", MISSING) from None
    except KeyError as error:
        raise InputError(path, f"has no vertices with x y z ({error})", REMEDY) from error
    except Exception as error:
        reason = f"is no PLY, is truncated or its header lies ({_reason(error)})"
        raise InputError(path, reason, REMEDY) from error
    data = vertex.get("data")
    if data is None:
        raise InputError(path, "holds no points", "give a cloud with points")
    names = data.keys() if isinstance(data, dict) else data.dtype.names
    columns = {name: np.asarray(data[name]).reshape(len(data[name]), -1)[:, 0] for name in names}
    if not {"x", "y", "z"} <= columns.keys():
        raise InputError(path, "has no vertices with x y z", REMEDY)
    lengths = {len(column) for column in columns.values()}
    if lengths != {vertex["length"]}:
        reason = f"the header lies: {vertex['length']} points said, {min(lengths)} there"
        raise InputError(path, reason, REMEDY)
    return {name.lower(): column for name, column in columns.items()}


def _reason(error: Exception) -> str:
    """One line of what a library says."""
    if hasattr(error, "errors"):
        first = error.errors()[0]
        return f"{str(first['loc'][0]).upper()}: {first['msg'].lower()}"
    return " ".join(str(error).split())[:200] or type(error).__name__


def _stack(columns: dict[str, NDArray[Any]], names: tuple[str, ...]) -> Array:
    return np.stack([columns[name].astype(np.float64) for name in names], axis=-1)


def _normals(columns: dict[str, NDArray[Any]]) -> Array | None:
    for names in (("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz")):
        if columns.keys() >= set(names):
            return _stack(columns, names)
    return None


def _labels(columns: dict[str, NDArray[Any]], divisor: int, path: Path) -> NDArray[np.int32] | None:
    if "label" not in columns:
        return None
    raw = columns["label"].astype(np.float64)
    if not np.isfinite(raw).all() or (raw != np.floor(raw)).any() or (raw < 0.0).any():
        raise InputError(
            path, "the field label holds what is no whole number from 0", "number objects from 1"
        )
    labels = raw // divisor
    if (labels >= SUPPORT_LABEL).any():
        raise InputError(
            path,
            f"the field label reaches {int(labels.max())}",
            f"number objects from 1 to {SUPPORT_LABEL - 1}",
        )
    return labels.astype(np.int32)


def _colours(columns: dict[str, NDArray[Any]]) -> NDArray[np.uint8] | None:
    for name in ("rgb", "rgba"):
        if name in columns and columns[name].dtype.itemsize == 4:
            packed = np.ascontiguousarray(columns[name]).view(np.uint32)
            return np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=-1).astype(np.uint8)
    if not columns.keys() >= {"red", "green", "blue"}:
        return None
    colours = _stack(columns, ("red", "green", "blue"))
    if columns["red"].dtype.kind == "f" and np.nanmax(colours, initial=0.0) <= 1.0:
        colours = colours * 255.0
    return np.clip(np.nan_to_num(colours), 0.0, 255.0).astype(np.uint8)
