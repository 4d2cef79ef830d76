"""`caryatid config`: all settings with their defaults, to be edited and given back with --config."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass

from caryatid.commands.options import ModellingCommand
from caryatid.formats.json_files import json_text
from caryatid.settings import write_settings


@dataclass(frozen=True, kw_only=True)
class ShowConfig(ModellingCommand):
    """Write all settings as TOML, to be edited and given back with --config.

    To try:
      caryatid config > settings.toml
    """

    def __call__(self) -> int:
        """Run the command."""
        config = self.modelling.settings()
        sys.stdout.write(json_text(asdict(config)) if self.general.json else write_settings(config))
        return 0
