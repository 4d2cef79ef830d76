"""NumPy's types of arrays by their names: what they stand for fills lines and tells a reader nothing."""

from __future__ import annotations

import types

import numpy.typing


class NDArray:
    """What annotations of arrays are in the reference."""

    __class_getitem__ = classmethod(types.GenericAlias)


class ArrayLike:
    """What annotations of what becomes an array are there."""


def keep_their_names() -> None:
    """Put the names in the place of the types; before the modules are imported that use them."""
    for kind in (NDArray, ArrayLike):
        kind.__module__ = "numpy.typing"
        setattr(numpy.typing, kind.__name__, kind)
