"""`caryatid config`: all settings with their defaults, to be edited and given back with --config."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from caryatid.commands.options import Modelling
from caryatid.settings import write_settings


@dataclass(frozen=True, kw_only=True)
class ShowConfig(Modelling):
    """Write all settings as TOML, to be edited and given back with --config."""

    def __call__(self) -> int:
        """Run the command."""
        sys.stdout.write(write_settings(self.settings()))
        return 0
