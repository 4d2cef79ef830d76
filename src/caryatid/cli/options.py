"""Reading the command line: options that commands share, and how the help shows them."""

from __future__ import annotations

import inspect
import io
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from caryatid.config import Config, FusionMethod, NoiseModel, SegmentationMethod
from caryatid.config.settings import read_settings, write_settings
from caryatid.errors import InputError
from caryatid.planning.planners import BUILT_IN, ORACLE, make_planner, offered
from caryatid.robots import ARM, HUMANOID, find_robot

DESCRIPTION = """Explore a cluttered table until it is known which object supports which.

To begin:
  caryatid demo                                     a built-in table, explored in simulation
  caryatid view clutter                             the same in the browser, view by view
  caryatid explore tower --noise carmine --out run  another, or a scene or recording of your own
  caryatid extract table.pcd --out run              one cloud, or all views of a recording
  caryatid order run                                a safe order to take away what was found
  caryatid COMMAND --help                           what a command does, its options, and examples
  caryatid --version                                the version of caryatid
"""
"""Beginning of the help."""

DEFAULTS = Config()
"""Settings without file and flags."""

MARKERS = (tyro.conf.FlagCreatePairsOff, tyro.conf.HelptextFromCommentsOff)
"""How options look."""

SAID = tyro.conf.arg(help_behavior_hint="")
"""An option whose help text says everything, including what happens without it."""


def read_command(commands: Mapping[str, Callable[..., Any]], arguments: Sequence[str]) -> Any:
    """Return the command that the arguments ask for, ready to be called.

    Args:
        commands: All commands by name.
        arguments: Command and options.

    Raises:
        SystemExit: After --help, with 0; on wrong options, with 2.
    """
    shown = sys.stdout.isatty() and sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    tyro._experimental_options["ansi_codes"] = shown
    return tyro.cli(
        one_of_commands(commands, arguments[:1]),
        prog="caryatid",
        description=DESCRIPTION,
        args=list(arguments),
        config=MARKERS,
    )


def one_of_commands(commands: Mapping[str, Callable[..., Any]], detailed: Sequence[str]) -> Any:
    """Return the type that tyro reads a command from.

    Args:
        commands: All commands by name.
        detailed: Commands whose help is given in full; of others only the first line.
    """
    subcommands = []
    for name, command in commands.items():
        text = None if name in detailed else (inspect.getdoc(command) or "").partition("\n")[0]
        spec = tyro.conf.subcommand(name, constructor=command, description=text)
        subcommands.append(Annotated[Any, spec])
    return Union[tuple(subcommands)]  # noqa: UP007 -- types that are only known at run time


def defaults_to(value: object, metavar: str | None = None) -> object:
    """An option that is None when left out; the help names what applies then."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {value})")


def one_of(choice: Any) -> PrimitiveConstructorSpec[str | None]:
    """One of a few words, or None when left out; anything else is a usage error that lists them.

    Args:
        choice: The words, or a Literal of them.
    """
    words: tuple[str, ...] = get_args(choice) or choice
    return _spec("{" + ",".join(words) + "}", lambda word: word, str, words)


def whole_number(least: int) -> PrimitiveConstructorSpec[int | None]:
    """A whole number of at least `least`, or None when left out; anything else is a usage error."""

    def parse(word: str) -> int:
        if not word.isdecimal() or int(word) < least:
            raise ValueError(f"{word} is not a whole number of at least {least}")
        return int(word)

    return _spec("N", parse, int)


def name_of(find: Callable[[str], object], shown: Iterable[str]) -> PrimitiveConstructorSpec[str]:
    """A name that `find` accepts; anything else is a usage error that lists the names.

    Args:
        find: Raises InputError where it does not know a name.
        shown: Names the help lists; where the last one is `…`, there are others.
    """

    def parse(word: str) -> str:
        try:
            find(word)
        except InputError as error:
            raise ValueError(f"{error.reason}; {error.remedy}") from None
        return word

    names = tuple(shown)
    complete = not any(name.endswith("…") for name in names)
    return _spec("{" + ",".join(names) + "}", parse, str, names if complete else None)


def _spec(
    metavar: str, parse: Callable[[str], Any], kind: type, choices: tuple[str, ...] | None = None
) -> PrimitiveConstructorSpec[Any]:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: parse(words[0]),
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: [str(value)],
        choices=choices,
    )


def _known_planner(name: str) -> None:
    if name not in {*BUILT_IN, ORACLE}:
        make_planner(name)


def _known_robot(name: str) -> None:
    if ":" not in name:
        find_robot(name)


Views = Annotated[int | None, whole_number(1)]
Seed = Annotated[int, whole_number(0)]
OutPath = Annotated[Path, tyro.conf.arg(metavar="RUN")]
OptionalPath = Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE"), SAID]
RunPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
SourceName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
Segmentation = Annotated[
    SegmentationMethod | None, one_of(SegmentationMethod), defaults_to("labels where the source has them")
]
PlannerName = Annotated[str, name_of(_known_planner, [*BUILT_IN, *sorted(offered()), ORACLE])]
"""`oracle`, or a name `make_planner` knows, including planners of other packages."""
RobotName = Annotated[str, name_of(_known_robot, [HUMANOID, f"{ARM}FILE.npz", "module:callable", "…"])]
"""A name `find_robot` knows; files and modules are checked when they are opened."""
ConfigPath = Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.toml"), SAID]
Assignments = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="STAGE.NAME=VALUE")]


@dataclass(frozen=True, kw_only=True)
class General:
    """Output."""

    json: Annotated[bool, SAID] = False
    """Write the result to stdout as one JSON document, and nothing else."""
    quiet: Annotated[bool, SAID] = False
    """Print nothing while working."""
    debug: Annotated[bool, SAID] = False
    """Show the traceback of an error instead of one line."""

    @property
    def silent(self) -> bool:
        """Whether nothing is printed for a person."""
        return self.quiet or self.json


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings."""

    config: ConfigPath = None
    """Settings that replace the defaults; `caryatid config` writes a file with all of them."""
    set: Assignments = ()
    """Set one setting, such as `--set fit.hypotheses=200`; overrides the file."""

    def settings(self, base: Config = DEFAULTS) -> Config:
        """The configuration: flag > file > default.

        Args:
            base: The defaults.

        Raises:
            InputError: A file, name or value is not valid.
        """
        return read_settings(self.config, self.set, base)


