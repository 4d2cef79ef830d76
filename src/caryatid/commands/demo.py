"""`caryatid demo`: the built-in cluttered table, explored in simulation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from caryatid.commands.explore import Explore, run_exploration
from caryatid.commands.options import Modelling

SCENE = "clutter"
VIEWS = 5


@dataclass(frozen=True, kw_only=True)
class Demo(Modelling):
    """Explore a built-in cluttered table in simulation and say, view by view, what was found."""

    out: Path = Path("demo-run")
    """Run folder to write; a run already there is replaced."""
    scene: str = SCENE
    """Which built-in scene."""
    views: int = VIEWS
    """Views at the most, the first one too."""

    def __call__(self) -> int:
        """Run the command."""
        config = self.settings()
        config = replace(config, active=replace(config.active, max_views=self.views))
        options = Explore(
            source=self.scene,
            out=self.out,
            noise="carmine",
            segmentation="labels",
            seed=self.seed,
            json=self.json,
            quiet=self.quiet,
            debug=self.debug,
        )
        return run_exploration(options, config)
