"""What can be asked about: a run, a session, or a graph.json, by its path."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from caryatid.graph import SupportGraph
from caryatid.io.graph_json import read_graph
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.sessions.session import Session
from caryatid.steps import Run, RunWriter, is_session, read_run


def read_model(path: Path) -> tuple[SupportGraph, VoxelMap | None]:
    """Read the graph of a run, a session or a graph.json; of a session, also what it knows of space.

    Raises:
        InputError: It is none of these, or a file in it is missing or broken.
    """
    if path.is_file():
        return read_graph(path), None
    if not is_session(path):
        return read_run(path).graph, None
    with Session.open(path, read_only=True) as session:
        return session.graph, session.scene.voxels


@contextmanager
def open_run(folder: Path) -> Iterator[Run]:
    """Read a run; a session is replayed into one, which is deleted at the end of the `with` block.

    Raises:
        InputError: It is neither, a file in it is missing or broken, or a session has no view of a table.
    """
    if not is_session(folder):
        yield read_run(folder)
        return
    with TemporaryDirectory() as place, Session.open(folder, read_only=True) as session:
        b, copy = session.beginning, Path(place) / "run"
        options = {"planner": b.planner, "robot": b.robot, "segmentation": b.segmentation}
        about: dict[str, Any] = {"command": "session", "source": str(folder), "seed": b.seed}
        with RunWriter(copy, b.settings, about | {"options": options}) as writer:
            for step in session.replay():
                writer.add(step)
        yield replace(read_run(copy), folder=folder)
