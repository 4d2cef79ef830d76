"""What `caryatid completion` writes: shtab's script, told which words are files and which are names."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import shtab
import tyro

from caryatid.benchmark.suites import SUITES
from caryatid.cli import commands
from caryatid.cli.completion import Shell
from caryatid.cli.reading import MARKERS, one_of_commands
from caryatid.planning.planners import BUILT_IN, ORACLE
from caryatid.planning.planners import offered as offered_planners
from caryatid.robots import HUMANOID
from caryatid.robots import offered as offered_robots
from caryatid.simulation.scenes import DESIGNED

SCENES = [*DESIGNED, "pile-8-0", "dense-12-0", "packed-20-0"]
"""Names of scenes: all that are designed, and one of each generator."""

SCENES_OR_FILES = {("explore", "source"), ("dismantle", "source"), ("benchmark", "scenes")}
"""Options that take the name of a scene as well as a file or folder."""


def completion_script(shell: Shell) -> str:
    """Write the script that completes for a shell."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser: Any = tyro.extras.get_parser(one_of_commands(commands(), ()), prog="caryatid", config=MARKERS)
    names = {
        "planner": [*BUILT_IN, *sorted(offered_planners()), ORACLE],
        "robot": [HUMANOID, *sorted(offered_robots())],
        "suite": list(SUITES),
        "scene": SCENES,
    }
    for command, action in _options(parser):
        option = action.dest.rpartition(".")[2]
        if option in names:
            action.choices = names[option]
        elif (command, option) in SCENES_OR_FILES:
            action.complete = _scenes_or_files()
        elif option == "source":
            action.complete = shtab.FILE
    script: str = shtab.complete(parser, shell)
    return script if script.endswith("\n") else f"{script}\n"


def _scenes_or_files() -> dict[str, Any]:
    """What shtab calls to complete a scene: a function for each shell that can have one."""
    function, scenes = "_caryatid_scenes_files", " ".join(SCENES)
    return shtab.FILE | {
        "bash": function,
        "zsh": function,
        "fish": f"{scenes} {shtab.FILE['fish']}",
        "preamble": {
            "bash": f'{function}() {{\n  compgen -W "{scenes}" -- "$1"\n  compgen -f -- "$1"\n}}',
            "zsh": f"{function}() {{\n  _alternative 'scenes:scene:({scenes})' 'files:file:_files'\n}}",
        },
    }


def _options(parser: Any) -> Iterator[tuple[str, Any]]:
    """Options and positional words of an argparse parser and of those below it, each after its command."""
    for action in parser._actions:
        if isinstance(action.choices, dict):
            for below in action.choices.values():
                yield from _options(below)
        else:
            yield parser.prog.rpartition(" ")[2], action
