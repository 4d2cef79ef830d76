"""All commands by name, the parsing of the command line, and the commands that only print text."""

from __future__ import annotations

import inspect
import io
import os
import re
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import asdict, dataclass, is_dataclass, make_dataclass
from difflib import get_close_matches
from itertools import pairwise
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from caryatid.cli.options import Command, Modelling

DESCRIPTION = """Explore a cluttered table and find out which object supports which.

Get started:
  caryatid demo                  explore a built-in table in simulation
  caryatid view clutter          watch an exploration in the browser, view by view
  caryatid explore tower         explore another built-in scene, or your own scene or recording
  caryatid extract sample-cloud  process one cloud, or all views of a recording
  caryatid order run             find a safe order in which to remove the objects of a run
  caryatid COMMAND --help        show what a command does, its options, and examples
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
    if list(arguments[:1]) in ([], ["help"]):
        arguments = [*arguments[1:], "--help"]
    name, *options = arguments
    try:
        if name in COMMANDS:
            return tyro.cli(find_command(name), prog=f"caryatid {name}", args=options, config=MARKERS)
        read = tyro.cli(
            _any_command(), prog="caryatid", description=DESCRIPTION, args=arguments, config=MARKERS
        )
        return read.command
    except SystemExit as end:
        if end.code:
            _suggest(name, options)
        raise


def _suggest(name: str, options: Sequence[str]) -> None:
    """Print the command or the value of an option that a mistyped one resembles."""
    pairs = [("", name)]
    choices: dict[str, tuple[str, ...]] = {"": tuple(COMMANDS)}
    if name in COMMANDS:
        choices, pairs = _choices(find_command(name)), list(pairwise(options))
    for option, word in pairs:
        known = choices.get(option, ()) if not word.startswith("-") else ()
        if word not in known and (meant := get_close_matches(word, known, 1)):
            sys.stderr.write(f"Did you mean {meant[0]}?\n")


def _choices(hint: Any) -> dict[str, tuple[str, ...]]:
    """The words that each option of a command, or the type of one option (""), chooses from."""
    found: dict[str, tuple[str, ...]] = {}
    if isinstance(hint, PrimitiveConstructorSpec):
        found[""] = hint.choices or ()
    elif get_origin(hint) is Literal:
        found[""] = tuple(map(str, get_args(hint)))
    elif isinstance(hint, type) and is_dataclass(hint):
        for name, part in get_type_hints(hint, include_extras=True).items():
            found |= {
                option or f"--{name.replace('_', '-')}": words for option, words in _choices(part).items()
            }
    else:
        for part in (*get_args(hint), *getattr(hint, "__metadata__", ())):
            found |= _choices(part)
    return found


def _any_command() -> Any:
    """The type of all commands, each with the first line of its help."""
    subcommands = []
    for name in COMMANDS:
        command = find_command(name)
        summary = (inspect.getdoc(command) or "").partition("\n")[0]
        spec = tyro.conf.subcommand(name, constructor=command, description=summary)
        subcommands.append(Annotated[Any, spec])
    # Where there is no help text, tyro looks for one in the sources of `typing`, which takes long.
    chosen: Any = Annotated[Union[tuple(subcommands)], tyro.conf.arg(help="")]  # noqa: UP007
    version: Any = Annotated[bool, tyro.conf.arg(help="Print the version.", help_behavior_hint="")]
    return make_dataclass("Caryatid", [("command", chosen), ("version", version, False)])


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


OFFERS = """

def offer_values(command, names):
    for option in command['options']:
        if '--set' in option['flags']:
            option.update(type='choice', choices=SETTINGS)
    for name, child in command['subcommands'].items():
        offer_values(child, [])
    command['subcommands'].update((name, dict(command, subcommands={})) for name in names)

for name, command in COMPLETION_SPEC['subcommands'].items():
    offer_values(command, SOURCES.get(name, []))
"""
"""What tyro's script does not know: settings and sources. Fish quotes it: no double quote, backslash or $."""
FILES = {
    "get_completions(words, current_index, COMPLETION_SPEC)  #": (
        "get_completions(words, current_index, COMPLETION_SPEC) or ['__TYRO_COMPLETE_FILES__']  #"
    ),
    'compgen -f -- "$cur"': 'compgen -f -- "${COMP_WORDS[COMP_CWORD]}"',
    '  COMPREPLY=("${matches[@]}")\n': (
        '  COMPREPLY=("${matches[@]}")\n'
        '  if [[ "${COMPREPLY[0]}" == *= ]]; then compopt -o nospace 2> /dev/null; fi\n'
    ),
}
"""Changes to tyro's script: files wherever nothing else is known, and no space after a setting's =."""


@dataclass(frozen=True, kw_only=True)
class Completion(Command):
    """Print a shell completion script for commands, options, scenes, settings and files.

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
        from caryatid.config import Config
        from caryatid.io.datasets import DESCRIPTIONS
        from caryatid.simulation.scenes import DESIGNED

        script = io.StringIO()
        words = ["--tyro-write-completion", self.shell, "-"]
        with redirect_stdout(script), suppress(SystemExit):
            tyro.cli(_any_command(), prog="caryatid", args=words, config=MARKERS)
        settings = [f"{stage}.{name}=" for stage, values in asdict(Config()).items() for name in values]
        recordings = [name for name in DESCRIPTIONS if "recording" in name]
        both = [*DESIGNED, *recordings]
        sources = {"explore": both, "view": both, "clear": [*DESIGNED], "extract": [*DESCRIPTIONS]}
        text = script.getvalue()
        offers = OFFERS.replace("SETTINGS", repr(settings)).replace("SOURCES", repr(sources))
        text = re.sub("^COMPLETION_SPEC = .*", lambda line: line[0] + offers, text, flags=re.MULTILINE)
        for old, new in FILES.items():
            text = text.replace(old, new)
        self.output.result({"shell": self.shell, "script": text}, text)
