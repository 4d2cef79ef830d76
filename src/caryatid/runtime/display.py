"""Hooks for functions of higher rooms, which the package registers, so that no room imports one above it."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Any

hooks: dict[str, str] = {}
"""Name of a hook → `module:function`, imported at the first call; `caryatid/__init__.py` fills it."""


def call(hook: str, *arguments: Any) -> Any:
    """Call the function that a hook names, and return what it returns.

    Args:
        hook: One of the names in `hooks`.
        arguments: Arguments of the function.
    """
    return resolve_name(hooks[hook])(*arguments)


class Pictured:
    """Gives a class its picture in a notebook."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        drawn: str = call("notebook cell", self)
        return drawn
