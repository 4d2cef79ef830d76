"""The service over HTTP: sessions, their views, graph and next view."""

from __future__ import annotations

import base64
import secrets
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Annotated, Any

import numpy as np
from fastapi import Depends, FastAPI, HTTPException, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat
from starlette.middleware.trustedhost import TrustedHostMiddleware

from caryatid.config import SegmentationMethod
from caryatid.config.settings import changed_settings
from caryatid.errors import CaryatidError, InputError, PlanningError
from caryatid.io.graph_json import graph_to_json
from caryatid.service.pool import FullError, MissingError, SessionPool
from caryatid.sessions import Capture, Session
from caryatid.sessions.captures import CameraRecord
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

MAX_CANDIDATES = 100_000
"""Maximum number of candidates [1]; more than the view sphere has."""

Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
Matrix3 = Annotated[list[Row3], Field(min_length=3, max_length=3)]
Matrix4 = Annotated[list[Row4], Field(min_length=4, max_length=4)]
Base64 = Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]
Length = Annotated[FiniteFloat, Field(ge=0.0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
SessionName = Annotated[Name, Path(description="Name of the session")]


class Document(BaseModel):
    """A JSON object of these keys and no others."""

    model_config = ConfigDict(extra="forbid")


class Problem(Document):
    """What went wrong, in one sentence."""

    detail: str = Field(description="What, where, and what can be done about it")


class SessionOptions(Document):
    """What a session is begun with."""

    name: Name = Field(description="Its name")
    segmentation: SegmentationMethod | None = Field(
        None, description="Where segments come from; null = labels where the first view has them"
    )
    seed: int = Field(0, ge=0, le=2**63 - 1, description="Seed of every random choice")
    planner: str = Field("support", description="Planner of the next view")


class NewSession(SessionOptions):
    """A session to begin."""

    settings: dict[str, dict[str, Any]] = Field(
        {}, description="As `caryatid config --json` lists them: stage → name → value"
    )


class SessionAnswer(SessionOptions):
    """A session."""

    views: int = Field(description="Number of its views")


class SessionList(Document):
    """All sessions."""

    sessions: list[str] = Field(description="Their names")


class Camera(Document):
    """The camera of a view."""

    K: Matrix3 = Field(description="Pinhole matrix [px]")
    T_world_camera: Matrix4 = Field(description="Pose [m], OpenCV camera frame, world z up")
    depth_scale: FiniteFloat = Field(1.0, gt=0.0, description="Millimetres of one unit of a depth PNG")


class NewView(Document):
    """A view; its images are files in base64."""

    camera: Camera = Field(description="Where it was taken, and with what")
    depth: Base64 = Field(description="16-bit PNG, or .npy (H, W) of floats in metres; 0 = no reading")
    rgb: Base64 | None = Field(None, description="PNG, JPEG, or .npy (H, W, 3) of uint8")
    labels: Base64 | None = Field(
        None, description="Grey PNG, or .npy (H, W) of whole numbers: the object of each pixel, 0 = nothing"
    )
    number: int | None = Field(
        None, ge=0, description="Number it is to have, 0 the first; a view that is there is not added again"
    )

    def capture(self) -> Capture:
        """The view, its images not decoded yet.

        Raises:
            InputError: An image is no base64.
        """
        given = {"depth": self.depth, "rgb": self.rgb, "labels": self.labels}
        images = {key: _decoded(key, text) for key, text in given.items() if text is not None}
        K, T_world_camera = np.array(self.camera.K), np.array(self.camera.T_world_camera)
        name = "view" if self.number is None else f"view {self.number}"
        return Capture(images, CameraRecord(K, T_world_camera, self.camera.depth_scale, name))


class GraphAnswer(Document):
    """What is known."""

    graph: dict[str, Any] = Field(description="graph.json")


class ViewAnswer(GraphAnswer):
    """What came of a view."""

    view: int = Field(description="Its number, 0 the first")
    changed: bool = Field(description="Whether it changed the graph")


class UndoAnswer(GraphAnswer):
    """What is left."""

    views: int = Field(description="Number of views left")


class Candidates(Document):
    """Views a robot reaches."""

    T_world_camera: list[Matrix4] = Field(
        max_length=MAX_CANDIDATES, description="Poses [m], OpenCV camera frame, world z up"
    )
    path_length: list[Length] | None = Field(
        None, max_length=MAX_CANDIDATES, description="Path length to each [m]; null = straight lines"
    )


class Gaze(Document):
    """Where the head looks, against the platform [rad]."""

    yaw: float = Field(description="To the left")
    pitch: float = Field(description="Upwards")


class NextAnswer(Document):
    """Where to look next."""

    view: int = Field(description="Number it would have, 0 the first")
    T_world_camera: list[list[float]] = Field(description="Pose [m], OpenCV camera frame, world z up")
    candidate: int = Field(description="Which of the candidates it is")
    platform: list[float] | None = Field(description="x, y, yaw [m, rad]; null with candidates")
    camera_height: float | None = Field(description="Over the floor [m]; null with candidates")
    gaze: Gaze | None = Field(description="How the head turns; null with candidates")
    expected_gain: float = Field(description="Saliency s of eq. 3")
    cost: float = Field(description="Cost h of the path, eq. 3")
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
        with pool:
            yield

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
    app.add_exception_handler(RequestValidationError, _refuse)
    _add_pages(app, pool)
    return app


def _add_pages(app: FastAPI, pool: SessionPool) -> None:
    @app.get("/sessions", response_model=SessionList)
    async def list_sessions() -> Any:
        """List the sessions."""
        return {"sessions": await pool.do(pool.names)}

    @app.post("/sessions", status_code=201, response_model=SessionAnswer)
    async def begin_session(given: NewSession) -> Any:
        """Begin a session."""

        def work() -> dict[str, Any]:
            config = changed_settings(pool.config, given.settings, "settings")
            options = given.model_dump(include={"segmentation", "seed", "planner"})
            return _described(given.name, pool.begin(given.name, config, **options))

        return await pool.do(work)

    @app.get("/sessions/{name}", response_model=SessionAnswer)
    async def describe_session(name: SessionName) -> Any:
        """Say what a session is, and how many views it has."""
        return await pool.do(lambda: _described(name, pool.session(name)))

    @app.post("/sessions/{name}/views", status_code=201, response_model=ViewAnswer)
    async def add_view(name: SessionName, given: NewView) -> Any:
        """Take in a view; when this answers, it is on the disk and stays."""

        def work() -> dict[str, Any]:
            added = pool.session(name).add(given.capture(), given.number)
            return {"view": added.number, "changed": added.changed, "graph": graph_to_json(added.graph)}

        return await pool.do(work)

    @app.delete("/sessions/{name}/views/last", response_model=UndoAnswer)
    async def undo_view(name: SessionName) -> Any:
        """Take the last view back."""

        def work() -> dict[str, Any]:
            session = pool.session(name)
            if session.views == 0:
                raise WrongNumberError(name, "has no views to take back", "add one first")
            return {"views": session.undo(), "graph": graph_to_json(session.graph)}

        return await pool.do(work)

    @app.get("/sessions/{name}/graph")
    async def tell_graph(name: SessionName) -> dict[str, Any]:
        """Say what is known: graph.json."""
        return await pool.do(lambda: graph_to_json(pool.session(name).graph))

    @app.get("/sessions/{name}/next", response_model=NextAnswer)
    async def tell_next(name: SessionName) -> Any:
        """Say where to look next, for the robot the session was begun with."""
        return await pool.do(lambda: pool.session(name).next().to_json())

    @app.post("/sessions/{name}/next", response_model=NextAnswer)
    async def choose_next(name: SessionName, given: Candidates) -> Any:
        """Choose where to look next among the views that your robot reaches."""
        reach = given.T_world_camera, given.path_length
        return await pool.do(lambda: pool.session(name).next(*reach).to_json())


def _bearer(token: str) -> Callable[..., Any]:
    async def check(given: Annotated[HTTPAuthorizationCredentials | None, Depends(BEARER)]) -> None:
        sent = "" if given is None else given.credentials
        if not secrets.compare_digest(sent.encode(), token.encode()):
            raise HTTPException(401, "the token is missing or wrong", {"WWW-Authenticate": "Bearer"})

    return check


def _decoded(key: str, text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except ValueError:
        raise InputError(key, "is no base64", "encode the bytes of the file") from None


def _described(name: str, session: Session) -> dict[str, Any]:
    b = session.beginning
    chosen = {"segmentation": b.segmentation, "seed": b.seed, "planner": b.planner}
    return {"name": name, "views": session.views} | chosen


async def _refuse(request: Request, error: Exception) -> Response:
    """Say what does not fit in one sentence, and not what was sent."""
    status = next((code for kind, code in STATUS.items() if isinstance(error, kind)), 422)
    text = str(error)
    if isinstance(error, RequestValidationError):
        first = error.errors()[0]
        text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    # Names that were sent may hold halves of characters, which no answer can.
    detail = " ".join(text.encode("utf-8", "replace").decode().splitlines())
    return JSONResponse({"detail": detail}, status, {"Retry-After": "1"} if status == 503 else None)
