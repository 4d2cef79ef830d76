"""Compiled kernels, the only place with numba; each stands beside a plain NumPy reference.

Those with `no_cpython_wrapper` compile faster. They are for other kernels and `parallel.for_each` to call;
called from Python they break it.
"""

from __future__ import annotations

from pathlib import Path

from numba import njit

from caryatid.errors import InputError


def _nothing() -> None:
    """As good as any kernel to ask numba where it keeps those of this folder."""


try:
    CACHE = Path(njit(cache=True)(_nothing).stats.cache_path)
    """Where numba keeps the compiled kernels of this folder."""
except RuntimeError:
    raise InputError(
        "NUMBA_CACHE_DIR",
        "compiled kernels cannot be kept, no folder for them can be written to",
        "set it to one that can",
    ) from None
