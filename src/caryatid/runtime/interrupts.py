"""Ctrl-C: while nothing is begun, while there is something to save, and while processes are started."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType
from typing import TypeVar

T = TypeVar("T")

STATUS = 130
"""Exit status of a command that was interrupted."""

TIME_TO_MAKE = 0.7
"""How long after Ctrl-C what can be left out may be made [s]; the process is to end within a second."""

TIME_TO_RING_AGAIN = 0.05
"""After which an alarm that was lost rings again [s]."""

NOTHING = "nothing was written"
"""What was kept, where a command does not say."""


class Interrupted(KeyboardInterrupt):
    """A command was interrupted, and has saved what it had.

    Args:
        kept: What was saved, and where.
    """

    def __init__(self, kept: str) -> None:
        super().__init__(kept)
        self.kept = kept


class _AlarmError(Exception):
    """The time is up."""


_heard: list[float] = []
"""When Ctrl-C was heard since the command began [s], by `time.monotonic`."""


@contextmanager
def left_at_once() -> Iterator[None]:
    """Until the end Ctrl-C ends the process at once, but for what is `interruptible`.

    While modules are imported an exception may be lost: a library that is being initialised takes it for a
    failure of its own. Where Ctrl-C is ignored, as in the background of a shell, it stays so.
    """
    with _handled_by(_leave):
        yield


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt where there is something to save or to clear away."""
    with _handled_by(_raise):
        yield


def note_interrupts() -> None:
    """From here to the end of what is `interruptible` Ctrl-C raises nothing; `interrupted` tells of it.

    For what comes between two parts that may be interrupted, and must not get lost.
    """
    if current_thread() is main_thread() and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _note)


def interrupted() -> bool:
    """Whether Ctrl-C was heard since the command began."""
    return bool(_heard)


def forget_interrupts() -> None:
    """Begin anew, as a command does."""
    _heard.clear()


def made_in_time(make: Callable[[], T]) -> T | None:
    """Make what can be done without: after Ctrl-C there is little time for it, and Ctrl-C meanwhile ends it.

    Args:
        make: Makes it.

    Returns:
        What was made, or None where it was left out.
    """
    try:
        with interruptible(), _alarmed(_heard[0] + TIME_TO_MAKE if interrupted() else None):
            return make()
    except (_AlarmError, KeyboardInterrupt):
        return None


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back until the end; processes started meanwhile never get it, so that they leave quietly.

    The mask is what the processes inherit. It does not hold Ctrl-C back here, where another thread may take
    it and half-started processes would be left behind: the handler does. Where Ctrl-C is ignored, as in the
    background of a shell, it stays so.
    """
    if current_thread() is not main_thread() or signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        yield
        return
    held: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, frame: held.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
    if held:
        _raise()


@contextmanager
def _alarmed(end: float | None) -> Iterator[None]:
    """Raise an alarm when the time is up [s], by `time.monotonic`; at once where there are no alarms."""
    if end is None or current_thread() is not main_thread():
        yield
        return
    left = end - time.monotonic()
    if left <= 0.0 or not hasattr(signal, "setitimer"):
        raise _AlarmError

    def ring(number: int, frame: FrameType | None) -> None:
        raise _AlarmError

    def pass_over(lost: sys.UnraisableHookArgs) -> None:
        if not isinstance(lost.exc_value, _AlarmError):
            report_lost(lost)

    # Where Python can pass no exception on, as in what is called at an object's end, the alarm is lost.
    report_lost, sys.unraisablehook = sys.unraisablehook, pass_over
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, left, TIME_TO_RING_AGAIN)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        sys.unraisablehook = report_lost


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    if current_thread() is not main_thread() or signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _leave(number: int, frame: FrameType | None) -> None:
    if not interrupted():
        os.write(2, f"interrupted: {NOTHING}\n".encode())
    os._exit(STATUS)


def _note(number: int = signal.SIGINT, frame: FrameType | None = None) -> None:
    _heard.append(time.monotonic())


def _raise(number: int = signal.SIGINT, frame: FrameType | None = None) -> None:
    _note()
    raise KeyboardInterrupt
