"""Running the service until it is told to stop."""

from __future__ import annotations

import ipaddress
import signal
import socket
from collections.abc import Callable

import uvicorn

from caryatid.errors import InputError
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
        reason = f"{host} can be reached from elsewhere, and there is no token"
        raise InputError("--host", reason, "set CARYATID_TOKEN, or serve at 127.0.0.1")


def run_service(
    pool: SessionPool,
    *,
    host: str,
    port: int,
    token: str | None,
    max_request: int,
    listening: Callable[[str], None],
) -> None:
    """Serve sessions until Ctrl-C or SIGTERM; what has been asked by then is answered.

    Args:
        pool: The sessions.
        host: Address to listen at.
        port: Port to listen at; 0 = any that is free.
        token: What every request has to carry, or None.
        max_request: Largest request [bytes].
        listening: Called with the address.

    Raises:
        InputError: The address is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=CONNECTIONS)
    except (OSError, OverflowError) as error:
        reason = f"cannot be listened at ({(getattr(error, 'strerror', None) or str(error)).lower()})"
        raise InputError(f"{host}:{port}", reason, "choose another --port or --host") from None
    server = uvicorn.Server(
        uvicorn.Config(
            make_app(pool, token=token, max_request=max_request, host=host),
            log_level="warning",
            access_log=False,
            limit_concurrency=CONNECTIONS,
            ws="none",
            lifespan="on",
            server_header=False,
        )
    )

    def stop(number: int, frame: object) -> None:
        server.should_exit = True

    # The server hears signals itself as soon as it runs, and hands them on once it has stopped.
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        listening(f"http://{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}")
        server.run(sockets=[listener])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
