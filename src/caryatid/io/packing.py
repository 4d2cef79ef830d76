"""Dataclasses with arrays in one file: a .npz with a JSON document and each larger array."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


def pack(value: Any) -> bytes:
    """Return the content of a .npz: the value as JSON in the member `document`, larger arrays as members.

    The same value gives the same bytes.
    """
    arrays: dict[str, NDArray[Any]] = {}

    def encoded(value: Any, path: str) -> Any:
        match value:
            case np.ndarray() if 0 < value.size <= 16 and value.dtype == np.float64:
                return {"$array": value.tolist()}
            case np.ndarray():
                arrays[path] = value
                return {"$array": path}
            case np.generic():
                return value.item()
            case Mapping():
                return {key: encoded(item, f"{path}.{key}".strip(".")) for key, item in value.items()}
            case tuple():
                return [encoded(item, f"{path}.{number}") for number, item in enumerate(value)]
        if is_dataclass(value):
            members = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
            return {"$kind": type(value).__name__} | encoded(members, path)
        return value

    arrays["document"] = np.frombuffer(json.dumps(encoded(value, "")).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    # Higher levels of compression take longer and save little.
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def unpack(content: bytes, kinds: Collection[type]) -> Any:
    """Return what `pack` packed; of dataclasses only these kinds.

    A damaged file raises almost any exception.
    """
    arrays = dict(np.load(io.BytesIO(content), allow_pickle=False))
    known = {kind.__name__: kind for kind in kinds}

    def decoded(value: Any) -> Any:
        match value:
            case {"$array": str(name)}:
                return arrays[name]
            case {"$array": numbers}:
                return np.array(numbers)
            case {"$kind": kind, **members}:
                return known[kind](**decoded(members))
            case dict():
                return {key: decoded(item) for key, item in value.items()}
            case list():
                return tuple(decoded(item) for item in value)
        return value

    return decoded(json.loads(arrays.pop("document").tobytes()))
