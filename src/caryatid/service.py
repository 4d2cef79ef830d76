"""Sessions over HTTP, for robot software in any language: `caryatid serve`.

The sessions handle one request at a time. A view already uses all cores in compiled loops, and not every
threading layer of numba allows two threads at once, so more threads would gain nothing.
"""

from __future__ import annotations

import asyncio
import ipaddress
import secrets
import shutil
import signal
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import uvicorn
from fastapi import Depends, FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPBearer
from pydantic import Base64Bytes, BaseModel, ConfigDict, Field
from starlette.middleware.base import RequestResponseEndpoint
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect

from caryatid.config import Config, SegmentationMethod
from caryatid.config.settings import changed_settings
from caryatid.errors import CaryatidError, InputError, PlanningError, in_one_line
from caryatid.exports import planning_scene
from caryatid.geometry.transforms import Array
from caryatid.io.graph_json import graph_to_json
from caryatid.io.images import read_mask
from caryatid.io.json_files import Numbers
from caryatid.io.staging import BusyError
from caryatid.manipulation.order import plan_order
from caryatid.runtime.parallel import cores
from caryatid.sessions import Capture, Session
from caryatid.sessions.messages import CameraRecord, CandidateViews, check_limits
from caryatid.sessions.session import SessionConflictError, is_session
from caryatid.support.relations import Effect

STATUS = {SessionConflictError: 409, BusyError: 409, PlanningError: 409, OSError: 503, MemoryError: 503}
"""Status of each error; all others are 422: the input cannot be used."""
LATER = {"Retry-After": "1"}
"""Header of answers with status 503."""
PATIENCE = 30.0
"""Maximum time for a request's body to arrive [s]: 16 MB at half a megabyte per second."""

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$", description="Name of the session")]
_SETTINGS = Field(description="Settings to change, as in `caryatid config --json`: stage → name → value")
Settings = Annotated[dict[str, dict[str, Any]], _SETTINGS]


class Document(BaseModel):
    """A JSON object with no other keys."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class NewSession(Document):
    """A session to create."""

    name: Name
    segmentation: SegmentationMethod | None = None
    """Source of segments; null = labels if the first view has them."""
    seed: int = Field(0, ge=0, le=2**63 - 1)
    """Random seed."""
    planner: str = "support"
    """Planner of the next view."""
    settings: Settings = {}
    ignore: Base64Bytes | None = None
    """Grey PNG of pixels to ignore in every view, such as the robot's arm; 0 = keep."""


class NewView(Document):
    """A view, with image files in base64."""

    camera: CameraRecord
    depth: Base64Bytes
    """16-bit PNG, or .npy (H, W) of floats in metres; 0 = no reading."""
    rgb: Base64Bytes | None = None
    """PNG, JPEG, or .npy (H, W, 3) of uint8."""
    labels: Base64Bytes | None = None
    """Grey PNG, or .npy (H, W) of integers: the object of each pixel, 0 = no object."""
    number: int | None = Field(None, ge=0)
    """Number of the view, from 0; makes retries safe: the last view is not added twice."""
    budget: float | None = Field(None, ge=0.0, le=3600.0)
    """Time [s] after which to answer with status 202 that the view is `open`: it is still being added, and
    has to be sent again; null = wait."""


class NewReport(Document):
    """An object that the robot removed or moved."""

    object: str
    """Id of the object."""
    T: Annotated[Array, Numbers(4, 4, rigid=True)] | None = None
    """The object's motion: rigid transform (4, 4), world frame [m]; null = removed."""
    number: int | None = Field(None, ge=0)
    """Number of the report, from 0; makes retries safe: the newest report is not repeated."""


class NewOrder(Document):
    """A removal order to plan."""

    goal: str | None = None
    """Id of the object to reach; null = remove all."""
    hands: Literal[1, 2] = 1
    """With 2, one may hold an object while the other lifts one."""
    settings: Settings = {}


