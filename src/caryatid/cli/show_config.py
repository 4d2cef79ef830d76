"""`caryatid config`: all settings with their defaults, to be edited and given back with --config."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass

from caryatid.cli.options import ModellingCommand
from caryatid.config.settings import write_settings


@dataclass(frozen=True, kw_only=True)
class ShowConfig(ModellingCommand):
    """Write all settings as TOML, to be edited and given back with --config.

    To try:
      caryatid config > settings.toml
    """

    def __call__(self) -> int:
        """Run the command."""
        config = self.modelling.settings()
        if self.general.json:
            from caryatid.io.json_files import json_text

            sys.stdout.write(json_text(asdict(config)))
        else:
            sys.stdout.write(write_settings(config))
        return 0
