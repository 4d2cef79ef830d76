"""Run folders: written whole or not at all, and read back."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from caryatid.errors import CaryatidError, InputError
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.io import images
from caryatid.io.graph_json import graph_text, read_graph
from caryatid.io.json_files import Numbers, json_text, parse_json, read_json
from caryatid.io.staging import StagedFolder
from caryatid.sensing.views import SUPPORT_LABEL

FORMAT: Final = "caryatid/run"
VERSION: Final = 2
"""What run.json says it is. Version 1, of caryatid 0.1.0, has no step.npz."""
AGAIN: Final = "run caryatid again"
"""What to do where a file of a run is broken."""


class RunWriter(StagedFolder):
    """Writes a run folder as views come in.

    Leaving the `with` block without `finish`, by an error or otherwise, leaves nothing behind. After an
    interrupt call `finish`, inside the block, to keep the views done so far. A run folder already there is
    replaced, at `finish` and not before; a folder that is no run is never touched.

    Args:
        folder: RUN.

    Attributes:
        views: Number of views written.

    Raises:
        InputError: RUN holds something else, or cannot be written.
    """

    remedy = "give another --out; only a folder written by caryatid is replaced"

    def __init__(self, folder: str | Path) -> None:
        super().__init__(folder)
        self.views = 0

    def replaces(self, folder: Path) -> bool:
        """Whether a folder is a run."""
        return is_run(folder)

    def add_view(
        self,
        graph: SupportGraph,
        labels: NDArray[np.integer[Any]],
        *,
        name: str,
        T_world_camera: Array | None = None,
        K: Array | None = None,
        record: Mapping[str, Any] | None = None,
        step: bytes | None = None,
    ) -> None:
        """Write the next view.

        Args:
            graph: The fused graph after this view.
            labels: Label image (H, W), or one label per point (N,) of a cloud; 0 = nothing.
            name: The view's name; a recording's frame is found again by it.
            T_world_camera: Camera pose (4, 4) in the run's world, if there is one.
            K: Pinhole matrix (3, 3) [px], if there is one.
            record: What else view.json shall hold: the candidates' summary and the choice.
            step: Content of step.npz.

        Raises:
            InputError: Labels leave 16 bits, or the disk is full or refuses; nothing is left behind.
        """
        if labels.size and not 0 <= labels.min() <= labels.max() <= SUPPORT_LABEL:
            raise InputError(name, f"labels leave 0…{SUPPORT_LABEL}", "number objects from 1, 0 = nothing")
        folder = _view_folder(self.views)
        self.write(f"{folder}/graph.json", graph_text(graph).encode())
        if labels.ndim == 2:
            self.write(f"{folder}/labels.png", images.png(labels.astype(np.uint16)))
        else:
            buffer = io.BytesIO()
            np.save(buffer, labels.astype(np.int32))
            self.write(f"{folder}/labels.npy", buffer.getvalue())
        document = {"view": self.views, "name": name, "T_world_camera": T_world_camera, "K": K}
        self.write(f"{folder}/view.json", json_text(document | dict(record or {})).encode())
        if step is not None:
            self.write(f"{folder}/step.npz", step)
        self.views += 1

    def finish(
        self,
        graph: SupportGraph,
        record: Mapping[str, Any],
        files: Mapping[str, bytes] | None = None,
    ) -> None:
        """Write the rest and put the folder in its place.

        Args:
            graph: The final fused graph.
            record: For run.json: settings, seed, versions, source, timings [s], angle and path travelled.
            files: Further files by their paths in the folder.

        Raises:
            CaryatidError: No view was added.
            InputError: The disk is full or refuses; nothing is left behind.
        """
        if self.views == 0:
            raise CaryatidError(f"{self.folder}: no view was finished, so there is no run to keep")
        self.remove(_view_folder(self.views))
        self.write("graph.json", graph_text(graph).encode())
        for path, content in (files or {}).items():
            self.write(path, content)
        document = {"format": FORMAT, "version": VERSION, "views": self.views} | dict(record)
        self.write("run.json", json_text(document).encode())
        self.publish()


@dataclass(frozen=True, eq=False, slots=True)
class RunView:
    """One view of a run.

    Attributes:
        index: 0 for the first.
        name: The view's name.
        graph: The fused graph after this view.
        T_world_camera: Camera pose (4, 4), or None.
        K: Pinhole matrix (3, 3) [px], or None.
        record: All of view.json.
        folder: Its folder, `views/NN`.
    """

    index: int
    name: str
    graph: SupportGraph
    T_world_camera: Array | None
    K: Array | None
    record: dict[str, Any]
    folder: Path

    @property
    def labels_path(self) -> Path:
        """labels.png, or labels.npy of a cloud."""
        image = self.folder / "labels.png"
        return image if image.exists() else self.folder / "labels.npy"

    def load_labels(self) -> NDArray[np.int32]:
        """Read the label image (H, W), or the labels (N,) of a cloud's points.

        Raises:
            InputError: The file is missing, broken or of another kind.
        """
        path = self.labels_path
        if path.suffix == ".png":
            return images.read_units(path)
        try:
            labels = np.load(path, allow_pickle=False)
        except FileNotFoundError:
            raise InputError(path, "the file is missing", AGAIN) from None
        except (OSError, ValueError, EOFError) as error:
            raise InputError(path, f"is no label array ({error})", AGAIN) from error
        if not isinstance(labels, np.ndarray) or labels.ndim != 1 or labels.dtype.kind not in "iu":
            raise InputError(path, "is no array of whole numbers (N,)", AGAIN)
        return labels.astype(np.int32)


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """A run folder as read.

    Attributes:
        folder: RUN.
        record: All of run.json: settings, seed, versions, source, timings.
        graph: The final fused graph.
        views: The views in their order.
    """

    folder: Path
    record: dict[str, Any]
    graph: SupportGraph
    views: tuple[RunView, ...]


@dataclass(frozen=True, slots=True)
class _RunFile:
    views: int
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _ViewFile:
    name: str
    T_world_camera: Annotated[Array, Numbers(4, 4, rigid=True)] | None = None
    K: Annotated[Array, Numbers(3, 3)] | None = None


def read_run(folder: str | Path) -> Run:
    """Read a run folder; label images are loaded when asked for.

    Raises:
        InputError: It is no run folder, or a file in it is missing or broken.
    """
    folder, remedy = Path(folder), "give the folder a run was written to with --out"
    if not folder.is_dir():
        raise InputError(folder, "is no folder", remedy)
    path = folder / "run.json"
    record = read_json(path, remedy)
    if record.get("format") != FORMAT or record.get("version") not in (1, VERSION):
        raise InputError(path, f"is not of format '{FORMAT}', version 1 or {VERSION}", AGAIN)
    count = parse_json(_RunFile, record, path, AGAIN).views
    return Run(
        folder,
        record,
        read_graph(folder / "graph.json"),
        tuple(_read_view(folder / _view_folder(index), index) for index in range(count)),
    )


def is_run(folder: Path) -> bool:
    """Whether a folder was written by `RunWriter`, whatever its version."""
    try:
        return read_json(folder / "run.json").get("format") == FORMAT
    except InputError:
        return False


def _view_folder(index: int) -> str:
    return f"views/{index:02d}"


def _read_view(folder: Path, index: int) -> RunView:
    path = folder / "view.json"
    record = read_json(path, AGAIN)
    given = vars(parse_json(_ViewFile, record, path, AGAIN))
    return RunView(index, graph=read_graph(folder / "graph.json"), record=record, folder=folder, **given)
