"""The command line: `caryatid COMMAND …`.

Each command is a dataclass of its options; calling it runs it. Slow imports happen there.
`main` prints errors in one line.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from caryatid import __version__
from caryatid.errors import GoalError, in_one_line

NOT_SAFE = 3
"""Exit status if no order is safe, or not all that was to be removed was removed without harm."""
GOAL_NOT_FOUND = 4
"""Exit status if the goal is not among the objects."""
INTERRUPTED = 130
"""Exit status after Ctrl-C."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, by default that of the command line, and return its exit status.

    Returns:
        0 done, 1 bad input, failed work or a closed pipe, 3 no safe order, 4 goal not found, 130 interrupted.

    Raises:
        SystemExit: After --help, with 0; on wrong options, with 2.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    debug = False
    try:
        if arguments in (["--version"], ["-V"], ["version"]):
            sys.stdout.write(f"caryatid {__version__}\n")
            return 0
        from caryatid.cli.commands import read_command

        command = read_command(arguments)
        debug = command.general.debug
        status: int = command() or 0
        sys.stdout.flush()
    except KeyboardInterrupt as stop:
        sys.stderr.write(f"interrupted: {str(stop) or 'nothing was written'}\n")
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if _interrupted(error):
            sys.stderr.write("interrupted: nothing was written\n")
            return INTERRUPTED
        if debug:
            raise
        sys.stderr.write(f"error: {in_one_line(error)}\n")
        return GOAL_NOT_FOUND if isinstance(error, GoalError) else 1
    return status


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C caused an error: a library may turn it into its own error during import."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _interrupt_again(lost: sys.UnraisableHookArgs) -> None:
    """Repeat an interrupt that a callback or finaliser lost, once that has returned."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, 0.01)
    else:
        sys.__unraisablehook__(lost)


def run_from_shell() -> NoReturn:
    """Run the command line and exit with its status.

    SIGTERM and SIGHUP act like Ctrl-C. Output to a closed stdout or stderr is dropped.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
        stream.reconfigure(errors="backslashreplace")  # JSON and TOML read these escapes
        setattr(sys, name, stream)
    if not hasattr(signal, "SIGALRM"):
        sys.exit("error: caryatid: this system has no POSIX signals; on Windows, run it in WSL")
    try:
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        sys.unraisablehook = _interrupt_again
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, signal.default_int_handler)
        status = main()
    except KeyboardInterrupt:  # before `main` began or after it ended
        sys.stderr.write("interrupted: nothing was written\n")
        status = INTERRUPTED
    if status == INTERRUPTED:
        # Do not make the user wait for threads and libraries to end.
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)
