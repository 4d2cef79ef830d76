"""Show NumPy's array types by name: their definitions fill lines and tell a reader nothing."""

from __future__ import annotations

import types

import numpy.typing


class NDArray:
    """Replaces `numpy.typing.NDArray` in the reference."""

    __class_getitem__ = classmethod(types.GenericAlias)


class ArrayLike:
    """Replaces `numpy.typing.ArrayLike` in the reference."""


def keep_their_names() -> None:
    """Replace the types by these classes; call this before importing modules that use them."""
    for kind in (NDArray, ArrayLike):
        kind.__module__ = "numpy.typing"
        setattr(numpy.typing, kind.__name__, kind)
