"""`caryatid session` and `caryatid serve`: for loops driven by the robot's own software."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from caryatid.cli import options
from caryatid.errors import InputError, needs_extra

if TYPE_CHECKING:
    from caryatid.sessions import Session

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
ImagePath = Annotated[Path | None, options.shown("FILE")]
KEPT = "all views and changes saved so far are kept"


@dataclass(frozen=True, kw_only=True)
class SessionStep(options.ComputingCommand):
    """A command on a session."""

    folder: Folder
    """Folder of the session."""

    def show_changed(self, session: Session, lead: str) -> None:
        """Print the number of views and the graph after a change."""
        from caryatid.io.graph_json import graph_to_json
        from caryatid.viz.tables import census

        document = {"views": session.views, "graph": graph_to_json(session.graph)}
        self.show(document, f"{lead}: {census(session.graph)}")

    def show(self, document: Mapping[str, Any], line: str) -> None:
        """Print one JSON document, or a line unless --quiet."""
        self.output.result(document, "" if self.general.quiet else f"{line}\n")


@dataclass(frozen=True, kw_only=True)
class New(SessionStep, options.PlanningCommand):
    """Create a session in a new folder.

    Usage examples:
      caryatid session new table
      caryatid session new table --segmentation auto --set "robot.camera_height=[1.2, 1.8]"
      caryatid session new table --robot arm:arm.npz
    """

    folder: Folder
    """Folder of the session; must be new or empty."""

    def __call__(self) -> None:
        from caryatid.io.images import read_mask
        from caryatid.robots import located
        from caryatid.sessions import Session

        config = self.settings.read()
        most = config.recording.max_pixels
        session = Session.begin(
            self.folder,
            config,
            segmentation=self.segmentation,
            seed=self.settings.seed,
            planner=self.chosen_planner,
            robot=located(self.robot),
            ignore=None if self.ignore is None else read_mask(self.ignore, max_pixels=most),
        )
        with session:
            self.show({"session": self.folder, "views": 0}, f"session: {self.folder}")


@dataclass(frozen=True, kw_only=True)
class Add(SessionStep):
    """Add a view; exit status 0 means that the view is safe on disk.

    camera.json: {"K": 3×3 [px], "T_world_camera": 4×4 [m], "depth_scale": mm per unit of depth (default 1)}
    The first view may omit T_world_camera: its table then defines the world frame (z = 0), --json prints the
    camera pose, and `next` requires --candidates.

    Usage examples:
      caryatid session add table --depth depth.png --camera camera.json
      caryatid session add table --depth depth.npy --rgb rgb.png --labels labels.png --camera camera.json
    """

    depth: Annotated[Path, tyro.conf.arg(metavar="D.png")]
    """Depth image: 16-bit PNG, or .npy in metres; 0 or NaN = no reading."""
    camera: Annotated[Path, tyro.conf.arg(metavar="C.json")]
    """Camera matrix, camera pose, and scale of the depth image."""
    rgb: ImagePath = None
    """Colour image: PNG, JPEG or .npy."""
    labels: ImagePath = None
    """Object number of each pixel: grey PNG or .npy; 0 = no object. An object has one number in all views."""
    number: Annotated[int | None, options.shown("N")] = None
    """Number of the view, from 0; makes a repeated command safe: an existing view is not added again."""

    def __call__(self) -> None:
        from caryatid.cli.output import kept
        from caryatid.sessions import Capture, Session
        from caryatid.viz.tables import census

        with kept(KEPT), Session.open(self.folder) as session:
            limits = session.beginning.settings.session
            images = {"depth": self.depth, "rgb": self.rgb, "labels": self.labels}
            capture = Capture.from_files(images, self.camera, limits)
            added = session.add(capture, self.number)
        for line in (*added.warnings, *map(str, added.changes)):
            self.output.say(line)
        news = "" if added.changed else ", graph unchanged"
        self.show(
            added.to_json(), f"view {added.number + 1} (number {added.number}): {census(added.graph)}{news}"
        )


@dataclass(frozen=True, kw_only=True)
class Next(SessionStep):
    """Print the next best view as JSON: camera pose, platform pose, gaze, expected gain and reason.

    candidates.json: {"T_world_camera": [4×4 …] reachable poses, "path_length": [m …], "refused": [4×4 …]
    poses to which the robot cannot go after all}; all are optional

    Usage examples:
      caryatid session next table
      caryatid session next table --candidates candidates.json
    """

    candidates: Annotated[Path | None, options.shown("C.json")] = None
    """Candidate poses to choose from, instead of those that the session's robot reaches; or poses to omit."""

    def __call__(self) -> None:
        from caryatid.io.json_files import parse_json, read_json
        from caryatid.sessions import Session
        from caryatid.sessions.next_view import CandidateViews

        with Session.open(self.folder, read_only=True) as session:
            if self.candidates is None:
                view = session.next()
            else:
                document = read_json(self.candidates)
                if document.keys().isdisjoint(("T_world_camera", "refused")):
                    remedy = "give camera poses to choose from, or those that the robot refuses as 'refused'"
                    raise InputError(self.candidates, "'T_world_camera' is missing", remedy)
                given = parse_json(CandidateViews, document, self.candidates)
                view = session.next(**given.arguments)
        self.output.result(view.to_json())


