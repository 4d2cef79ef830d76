"""`caryatid view`: a run, a scene or a recording in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from caryatid.cli.names import PlannerName, RobotName
from caryatid.cli.options import SAID, ModellingCommand, Views, defaults_to, whole_number, with_views
from caryatid.config import NoiseModel, SegmentationMethod

Port = Annotated[int, whole_number(0)]


@dataclass(frozen=True, kw_only=True)
class View(ModellingCommand):
    """Look at a finished run in the browser, or work the loop there on a scene or a recording.

    SOURCE is one of
      a run folder, as explore, extract and dismantle write it; it is shown, and not changed
      an MJCF scene, the name of a built-in one, or a recording, as of explore; the page takes view after
      view when it is told to

    The page is served to this machine only, loads nothing from elsewhere, and stays until Ctrl-C.

    To try:
      caryatid view run
      caryatid view clutter --noise carmine
      caryatid view recording/ --segmentation auto --port 8080 --no-browser
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Run, scene or recording."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen at; at any other than this one others can come, and nobody asks them who they are."""
    port: Port = 8770
    """Port to listen at, or the next one that is free; 0 = any that is free."""
    no_browser: Annotated[bool, SAID] = False
    """Say where the page is, and leave it to you to open it."""
    views: Annotated[Views, defaults_to(10)] = None
    """After so many views `run` pauses."""
    planner: PlannerName = "support"
    """Who chooses the next view, until another is chosen in the page."""
    robot: RobotName = "humanoid"
    """Who carries the simulated camera, as of explore."""
    segmentation: Annotated[
        SegmentationMethod | None, tyro.conf.DisallowNone, defaults_to("labels where the source has them")
    ] = None
    """Where parts come from: the masks that are given, or automatic."""
    noise: NoiseModel = "none"
    """Noise of the simulated camera: depth noise and registration error of a Carmine, or none."""

    def __call__(self) -> int:
        """Run the command."""
        config = with_views(self.modelling.settings(), self.views)
        from caryatid.cli.viewing import run_viewer

        return run_viewer(self, config)
