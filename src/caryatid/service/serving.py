"""Running the service until it is told to stop."""

from __future__ import annotations

import ipaddress
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import uvicorn

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.io.staging import write_errors
from caryatid.runtime.compiling import compile_kernels
from caryatid.service.app import make_app
from caryatid.service.pool import SessionPool

CONNECTIONS = 64
"""Connections at the most [1]; with the size of a request they bound what is held in memory."""


def is_local(host: str) -> bool:
    """Whether an address is this machine's own, which no other can reach."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_token(host: str, token: str | None) -> None:
    """Refuse to serve others than this machine without a token.

    Raises:
        InputError: There is none, or it is too short to keep anybody out.
    """
    if token is not None and len(token) < 16:
        raise InputError("--token", "has fewer than 16 characters", "give a longer one that nobody can guess")
    if token is None and not is_local(host):
        raise InputError(
            "--host",
            f"{host} can be reached from elsewhere, and there is no token",
            "set CARYATID_TOKEN, or serve at 127.0.0.1",
        )


def run_service(
    folder: Path,
    config: Config,
    *,
    host: str,
    port: int,
    token: str | None,
    open_sessions: int,
    waiting: int,
    max_request: int,
    compiling: Callable[[str], None],
    listening: Callable[[str], None],
) -> None:
    """Serve the sessions of a folder until Ctrl-C or SIGTERM; what has been asked by then is answered.

    Args:
        folder: Holds the sessions.
        config: Settings of sessions that name none.
        host: Address to listen at.
        port: Port to listen at; 0 = any that is free.
        token: What every request has to carry, or None.
        open_sessions: How many are kept in memory at once.
        waiting: How many requests may wait.
        max_request: Largest request [bytes].
        compiling: Called with one line if there are kernels to compile.
        listening: Called with the address once requests are answered.

    Raises:
        InputError: A token is missing, the address is taken, or the folder cannot be written.
    """
    check_token(host, token)
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    listener = _listen(host, port)
    compile_kernels(compiling)
    app = make_app(
        SessionPool(folder, config, open_sessions, waiting), token=token, max_request=max_request, host=host
    )
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            limit_concurrency=CONNECTIONS,
            ws="none",
            lifespan="on",
            server_header=False,
        )
    )
    shown = f"[{host}]" if ":" in host else host
    address = f"http://{shown}:{listener.getsockname()[1]}"

    def stop(number: int, frame: object) -> None:
        server.should_exit = True

    # The server hears signals itself as soon as it runs, and hands them on once it has stopped.
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        listening(address)
        server.run(sockets=[listener])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=CONNECTIONS)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{host}:{port}", f"cannot be listened at ({reason.lower()})", "choose another --port or --host"
        ) from None
