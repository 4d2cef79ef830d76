"""The command line: `caryatid COMMAND …`; errors end here, in one line.

The modules of the commands say what options there are. What does the work, and takes its time to import, they
import when they are called.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from caryatid.errors import in_one_line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    Args:
        arguments: The command and its options; None takes them from the command line.

    Returns:
        0 done, 1 the input is bad, the work failed or nobody reads the result, 130 interrupted.

    Raises:
        SystemExit: After --help, with 0; where options are wrong, with 2.
    """
    try:
        return _run(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: nothing was written\n")
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _run(arguments: Sequence[str]) -> int:
    import tyro

    from caryatid.commands.benchmark import Benchmark
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

    command = tyro.extras.subcommand_cli_from_dict(
        {
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
        },
        prog="caryatid",
        description="Look around a cluttered table until it is known what holds up what.",
        args=list(arguments),
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.HelptextFromCommentsOff),
    )
    try:
        status: int = command()
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except Exception as error:
        if command.general.debug:
            raise
        sys.stderr.write(f"error: {in_one_line(error)}\n")
        return 1
    return status


if __name__ == "__main__":
    sys.exit(main())
