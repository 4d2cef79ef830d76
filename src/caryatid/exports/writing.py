"""Scene models written to files of other programs' formats."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from caryatid.config import ExportConfig
from caryatid.config.choices import ExportFormat
from caryatid.errors import InputError
from caryatid.graph import SupportGraph
from caryatid.io.staging import write_file

ENDINGS: Final[dict[ExportFormat, tuple[str, ...]]] = {
    "mjcf": (".xml",),
    "urdf": (".urdf",),
    "gltf": (".glb", ".gltf"),
    "graphml": (".graphml",),
    "dot": (".dot", ".gv"),
}
"""How files of each format end."""


def format_of(path: Path) -> ExportFormat:
    """The format a file's name ends in.

    Raises:
        InputError: None does.
    """
    for format_, endings in ENDINGS.items():
        if path.suffix.lower() in endings:
            return format_
    known = ", ".join(ending for endings in ENDINGS.values() for ending in endings)
    raise InputError(path, "does not say which format it is to have", f"end its name in one of {known}")


def export_graph(
    graph: SupportGraph,
    path: str | Path,
    format_: ExportFormat | None = None,
    config: ExportConfig | None = None,
) -> None:
    """Write a scene model to a file, whole or not at all; a file already there is replaced.

    Args:
        graph: The scene model.
        path: The file.
        format_: Its format; None takes it from the file's name.
        config: Density, friction and how fine meshes are.

    Raises:
        InputError: The name does not end as the format's do, there is nothing to export, or the file cannot
            be written.
    """
    path = Path(path)
    chosen = format_ or format_of(path)
    if path.suffix.lower() not in ENDINGS[chosen]:
        endings = " or ".join(ENDINGS[chosen])
        raise InputError(path, f"does not end as {chosen} does", f"end its name in {endings}")
    if not graph.objects:
        raise InputError("the scene model", "holds no objects", "nothing was written")
    content = _content(graph, path, chosen, config or ExportConfig())
    write_file(path, content)


def _content(graph: SupportGraph, path: Path, format_: ExportFormat, config: ExportConfig) -> bytes:
    from caryatid.exports import to_dot, to_gltf, to_graphml, to_mjcf, to_urdf

    match format_:
        case "mjcf":
            return to_mjcf(graph, config).encode()
        case "urdf":
            return to_urdf(graph, config).encode()
        case "gltf":
            return to_gltf(graph, config, binary=path.suffix.lower() == ".glb")
        case "graphml":
            return to_graphml(graph).encode()
        case "dot":
            return to_dot(graph).encode()
