"""Sessions over HTTP, for robot software in any language: `caryatid serve`.

One thread handles the requests in turn. A view already uses all cores in compiled loops, and not every
threading layer of numba allows two threads at once, so more threads would gain nothing.
"""

from __future__ import annotations

import asyncio
import ctypes
import ipaddress
import secrets
import shutil
import signal
import socket
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial, wraps
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import uvicorn
from fastapi import Depends, FastAPI, HTTPException, Request, Response
from fastapi import Path as PathParameter
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPBearer
from pydantic import Base64Bytes, BaseModel, ConfigDict, Field
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from caryatid.config import Config, SegmentationMethod
from caryatid.config.settings import changed_settings
from caryatid.errors import CaryatidError, InputError, PlanningError, in_one_line
from caryatid.geometry.transforms import Array
from caryatid.graph import Change
from caryatid.io.graph_json import graph_to_json
from caryatid.io.images import read_mask
from caryatid.io.json_files import Numbers
from caryatid.io.log import BusyError
from caryatid.manipulation.order import plan_order
from caryatid.runtime.parallel import cores
from caryatid.sessions import Capture, Session
from caryatid.sessions.captures import CameraRecord
from caryatid.sessions.next_view import CandidateViews
from caryatid.sessions.session import Added, SessionConflictError, is_session


class FullError(CaryatidError):
    """The service is at a limit and accepts no more data at present."""


class MissingError(CaryatidError):
    """No session has this name."""


STATUS: dict[type[Exception], int] = {
    MissingError: 404,
    SessionConflictError: 409,
    BusyError: 409,
    PlanningError: 409,
    FullError: 503,
    OSError: 503,
    MemoryError: 503,
}
"""Status of each error; all others are 422: the input cannot be used."""

PATIENCE = 30.0
"""Maximum time for a request's body to arrive [s]: 16 MB at half a megabyte per second."""

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
SessionName = Annotated[Name, PathParameter(description="Name of the session")]


