"""Files: datasets (BOP folders, TUM RGB-D folders, bags), clouds (PCD, PLY), graph.json and run folders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime.late import imported_late

if TYPE_CHECKING:
    from caryatid.io.bop import read_recording, write_recording
    from caryatid.io.datasets import Dataset, Format, Frame, OpenOptions, Topics, open_dataset
    from caryatid.io.graph_json import graph_from_json, graph_text, graph_to_json, read_graph
    from caryatid.io.importing import Imported, choose_frames, choose_views, import_recording
    from caryatid.io.point_clouds import StoredCloud, read_cloud, read_stored_cloud
    from caryatid.io.runs import Run, RunView, RunWriter, read_run
    from caryatid.io.video import TransformTree

_HOMES = {
    "bop": ["read_recording", "write_recording"],
    "datasets": ["Dataset", "Format", "Frame", "OpenOptions", "Topics", "open_dataset"],
    "graph_json": ["graph_from_json", "graph_text", "graph_to_json", "read_graph"],
    "importing": ["Imported", "choose_frames", "choose_views", "import_recording"],
    "point_clouds": ["StoredCloud", "read_cloud", "read_stored_cloud"],
    "runs": ["Run", "RunView", "RunWriter", "read_run"],
    "video": ["TransformTree"],
}

__all__ = [
    "Dataset",
    "Format",
    "Frame",
    "Imported",
    "OpenOptions",
    "Run",
    "RunView",
    "RunWriter",
    "StoredCloud",
    "Topics",
    "TransformTree",
    "choose_frames",
    "choose_views",
    "graph_from_json",
    "graph_text",
    "graph_to_json",
    "import_recording",
    "open_dataset",
    "read_cloud",
    "read_graph",
    "read_recording",
    "read_run",
    "read_stored_cloud",
    "write_recording",
]

if not TYPE_CHECKING:
    __getattr__ = imported_late(__name__, _HOMES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
