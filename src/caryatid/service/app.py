"""The service over HTTP: sessions, their views, graph and next view."""

from __future__ import annotations

import base64
import binascii
import secrets
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import Depends, FastAPI, HTTPException, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat
from starlette.middleware.trustedhost import TrustedHostMiddleware

from caryatid.config import Config
from caryatid.config.settings import changed_settings
from caryatid.errors import CaryatidError, InputError, PlanningError
from caryatid.io.graph_json import graph_to_json
from caryatid.io.json_files import json_text
from caryatid.service.pool import FullError, MissingError, SessionPool
from caryatid.sessions import Capture, Session
from caryatid.sessions.session import SessionBusyError, TakenError, WrongNumberError

LOCAL = ["127.0.0.1", "localhost", "[::1]"]
"""Host names of this machine; pages from elsewhere that a browser here shows are refused."""

STATUS: dict[type[CaryatidError], int] = {
    MissingError: 404,
    SessionBusyError: 409,
    TakenError: 409,
    WrongNumberError: 409,
    PlanningError: 409,
    FullError: 503,
}
"""Statuses of errors; of all others 422: what was given cannot be used."""

Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
Matrix3 = Annotated[list[Row3], Field(min_length=3, max_length=3)]
Matrix4 = Annotated[list[Row4], Field(min_length=4, max_length=4)]
Base64 = Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]

MAX_CANDIDATES = 100_000
"""Maximum number of candidates [1]; more than the view sphere has."""


