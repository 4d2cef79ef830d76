"""JSON, read strictly and written so that the same content gives the same bytes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import GetPydanticSchema, TypeAdapter, ValidationError
from pydantic_core import core_schema, from_json

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.staging import read_errors

T = TypeVar("T")

LARGEST: Final = 2.0**63
"""Largest number in a file, in any unit: its square is finite, and it fits in 64 bits."""
LARGEST_FILE: Final = 100_000_000
"""Maximum size of a file [bytes]; reading it takes ten times as much memory."""
DECIMALS: Final = 9
"""Decimals of floats in files: a nanometre, far below the sensor's noise, far above rounding errors."""


def Numbers(*shape: int, rigid: bool = False) -> GetPydanticSchema:
    """Mark a field of nested lists of finite numbers, such as a matrix, in an `Annotated` type.

    Args:
        *shape: Sizes; -1 = any.
        rigid: Whether they must be a rigid transform.
    """
    schema: dict[str, Any] = {"type": "number"}
    for size in reversed(shape):
        schema = {"type": "array", "items": schema}
        if size >= 0:
            schema |= {"minItems": size, "maxItems": size}

    def read(value: Any) -> Array:
        try:
            array = np.array(value)
        except ValueError:
            array = np.array("lists of different lengths")
        if array.size == 0 and shape[0] < 0:
            array = array.reshape(0, *shape[1:])
        same = array.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, array.shape, strict=True))
        if not same or array.dtype.kind not in "if" or not (np.abs(array) <= LARGEST).all():
            sizes = "×".join("N" if n < 0 else str(n) for n in shape)
            raise ValueError(f"must be {sizes} finite numbers")
        array = array.astype(np.float64)
        try:
            return transforms.as_rigid(array, "") if rigid else array
        except InputError as error:
            raise ValueError(error.reason) from None

    validator = core_schema.no_info_plain_validator_function(read)
    return GetPydanticSchema(lambda _, __: validator, lambda _, __: schema)


def parse_json(
    kind: Callable[..., T], document: Mapping[str, Any], source: str | Path, remedy: str = "correct it"
) -> T:
    """Read a JSON object into a dataclass, whose fields are the keys, or a type of dict.

    Other keys of dataclasses are ignored. Errors name the source and the remedy.

    Raises:
        InputError: A key is missing, or a value is of another type; the sentence names the key.
    """
    try:
        if not _largest(document) <= LARGEST:
            raise ValueError(f"a number is larger than {LARGEST:.2g}")
        return _adapter(kind).validate_json(json.dumps(document, allow_nan=False), strict=True)
    except ValidationError as error:
        raise InputError(str(source), _sentence(error.errors()[0]), remedy) from None
    except (ValueError, RecursionError) as error:
        raise InputError(str(source), f"cannot be read ({error})", remedy) from None


def read_json(path: Path, remedy: str = "write the file again") -> dict[str, Any]:
    """Read a file that holds one JSON object; `remedy` tells the user how to mend it.

    Raises:
        InputError: The file is missing, unreadable, too large, not JSON or not an object, or holds NaN or
            infinity.
    """
    with read_errors(path, remedy):
        if (size := path.stat().st_size) > LARGEST_FILE:
            reason = f"{size / 1e6:,.0f} MB is too large, at most {LARGEST_FILE / 1e6:.0f} MB are read"
            raise InputError(path, reason, "give a smaller file")
        content = path.read_bytes()
    try:
        document = from_json(content, allow_inf_nan=False)
    except ValueError as error:
        raise InputError(path, f"broken JSON: {error}", remedy) from error
    if not isinstance(document, dict):
        raise InputError(path, f"expected a JSON object, not a {type(document).__name__}", remedy)
    return document


def read_names(folder: Path, view: str = "names") -> dict[int, str] | None:
    """Read the names of labels from a folder of masks: `VIEW.json`, or else `names.json`; None without.

    Raises:
        InputError: It is broken, or not an object of texts by number.
    """
    own, remedy = folder / f"{view}.json", 'write the name of each label: {"1": "mug"}'
    path = own if own.exists() else folder / "names.json"
    return parse_json(dict[int, str], read_json(path, remedy), path, remedy) if path.exists() else None


def json_text(document: Mapping[str, Any]) -> str:
    """Write a document as JSON text: keys in their order, floats rounded to `DECIMALS`, no negative zero.

    NumPy scalars and arrays become numbers and lists, dataclasses objects.

    Raises:
        ValueError: A number is NaN or infinite.
    """
    return json.dumps(plain(document), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """Turn NumPy values, tuples, paths and dataclasses into JSON types, with floats rounded to `DECIMALS`."""
    match value:
        case Mapping():
            return {str(key): plain(item) for key, item in value.items()}
        case np.ndarray() | np.generic():
            return plain(value.tolist())
        case object(__dataclass_fields__=names):
            return {name: plain(getattr(value, name)) for name in names}
        case list() | tuple():
            return [plain(item) for item in value]
        case float():
            return round(value, DECIMALS) + 0.0
        case Path():
            return str(value)
    return value


_adapter = cache(TypeAdapter[Any])


def _largest(value: Any) -> float:
    """The largest absolute value of all numbers in a document."""
    match value:
        case Mapping():
            return max(map(_largest, value.values()), default=0)
        case list():
            return max(map(_largest, value), default=0)
        case int() | float():
            return abs(value)
    return 0


def _sentence(error: Any) -> str:
    """The first error of pydantic in one sentence."""
    *above, last = error["loc"] or ("it",)
    where = f"{'.'.join(map(str, above))}: " if above else ""
    if error["type"] == "missing":
        return f"{where}the key '{last}' is missing"
    message = str(error.get("ctx", {}).get("error") or error["msg"])
    message = message.replace("Input should be", "must be")
    message = message.replace("a dictionary or an instance of", "the object")
    given = json.dumps(error["input"], ensure_ascii=False, default=str)
    return f"{where}'{last}' is {given if len(given) <= 40 else given[:37] + '…'}: {message}"
