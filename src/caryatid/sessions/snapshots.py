"""What a session has made of its views, kept beside them so that it need not be made again.

Views are the truth; a snapshot only saves time. So one that is missing, damaged, or made by other code or
of other views is passed over, and nothing waits for the disk when one is written.
"""

from __future__ import annotations

import json
import os
import secrets
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caryatid.config import Config, SegmentationMethod
from caryatid.runtime.fingerprint import fingerprint
from caryatid.scene import Scene
from caryatid.sessions.durable import PARTIAL
from caryatid.sessions.scene_state import SceneWriter, read_scene

FORMAT = "caryatid/session-state 1"
"""What a snapshot says it is."""

STEPS = (1, 8, 64)
"""Of snapshots the newest after a multiple of each of these many views is kept [1]."""


@dataclass(frozen=True, eq=False, slots=True)
class State:
    """What is known after some views.

    Attributes:
        scene: The scene.
        changed: Whether the last view changed the graph.
    """

    scene: Scene
    changed: bool


class Snapshots:
    """The snapshots of one session.

    Args:
        folder: Where they are.
        made_of: What tells the session from others: a digest of its settings.
        config: Its settings.
        segmentation: Where its parts come from.
        seed: Its seed.
    """

    def __init__(
        self, folder: Path, made_of: str, config: Config, segmentation: SegmentationMethod | None, seed: int
    ) -> None:
        self._folder = folder
        self._made_of = made_of
        self._config = config
        self._segmentation = segmentation
        self._seed = seed
        self._writer = SceneWriter()

    def write(self, state: State, chain: str) -> None:
        """Keep a state; forget those that are not needed any more. A disk that refuses is no failure.

        Args:
            state: What is known.
            chain: Digest of the views it is made of.
        """
        views = state.scene.views
        text, arrays = self._writer.write(state.scene)
        about = json.dumps(self._about(chain) | {"changed": state.changed})
        members = {"about": _bytes(about), "document": _bytes(text)} | arrays
        partial = self._folder / f"{PARTIAL}{secrets.token_hex(4)}.npz"
        with suppress(OSError):
            try:
                with partial.open("xb") as file:
                    np.savez(file, **members)  # type: ignore[arg-type]
                os.replace(partial, self._path(views))
            finally:
                partial.unlink(missing_ok=True)
            self._forget(views)

    def read(self, views: int, chain: str) -> State | None:
        """What was known after so many views; None where that is not here or cannot be trusted.

        Args:
            views: How many.
            chain: Digest of these views.
        """
        path = self._path(views)
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as members:
                about = json.loads(members["about"].tobytes())
                wanted = self._about(chain)
                if {key: about.get(key) for key in wanted} != wanted:
                    return None
                text = members["document"].tobytes().decode()
                arrays = {key: members[key] for key in members.files if key not in ("about", "document")}
            scene = read_scene(text, arrays, self._config, self._segmentation, self._seed)
        except Exception:  # whatever a damaged file leads to: the views are still there
            return None
        return State(scene, bool(about["changed"])) if scene.views == views else None

    def numbers(self) -> list[int]:
        """After how many views there are snapshots, the latest first."""
        stems = (path.stem for path in self._folder.glob("[0-9]*.npz"))
        return sorted((int(stem) for stem in stems if stem.isdecimal()), reverse=True)

    def _forget(self, views: int) -> None:
        kept = {n - n % step for n in (views, views - 1) for step in STEPS}
        for number in self.numbers():
            if number not in kept:
                self._path(number).unlink(missing_ok=True)

    def _about(self, chain: str) -> dict[str, Any]:
        return {"format": FORMAT, "code": fingerprint(), "session": self._made_of, "views": chain}

    def _path(self, views: int) -> Path:
        return self._folder / f"{views:06d}.npz"


def _bytes(text: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.frombuffer(text.encode(), dtype=np.uint8)
