"""A page in a process of its own, so that drawing it takes no time from the loop."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from multiprocessing import get_context
from multiprocessing.connection import Connection

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.viewer.drawing import Moment
from caryatid.viewer.page import Page, needs_viser


class PageProcess:
    """A page like `Page`, to which moments can be added and no more.

    Args:
        title: What the page is of.
        support: The numbers the graphs were inferred with.
        host: Address to listen at.
        port: Port to listen at, or the next free one; 0 = any that is free.

    Attributes:
        url: Where the page is.

    Raises:
        InputError: viser is not installed, or the page cannot be served.
    """

    def __init__(self, title: str, support: SupportConfig, *, host: str = "127.0.0.1", port: int = 0) -> None:
        if find_spec("viser") is None:
            raise needs_viser()
        context = get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, title, support, host, port), daemon=True)
        self._process.start()
        theirs.close()
        try:
            self.url: str = self._connection.recv()
        except EOFError:
            remedy = "choose another address"
            raise InputError("viewer", f"cannot be served at {host}:{port}", remedy) from None
        self._sender = ThreadPoolExecutor(1, "viewer")

    def add(self, moment: Moment) -> None:
        """Add a moment; it is sent as soon as those before it are, unless the page is gone."""
        self._sender.submit(lambda: self._connection.send(moment.reduced()))

    def close(self) -> None:
        """Stop serving the page, once all that was added has been sent."""
        self._sender.shutdown()
        self._connection.close()
        self._process.join()


def _serve(connection: Connection, title: str, support: SupportConfig, host: str, port: int) -> None:
    """Serve a page and show the moments that come, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)  # Where cores are scarce, the loop goes first.
    page = Page(title, support, host=host, port=port)
    connection.send(page.url)
    try:
        while True:
            page.add(connection.recv())
    except EOFError:
        page.close()