@dataclass(frozen=True, kw_only=True)
class Graph(SessionStep):
    """Print the current support graph in the format of graph.json.

    Usage examples:
      caryatid session graph table > graph.json
    """

    def __call__(self) -> None:
        from caryatid.io.graph_json import graph_to_json
        from caryatid.sessions import Session

        with Session.open(self.folder, read_only=True) as session:
            self.output.result(graph_to_json(session.graph))


@dataclass(frozen=True, kw_only=True)
class Take(SessionStep):
    """Report that the robot removed or moved an object; exit status 0 means that this is safe on disk.

    moved.json: {"T": 4×4 [m], the object's motion as a rigid transform in the world frame}

    Usage examples:
      caryatid session take table o3
      caryatid session take table o3 --moved moved.json
    """

    object: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ID")]
    """ID of the object."""
    moved: Annotated[Path | None, options.shown("T.json")] = None
    """The object's motion. If omitted, the object was removed."""
    number: Annotated[int | None, options.shown("N")] = None
    """Number of the report, from 0; makes a repeated command safe: the newest report is not repeated."""

    def __call__(self) -> None:
        from caryatid.cli.output import kept
        from caryatid.io.json_files import parse_json, read_json
        from caryatid.sessions import Session
        from caryatid.sessions.session import Moved

        T = None if self.moved is None else parse_json(Moved, read_json(self.moved), self.moved).T
        with kept(KEPT), Session.open(self.folder) as session:
            session.take(self.object, T, self.number)
            self.show_changed(session, f"{self.object} {'removed' if T is None else 'moved'}")


@dataclass(frozen=True, kw_only=True)
class Undo(SessionStep):
    """Undo the last view, or the last report of a removed or moved object.

    Usage examples:
      caryatid session undo table
    """

    def __call__(self) -> None:
        from caryatid.cli.output import kept
        from caryatid.sessions import Session
        from caryatid.viz.tables import count_of

        with kept(KEPT), Session.open(self.folder) as session:
            self.show_changed(session, f"{count_of(session.undo(), 'view')} left")


@dataclass(frozen=True)
class SessionCommand:
    """Keep a scene model in a folder, and add views from the robot's own software.

    Saved data survives a crash. Only one command writes at a time.
    """

    step: New | Add | Next | Graph | Take | Undo

    @property
    def general(self) -> options.General:
        """Output options of the step."""
        return self.step.general

    def __call__(self) -> None:
        self.step()


@dataclass(frozen=True, kw_only=True)
class Serve(SessionStep):
    """Serve sessions over HTTP, for robot software in any language; /openapi.json describes the API.

    On 127.0.0.1, only programs on this machine can connect, without a token. Any other --host requires
    requests with `Authorization: Bearer TOKEN`. Traffic is not encrypted: use a network you trust.

    Usage examples:
      caryatid serve sessions
      CARYATID_TOKEN=$(openssl rand -hex 16) caryatid serve sessions --host 0.0.0.0
    """

    settings: options.Settings = options.Settings()
    folder: Folder
    """Folder of the sessions; created if missing."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on."""
    port: options.Port = 8765
    """Port to listen on; 0 = any free port."""
    token: Annotated[str | None, options.shown("TOKEN")] = None
    """Token that requests must send; prefer CARYATID_TOKEN, which process lists do not show."""
    open_sessions: options.Count = 4
    """Number of sessions kept in memory; others are loaded on request in a tenth of a second."""
    waiting: options.Count = 16
    """Maximum number of waiting requests; further requests get status 503."""
    max_request: options.Count = 16
    """Maximum size of a request [MB]."""

    def __call__(self) -> None:
        config = self.settings.read()
        with needs_extra("serve", "serve"):
            from caryatid.service import SessionPool, check_token, make_app, run_service
        from caryatid.io.staging import write_errors

        def listening(address: str) -> None:
            text = f"serving {self.folder} at {address} (API: {address}/openapi.json); press Ctrl-C to quit"
            self.show({"address": address, "folder": self.folder}, text)

        token = self.token or os.environ.get("CARYATID_TOKEN") or None
        check_token(self.host, token)
        with write_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        pool = SessionPool(self.folder, config, self.open_sessions, self.waiting)
        app = make_app(pool, token=token, max_request=self.max_request * 1_000_000, host=self.host)
        run_service(app, self.host, self.port, listening)