class _Document(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Problem(_Document):
    """What went wrong, in one sentence."""

    detail: str = Field(description="What, where, and what can be done about it")


class NewSession(_Document):
    """A session to begin."""

    name: Name = Field(description="What it is to be called")
    segmentation: Literal["labels", "auto"] | None = Field(
        None, description="Where parts come from; null = labels where the first view has them"
    )
    seed: int = Field(0, ge=0, le=2**63 - 1, description="Seed of every random choice")
    planner: str = Field("support", description="Who chooses the next view")
    settings: dict[str, dict[str, Any]] = Field(
        default_factory=dict,
        description="As `caryatid config --json` lists them: stage → name → value",
    )


class SessionAnswer(_Document):
    """A session."""

    name: str = Field(description="What it is called")
    views: int = Field(description="How many it has")
    segmentation: Literal["labels", "auto"] | None = Field(description="Where parts come from")
    seed: int = Field(description="Seed of every random choice")
    planner: str = Field(description="Who chooses the next view")


class SessionList(_Document):
    """All sessions."""

    sessions: list[str] = Field(description="Their names")


class Camera(_Document):
    """The camera of a view."""

    K: Matrix3 = Field(description="Pinhole matrix [px]")
    T_world_camera: Matrix4 = Field(description="Pose [m], OpenCV camera frame, world z up")
    depth_scale: FiniteFloat = Field(1.0, gt=0.0, description="Millimetres of one unit of a depth PNG")


class NewView(_Document):
    """A view; its images are files in base64."""

    camera: Camera = Field(description="Where it was taken, and with what")
    depth: Base64 = Field(description="16-bit PNG, or .npy (H, W) of floats in metres; 0 = no reading")
    rgb: Base64 | None = Field(None, description="PNG, JPEG, or .npy (H, W, 3) of uint8")
    labels: Base64 | None = Field(
        None, description="Grey PNG, or .npy (H, W) of whole numbers: the object of each pixel, 0 = nothing"
    )
    number: int | None = Field(
        None,
        ge=0,
        description="Which view it is to be, 0 the first; asked again, it is not added again",
    )

    def capture(self) -> Capture:
        """The view, not decoded yet.

        Raises:
            InputError: An image is no base64, or the pose is none.
        """
        images = {
            key: _decoded(key, text)
            for key, text in (("depth", self.depth), ("rgb", self.rgb), ("labels", self.labels))
            if text is not None
        }
        name = "view" if self.number is None else f"view {self.number}"
        K, T = np.array(self.camera.K), np.array(self.camera.T_world_camera)
        return Capture.checked(images, K, T, self.camera.depth_scale, "camera", name)


class ViewAnswer(_Document):
    """What came of a view."""

    view: int = Field(description="Which it is, 0 the first")
    changed: bool = Field(description="Whether it changed the graph")
    graph: dict[str, Any] = Field(description="graph.json")


class UndoAnswer(_Document):
    """What is left."""

    views: int = Field(description="How many are left")
    graph: dict[str, Any] = Field(description="graph.json")


class Candidates(_Document):
    """Views a robot reaches."""

    T_world_camera: list[Matrix4] = Field(
        max_length=MAX_CANDIDATES, description="Poses [m], OpenCV camera frame, world z up"
    )
    path_length: list[Annotated[FiniteFloat, Field(ge=0.0)]] | None = Field(
        None, max_length=MAX_CANDIDATES, description="Way to each [m]; null = straight lines"
    )


class Gaze(_Document):
    """Where the head looks, against the platform [rad]."""

    yaw: float = Field(description="To the left")
    pitch: float = Field(description="Upwards")


class NextAnswer(_Document):
    """Where to look next."""

    view: int = Field(description="Which it would be, 0 the first")
    T_world_camera: list[list[float]] = Field(description="Pose [m], OpenCV camera frame, world z up")
    candidate: int = Field(description="Which of the candidates it is")
    platform: list[float] | None = Field(description="x, y, yaw [m, rad]; null with candidates")
    camera_height: float | None = Field(description="Over the floor [m]; null with candidates")
    gaze: Gaze | None = Field(description="How the head turns; null with candidates")
    expected_gain: float = Field(description="Saliency s of eq. 3")
    cost: float = Field(description="Cost h of the way, eq. 3")
    score: float = Field(description="c = s − h, eq. 3")
    why: str = Field(description="One sentence for a person to read")
    stop: str | None = Field(description="Why looking on may not pay, or null")


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


def make_app(pool: SessionPool, *, token: str | None, max_request: int, host: str = "127.0.0.1") -> FastAPI:
    """Make the application.

    Args:
        pool: The sessions; started and stopped with the application.
        token: What requests have to bear; None = only this machine's own may come, and need none.
        max_request: Size of a request at the most [bytes].
        host: Address it listens at.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        pool.start()
        yield
        pool.stop()

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
    _add_pages(app, pool)
    return app


def _add_pages(app: FastAPI, pool: SessionPool) -> None:
    @app.get("/sessions", response_model=SessionList)
    async def list_sessions() -> Response:
        """List the sessions."""
        return _json({"sessions": await pool.do(pool.names)})

    @app.post("/sessions", status_code=201, response_model=SessionAnswer)
    async def begin_session(given: NewSession) -> Response:
        """Begin a session."""

        def work() -> dict[str, Any]:
            config: Config = changed_settings(pool.config, given.settings, "settings")
            session = pool.begin(given.name, config, given.segmentation, given.seed, given.planner)
            return _described(given.name, session)

        return _json(await pool.do(work), 201)

    @app.get("/sessions/{name}", response_model=SessionAnswer)
    async def describe_session(name: SessionName) -> Response:
        """Say what a session is, and how many views it has."""
        return _json(await pool.do(lambda: _described(name, pool.session(name))))

    @app.post("/sessions/{name}/views", status_code=201, response_model=ViewAnswer)
    async def add_view(name: SessionName, given: NewView) -> Response:
        """Take in a view; when this answers, it is on the disk and stays."""

        def work() -> dict[str, Any]:
            added = pool.session(name).add(given.capture(), given.number)
            graph = graph_to_json(added.graph)
            return {"view": added.number, "changed": added.changed, "graph": graph}

        return _json(await pool.do(work), 201)

    @app.delete("/sessions/{name}/views/last", response_model=UndoAnswer)
    async def undo_view(name: SessionName) -> Response:
        """Take the last view back."""

        def work() -> dict[str, Any]:
            session = pool.session(name)
            if session.views == 0:
                raise WrongNumberError(name, "has no views to take back", "add one first")
            return {"views": session.undo(), "graph": graph_to_json(session.graph)}

        return _json(await pool.do(work))

    @app.get("/sessions/{name}/graph")
    async def tell_graph(name: SessionName) -> dict[str, Any]:
        """Say what is known: graph.json."""
        return await pool.do(lambda: graph_to_json(pool.session(name).graph))

    @app.get("/sessions/{name}/next", response_model=NextAnswer)
    async def tell_next(name: SessionName) -> Response:
        """Say where to look next, for the robot the session was begun with."""
        return _json(await pool.do(lambda: pool.session(name).next().to_json()))

    @app.post("/sessions/{name}/next", response_model=NextAnswer)
    async def choose_next(name: SessionName, given: Candidates) -> Response:
        """Choose where to look next among the views that your robot reaches."""

        def work() -> dict[str, Any]:
            poses = np.array(given.T_world_camera).reshape(-1, 4, 4)
            return pool.session(name).next(poses, given.path_length).to_json()

        return _json(await pool.do(work))


def _bearer(token: str) -> Callable[..., Any]:
    async def check(given: Annotated[HTTPAuthorizationCredentials | None, Depends(BEARER)]) -> None:
        sent = "" if given is None else given.credentials
        if not secrets.compare_digest(sent.encode(), token.encode()):
            raise HTTPException(401, "the token is missing or wrong", {"WWW-Authenticate": "Bearer"})

    return check


def _described(name: str, session: Session) -> dict[str, Any]:
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


def _decoded(key: str, text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise InputError(key, "is no base64", "encode the bytes of the file") from None
