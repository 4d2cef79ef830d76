"""Files: recordings (BOP folders), clouds (PCD, PLY), graph.json and run folders."""

from __future__ import annotations

from caryatid.io.bop import Frame, Recording, read_recording
from caryatid.io.bop_writer import write_recording
from caryatid.io.graph_json import graph_from_json, graph_text, graph_to_json, read_graph
from caryatid.io.point_clouds import StoredCloud, read_cloud, read_stored_cloud
from caryatid.io.runs import Run, RunView, RunWriter, read_run

__all__ = [
    "Frame",
    "Recording",
    "Run",
    "RunView",
    "RunWriter",
    "StoredCloud",
    "graph_from_json",
    "graph_text",
    "graph_to_json",
    "read_cloud",
    "read_graph",
    "read_recording",
    "read_run",
    "read_stored_cloud",
    "write_recording",
]
