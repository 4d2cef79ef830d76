"""Compiled kernels, threads, the fingerprint of the code, late imports, and hooks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from typing import Any


def imported_late(package: str, homes: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Make the `__getattr__` (PEP 562) of a package that imports names, listed by module, on first use."""
    module_of = {name: module for module, names in homes.items() for name in names}

    def get(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(f"{package}.{module_of[name]}"), name)

    return get


hooks: dict[str, str] = {}
"""Hooks by which lower-level packages call higher-level ones without importing them: name of a hook →
`module:function`, imported at the first call; registered in `caryatid/__init__.py`."""


def call(hook: str, *arguments: Any, **options: Any) -> Any:
    """Call the function registered for one of the `hooks`, and return its result."""
    return resolve_name(hooks[hook])(*arguments, **options)


class Pictured:
    """Mixin that shows an object as a picture in a notebook."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return call("notebook cell", self)


LIBRARIES = ("numpy", "scipy", "numba", "mujoco", "shapely")
"""Libraries whose version can change a result."""

BYSTANDERS = frozenset(
    {"benchmark", "cli", "exports", "service.py", "sessions", "sources.py", "viewer", "viz"}
)
"""Parts of caryatid that do not affect results, except for the modules in `DECIDING`."""

DECIDING = frozenset({"benchmark/episodes.py"})
"""Modules in these parts that do affect results."""


@cache
def fingerprint() -> str:
    """Digest of code, network and library versions that determine the result of an episode."""
    import hashlib
    from importlib.metadata import version

    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted([*root.rglob("*.py"), *root.rglob("*.onnx")]):
        name = file.relative_to(root).as_posix()
        if not BYSTANDERS & set(name.split("/")) or name in DECIDING:
            digest.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    for library in LIBRARIES:
        digest.update(f"{library} {version(library)}\0".encode())
    return digest.hexdigest()[:16]
