"""Options the commands share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.config import Config, FusionMethod
from caryatid.settings import read_settings


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every command."""

    json: bool = False
    """Write the result to stdout as one JSON document and nothing else."""
    quiet: bool = False
    """Say nothing while working."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class Modelling(Common):
    """Options of commands that build a scene model."""

    fusion: FusionMethod | None = None
    """What is fused over views: points, graphs or both. [default: pc+sg]"""
    seed: int = 0
    """Seed of every random choice; the same seed gives the same graph, byte for byte."""
    config: Path | None = None
    """TOML file with settings; `caryatid config` writes one with the defaults."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="STAGE.NAME=VALUE")] = ()
    """One setting, e.g. `--set fit.hypotheses=200`; may be given more than once."""

    def settings(self) -> Config:
        """The configuration: flag > file > default.

        Raises:
            InputError: A file, name or value is not valid.
        """
        config = read_settings(self.config, self.set)
        if self.fusion is None:
            return config
        return replace(config, fusion=replace(config.fusion, method=self.fusion))
