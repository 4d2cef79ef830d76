"""Parsing of the command line by tyro, and the commands that only print text."""

from __future__ import annotations

import inspect
import io
import os
import re
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import asdict, is_dataclass, make_dataclass
from difflib import get_close_matches
from itertools import pairwise
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from caryatid.cli.commands import COMMANDS, Completion, Config, Scenes
from caryatid.cli.options import REGISTRY

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

MARKERS = (
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.HelptextFromCommentsOff,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.OmitSubcommandPrefixes,
)
"""How tyro turns fields into options."""


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
            return _parse(COMMANDS[name], f"caryatid {name}", options)
        return _parse(_any_command(), "caryatid", arguments).command
    except SystemExit as end:
        if end.code:
            _suggest(name, options)
        raise


def _parse(kind: Any, program: str, arguments: Sequence[str]) -> Any:
    description = None if kind in COMMANDS.values() else DESCRIPTION
    return tyro.cli(
        kind, prog=program, description=description, args=arguments, config=MARKERS, registry=REGISTRY
    )


def _suggest(name: str, options: Sequence[str]) -> None:
    """Print the command or the value of an option that a mistyped one resembles."""
    pairs = pairwise(options) if name in COMMANDS else [("", name)]
    choices = _choices(COMMANDS[name]) if name in COMMANDS else {"": list(COMMANDS)}
    for option, word in pairs:
        known = choices.get(option, []) if not word.startswith("-") else []
        if word not in known and (meant := get_close_matches(word, known, 1)):
            sys.stderr.write(f"Did you mean {meant[0]}?\n")


def _choices(kind: Any, option: str = "") -> dict[str, list[str]]:
    """The words that each option of a command chooses from; `kind` is its type, or that of an option."""
    if isinstance(kind, PrimitiveConstructorSpec):
        return {option: list(kind.choices or ())}
    if get_origin(kind) is Literal:
        return {option: [str(word) for word in get_args(kind)]}
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind, include_extras=True)
        parts = [(part, f"--{name.replace('_', '-')}") for name, part in hints.items()]
    else:
        parts = [(part, option) for part in (*get_args(kind), *getattr(kind, "__metadata__", ()))]
    return {name: words for part in parts for name, words in _choices(*part).items()}


def _any_command() -> Any:
    """The type of all commands, each with the first line of its help."""
    subcommands = []
    for name, command in COMMANDS.items():
        summary = (inspect.getdoc(command) or "").partition("\n")[0]
        spec = tyro.conf.subcommand(name, constructor=command, description=summary)
        subcommands.append(Annotated[Any, spec])
    # Where there is no help text, tyro looks for one in the sources of `typing`, which takes long.
    chosen: Any = Annotated[Union[tuple(subcommands)], tyro.conf.arg(help="")]  # noqa: UP007
    version: Any = Annotated[bool, tyro.conf.arg(help="Print the version.", help_behavior_hint="")]
    return make_dataclass("Caryatid", [("command", chosen), ("version", version, False)])


def print_scenes(command: Scenes) -> None:
    from caryatid.cli.output import table
    from caryatid.io.datasets import DESCRIPTIONS
    from caryatid.simulation.scenes import list_scenes

    scenes, columns = list_scenes(), ("name", "description")
    shown = table("Built-in scenes", columns, scenes.items()), table("Samples", columns, DESCRIPTIONS.items())
    command.output.result({"scenes": scenes, "samples": DESCRIPTIONS}, *shown)


def print_config(command: Config) -> None:
    from caryatid.config.settings import write_settings

    config = command.settings.read()
    command.output.result(asdict(config), write_settings(config))


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


def print_completion(command: Completion) -> None:
    from caryatid import config
    from caryatid.io.datasets import DESCRIPTIONS
    from caryatid.simulation.scenes import DESIGNED

    script = io.StringIO()
    with redirect_stdout(script), suppress(SystemExit):
        _parse(_any_command(), "caryatid", ["--tyro-write-completion", command.shell, "-"])
    settings = [f"{stage}.{name}=" for stage, values in asdict(config.Config()).items() for name in values]
    both = [*DESIGNED, *(name for name in DESCRIPTIONS if "recording" in name)]
    sources = {"explore": both, "view": both, "clear": [*DESIGNED], "extract": [*DESCRIPTIONS]}
    offers = OFFERS.replace("SETTINGS", repr(settings)).replace("SOURCES", repr(sources))
    known = re.sub(
        "^COMPLETION_SPEC = .*", lambda line: line[0] + offers, script.getvalue(), flags=re.MULTILINE
    )
    for old, new in FILES.items():
        known = known.replace(old, new)
    command.output.result({"shell": command.shell, "script": known}, known)
