"""Where commands write: what moves or is coloured only to a person, never into a file."""

from __future__ import annotations

import sys

from rich.console import Console


def result_console() -> Console:
    """Stdout, for results."""
    return Console(highlight=False)


def news_console(quiet: bool) -> Console:
    """Stderr, for what is said while working; `is_interactive` where a bar or spinner can move.

    FORCE_COLOR colours what goes into a file, and nothing moves there all the same.

    Args:
        quiet: Say nothing.
    """
    moving = None if sys.stderr.isatty() else False
    return Console(
        stderr=True, quiet=quiet, highlight=False, emoji=False, soft_wrap=True, force_interactive=moving
    )
