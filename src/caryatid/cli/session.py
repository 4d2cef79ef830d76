"""`caryatid session`: a robot's own software drives the loop, view by view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.names import PlannerName, RobotName
from caryatid.cli.options import SAID, General, Modelling, defaults_to, one_of
from caryatid.config import SegmentationMethod

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
File = Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE"), SAID]
GENERAL = General()
MODELLING = Modelling()


@dataclass(frozen=True, kw_only=True)
class New:
    """Begin a session in a new folder.

    To try:
      caryatid session new table
      caryatid session new table --segmentation auto --set "robot.camera_height=[1.2, 1.8]"
      caryatid session new table --robot arm:arm.npz
    """

    folder: Folder
    """Folder of the session; new or empty."""
    segmentation: Annotated[
        SegmentationMethod | None,
        one_of(SegmentationMethod),
        defaults_to("labels where the first view has them"),
    ] = None
    """Where parts come from: label images that are given, or automatic."""
    planner: PlannerName = "support"
    """Who chooses the next view."""
    robot: RobotName = "humanoid"
    """Who takes it: arm:FILE.npz is an arm with a map of what it reaches, module:callable one of your own."""
    modelling: tyro.conf.OmitArgPrefixes[Modelling] = MODELLING
    general: tyro.conf.OmitArgPrefixes[General] = GENERAL

    def __call__(self) -> int:
        """Run the command."""
        config = self.modelling.settings()
        from caryatid.cli.session_steps import begin_session

        return begin_session(self, config)


@dataclass(frozen=True, kw_only=True)
class Add:
    """Take in a view; when the command ends with 0, the view is on the disk and stays.

    camera.json: {"K": 3×3 [px], "T_world_camera": 4×4 [m], "depth_scale": mm of one unit of depth, else 1}

    To try:
      caryatid session add table --depth depth.png --camera camera.json
      caryatid session add table --depth depth.npy --rgb rgb.png --labels labels.png --camera camera.json
    """

    folder: Folder
    """Folder of the session."""
    depth: Annotated[Path, tyro.conf.arg(metavar="D.png")]
    """Depth image: 16-bit PNG, or .npy in metres; 0 or NaN = no reading."""
    camera: Annotated[Path, tyro.conf.arg(metavar="C.json")]
    """Camera of the view: pinhole matrix, pose, scale of the depth image."""
    rgb: File = None
    """Colour image: PNG, JPEG or .npy."""
    labels: File = None
    """Object number of each pixel: grey PNG or .npy; 0 = nothing, an object keeps its number."""
    number: Annotated[int | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="N"), SAID] = None
    """Which view it is to be, 0 the first: one that is there already is not added again."""
    general: tyro.conf.OmitArgPrefixes[General] = GENERAL

    def __call__(self) -> int:
        """Run the command."""
        from caryatid.cli.session_steps import add_view

        return add_view(self)


@dataclass(frozen=True, kw_only=True)
class Next:
    """Say where to look next: camera pose, platform, gaze, expected gain, and why; as JSON.

    candidates.json: {"T_world_camera": [4×4 …] that the robot reaches, "path_length": [m …], may be left out}

    To try:
      caryatid session next table
      caryatid session next table --candidates candidates.json
    """

    folder: Folder
    """Folder of the session."""
    candidates: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="C.json"), SAID] = None
    """Poses to choose from, in place of those that the settings' robot reaches."""
    general: tyro.conf.OmitArgPrefixes[General] = GENERAL

    def __call__(self) -> int:
        """Run the command."""
        from caryatid.cli.session_steps import tell_next

        return tell_next(self)


@dataclass(frozen=True, kw_only=True)
class Graph:
    """Write the support graph of all views so far to stdout, as graph.json.

    To try:
      caryatid session graph table > graph.json
    """

    folder: Folder
    """Folder of the session."""
    general: tyro.conf.OmitArgPrefixes[General] = GENERAL

    def __call__(self) -> int:
        """Run the command."""
        from caryatid.cli.session_steps import tell_graph

        return tell_graph(self)


@dataclass(frozen=True, kw_only=True)
class Undo:
    """Take the last view back.

    To try:
      caryatid session undo table
    """

    folder: Folder
    """Folder of the session."""
    general: tyro.conf.OmitArgPrefixes[General] = GENERAL

    def __call__(self) -> int:
        """Run the command."""
        from caryatid.cli.session_steps import undo_view

        return undo_view(self)


@dataclass(frozen=True)
class SessionCommand:
    """A scene model that grows as a robot's own software gives views; kept in a folder.

    A view that was taken in stays, whatever happens to the process. One command writes at a time.
    """

    step: tyro.conf.OmitArgPrefixes[
        tyro.conf.OmitSubcommandPrefixes[
            Annotated[New, tyro.conf.subcommand("new")]
            | Annotated[Add, tyro.conf.subcommand("add")]
            | Annotated[Next, tyro.conf.subcommand("next")]
            | Annotated[Graph, tyro.conf.subcommand("graph")]
            | Annotated[Undo, tyro.conf.subcommand("undo")]
        ]
    ]

    @property
    def general(self) -> General:
        """What is said, and how."""
        return self.step.general

    def __call__(self) -> int:
        """Run the command."""
        return self.step()
