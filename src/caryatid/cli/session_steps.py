"""What `caryatid session …` does."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from caryatid.cli.options import General
from caryatid.cli.progress import summary
from caryatid.cli.session import Add, Graph, New, Next, Undo
from caryatid.config import Config
from caryatid.io.graph_json import graph_text, graph_to_json
from caryatid.io.json_files import json_text, read_json
from caryatid.robots import located
from caryatid.runtime.interrupts import Interrupted, interruptible
from caryatid.sessions import Capture, Session
from caryatid.sessions.next_view import candidates_from


@contextmanager
def _whole_views() -> Iterator[None]:
    """Let Ctrl-C leave a session as it was, or as the command has made it."""
    try:
        with interruptible():
            yield
    except KeyboardInterrupt:
        raise Interrupted("the session keeps every view that is in it") from None


@interruptible()
def begin_session(options: New, config: Config) -> int:
    """Begin a session."""
    seed = options.modelling.seed
    with Session.begin(
        options.folder, config, segmentation=options.segmentation, seed=seed, planner=options.planner,
        robot=located(options.robot),
    ):  # fmt: skip
        _tell(options.general, {"session": str(options.folder), "views": 0}, f"session: {options.folder}")
    return 0


@_whole_views()
def add_view(options: Add) -> int:
    """Take in a view."""
    with Session.open(options.folder) as session:
        capture = Capture.from_files(
            options.depth, options.camera, options.rgb, options.labels, session.beginning.config.session
        )
        added = session.add(capture, options.number)
    news = "" if added.changed else ", nothing new"
    document = {"view": added.number, "changed": added.changed, "graph": graph_to_json(added.graph)}
    _tell(options.general, document, f"view {added.number + 1}: {summary(added.graph)}{news}")
    return 0


@interruptible()
def tell_next(options: Next) -> int:
    """Say where to look next."""
    with Session.open(options.folder, read_only=True) as session:
        poses, ways = None, None
        if options.candidates is not None:
            poses, ways = candidates_from(read_json(options.candidates), str(options.candidates))
        sys.stdout.write(json_text(session.next(poses, ways).to_json()))
    return 0


@interruptible()
def tell_graph(options: Graph) -> int:
    """Write the graph."""
    with Session.open(options.folder, read_only=True) as session:
        sys.stdout.write(graph_text(session.graph))
    return 0


@_whole_views()
def undo_view(options: Undo) -> int:
    """Take the last view back."""
    with Session.open(options.folder) as session:
        left = session.undo()
        document = {"views": left, "graph": graph_to_json(session.graph)}
        count = "1 view" if left == 1 else f"{left} views"
        _tell(options.general, document, f"{count} left: {summary(session.graph)}")
    return 0


def _tell(general: General, document: dict[str, Any], line: str) -> None:
    if general.json:
        sys.stdout.write(json_text(document))
    elif not general.quiet:
        sys.stdout.write(f"{line}\n")
