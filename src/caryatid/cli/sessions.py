"""`caryatid session` and `caryatid serve`: for loops driven by the robot's own software."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import closing
from typing import Any

from caryatid.cli.commands import Add, Graph, New, Next, Serve, SessionStep, Take, Undo
from caryatid.cli.output import kept
from caryatid.errors import InputError, needs_extra
from caryatid.io.graph_json import graph_to_json
from caryatid.io.images import read_mask
from caryatid.io.json_files import parse_json, read_json
from caryatid.io.staging import write_errors
from caryatid.robots import located
from caryatid.sessions import Capture, Session
from caryatid.sessions.messages import CandidateViews, Moved
from caryatid.viz.tables import census, count_of

KEPT = "all views and changes saved so far are kept"


def begin_session(command: New) -> None:
    config, mask = command.settings.read(), command.ignore
    ignored = None if mask is None else read_mask(mask, max_pixels=config.recording.max_pixels)
    session = Session.begin(
        command.folder, config, planner=command.chosen_planner, robot=located(command.robot),
        ignore=ignored, **command.looking,
    )  # fmt: skip
    with session:
        _show(command, {"session": command.folder, "views": 0}, f"session: {command.folder}")


def add_view(command: Add) -> None:
    with kept(KEPT), Session.open(command.folder) as session:
        images = {"depth": command.depth, "rgb": command.rgb, "labels": command.labels}
        capture = Capture.from_files(images, command.camera, session.beginning.settings.session)
        added = session.add(capture, command.number)
    for line in (*added.warnings, *map(str, added.changes)):
        command.output.say(line)
    news = "" if added.changed else ", graph unchanged"
    line = f"view {added.number + 1} (number {added.number}): {census(added.graph)}{news}"
    _show(command, added.to_json(), line)


def plan_view(command: Next) -> None:
    with Session.open(command.folder, read_only=True) as session:
        given = CandidateViews()
        if command.candidates is not None:
            document = read_json(command.candidates)
            if document.keys().isdisjoint(("T_world_camera", "refused")):
                remedy = "give camera poses to choose from, or those that the robot refuses as 'refused'"
                raise InputError(command.candidates, "'T_world_camera' is missing", remedy)
            given = parse_json(CandidateViews, document, command.candidates)
        view = session.next(given.T_world_camera, given.path_length, refused=given.refused)
    command.output.result(view.to_json())


def show_graph(command: Graph) -> None:
    with Session.open(command.folder, read_only=True) as session:
        command.output.result(graph_to_json(session.graph))


def report_change(command: Take) -> None:
    moved = command.moved
    T = None if moved is None else parse_json(Moved, read_json(moved), moved).T
    with kept(KEPT), Session.open(command.folder) as session:
        session.take(command.object, T, command.number)
        _show_changed(command, session, f"{command.object} {'removed' if T is None else 'moved'}")


def undo_last(command: Undo) -> None:
    with kept(KEPT), Session.open(command.folder) as session:
        _show_changed(command, session, f"{count_of(session.undo(), 'view')} left")


def serve_sessions(command: Serve) -> None:
    config, folder, host = command.settings.read(), command.folder, command.host
    with needs_extra("serve", "serve"):
        from caryatid.service import SessionPool, check_token, make_app, run_service

    def listening(address: str) -> None:
        text = f"serving {folder} at {address} (API: {address}/openapi.json); press Ctrl-C to quit"
        _show(command, {"address": address, "folder": folder}, text)

    token = command.token or os.environ.get("CARYATID_TOKEN") or None
    check_token(host, token)
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with closing(SessionPool(folder, config, command.open_sessions)) as pool:
        most = command.max_request * 1_000_000
        app = make_app(pool, token=token, max_request=most, waiting=command.waiting, host=host)
        run_service(app, host, command.port, listening)


def _show_changed(command: SessionStep, session: Session, lead: str) -> None:
    """Print the number of views and the graph after a change."""
    document = {"views": session.views, "graph": graph_to_json(session.graph)}
    _show(command, document, f"{lead}: {census(session.graph)}")


def _show(command: SessionStep, document: Mapping[str, Any], line: str) -> None:
    """Print one JSON document, or a line unless --quiet."""
    command.output.result(document, "" if command.general.quiet else f"{line}\n")
