"""The door of the viewer: an ASGI app that lets in who has the token, and passes them on to viser.

viser cannot restrict access. It listens on this machine alone, at a loopback address that nobody can guess.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from caryatid.errors import InputError, needs_extra

if TYPE_CHECKING:
    from starlette.datastructures import Headers
    from starlette.types import ASGIApp, Receive, Scope, Send

LARGEST = 50 * 1024 * 1024
"""Of a message, as viser allows [bytes]."""
FOLLOW_THEME = b"""<head><script>if (matchMedia("(prefers-color-scheme: dark)").matches) {
  const address = new URL(location)
  address.searchParams.set("darkMode", "")
  history.replaceState(null, "", address)
}</script>"""
"""What the page begins with: it follows the system to a dark theme, where viser sets one for everybody."""


class Door:
    """A viser server behind a token.

    Args:
        title: Title of the page.
        host: Address to listen on.
        port: Port to listen on; if taken, the next free one; 0 = any free port.
        choose: Called with the id of an object whose vertex in the support graph is clicked. viser does not
            say what is clicked in HTML, so a vertex is a link, and the answer to it is empty.

    Attributes:
        server: The `viser.ViserServer`.
        url: Address of the page, with its token.

    Raises:
        InputError: viser is not installed, or the page cannot be served.
    """

    def __init__(self, title: str, host: str, port: int, choose: Callable[[str], None]) -> None:
        with needs_extra("view", "viewer"):
            import uvicorn
            import viser

        class Server(viser.ViserServer):
            """A server whose page stays on this machine: nobody can ask for a public address."""

            def request_share_url(self, verbose: bool = True) -> str | None:
                return None

        listening, token, hidden = _listen(host, port), secrets.token_urlsafe(16), _hidden_address()
        with _silent():
            self.server: Any = Server(host=hidden, port=0, label=title, verbose=False)
        pages = Path(viser.__file__).parent / "client" / "build"
        app = _app(f"ws://{hidden}:{self.server.get_port()}", pages, token, host, choose)
        options: dict[str, Any] = {"log_level": "critical", "lifespan": "off", "ws_max_size": LARGEST}
        self._front = uvicorn.Server(uvicorn.Config(app, ws_per_message_deflate=False, **options))
        self._thread = Thread(target=self._front.run, args=([listening],), daemon=True)
        self._thread.start()
        named = f"[{host}]" if ":" in host else host
        self.url = f"http://{named}:{listening.getsockname()[1]}/{token}"

    def close(self) -> None:
        """Stop serving the page."""
        self._front.should_exit = self._front.force_exit = True
        self._thread.join(5.0)
        with _silent():
            self.server.stop()


def _listen(host: str, port: int) -> socket.socket:
    """A socket that listens on a port, or on the next free one."""
    if not 0 <= port < 2**16:
        raise InputError(f"port {port}", "is out of range", "choose 0 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, 0), family=family).close()
    except OSError:
        raise InputError(host, "is not an address of this machine", "choose another --host") from None
    for attempt in range(port, 2**16 if port else 1):
        with suppress(OSError):
            return socket.create_server((host, attempt), family=family)
    raise InputError(f"port {port}", "and all above are taken", "choose another --port")


def _hidden_address() -> str:
    """A random loopback address; 127.0.0.1 where a system has no other."""
    hidden = "127." + ".".join(str(1 + secrets.randbelow(254)) for _ in range(3))
    try:
        socket.create_server((hidden, 0)).close()
    except OSError:
        return "127.0.0.1"
    return hidden


def _app(inside: str, pages: Path, token: str, host: str, choose: Callable[[str], None]) -> ASGIApp:
    """The app: viser's page, and its messages in both directions, for those who may come in."""
    from starlette.applications import Starlette
    from starlette.datastructures import Headers
    from starlette.requests import Request
    from starlette.responses import PlainTextResponse, Response
    from starlette.routing import Mount, Route, WebSocketRoute
    from starlette.staticfiles import StaticFiles
    from starlette.websockets import WebSocket
    from websockets.asyncio.client import connect

    async def pass_on(outer: WebSocket) -> None:
        known: Any = {"subprotocols": outer.scope["subprotocols"], "max_size": None, "compression": None}
        async with connect(inside, **known) as inner:
            await outer.accept(inner.subprotocol)

            async def read() -> None:
                async for message in outer.iter_bytes():
                    await inner.send(message)

            async def write() -> None:
                while True:
                    await outer.send_bytes(await inner.recv(decode=False))

            tasks = [asyncio.create_task(work()) for work in (read, write)]
            _, unfinished = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in unfinished:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    page = (pages / "index.html").read_bytes().replace(b"<head>", FOLLOW_THEME, 1)

    async def open_page(_: Request) -> Response:
        return Response(page, media_type="text/html")

    async def click(request: Request) -> Response:
        choose(request.path_params["object_id"])
        return Response(status_code=204)

    routes = [Route("/", open_page), Route("/object/{object_id}", click), WebSocketRoute("/", pass_on)]
    routes.append(Mount("/", StaticFiles(directory=pages)))
    app = Starlette(routes=[WebSocketRoute(f"/{token}", pass_on), Mount(f"/{token}", routes=routes)])

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        first = scope["path"].removeprefix("/").partition("/")[0].encode()
        allowed = secrets.compare_digest(first, token.encode()) and _is_ours(Headers(scope=scope), host)
        refusal = PlainTextResponse("open the full address that caryatid printed\n", 403)
        await (app if allowed else refusal)(scope, receive, send)

    return guarded


def _is_ours(headers: Headers, host: str) -> bool:
    """Whether a request names this machine, and comes from the viewer's own page."""
    try:
        (named,) = headers.getlist("Host")
        name = urlsplit(f"//{named}").hostname
    except ValueError:
        return False
    known = name in {"127.0.0.1", "localhost", "::1", host} or (name and host in ("0.0.0.0", "::", ""))
    ours = all(origin in (f"http://{named}", f"https://{named}") for origin in headers.getlist("Origin"))
    return bool(known and ours)


@contextmanager
def _silent() -> Iterator[None]:
    """Keep viser from printing."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
