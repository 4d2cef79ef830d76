"""What code another package's planner runs: a digest of it."""

from __future__ import annotations

import hashlib
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path

from caryatid.planning.planners import offered


def plugin_of(planner: str) -> str:
    """Digest of the package that offers a planner; empty for those that come with caryatid.

    Args:
        planner: Its name.
    """
    point = offered().get(planner)
    return "" if point is None else _digest(point)


def _digest(point: EntryPoint) -> str:
    """Digest of the Python files of the package, or of the one module, an entry point leads into."""
    spec = find_spec(point.module.split(".")[0])
    digest = hashlib.sha256(point.value.encode())
    if spec is not None:
        folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
        files = [Path(spec.origin)] if spec.origin and not folders else []
        for file in files + [f for folder in folders for f in sorted(folder.rglob("*.py"))]:
            digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]