class Document(BaseModel):
    """A JSON object with no other keys."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Problem(Document):
    """An error, in one sentence."""

    detail: str = Field(description="Input at fault, reason and remedy")


class SessionOptions(Document):
    """Options of a new session."""

    name: Name = Field(description="Name of the session")
    segmentation: SegmentationMethod | None = Field(
        None, description="Source of segments; null = labels if the first view has them"
    )
    seed: int = Field(0, ge=0, le=2**63 - 1, description="Random seed")
    planner: str = Field("support", description="Planner of the next view")


Settings = Annotated[
    dict[str, dict[str, Any]],
    Field(description="Settings to change, as in `caryatid config --json`: stage → name → value"),
]


class NewSession(SessionOptions):
    """A session to create."""

    settings: Settings = {}
    ignore: Base64Bytes | None = Field(
        None,
        description="Grey PNG of pixels to ignore in every view, such as the robot's arm; 0 = keep",
    )


class SessionAnswer(SessionOptions):
    """A session."""

    views: int = Field(description="Number of its views")
    reports: int = Field(description="Number of its reports")


class NewView(Document):
    """A view, with image files in base64."""

    camera: CameraRecord = Field(description="Camera matrix and camera pose")
    depth: Base64Bytes = Field(description="16-bit PNG, or .npy (H, W) of floats in metres; 0 = no reading")
    rgb: Base64Bytes | None = Field(None, description="PNG, JPEG, or .npy (H, W, 3) of uint8")
    labels: Base64Bytes | None = Field(
        None, description="Grey PNG, or .npy (H, W) of integers: the object of each pixel, 0 = no object"
    )
    number: int | None = Field(
        None,
        ge=0,
        description="Number of the view, from 0; makes retries safe: the last view is not added twice",
    )

    def capture(self) -> Capture:
        """The view, its images not decoded yet."""
        images = {"depth": self.depth, "rgb": self.rgb, "labels": self.labels}
        name = "view" if self.number is None else f"view {self.number + 1}"
        given = {key: content for key, content in images.items() if content is not None}
        return Capture(given, replace(self.camera, name=name))


class ViewAnswer(Document):
    """Result of adding a view."""

    view: int = Field(description="Number of the view, from 0")
    changed: bool = Field(description="Whether it changed the graph")
    T_world_camera: list[list[float]] | None = Field(
        description="Pose [m] after registration, or null while the view waits"
    )
    warnings: list[str] = Field(description="What may be wrong with the view, or why it waits")
    changes: list[Change] = Field(description="Changes of objects since the previous view, seen or reported")
    graph: dict[str, Any] = Field(description="graph.json")


class NewReport(Document):
    """An object that the robot removed, or moved by T (4, 4)."""

    object: str = Field(description="Id of the object")
    T: Annotated[Array, Numbers(4, 4, rigid=True)] | None = Field(
        None,
        description="The object's motion: rigid transform (4, 4), world frame [m]; null = removed",
    )
    number: int | None = Field(
        None,
        ge=0,
        description="Number of the report, from 0; makes retries safe: the newest report is not repeated",
    )


class Known(Document):
    """The session after a change."""

    views: int = Field(description="Number of views")
    reports: int = Field(description="Number of reports")
    graph: dict[str, Any] = Field(description="graph.json")


class Gaze(Document):
    """Where the head looks, relative to the platform [rad]."""

    yaw: float = Field(description="To the left")
    pitch: float = Field(description="Upwards")


class Waypoint(Document):
    """Posture of the robot on its path."""

    platform: list[float] = Field(description="x, y, yaw [m, m, rad]")
    camera_height: float = Field(description="Above the floor [m]")
    gaze: Gaze = Field(description="Direction of the head")
    joints: list[float] | None = Field(description="Joint positions of an arm, or null if unknown")


class NextAnswer(Document):
    """The next best view."""

    view: int = Field(description="Number of the next view, from 0")
    T_world_camera: list[list[float]] = Field(description="Camera pose [m]: OpenCV camera frame, world z up")
    candidate: int = Field(description="Index among the candidates")
    platform: list[float] | None = Field(description="x, y, yaw [m, m, rad]; null with candidates")
    camera_height: float | None = Field(description="Above the floor [m]; null with candidates")
    gaze: Gaze | None = Field(description="Direction of the head; null with candidates")
    joints: list[float] | None = Field(description="Joint positions of an arm, or null if unknown")
    waypoints: list[Waypoint] = Field(
        description="Postures on the path there, connected by straight lines; empty with candidates"
    )
    expected_gain: float = Field(description="Saliency s of eq. 3")
    cost: float = Field(description="Cost h of the path, eq. 3")
    score: float = Field(description="c = s − h, eq. 3")
    why: str = Field(description="Reason in one sentence")
    stop: str | None = Field(description="Why another view may not be worth its path, or null")


class NewOrder(Document):
    """A removal order to plan."""

    goal: str | None = Field(None, description="Id of the object to reach; null = remove all")
    hands: Literal[1, 2] = Field(1, description="With 2, one may hold an object while the other lifts one")
    settings: Settings = {}


class Lift(Document):
    """An object to remove."""

    object: str = Field(description="Its id")
    hold: list[str] = Field(description="Objects that the other hand holds meanwhile")
    safe: bool = Field(description="Whether the risk is at most `rehearsal.risk`")
    risk: float = Field(description="Probability that another object moves")
    probability: float = Field(description="Probability that no other object moves")
    why: str = Field(description="Reason in one sentence")
    grasp: dict[str, Any] | None = Field(
        None, description="T_world_gripper and width [m]; null unless `gripper.kind` is set"
    )


class OrderAnswer(Document):
    """A removal order."""

    steps: list[Lift] = Field(description="Objects to remove, in this order")
    probability: float = Field(description="Probability that no step moves another object")
    safe: bool = Field(description="Whether every step is safe")
    refusal: str | None = Field(description="Why no order is safe, or null")


class EffectAnswer(Document):
    """An object that moves when another one is removed."""

    object_id: str = Field(description="Its id")
    why: str = Field(description="What it loses")
    probability: float = Field(description="Probability that it moves")


class SessionPool:
    """The sessions in one folder. From other threads, call only `do`.

    Args:
        folder: Folder of the sessions; each has a subfolder of its name.
        config: Settings of new sessions.
        open_sessions: Maximum number of open sessions; the least recently used one is closed first.
        waiting: Maximum number of requests that wait or are being processed.
    """

    def __init__(self, folder: Path, config: Config, open_sessions: int, waiting: int) -> None:
        self.folder = folder.resolve()  # a path that no sentence contains by chance
        self.config = config
        self._max_open = open_sessions
        self._max_waiting = waiting
        self._waiting = 0
        self._open: dict[str, Session] = {}

    async def __aenter__(self) -> None:
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="sessions")

    async def __aexit__(self, *error: object) -> None:
        """Finish the waiting requests and close the sessions."""
        self._worker.shutdown()
        self._close_all_but(0)

    async def do(self, work: Callable[[], Any]) -> Any:
        """Run work on the sessions in the pool's thread, after all earlier work.

        Raises:
            FullError: Too many requests are waiting.
        """
        if self._waiting >= self._max_waiting:
            raise FullError(f"{self._waiting} requests are already waiting; try again later")
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._worker, work)
        finally:
            self._waiting -= 1

    def names(self) -> list[str]:
        """Names of all sessions."""
        return sorted(path.name for path in self.folder.glob("*") if is_session(path))

    def begin(self, name: str, config: Config, **options: Any) -> Session:
        """Create a session; the options are those of `Session.begin`.

        Raises:
            InputError: The name is taken, or a setting exceeds the limits for clients.
            FullError: There are too many sessions, or the disk is full.
        """
        _check_limits(self.config, config)
        self._check_room()
        if len(self.names()) >= self.config.session.max_sessions:
            most = self.config.session.max_sessions
            remedy = "delete folders of old sessions, or raise that setting"
            raise FullError(f"this service has reached session.max_sessions = {most}; {remedy}")
        return self._opened(name, Session.begin(self.folder / name, config, **options))

    def session(self, name: str) -> Session:
        """Return a session, opened from disk if needed.

        Raises:
            MissingError: No session has this name.
            BusyError: Another process has it open.
        """
        if name in self._open:
            return self._opened(name, self._open.pop(name))
        if not is_session(self.folder / name):
            raise MissingError(f"unknown session '{name}'; create it first")
        return self._opened(name, Session.open(self.folder / name))

    def add(self, name: str, view: Capture, number: int | None) -> Added:
        """Add a view to a session, as `Session.add` does.

        Raises:
            FullError: The disk is full.
        """
        self._check_room()
        added = self.session(name).add(view, number)
        _release_memory()
        return added

    def take(self, name: str, object_id: str, T: Array | None, number: int | None) -> Session:
        """Report to a session that an object was moved by T (4, 4), or removed; return the session.

        Raises:
            FullError: The disk is full.
        """
        self._check_room()
        session = self.session(name)
        session.take(object_id, T, number)
        return session

    def _check_room(self) -> None:
        free, least = shutil.disk_usage(self.folder).free, self.config.session.min_free
        if free < least:
            reason = f"only {free / 1e9:.1f} GB of disk space is free"
            raise FullError(f"{reason}; session.min_free is {least / 1e9:.1f} GB")

    def _opened(self, name: str, session: Session) -> Session:
        """Keep a session open as the most recently used one."""
        self._open[name] = session
        self._close_all_but(self._max_open)
        return session

    def _close_all_but(self, most: int) -> None:
        while len(self._open) > most:
            self._open.pop(next(iter(self._open))).close()


def _release_memory() -> None:
    """Return free memory to the system: glibc keeps what a view needed for a while, up to 70 MB."""
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "malloc_trim"):
        library.malloc_trim(0)


PROBLEMS: dict[int | str, dict[str, Any]] = {
    **{status: {"model": Problem} for status in (400, 401, 404, 409, 422, 503)},
    413: {"content": {"text/plain": {}}, "description": "The request is too large"},
}
"""Answers to requests that fail, by their status."""

BEARER = HTTPBearer(auto_error=False, description="Token with which the service was started")
"""How requests send their token."""


def make_app(pool: SessionPool, *, token: str | None, max_request: int, host: str = "127.0.0.1") -> FastAPI:
    """Make the application.

    Args:
        pool: The sessions; started and stopped with the application.
        token: Token that requests must send; None allows only this machine to connect.
        max_request: Maximum size of a request [bytes].
        host: Address it listens on.
    """
    app = FastAPI(
        title="caryatid",
        summary="Active vision sessions: add views, get the support graph and the next best view",
        version=version("caryatid"),
        lifespan=lambda app: pool,
        docs_url=None,  # these pages load external scripts; /openapi.json has the same content
        redoc_url=None,
        max_body_size=max_request,
        responses=PROBLEMS,
        dependencies=[] if token is None else [Depends(BEARER)],
    )
    app.add_middleware(Gate, token=token)
    if token is None:
        # Reject requests from foreign pages in a browser on this machine: they name another host.
        local = ["127.0.0.1", "localhost", "[::1]", host]
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=local)
    for kind in (CaryatidError, RequestValidationError, OSError, MemoryError):
        app.add_exception_handler(kind, partial(_refuse, pool.folder))
    _add_pages(app, pool)
    return app


def _add_pages(app: FastAPI, pool: SessionPool) -> None:
    def queued(work: Callable[..., Any]) -> Callable[..., Any]:
        """Handle a request in the pool's thread."""

        @wraps(work)
        async def answer(**given: Any) -> Any:
            return await pool.do(partial(work, **given))

        return answer

    def described(name: str, session: Session) -> dict[str, Any]:
        b = session.beginning
        chosen = {"segmentation": b.segmentation, "seed": b.seed, "planner": b.planner}
        return {"name": name, "views": session.views, "reports": session.reports} | chosen

    def state_of(session: Session) -> dict[str, Any]:
        counts = {"views": session.views, "reports": session.reports}
        return counts | {"graph": graph_to_json(session.graph)}

    @app.get("/sessions")
    @queued
    def list_sessions() -> dict[str, list[str]]:
        """List the sessions."""
        return {"sessions": pool.names()}

    @app.post("/sessions", status_code=201, response_model=SessionAnswer)
    @queued
    def begin_session(given: NewSession) -> Any:
        """Create a session."""
        config = changed_settings(pool.config, given.settings, "settings")
        options = given.model_dump(include={"segmentation", "seed", "planner"})
        if given.ignore is not None:
            options["ignore"] = read_mask(given.ignore, "ignore", pool.config.recording.max_pixels)
        return described(given.name, pool.begin(given.name, config, **options))

    @app.get("/sessions/{name}", response_model=SessionAnswer)
    @queued
    def describe_session(name: SessionName) -> Any:
        """Return the options of a session and its number of views."""
        return described(name, pool.session(name))

    @app.post("/sessions/{name}/views", status_code=201, response_model=ViewAnswer)
    @queued
    def add_view(name: SessionName, given: NewView) -> Any:
        """Add a view; once this returns, the view is safe on disk."""
        return pool.add(name, given.capture(), given.number).to_json()

    @app.post("/sessions/{name}/reports", status_code=201, response_model=Known)
    @queued
    def report_change(name: SessionName, given: NewReport) -> Any:
        """Report an object that was removed or moved; once this returns, the report is safe on disk."""
        return state_of(pool.take(name, given.object, given.T, given.number))

    @app.delete("/sessions/{name}/views/last", response_model=Known)
    @queued
    def undo_view(name: SessionName) -> Any:
        """Undo the last view, or the last report after it."""
        session = pool.session(name)
        session.undo()
        return state_of(session)

    @app.get("/sessions/{name}/graph")
    @queued
    def get_graph(name: SessionName) -> dict[str, Any]:
        """Return the support graph in the format of graph.json."""
        return graph_to_json(pool.session(name).graph)

    @app.get("/sessions/{name}/next", response_model=NextAnswer)
    @queued
    def get_next_view(name: SessionName) -> Any:
        """Plan the next best view for the session's robot."""
        return pool.session(name).next().to_json()

    @app.post("/sessions/{name}/next", response_model=NextAnswer)
    @queued
    def choose_next_view(name: SessionName, given: CandidateViews) -> Any:
        """Plan the next best view among poses that your robot can reach, or without those that it cannot."""
        return pool.session(name).next(**given.arguments).to_json()

    @app.post("/sessions/{name}/order", response_model=OrderAnswer, response_model_exclude_unset=True)
    @queued
    def order_removals(name: SessionName, given: NewOrder) -> Any:
        """Plan a safe order in which to remove all objects, or to reach one; each lift is rehearsed."""
        scene = pool.session(name).scene
        config = changed_settings(scene.config, given.settings, "settings")
        _check_limits(pool.config, config)
        known: dict[str, Any] = {"goal": given.goal, "hands": given.hands}
        known |= {"seed": scene.seed, "voxels": scene.voxels}
        return plan_order(scene.graph, config, threads=cores(), **known).to_json()

    @app.get("/sessions/{name}/effects/{object_id}", response_model=list[EffectAnswer])
    @queued
    def predict_removal(name: SessionName, object_id: str) -> Any:
        """Predict which objects move when one is removed."""
        return [asdict(effect) for effect in pool.session(name).scene.predict_removal(object_id)]

    @app.get("/sessions/{name}/supports/{supporter}/{supported}")
    @queued
    def explain_support(name: SessionName, supporter: str, supported: str) -> dict[str, str]:
        """Explain why one object supports another, or why not."""
        return {"why": pool.session(name).scene.explain(supporter, supported)}


