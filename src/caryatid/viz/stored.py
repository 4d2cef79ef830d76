"""Reports as JSON: what `report.json` of a run folder holds, from which its pages are made again."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import Any, Final, Literal, get_args, get_origin, get_type_hints

from caryatid.errors import InputError
from caryatid.io.json_files import json_text, read_json
from caryatid.viz.contents import Report

FORMAT: Final = "caryatid/report"
VERSION: Final = 1
"""What a stored report says it is."""


def store_report(report: Report) -> str:
    """Return the text of report.json."""
    return json_text({"format": FORMAT, "version": VERSION} | dataclasses.asdict(report))


def read_report(path: str | Path) -> Report:
    """Read a report.json.

    Raises:
        InputError: The file is missing or broken, or something in it is missing or of another kind.
    """
    path = Path(path)
    remedy = "make the run again, without --no-report"
    document = read_json(path, remedy)
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(path, f"is not of format '{FORMAT}', version {VERSION}", remedy)
    content = {key: value for key, value in document.items() if key not in ("format", "version")}
    report = _rebuilt(Report, content, path, "the document")
    if not isinstance(report, Report) or not report.pages:
        raise InputError(path, "holds no view", remedy)
    if report.scores and len(report.scores) != len(report.pages):
        raise InputError(path, f"{len(report.scores)} scores for {len(report.pages)} views", remedy)
    return report


def _rebuilt(kind: Any, value: Any, path: Path, place: str) -> Any:
    """Turn plain JSON back into what a type says: dataclasses, tuples, mappings and plain values."""
    origin, inner = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        known = get_type_hints(kind)
        if not isinstance(value, dict) or value.keys() != known.keys():
            raise _wrong(path, place)
        return kind(**{name: _rebuilt(known[name], value[name], path, name) for name in known})
    if origin is tuple and isinstance(value, list):
        kinds = [inner[0]] * len(value) if inner[-1] is Ellipsis else inner
        if len(kinds) == len(value):
            return tuple(_rebuilt(k, item, path, place) for k, item in zip(kinds, value, strict=True))
    elif origin is Literal:
        if value in inner:
            return value
    elif origin is Mapping:
        if isinstance(value, dict):
            return {key: _rebuilt(inner[1], item, path, place) for key, item in value.items()}
    elif inner and NoneType in inner:
        return None if value is None else _rebuilt(inner[0], value, path, place)
    elif kind is float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    elif type(value) is kind:
        return value
    raise _wrong(path, place)


def _wrong(path: Path, place: str) -> InputError:
    return InputError(path, f"{place} is missing something or of another kind", "make the run again")
