"""What code made a figure: a digest of all that decides it."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

LIBRARIES = ("numpy", "scipy", "numba", "mujoco", "shapely")
"""Libraries whose release may change a figure."""

BYSTANDERS = frozenset(
    {"benchmark", "cli", "exports", "service.py", "sessions", "sources.py", "viewer", "viz"}
)
"""Parts of caryatid that only arrange, hand on, draw or tell what others found, but for `DECIDING`."""

DECIDING = frozenset({"benchmark/episodes.py"})
"""Modules in these parts that decide figures."""


@cache
def fingerprint() -> str:
    """Digest of the code and library releases that decide what an episode gives."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        name = file.relative_to(root).as_posix()
        if not BYSTANDERS & set(name.split("/")) or name in DECIDING:
            digest.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    for library in LIBRARIES:
        digest.update(f"{library} {version(library)}\0".encode())
    return digest.hexdigest()[:16]
