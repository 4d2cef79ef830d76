"""Running the service until it is told to stop."""

from __future__ import annotations

import ipaddress
import signal
import socket
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI

from caryatid.errors import InputError


def check_token(host: str, token: str | None) -> None:
    """Refuse to serve others than this machine without a token.

    Raises:
        InputError: There is none, or it is too short to keep anybody out.
    """
    if token is not None and len(token) < 16:
        raise InputError("--token", "has fewer than 16 characters", "give a longer one that nobody can guess")
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = host == "localhost"
    if token is None and not local:
        reason = f"{host} can be reached from elsewhere, and there is no token"
        raise InputError("--host", reason, "set CARYATID_TOKEN, or serve at 127.0.0.1")


def run_service(app: FastAPI, host: str, port: int, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C or SIGTERM, at any free port for 0; what has been asked by then is answered.

    `listening` is called with the address.

    Raises:
        InputError: The address is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = f"cannot be listened at ({(getattr(error, 'strerror', None) or str(error)).lower()})"
        raise InputError(f"{host}:{port}", reason, "choose another --port or --host") from None
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            limit_concurrency=64,  # with the size of a request this bounds what is held in memory
        )
    )

    def stop(number: int, frame: object) -> None:
        server.should_exit = True

    # The server hears signals itself as soon as it runs, and hands them on once it has stopped.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    listening(f"http://{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}")
    server.run(sockets=[listener])
