"""`caryatid explore`: the active vision loop on a scene or a recording, written to a run folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from caryatid.cli.names import PlannerName, RobotName
from caryatid.cli.options import (
    SAID,
    ModellingCommand,
    OutPath,
    Profile,
    Views,
    defaults_to,
    one_of,
    with_views,
)
from caryatid.config import NoiseModel, SegmentationMethod


@dataclass(frozen=True, kw_only=True)
class Explore(ModellingCommand):
    """Look around a scene until it is known what holds up what.

    SOURCE is one of
      an MJCF scene: an .xml file, or the folder of a scene.xml; robot and camera are simulated
      the name of a built-in scene: tower, clutter, pile-8-0, dense-12-0, …
      a recording: a folder in the BOP format; the camera can only be where a recorded view is

    To try:
      caryatid explore tower --noise carmine --out run
      caryatid explore scene.xml --views 5 --out run
      caryatid explore tower --robot arm:arm.npz --out run
      caryatid explore recording/ --segmentation auto --out run
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Scene or recording."""
    out: OutPath
    """Run folder to write; a run already there is replaced."""
    views: Annotated[Views, defaults_to(10)] = None
    """Views at the most, the first one too."""
    planner: PlannerName = "support"
    """Who chooses the next view; oracle, which knows the truth, in simulation only."""
    robot: RobotName = "humanoid"
    """Who carries the simulated camera: arm:FILE.npz is an arm with a map of what it reaches, module:callable
    one of your own."""
    segmentation: Annotated[
        SegmentationMethod | None, one_of(SegmentationMethod), defaults_to("labels where the source has them")
    ] = None
    """Where parts come from: the masks that are given, or automatic."""
    noise: NoiseModel = "none"
    """Noise of the simulated camera: depth noise and registration error of a Carmine, or none."""
    no_early_stop: Annotated[bool, SAID] = False
    """Go on until the views are used up; without this the loop ends when a view changes nothing."""
    no_report: Annotated[bool, SAID] = False
    """Leave report.html out."""
    view: Annotated[bool, SAID] = False
    """Show every view in the browser as soon as it is there; the page then stays until Ctrl-C."""
    profile: Profile = False
    """Print the time of each stage when all is done; with --json into the document."""

    def __call__(self) -> int:
        """Run the command."""
        config = with_views(self.modelling.settings(), self.views)
        from caryatid.cli.exploring import run_exploration

        return run_exploration(self, config)
