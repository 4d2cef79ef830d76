"""All commands by name, the parsing of the command line, and the commands that only print text."""

from __future__ import annotations

import inspect
import io
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from itertools import pairwise
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, Union

import tyro

from caryatid.cli.options import Command, Modelling

DESCRIPTION = """Explore a cluttered table and find out which object supports which.

Get started:
  caryatid demo                  explore a built-in table in simulation
  caryatid view clutter          watch an exploration in the browser, view by view
  caryatid explore tower         explore another built-in scene, or your own scene or recording
  caryatid extract sample-cloud  process one cloud, or all views of a recording
  caryatid order run             find a safe order in which to remove the objects of a run
  caryatid COMMAND --help        show what a command does, its options, and examples
  caryatid --version             print the version
"""
"""Text at the top of the help."""

COMMANDS = {
    "demo": "run:Demo",
    "explore": "run:Explore",
    "extract": "run:Extract",
    "view": "run:View",
    "evaluate": "results:Evaluate",
    "order": "results:OrderCommand",
    "clear": "run:Clear",
    "import": "results:Import",
    "report": "results:ReportCommand",
    "export": "results:Export",
    "benchmark": "benchmark:Benchmark",
    "session": "sessions:SessionCommand",
    "serve": "sessions:Serve",
    "scenes": "commands:Scenes",
    "config": "commands:ShowConfig",
    "completion": "commands:Completion",
}
"""Module and class of each command, in the order of the help; imported on demand."""

MARKERS = (
    tyro.conf.DisallowNone,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.HelptextFromCommentsOff,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.OmitSubcommandPrefixes,
)
"""How tyro turns fields into options."""


def find_command(name: str) -> type:
    """Return the dataclass of a command."""
    command: type = resolve_name(f"caryatid.cli.{COMMANDS[name]}")
    return command


def read_command(arguments: Sequence[str]) -> Any:
    """Parse the arguments into a command that is ready to be called.

    Raises:
        SystemExit: After --help, with 0; on wrong options, with 2.
    """
    shown = sys.stdout.isatty() and sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    tyro._experimental_options["ansi_codes"] = shown
    name, *options = arguments = [*arguments] or ["--help"]
    try:
        if name in COMMANDS:
            return tyro.cli(find_command(name), prog=f"caryatid {name}", args=options, config=MARKERS)
        return tyro.cli(
            _any_command(), prog="caryatid", description=DESCRIPTION, args=arguments, config=MARKERS
        )
    except SystemExit as end:
        if end.code:
            _suggest(name, options)
        raise


def _suggest(name: str, options: Sequence[str]) -> None:
    """Print the command or planner that a mistyped one resembles."""
    from caryatid.planning.planners import BUILT_IN, ORACLE, offered

    known, given = [*COMMANDS], [name]
    if name in COMMANDS:
        known = [*BUILT_IN, *offered(), ORACLE]
        given = [value for option, value in pairwise(options) if option == "--planner"]
    for word in given:
        if word not in known and (meant := get_close_matches(word, known, 1)):
            sys.stderr.write(f"Did you mean {meant[0]}?\n")


def _any_command() -> Any:
    """The type of all commands, each with the first line of its help."""
    subcommands = []
    for name in COMMANDS:
        command = find_command(name)
        summary = (inspect.getdoc(command) or "").partition("\n")[0]
        spec = tyro.conf.subcommand(name, constructor=command, description=summary)
        subcommands.append(Annotated[Any, spec])
    # Where there is no help text, tyro looks for one in the sources of `typing`, which takes long.
    return Annotated[Union[tuple(subcommands)], tyro.conf.arg(help="")]  # noqa: UP007


@dataclass(frozen=True, kw_only=True)
class Scenes(Command):
    """List the built-in scenes and the sample recordings.

    Usage examples:
      caryatid scenes
    """

    def __call__(self) -> None:
        from caryatid.cli.output import table
        from caryatid.io.datasets import DESCRIPTIONS
        from caryatid.simulation.scenes import list_scenes

        scenes = list_scenes()
        shown = [
            table(title, ("name", "description"), what.items())
            for title, what in (("Built-in scenes", scenes), ("Samples", DESCRIPTIONS))
        ]
        self.output.result({"scenes": scenes, "samples": DESCRIPTIONS}, *shown)


@dataclass(frozen=True, kw_only=True)
class ShowConfig(Command):
    """Print all settings as TOML, to edit and pass to --config.

    Usage examples:
      caryatid config > settings.toml
    """

    settings: Modelling = Modelling()

    def __call__(self) -> None:
        from caryatid.config.settings import write_settings

        config = self.settings.read()
        self.output.result(asdict(config), write_settings(config))


@dataclass(frozen=True, kw_only=True)
class Completion(Command):
    """Print a shell completion script for commands and options.

    Usage examples:
      source <(caryatid completion bash)
      caryatid completion bash > ~/.local/share/bash-completion/completions/caryatid
      caryatid completion zsh > "${fpath[1]}/_caryatid"
      caryatid completion fish > ~/.config/fish/completions/caryatid.fish
      caryatid completion tcsh > ~/.caryatid.tcsh && echo source ~/.caryatid.tcsh >> ~/.tcshrc
    """

    shell: Annotated[Literal["bash", "zsh", "fish", "tcsh"], tyro.conf.Positional]
    """Shell to print the script for."""

    def __call__(self) -> None:
        script = io.StringIO()
        words = ["--tyro-write-completion", self.shell, "-"]
        with redirect_stdout(script), suppress(SystemExit):
            tyro.cli(_any_command(), prog="caryatid", args=words, config=MARKERS)
        self.output.result({"shell": self.shell, "script": script.getvalue()}, script.getvalue())
