"""A scene model for other programs: simulators, viewers, motion planners, graph tools."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from caryatid.config import ExportConfig, ExportFormat
from caryatid.errors import InputError
from caryatid.exports.graphs import to_dot
from caryatid.exports.models import to_gltf, to_mjcf, to_urdf, to_usd
from caryatid.exports.motion import planning_scene
from caryatid.graph import SupportGraph
from caryatid.io.json_files import json_text, read_json
from caryatid.io.staging import write_file

__all__ = ["ENDINGS", "export_graph", "format_of", "planning_scene", "to_dot"]


class Format(NamedTuple):
    """The suffixes of a format's files, and what makes the content for one of them."""

    endings: tuple[str, ...]
    write: Callable[[SupportGraph, ExportConfig, str], str | bytes]


FORMATS: Final[dict[ExportFormat, Format]] = {
    "mjcf": Format((".xml",), lambda graph, config, _: to_mjcf(graph, config)),
    "urdf": Format((".urdf",), lambda graph, config, _: to_urdf(graph, config)),
    "usd": Format((".usda", ".usd"), lambda graph, config, _: to_usd(graph, config)),
    "gltf": Format(
        (".glb", ".gltf"), lambda graph, config, end: to_gltf(graph, config, binary=end == ".glb")
    ),
    "moveit": Format((".json",), lambda graph, config, _: json_text(planning_scene(graph, config.frame))),
    "dot": Format((".dot", ".gv"), lambda graph, config, _: to_dot(graph)),
}
"""The formats by name."""

ENDINGS: Final[dict[str, ExportFormat]] = {
    ending: name for name, known in FORMATS.items() for ending in known.endings
}
"""File suffix → format."""


def format_of(path: Path, wanted: ExportFormat | None = None) -> ExportFormat:
    """The format of a file by its suffix.

    Raises:
        InputError: The suffix is unknown, or not that of the wanted format.
    """
    found = ENDINGS.get(path.suffix.lower())
    if found is None or wanted not in (None, found):
        endings = ENDINGS if wanted is None else FORMATS[wanted].endings
        reason = f"the suffix is not that of {wanted or 'any format'}"
        raise InputError(path, reason, f"use {', '.join(endings)}")
    return found


def export_graph(graph: SupportGraph, path: str | Path, config: ExportConfig | None = None) -> None:
    """Write a scene model in the format of the file's suffix, whole or not at all; replace an existing file.

    Raises:
        InputError: The suffix is unknown, the file is a graph.json or run.json, there is nothing to export,
            the format rejects the name of an object, the extra of a format is not installed, or the file
            cannot be written.
    """
    path, config = Path(path), config or ExportConfig()
    chosen = FORMATS[format_of(path)]
    if _is_of_a_run(path):
        raise InputError(path, "holds a scene model or run, which would be lost", "give another file")
    if not graph.objects:
        raise InputError("the scene model", "has no objects", "give a graph with objects")
    content = chosen.write(graph, config, path.suffix.lower())
    write_file(path, content.encode() if isinstance(content, str) else content)


def _is_of_a_run(path: Path) -> bool:
    """Whether it is a graph.json or run.json: those of MoveIt have the same suffix."""
    with suppress(InputError):
        return path.suffix.lower() == ".json" and str(read_json(path).get("format")).startswith("caryatid/")
    return False
