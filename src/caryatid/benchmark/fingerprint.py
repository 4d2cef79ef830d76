"""What code made a figure: a digest of all that decides it."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import EntryPoint, version
from importlib.util import find_spec
from pathlib import Path

import caryatid
from caryatid.planners import offered

LIBRARIES = ("numpy", "scipy", "numba", "mujoco", "shapely")
"""Libraries whose release may change a figure."""

BYSTANDERS = frozenset(
    {
        "benchmark",
        "commands",
        "exports",
        "notebook",
        "recordings",
        "report",
        "service",
        "sessions",
        "viewer",
    }
)
"""Parts of caryatid that only arrange, hand on, draw or tell what others found, but for `DECIDING`."""

DECIDING = frozenset({"benchmark/episodes.py", "benchmark/records.py", "benchmark/scenes.py"})
"""Modules in these parts that decide figures."""


@cache
def fingerprint() -> str:
    """Digest of the code and library releases that decide what an episode gives."""
    root = Path(caryatid.__file__).parent
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        name = file.relative_to(root).as_posix()
        if name.split("/")[0] not in BYSTANDERS or name in DECIDING:
            digest.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    for library in LIBRARIES:
        digest.update(f"{library} {version(library)}\0".encode())
    return digest.hexdigest()[:16]


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