class SessionPool:
    """The sessions in one folder, each in a subfolder of its name; the most recently used ones are open."""

    def __init__(self, folder: Path, config: Config, open_sessions: int) -> None:
        self.folder = folder.resolve()  # a path that no sentence contains by chance
        self.config = config
        self._most = open_sessions
        self._open: dict[str, Session] = {}

    def names(self) -> list[str]:
        """Names of all sessions."""
        return sorted(path.name for path in self.folder.glob("*") if is_session(path))

    def begin(self, name: str, config: Config, **options: Any) -> None:
        """Create a session; the options are those of `Session.begin`."""
        check_limits(self.config, config)
        self.check_room()
        if len(self.names()) >= (most := self.config.session.max_sessions):
            reason = f"this service has reached session.max_sessions = {most}"
            remedy = "delete folders of old sessions, or raise that setting"
            raise HTTPException(503, f"{reason}; {remedy}", LATER)
        Session.begin(self.folder / name, config, **options).close()

    def session(self, name: str) -> Session:
        """Return a session, opened from disk if needed."""
        if not is_session(self.folder / name):
            raise HTTPException(404, f"unknown session '{name}'; create it first")
        known = self._open.pop(name) if name in self._open else Session.open(self.folder / name)
        self._open[name] = known  # the most recently used one is the last
        self.close(self._most)
        return known

    def check_room(self) -> None:
        """Refuse new data while less than `session.min_free` of the disk is free."""
        free, least = shutil.disk_usage(self.folder).free, self.config.session.min_free
        if free < least:
            reason = f"only {free / 1e9:.1f} GB of disk space is free"
            raise HTTPException(503, f"{reason}; session.min_free is {least / 1e9:.1f} GB", LATER)

    def close(self, most: int = 0) -> None:
        """Close all sessions but this number of the most recently used ones, and those that add a view."""
        idle = [name for name, session in self._open.items() if not most or not session.is_busy]
        for name in idle[: max(len(self._open) - most, 0)]:
            self._open.pop(name).close()


def make_app(
    pool: SessionPool, *, token: str | None, max_request: int, waiting: int, host: str = "127.0.0.1"
) -> FastAPI:
    """Make the application, for an address it listens on; without a token, only this machine can connect.

    It takes requests of at most `max_request` bytes; at most `waiting` arrive, wait or are being processed.
    """
    bearer = HTTPBearer(auto_error=False, description="Token with which the service was started")
    problem = {"model": dict[str, str], "content": {"text/plain": {}}, "description": "What is wrong"}
    app = FastAPI(
        title="caryatid",
        summary="Active vision sessions: add views, get the support graph and the next best view",
        version=version("caryatid"),
        docs_url=None,  # these pages load external scripts; /openapi.json has the same content
        redoc_url=None,
        max_body_size=max_request,
        responses={"4XX": problem, "5XX": problem},
        dependencies=[] if token is None else [Depends(bearer)],  # described here, checked by `admit`
    )
    wanted = None if token is None else f"Bearer {token}".encode()
    # With the maximum size of a request, the number of requests limits the memory in use.
    room, turn = asyncio.Semaphore(waiting), asyncio.Lock()

    @app.middleware("http")
    async def admit(request: Request, handle: RequestResponseEndpoint) -> Response:
        """Check the token, wait for the whole request, and then for its turn."""
        sent = dict(request.scope["headers"]).get(b"authorization", b"")
        if wanted is not None and not secrets.compare_digest(sent, wanted):
            detail = "the token is missing or wrong"
            return JSONResponse({"detail": detail}, 401, {"WWW-Authenticate": "Bearer"})
        if room.locked():
            detail = f"{waiting} requests are already waiting; try again later"
            return JSONResponse({"detail": detail}, 503, LATER)
        async with room:
            try:
                async with asyncio.timeout(PATIENCE):
                    await request.body()
            except (TimeoutError, ClientDisconnect):
                return JSONResponse({"detail": f"the request body took longer than {PATIENCE:g} s"}, 408)
            async with turn:
                return await handle(request)

    if token is None:
        # Reject requests from foreign pages in a browser on this machine: they name another host.
        local = ["127.0.0.1", "localhost", "[::1]", host]
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=local)
    for kind in (CaryatidError, RequestValidationError, OSError, MemoryError):
        app.add_exception_handler(kind, partial(_refuse, pool.folder))
    _add_pages(app, pool)
    return app