@dataclass(frozen=True, kw_only=True)
class Modelling(Settings):
    """How views become a scene model."""

    fusion: Annotated[FusionMethod | None, one_of(FusionMethod), defaults_to(DEFAULTS.fusion.method)] = None
    """What to fuse over views: points, graphs, or both."""
    seed: Seed = 0
    """Seed of every random choice; the same seed gives the same graph, byte for byte."""

    def settings(self, base: Config = DEFAULTS) -> Config:
        """The configuration: flag > file > default.

        Args:
            base: The defaults.

        Raises:
            InputError: A file, name or value is not valid.
        """
        config = read_settings(self.config, self.set, base)
        if self.fusion is None:
            return config
        return replace(config, fusion=replace(config.fusion, method=self.fusion))


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command."""

    general: tyro.conf.OmitArgPrefixes[General] = General()


@dataclass(frozen=True, kw_only=True)
class ModellingCommand(Command):
    """A command that builds a scene model."""

    modelling: tyro.conf.OmitArgPrefixes[Modelling] = Modelling()


@dataclass(frozen=True, kw_only=True)
class ExploringCommand(ModellingCommand):
    """A command that explores a scene."""

    views: Annotated[Views, defaults_to(10)] = None
    """Maximum number of views, including the first."""
    planner: PlannerName = "support"
    """Planner of the next view; oracle knows the ground truth and works in simulation only."""
    robot: RobotName = "humanoid"
    """Robot that carries the simulated camera: arm:FILE.npz is an arm with a reachability map,
    module:callable one of your own."""
    segmentation: Segmentation = None
    """Use the masks that are given, or segment automatically."""
    noise: NoiseModel = "none"
    """Noise of the simulated camera: depth noise and registration error of a Carmine, or none."""

    def settings(self) -> Config:
        """The configuration: flag > file > default.

        Raises:
            InputError: A file, name or value is not valid.
        """
        return with_views(self.modelling.settings(), self.views)


def with_views(config: Config, views: int | None) -> Config:
    """The configuration with another maximum number of views, where one is given."""
    return config if views is None else replace(config, active=replace(config.active, max_views=views))


@dataclass(frozen=True, kw_only=True)
class ShowConfig(ModellingCommand):
    """Print all settings as TOML, to edit and pass back with --config.

    To try:
      caryatid config > settings.toml
    """

    def __call__(self) -> None:
        """Run the command."""
        config = self.modelling.settings()
        if self.general.json:
            from caryatid.cli.output import write_json

            write_json(asdict(config))
        else:
            sys.stdout.write(write_settings(config))


@dataclass(frozen=True, kw_only=True)
class Completion(Command):
    """Print a script that lets the shell complete commands and options.

    To try:
      source <(caryatid completion bash)
      caryatid completion bash > ~/.local/share/bash-completion/completions/caryatid
      caryatid completion zsh > "${fpath[1]}/_caryatid"
      caryatid completion fish > ~/.config/fish/completions/caryatid.fish
      caryatid completion tcsh > ~/.caryatid.tcsh && echo source ~/.caryatid.tcsh >> ~/.tcshrc
    """

    shell: Annotated[Literal["bash", "zsh", "fish", "tcsh"], tyro.conf.Positional]
    """The shell."""

    def __call__(self) -> None:
        """Run the command."""
        from caryatid.cli import commands

        words = ["--tyro-write-completion", self.shell, "-"]
        output = io.StringIO()
        with redirect_stdout(output), suppress(SystemExit):
            tyro.cli(one_of_commands(commands(), ()), prog="caryatid", args=words, config=MARKERS)
        script = output.getvalue()
        if self.general.json:
            from caryatid.cli.output import write_json

            write_json({"shell": self.shell, "script": script})
        else:
            sys.stdout.write(script)
