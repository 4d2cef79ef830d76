"""From the words of a command line to a command."""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Union

import tyro

DESCRIPTION = """Look around a cluttered table until it is known what holds up what.

To begin:
  caryatid demo                                     a built-in table, explored in simulation
  caryatid view clutter                             the same in the browser, view by view
  caryatid explore tower --noise carmine --out run  another, or a scene or recording of your own
  caryatid extract table.pcd --out run              one cloud, or all views of a recording
  caryatid order run                                a safe order to take away what was found
  caryatid COMMAND --help                           what a command does, its options, and more to try
  caryatid --version                                which caryatid this is
"""
"""What the help of the whole begins with."""

MARKERS = (tyro.conf.FlagCreatePairsOff, tyro.conf.HelptextFromCommentsOff)
"""How options look."""


def read_command(commands: Mapping[str, Callable[..., Any]], arguments: Sequence[str]) -> Any:
    """The command that the words ask for, ready to be called.

    Args:
        commands: All commands by name.
        arguments: The words.

    Raises:
        SystemExit: After --help, with 0; where options are wrong, with 2.
    """
    tyro._experimental_options["ansi_codes"] = _coloured()
    return tyro.cli(
        one_of_commands(commands, arguments[:1]),
        prog="caryatid",
        description=DESCRIPTION,
        args=list(arguments),
        config=MARKERS,
    )


def one_of_commands(commands: Mapping[str, Callable[..., Any]], told: Sequence[str]) -> Any:
    """What tyro reads a command from.

    Args:
        commands: All commands by name.
        told: Of these the help says everything; of others, as in the list of all, the first line.
    """
    return Union[  # noqa: UP007 -- of types that are only known here
        tuple(
            Annotated[
                Any,
                tyro.conf.subcommand(
                    name, constructor=command, description=None if name in told else _first_line(command)
                ),
            ]
            for name, command in commands.items()
        )
    ]


def _first_line(command: Callable[..., Any]) -> str:
    return (inspect.getdoc(command) or "").partition("\n")[0]


def _coloured() -> bool:
    """Whether help and usage errors are coloured: for a person who has not said no."""
    return sys.stdout.isatty() and sys.stderr.isatty() and not os.environ.get("NO_COLOR")