def _add_pages(app: FastAPI, pool: SessionPool) -> None:
    def counts(session: Session) -> dict[str, Any]:
        return {"views": session.views, "reports": session.reports}

    @app.get("/sessions")
    def list_sessions() -> dict[str, list[str]]:
        """List the sessions."""
        return {"sessions": pool.names()}

    @app.get("/sessions/{name}")
    def describe_session(name: Name) -> dict[str, Any]:
        """Return the options of a session, and its numbers of views and reports."""
        session = pool.session(name)
        options = {key: getattr(session.beginning, key) for key in ("segmentation", "seed", "planner")}
        return {"name": name} | options | counts(session)

    @app.post("/sessions", status_code=201)
    def begin_session(given: NewSession) -> dict[str, Any]:
        """Create a session."""
        config = changed_settings(pool.config, given.settings, "settings")
        options = given.model_dump(include={"segmentation", "seed", "planner"})
        if given.ignore is not None:
            options["ignore"] = read_mask(given.ignore, "ignore", pool.config.recording.max_pixels)
        pool.begin(given.name, config, **options)
        return describe_session(given.name)

    @app.post("/sessions/{name}/views", status_code=201)
    def add_view(name: Name, given: NewView, response: Response) -> dict[str, Any]:
        """Add a view; once this returns 201, the view is safe on disk."""
        pool.check_room()
        camera = replace(given.camera, name="view" if given.number is None else f"view {given.number + 1}")
        images = {"depth": given.depth, "rgb": given.rgb, "labels": given.labels}
        known = {key: content for key, content in images.items() if content is not None}
        added = pool.session(name).add(Capture(known, camera), given.number, budget=given.budget)
        response.status_code = 202 if added.open else 201
        return added.to_json()

    @app.post("/sessions/{name}/reports", status_code=201)
    def report_change(name: Name, given: NewReport) -> dict[str, Any]:
        """Report an object that was removed or moved; once this returns, the report is safe on disk."""
        pool.check_room()
        session = pool.session(name)
        graph = session.take(given.object, given.T, given.number)
        return counts(session) | {"graph": graph_to_json(graph)}

    @app.delete("/sessions/{name}/views/last")
    def undo_view(name: Name) -> dict[str, Any]:
        """Undo the last view, or the last report after it."""
        session = pool.session(name)
        session.undo()
        return counts(session) | {"graph": graph_to_json(session.graph)}

    @app.get("/sessions/{name}/graph")
    def get_graph(name: Name) -> dict[str, Any]:
        """Return the support graph in the format of graph.json."""
        return graph_to_json(pool.session(name).graph)

    @app.get("/sessions/{name}/planning_scene")
    def get_planning_scene(name: Name, frame: str = "world") -> dict[str, Any]:
        """Return a moveit_msgs/PlanningScene: objects as a diff; poses are not transformed to `frame`."""
        return planning_scene(pool.session(name).graph, frame)

    @app.get("/sessions/{name}/next")
    def get_next_view(name: Name) -> dict[str, Any]:
        """Plan the next best view for the session's robot."""
        return pool.session(name).next().to_json()

    @app.post("/sessions/{name}/next")
    def choose_next_view(name: Name, given: CandidateViews) -> dict[str, Any]:
        """Plan the next best view among poses that your robot can reach, or without those that it cannot."""
        return (
            pool.session(name).next(given.T_world_camera, given.path_length, refused=given.refused).to_json()
        )

    @app.post("/sessions/{name}/order")
    def order_removals(name: Name, given: NewOrder) -> dict[str, Any]:
        """Plan a safe order in which to remove all objects, or to reach one; each lift is rehearsed."""
        scene = pool.session(name).scene
        config = changed_settings(scene.config, given.settings, "settings")
        check_limits(pool.config, config)
        return plan_order(
            scene.graph, config, goal=given.goal, hands=given.hands, seed=scene.seed, threads=cores(),
            voxels=scene.voxels,
        ).to_json()  # fmt: skip

    @app.get("/sessions/{name}/effects/{object_id}")
    def predict_removal(name: Name, object_id: str) -> list[Effect]:
        """Predict which objects move when one is removed."""
        return list(pool.session(name).scene.predict_removal(object_id))

    @app.get("/sessions/{name}/supports/{supporter}/{supported}")
    def explain_support(name: Name, supporter: str, supported: str) -> dict[str, str]:
        """Explain why one object supports another, or why not."""
        return {"why": pool.session(name).scene.explain(supporter, supported)}


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
    return JSONResponse({"detail": detail}, status, LATER if status == 503 else None)


def check_token(host: str, token: str | None) -> None:
    """Refuse to serve other machines without a token.

    Raises:
        InputError: The token is missing or too short to be safe.
    """
    if token is not None and len(token) < 16:
        raise InputError("--token", "has fewer than 16 characters", "give a longer random token")
    local = host == "localhost"
    with suppress(ValueError):
        local = ipaddress.ip_address(host).is_loopback
    if token is None and not local:
        reason = f"{host} is open to other machines, and no token is set"
        raise InputError("--host", reason, "set CARYATID_TOKEN, or serve on 127.0.0.1")


def run_service(app: FastAPI, host: str, port: int, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C or SIGTERM, then answer the remaining requests.

    `listening` is called with the address of the service.

    Raises:
        InputError: The address cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = f"cannot listen on it ({(getattr(error, 'strerror', None) or str(error)).lower()})"
        raise InputError(f"{host}:{port}", reason, "choose another --port or --host") from None
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False))
    # When a signal stops it, the server answers what is open, and then repeats the signal.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with suppress(KeyboardInterrupt):
        listening(f"http://{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}")
        server.run(sockets=[listener])
