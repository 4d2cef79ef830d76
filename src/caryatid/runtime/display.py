"""Hooks that let lower-level packages call higher-level ones without importing them."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Any

hooks: dict[str, str] = {}
"""Name of a hook → `module:function`, imported at the first call; registered in `caryatid/__init__.py`."""


def call(hook: str, *arguments: Any) -> Any:
    """Call the function registered for one of the `hooks`, and return its result."""
    return resolve_name(hooks[hook])(*arguments)


class Pictured:
    """Mixin that shows an object as a picture in a notebook."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        drawn: str = call("notebook cell", self)
        return drawn
