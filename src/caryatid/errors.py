"""Errors that a user can fix, each in one sentence."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from os import PathLike
from pathlib import Path


class CaryatidError(Exception):
    """Any failure the command line reports in one line, without a traceback."""


class InputError(CaryatidError):
    """An input that cannot be used.

    Args:
        source: The invalid file, field or argument.
        reason: What is wrong with it.
        remedy: How the user can fix it.
    """

    def __init__(self, source: str | PathLike[str], reason: str, remedy: str = "") -> None:
        self.source = str(source)
        self.reason = reason
        self.remedy = remedy
        super().__init__(f"{self.source}: {reason}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """Arguments from which another process rebuilds it."""
        return type(self), (self.source, self.reason, self.remedy)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Ask whether the most similar known word was meant, with a space after the question; "" if none is."""
    meant = get_close_matches(word, [*known], 1)
    return f"did you mean {meant[0]}? " if meant else ""


def check_type(name: str, value: object, wanted: str | type | tuple[type, ...], remedy: str) -> None:
    """Reject an argument of the wrong type, or without a method of this name.

    Raises:
        InputError: The type is wrong; the error names the argument and its type.
    """
    fits = hasattr(value, wanted) if isinstance(wanted, str) else isinstance(value, wanted)
    if not fits:
        raise InputError(name, f"has the wrong type, {type(value).__name__}", remedy)


class GoalError(InputError):
    """A goal that is not among the objects."""


class WrongViewError(InputError):
    """A view whose depth, camera or pose cannot be correct; other views may be usable."""


class PerceptionError(CaryatidError):
    """A view from which nothing can be extracted: no depth readings, or no support surface."""


class NoSurfaceError(PerceptionError):
    """A view that shows no support surface; another one may."""


class PlanningError(CaryatidError):
    """No next view exists: none is reachable, or all were visited."""


def missing_extra(extra: str, library: str, source: str | PathLike[str]) -> InputError:
    """The error for a missing library that an extra of the package installs."""
    clone = Path(__file__).parents[2]
    package = clone if (clone / "pyproject.toml").is_file() else "caryatid"
    return InputError(source, f"needs {library}", f'{sys.executable} -m pip install "{package}[{extra}]"')


@contextmanager
def needs_extra(extra: str, source: str | PathLike[str]) -> Iterator[None]:
    """Name the extra to install if an import in the block fails.

    Raises:
        InputError: Instead of the ModuleNotFoundError.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        library = str(error.name).partition(".")[0]
        if library == "caryatid":
            raise
        raise missing_extra(extra, library, source) from None


def in_one_line(error: Exception) -> str:
    """Describe an error in one line."""
    match error:
        case OSError(filename=str() as name, strerror=str() as reason):
            text = f"{name}: {reason.lower()}"
        case OSError(strerror=str() as reason):
            text = reason.lower()
        case CaryatidError() | OSError():
            text = str(error)
        case MemoryError():
            text = f"out of memory: {error}"
        case _:
            text = f"internal error: {type(error).__name__}: {error}; run with --debug for the traceback"
    return " ".join(text.splitlines())