class Gate:
    """Checks the token before a request is read, and limits the time to receive its body.

    Args:
        app: The application behind it.
        token: Token that requests must send, or None.
    """

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        self._app = app
        self._bearer = None if token is None else f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer 401."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        sent = dict(scope["headers"]).get(b"authorization", b"")
        if self._bearer is not None and not secrets.compare_digest(sent, self._bearer):
            problem = {"detail": "the token is missing or wrong"}
            await JSONResponse(problem, 401, {"WWW-Authenticate": "Bearer"})(scope, receive, send)
            return
        deadline = asyncio.get_running_loop().time() + PATIENCE

        async def timely() -> Message:
            try:
                async with asyncio.timeout_at(deadline):
                    return await receive()
            except TimeoutError:
                raise HTTPException(408, f"the request body took longer than {PATIENCE:g} s") from None

        await self._app(scope, timely, send)


class PatientProtocol(H11Protocol):
    """HTTP whose keep-alive timeout also applies to request headers, so that incomplete requests end."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer of the first request."""
        super().connection_made(transport)
        wait, close = self.timeout_keep_alive, self.timeout_keep_alive_handler
        self.timeout_keep_alive_task = self.loop.call_later(wait, close)

    def data_received(self, data: bytes) -> None:
        """Receive bytes; the timer stops at a complete request, while uvicorn's own stops at any byte."""
        self.conn.receive_data(data)
        self.handle_events()


