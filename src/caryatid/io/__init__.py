"""Files: datasets (BOP folders, TUM RGB-D folders, bags), clouds (PCD, PLY) and graph.json."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime import imported_late

if TYPE_CHECKING:
    from caryatid.io.bop import read_recording, write_recording
    from caryatid.io.datasets import Dataset, Frame, OpenOptions, open_dataset
    from caryatid.io.graph_json import graph_from_json, graph_text, graph_to_json, read_graph
    from caryatid.io.importing import import_recording
    from caryatid.io.point_clouds import read_stored_cloud

__all__ = [
    "Dataset", "Frame", "OpenOptions", "graph_from_json", "graph_text", "graph_to_json", "import_recording",
    "open_dataset", "read_graph", "read_recording", "read_stored_cloud", "write_recording",
]  # fmt: skip

if not TYPE_CHECKING:
    __getattr__ = imported_late(
        __name__,
        {
            "bop": ["read_recording", "write_recording"],
            "datasets": ["Dataset", "Frame", "OpenOptions", "open_dataset"],
            "graph_json": ["graph_from_json", "graph_text", "graph_to_json", "read_graph"],
            "importing": ["import_recording"],
            "point_clouds": ["read_stored_cloud"],
        },
    )


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
