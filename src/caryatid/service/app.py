"""The service's pages: sessions, their views, graph and next view."""

from __future__ import annotations

import secrets
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Annotated, Any

from fastapi import Depends, FastAPI, HTTPException, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.middleware.trustedhost import TrustedHostMiddleware

from caryatid.config import Config
from caryatid.config.settings import changed_settings
from caryatid.errors import CaryatidError, PlanningError
from caryatid.io.graph_json import graph_to_json
from caryatid.io.json_files import json_text
from caryatid.service.desk import Desk, FullError, MissingError
from caryatid.service.documents import (
    Candidates,
    Name,
    NewSession,
    NewView,
    NextAnswer,
    Problem,
    SessionAnswer,
    SessionList,
    UndoAnswer,
    ViewAnswer,
)
from caryatid.sessions import Session
from caryatid.sessions.folder import TakenError
from caryatid.sessions.lock import SessionBusyError
from caryatid.sessions.next_view import candidates_from
from caryatid.sessions.session import WrongNumberError

LOCAL = ["127.0.0.1", "localhost", "[::1]"]
"""Names this machine has for itself; a page of another one that a browser here shows has no business."""

STATUS: dict[type[CaryatidError], int] = {
    MissingError: 404,
    SessionBusyError: 409,
    TakenError: 409,
    WrongNumberError: 409,
    PlanningError: 409,
    FullError: 503,
}
"""Statuses of errors; of all others 422: what was given cannot be used."""

PROBLEMS: dict[int | str, dict[str, Any]] = {
    code: {"model": Problem, "description": text}
    for code, text in {
        400: "No JSON, or another host's",
        401: "The token is missing or wrong",
        404: "There is no such session",
        409: "Not now: another writer has it, or there is not what it takes",
        422: "What was given cannot be used; nothing has changed",
        503: "Too much waits; try again",
    }.items()
}
"""Answers to requests that fail, by their status."""
PROBLEMS[413] = {"description": "Larger than a request may be", "content": {"text/plain": {}}}


BEARER = HTTPBearer(auto_error=False, description="The token the service was started with")
"""Where requests carry their token."""

SessionName = Annotated[Name, Path(description="Name of the session")]


def make_app(desk: Desk, *, token: str | None, max_request: int, host: str = "127.0.0.1") -> FastAPI:
    """Make the application.

    Args:
        desk: The sessions; started and stopped with the application.
        token: What requests have to bear; None = only this machine's own may come, and need none.
        max_request: Size of a request at the most [bytes].
        host: Address it listens at.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        desk.start()
        yield
        desk.stop()

    app = FastAPI(
        title="caryatid",
        summary="Sessions of active vision: views in, support graph and next view out",
        version=version("caryatid"),
        lifespan=lifespan,
        max_body_size=max_request,
        responses=PROBLEMS,
        dependencies=[] if token is None else [Depends(_bearer(token))],
    )
    if token is None:
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=[*LOCAL, host])
    app.add_exception_handler(CaryatidError, _refuse)
    app.add_exception_handler(RequestValidationError, _refuse_request)
    _add_pages(app, desk)
    return app


def _add_pages(app: FastAPI, desk: Desk) -> None:
    @app.get("/sessions", response_model=SessionList)
    async def list_sessions() -> Response:
        """List the sessions."""
        return _json({"sessions": await desk.do(desk.names)})

    @app.post("/sessions", status_code=201, response_model=SessionAnswer)
    async def begin_session(given: NewSession) -> Response:
        """Begin a session."""

        def work() -> dict[str, Any]:
            config: Config = changed_settings(desk.config, given.settings, "settings")
            session = desk.begin(given.name, config, given.segmentation, given.seed, given.planner)
            return _told(given.name, session)

        return _json(await desk.do(work), 201)

    @app.get("/sessions/{name}", response_model=SessionAnswer)
    async def describe_session(name: SessionName) -> Response:
        """Say what a session is, and how many views it has."""
        return _json(await desk.do(lambda: _told(name, desk.session(name))))

    @app.post("/sessions/{name}/views", status_code=201, response_model=ViewAnswer)
    async def add_view(name: SessionName, given: NewView) -> Response:
        """Take in a view; when this answers, it is on the disk and stays."""

        def work() -> dict[str, Any]:
            added = desk.session(name).add(given.capture(), given.number)
            graph = graph_to_json(added.graph)
            return {"view": added.number, "changed": added.changed, "graph": graph}

        return _json(await desk.do(work), 201)

    @app.delete("/sessions/{name}/views/last", response_model=UndoAnswer)
    async def undo_view(name: SessionName) -> Response:
        """Take the last view back."""

        def work() -> dict[str, Any]:
            session = desk.session(name)
            if session.views == 0:
                raise WrongNumberError(name, "has no views to take back", "add one first")
            return {"views": session.undo(), "graph": graph_to_json(session.graph)}

        return _json(await desk.do(work))

    @app.get("/sessions/{name}/graph")
    async def tell_graph(name: SessionName) -> dict[str, Any]:
        """Say what is known: graph.json."""
        return await desk.do(lambda: graph_to_json(desk.session(name).graph))

    @app.get("/sessions/{name}/next", response_model=NextAnswer)
    async def tell_next(name: SessionName) -> Response:
        """Say where to look next, for the robot the session was begun with."""
        return _json(await desk.do(lambda: desk.session(name).next().to_json()))

    @app.post("/sessions/{name}/next", response_model=NextAnswer)
    async def choose_next(name: SessionName, given: Candidates) -> Response:
        """Choose where to look next among the views that your robot reaches."""

        def work() -> dict[str, Any]:
            poses, ways = candidates_from(given.model_dump(), "candidates")
            return desk.session(name).next(poses, ways).to_json()

        return _json(await desk.do(work))


def _bearer(token: str) -> Callable[..., Any]:
    async def check(given: Annotated[HTTPAuthorizationCredentials | None, Depends(BEARER)]) -> None:
        sent = "" if given is None else given.credentials
        if not secrets.compare_digest(sent.encode(), token.encode()):
            raise HTTPException(401, "the token is missing or wrong", {"WWW-Authenticate": "Bearer"})

    return check


def _told(name: str, session: Session) -> dict[str, Any]:
    b = session.beginning
    return {
        "name": name,
        "views": session.views,
        "segmentation": b.segmentation,
        "seed": b.seed,
        "planner": b.planner,
    }


def _json(document: dict[str, Any], status: int = 200) -> Response:
    return Response(json_text(document), status, media_type="application/json")


async def _refuse(request: Request, error: Exception) -> Response:
    status = next((code for kind, code in STATUS.items() if isinstance(error, kind)), 422)
    return _problem(status, str(error), {"Retry-After": "1"} if status == 503 else None)


async def _refuse_request(request: Request, error: Exception) -> Response:
    """Say what does not fit in one sentence, and not what was sent."""
    if not isinstance(error, RequestValidationError):
        raise error
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return _problem(422, f"{where}: {first['msg']}")


def _problem(status: int, text: str, headers: dict[str, str] | None = None) -> Response:
    # Names that were sent may hold halves of characters, which no answer can.
    detail = " ".join(text.encode("utf-8", "replace").decode().splitlines())
    return JSONResponse({"detail": detail}, status, headers)