def _check_limits(own: Config, asked: Config) -> None:
    """Reject settings of a client that change a limit, or another setting by more than a factor of ten."""
    for stage, values in asdict(asked).items():
        for name, value in values.items():
            before = getattr(getattr(own, stage), name)
            if value == before:
                continue
            remedy = "change it in the settings of the service"
            if stage == "session" or name in ("max_voxels", "max_pixels"):
                raise InputError(f"{stage}.{name}", "is a limit of the service", remedy)
            given, ours = np.ravel(value), np.ravel(before)
            if given.dtype.kind not in "if" or not ours.any():
                continue
            given, ours = np.abs(given), np.abs(ours)
            smallest, largest = ours[ours > 0].min() / 10.0, 10.0 * ours.max()
            if len(given) > 10 * len(ours) or ((given > 0) & ((given < smallest) | (given > largest))).any():
                reason = f"differs from this service's {before} by more than a factor of ten"
                raise InputError(f"{stage}.{name}", reason, remedy)


async def _refuse(folder: Path, request: Request, error: Exception) -> Response:
    """Answer with the error in one sentence, without the data or the path of the sessions."""
    status = next((code for kind, code in STATUS.items() if isinstance(error, kind)), 422)
    text = in_one_line(error)
    if isinstance(error, RequestValidationError):
        first = error.errors()[0]
        text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    # Names in a request may hold lone surrogates, which an answer cannot.
    text = text.replace(f"{folder}/", "").replace(str(folder), "its folder")
    detail = " ".join(text.encode("utf-8", "replace").decode().splitlines())
    return JSONResponse({"detail": detail}, status, {"Retry-After": "1"} if status == 503 else None)


