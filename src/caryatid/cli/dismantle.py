"""`caryatid dismantle`: explore a scene, and take it apart in physics by what was extracted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from caryatid.cli.names import PlannerName, RobotName
from caryatid.cli.options import SAID, ModellingCommand, Views, defaults_to, with_views
from caryatid.config import NoiseModel, SegmentationMethod


@dataclass(frozen=True, kw_only=True)
class Dismantle(ModellingCommand):
    """Explore a scene, find a safe order to take it apart, and try it in physics.

    Objects are lifted straight up, one by one. A step fails when any other object moves by more than 2 cm
    or 15°.

    To try:
      caryatid dismantle bridge --noise carmine
      caryatid dismantle scene.xml --views 5 --hands 1 --out run
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """An MJCF scene, or the name of a built-in one."""
    out: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="RUN"), SAID] = None
    """Run folder to write, its report with pictures of every lift; without it nothing is written."""
    hands: Literal[1, 2] = 2
    """With 2 another hand may hold one object while the first lifts one."""
    views: Annotated[Views, defaults_to(10)] = None
    """Views at the most, the first one too."""
    planner: PlannerName = "support"
    """Who chooses the next view."""
    robot: RobotName = "humanoid"
    """Who carries the simulated camera, as of explore."""
    segmentation: SegmentationMethod = "labels"
    """Where parts come from: the simulator's masks, or automatic."""
    noise: NoiseModel = "none"
    """Noise of the simulated camera: depth noise and registration error of a Carmine, or none."""
    no_early_stop: Annotated[bool, SAID] = False
    """Go on until the views are used up; without this the loop ends when a view changes nothing."""

    def __call__(self) -> int:
        """Run the command."""
        config = with_views(self.modelling.settings(), self.views)
        from caryatid.cli.dismantling import run_dismantling

        return run_dismantling(self, config)
