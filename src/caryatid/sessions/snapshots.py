"""The scene after some views, as a file: a cache, so that opening a session processes no view again."""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from caryatid.io.staging import write_file
from caryatid.objects.fusion import changed
from caryatid.runtime.fingerprint import fingerprint
from caryatid.scene import Scene
from caryatid.sensing.views import View

FORMAT: Final = "3"
"""Part of every snapshot's digest; to be raised when this module stores something else."""
STEPS: Final = (1, 8, 64)
"""The newest snapshot after a multiple of each of these numbers of views is kept [1], for undo."""
KNOWN: Final = {
    ("builtins", "set"),
    ("collections", "Counter"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}
"""What a snapshot may name besides classes of caryatid: a session that came from elsewhere runs no code."""


@dataclass(frozen=True, eq=False, slots=True)
class State:
    """The scene after some views, and whether the last of them changed the graph."""

    scene: Scene
    changed: bool = False

    def after(self, view: View) -> State:
        """Return the state with one more view; this one stays as it is."""
        scene = self.scene.copy()
        before = scene.graph
        return State(scene, changed(before, scene.update(view), scene.config.fusion))


class Snapshots:
    """Snapshots in a folder.

    Args:
        folder: Where they are.
        beginning: What the session was begun with, as text: snapshots of another one do not count.
    """

    def __init__(self, folder: Path, beginning: str) -> None:
        self._folder = folder
        self._beginning = beginning

    def read(self, views: Sequence[str]) -> Iterator[State]:
        """Snapshots that this code made of the first of some views, the newest first.

        Args:
            views: Digests of the views.
        """
        numbers = [int(path.stem) for path in self._folder.glob("*.pickle") if path.stem.isdecimal()]
        for number in sorted((n for n in numbers if n <= len(views)), reverse=True):
            with suppress(Exception):  # whatever a damaged file leads to: the views are still there
                content = self._path(number).read_bytes()
                seal, payload = content[:32], content[32:]
                if seal == self._seal(views[:number], payload):
                    state = _Unpickler(io.BytesIO(payload)).load()
                    if isinstance(state, State) and state.scene.views == number:
                        yield state

    def write(self, state: State, views: Sequence[str]) -> None:
        """Keep a state, and remove snapshots that are not needed any more; a failure costs only time.

        Args:
            state: The state after the views.
            views: Digests of the views.
        """
        with suppress(Exception):
            payload = pickle.dumps(state, protocol=5)
            write_file(self._path(len(views)), self._seal(views, payload) + payload)
            kept = {self._path(n - n % step) for n in (len(views), len(views) - 1) for step in STEPS}
            for path in self._folder.iterdir():
                if path not in kept:
                    path.unlink()

    def _path(self, views: int) -> Path:
        return self._folder / f"{views:06d}.pickle"

    def _seal(self, views: Sequence[str], payload: bytes) -> bytes:
        """Digest of the code, the settings and the views that made a snapshot, and of the snapshot itself."""
        made_of = " ".join((FORMAT, fingerprint(), self._beginning, *views))
        return hashlib.sha256(made_of.encode() + b"\0" + payload).digest()


class _Unpickler(pickle.Unpickler):
    """Makes nothing but arrays and objects of caryatid."""

    def find_class(self, module: str, name: str) -> Any:
        known = (module, name) in KNOWN
        if known or (module.split(".")[0] == "caryatid" and "." not in name):
            found = super().find_class(module, name)
            if known or isinstance(found, type):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is not part of a scene")
