"""The command line: `caryatid COMMAND …`; errors end here, in one line.

The modules of the commands say what options there are. What does the work, and takes its time to import, they
import when they are called.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from caryatid import __version__
from caryatid.errors import in_one_line
from caryatid.interrupts import (
    NOTHING,
    STATUS,
    Interrupted,
    forget_interrupts,
    interrupted,
    left_at_once,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    Args:
        arguments: The command and its options; None takes them from the command line.

    Returns:
        0 done, 1 the input is bad, the work failed or nobody reads the result, 130 interrupted.

    Raises:
        SystemExit: After --help, with 0; where options are wrong, with 2.
    """
    forget_interrupts()
    try:
        with left_at_once():
            return _run(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt as stop:
        kept = stop.kept if isinstance(stop, Interrupted) else NOTHING
        sys.stderr.write(f"interrupted: {kept}\n")
        return STATUS
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def run_from_shell() -> NoReturn:
    """Run the command of the shell, and end the process with its status."""
    status = main()
    if status == STATUS:
        # Threads and libraries take their time to end, and whoever pressed Ctrl-C does not wait for them.
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def commands() -> dict[str, Callable[..., Any]]:
    """All commands by name, in the order of the help."""
    from caryatid.commands.benchmark import Benchmark
    from caryatid.commands.completion import Completion
    from caryatid.commands.demo import Demo
    from caryatid.commands.dismantle import Dismantle
    from caryatid.commands.evaluate import Evaluate
    from caryatid.commands.explore import Explore
    from caryatid.commands.export import Export
    from caryatid.commands.extract import Extract
    from caryatid.commands.import_recording import Import
    from caryatid.commands.order import Order
    from caryatid.commands.report import ReportCommand
    from caryatid.commands.serve import Serve
    from caryatid.commands.session import SessionCommand
    from caryatid.commands.show_config import ShowConfig
    from caryatid.commands.view import View

    return {
        "demo": Demo,
        "explore": Explore,
        "extract": Extract,
        "view": View,
        "evaluate": Evaluate,
        "order": Order,
        "dismantle": Dismantle,
        "import": Import,
        "report": ReportCommand,
        "export": Export,
        "benchmark": Benchmark,
        "session": SessionCommand,
        "serve": Serve,
        "config": ShowConfig,
        "completion": Completion,
    }


def _run(arguments: Sequence[str]) -> int:
    if list(arguments) == ["--version"]:
        sys.stdout.write(f"caryatid {__version__}\n")
        return 0

    from caryatid.commands.reading import read_command

    command = read_command(commands(), arguments)
    try:
        status: int = command()
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except Exception as error:
        if interrupted():
            raise KeyboardInterrupt from error
        if command.general.debug:
            raise
        sys.stderr.write(f"error: {in_one_line(error)}\n")
        return 1
    return status


if __name__ == "__main__":
    run_from_shell()
