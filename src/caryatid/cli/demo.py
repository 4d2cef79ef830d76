"""`caryatid demo`: the built-in cluttered table, explored in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.explore import Explore
from caryatid.cli.options import (
    DEFAULTS,
    SAID,
    ModellingCommand,
    OutPath,
    Profile,
    Views,
    defaults_to,
    with_views,
)

SCENE = "clutter"
VIEWS = 5
"""What is explored, and how many views there are at the most."""


@dataclass(frozen=True, kw_only=True)
class Demo(ModellingCommand):
    """Explore a built-in cluttered table in simulation and say, view by view, what was found.

    To try:
      caryatid demo --out run
    """

    out: OutPath = Path("demo-run")
    """Run folder to write; a run already there is replaced."""
    scene: Annotated[str, tyro.conf.arg(metavar="NAME")] = SCENE
    """A built-in scene, say tower, bridge or dense-12-0."""
    views: Annotated[Views, defaults_to(VIEWS)] = None
    """Views at the most, the first one too."""
    view: Annotated[bool, SAID] = False
    """Show every view in the browser as soon as it is there; the page then stays until Ctrl-C."""
    profile: Profile = False
    """Print the time of each stage when all is done; with --json into the document."""

    def __call__(self) -> int:
        """Run the command."""
        config = with_views(self.modelling.settings(with_views(DEFAULTS, VIEWS)), self.views)
        options = Explore(
            source=self.scene,
            out=self.out,
            noise="carmine",
            view=self.view,
            profile=self.profile,
            modelling=self.modelling,
            general=self.general,
        )
        from caryatid.cli.exploring import run_exploration

        return run_exploration(options, config)
