"""The command line: `caryatid COMMAND …`; errors end here, in one line.

The modules of the commands say what options there are. What does the work, and takes its time to import, they
import when they are called.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any, NoReturn

from caryatid.errors import in_one_line
from caryatid.runtime.interrupts import (
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
    from caryatid.cli.benchmark import Benchmark
    from caryatid.cli.completion import Completion
    from caryatid.cli.demo import Demo
    from caryatid.cli.dismantle import Dismantle
    from caryatid.cli.evaluate import Evaluate
    from caryatid.cli.explore import Explore
    from caryatid.cli.export import Export
    from caryatid.cli.extract import Extract
    from caryatid.cli.import_recording import Import
    from caryatid.cli.order import Order
    from caryatid.cli.report import ReportCommand
    from caryatid.cli.serve import Serve
    from caryatid.cli.session import SessionCommand
    from caryatid.cli.show_config import ShowConfig
    from caryatid.cli.view import View

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
        sys.stdout.write(f"caryatid {version('caryatid')}\n")
        return 0

    from caryatid.cli.reading import read_command

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