def check_token(host: str, token: str | None) -> None:
    """Refuse to serve other machines without a token.

    Raises:
        InputError: The token is missing or too short to be safe.
    """
    if token is not None and len(token) < 16:
        raise InputError("--token", "has fewer than 16 characters", "give a longer random token")
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = host == "localhost"
    if token is None and not local:
        reason = f"{host} is open to other machines, and no token is set"
        raise InputError("--host", reason, "set CARYATID_TOKEN, or serve on 127.0.0.1")


def run_service(app: FastAPI, host: str, port: int, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C or SIGTERM, then answer the remaining requests.

    Args:
        app: The application.
        host: Address to listen on.
        port: Port to listen on; 0 = any free port.
        listening: Called with the address of the service.

    Raises:
        InputError: The address cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = f"cannot listen on it ({(getattr(error, 'strerror', None) or str(error)).lower()})"
        raise InputError(f"{host}:{port}", reason, "choose another --port or --host") from None
    # With the maximum size of a request, the number of connections limits the memory in use.
    limits: dict[str, Any] = {"http": PatientProtocol, "limit_concurrency": 64}
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False, **limits))

    def stop(number: int, frame: object) -> None:
        server.should_exit = True

    # The server handles signals itself while it runs, and forwards them once it has stopped.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    listening(f"http://{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}")
    server.run(sockets=[listener])
