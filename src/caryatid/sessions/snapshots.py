"""The scene after some views, as a file: a cache, so that opening a session processes no view again."""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from caryatid.io.staging import write_file
from caryatid.runtime.fingerprint import fingerprint
from caryatid.scene import Scene

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


def read_snapshot(folder: Path, history: Sequence[str]) -> Scene | None:
    """Return the newest scene in a folder that this code made of the first views of a session.

    Args:
        folder: Holds the snapshots.
        history: What the session was begun with, and the digest of each view.
    """
    for views in range(len(history) - 1, 0, -1):
        with suppress(Exception):  # whatever a damaged file leads to: the views are still there
            content = _path(folder, views).read_bytes()
            if content[:32] == _seal(history[: views + 1], content[32:]):
                scene = _Unpickler(io.BytesIO(content[32:])).load()
                if isinstance(scene, Scene) and scene.views == views:
                    return scene
    return None


def write_snapshot(folder: Path, history: Sequence[str], scene: Scene) -> None:
    """Keep the scene of all views, and those of the seven views before; a failure costs only time."""
    with suppress(Exception):
        folder.mkdir(exist_ok=True)
        payload = pickle.dumps(scene, protocol=5)
        write_file(_path(folder, scene.views), _seal(history, payload) + payload)
        kept = {_path(folder, scene.views - back) for back in range(8)}
        for path in set(folder.iterdir()) - kept:
            path.unlink()


def _path(folder: Path, views: int) -> Path:
    return folder / f"{views:06d}.pickle"


def _seal(history: Sequence[str], payload: bytes) -> bytes:
    """Digest of the code and the views that made a snapshot, and of the snapshot itself."""
    made_of = " ".join((fingerprint(), *history))
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
