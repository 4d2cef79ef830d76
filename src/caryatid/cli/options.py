"""Options the commands share, and how options look in the help."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_args

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from caryatid.config import Config, FusionMethod
from caryatid.config.settings import read_settings

DEFAULTS = Config()
"""Settings without file and flags: what the help says an option defaults to."""

SAID = tyro.conf.arg(help_behavior_hint="")
"""An option whose help text says all there is to say, also what happens without it."""


def defaults_to(value: object, metavar: str | None = None) -> object:
    """An option that is None where it is not given; the help names what counts then."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {value})")


def one_of(choice: Any) -> PrimitiveConstructorSpec[str | None]:
    """One of few words, or None where none is given; anything else is a usage error that lists them.

    Args:
        choice: A Literal of the words.
    """
    words: tuple[str, ...] = get_args(choice)
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(words) + "}",
        instance_from_str=lambda given: given[0],
        is_instance=lambda value: value is None or value in words,
        str_from_instance=lambda value: [str(value)],
        choices=words,
    )


def whole_number(least: int) -> PrimitiveConstructorSpec[int | None]:
    """A whole number from `least` on, or None where none is given; anything else is a usage error."""

    def parse(words: list[str]) -> int:
        if not words[0].isdecimal() or int(words[0]) < least:
            raise ValueError(f"{words[0]} is no whole number from {least} on")
        return int(words[0])

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="N",
        instance_from_str=parse,
        is_instance=lambda value: value is None or isinstance(value, int),
        str_from_instance=lambda value: [str(value)],
    )


Views = Annotated[int | None, whole_number(1)]
Seed = Annotated[int, whole_number(0)]
OutPath = Annotated[Path, tyro.conf.arg(metavar="RUN")]
Profile = Annotated[bool, SAID]


@dataclass(frozen=True, kw_only=True)
class General:
    """What is said, and how."""

    json: Annotated[bool, SAID] = False
    """Write the result to stdout as one JSON document, and nothing else."""
    quiet: Annotated[bool, SAID] = False
    """Say nothing while working."""
    debug: Annotated[bool, SAID] = False
    """Show the traceback of an error in place of one line."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Where settings come from."""

    config: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.toml"), SAID] = None
    """Settings to use in place of the defaults; `caryatid config` writes a file with all of them."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="STAGE.NAME=VALUE")] = ()
    """One setting, say `--set fit.hypotheses=200`; goes before the file's."""

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
    """What is fused over views: points, graphs, or both."""
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
class ModellingCommand:
    """A command that builds a scene model."""

    modelling: tyro.conf.OmitArgPrefixes[Modelling] = Modelling()
    general: tyro.conf.OmitArgPrefixes[General] = General()


def with_views(config: Config, views: int | None) -> Config:
    """The configuration with another limit of views, where one is given."""
    return config if views is None else replace(config, active=replace(config.active, max_views=views))
