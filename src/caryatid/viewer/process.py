"""A page in a process of its own, so that drawing it takes no time from the loop."""

from __future__ import annotations

import os
import signal
import webbrowser
from importlib.util import find_spec
from multiprocessing import get_context
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Thread

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.viewer.drawing import Moment, reduced
from caryatid.viewer.page import Page, needs_viser

NICENESS = 10
"""Of the drawing process: where cores are scarce, the loop goes first."""


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
            raise InputError(
                "viewer", f"cannot be served at {host}:{port}", "choose another address"
            ) from None
        self._queue: SimpleQueue[Moment | None] = SimpleQueue()
        self._sender = Thread(target=self._send, name="viewer", daemon=True)
        self._sender.start()

    def open_browser(self) -> None:
        """Open the page in the user's browser, if there is one."""
        webbrowser.open(self.url)

    def add(self, moment: Moment) -> None:
        """Add a moment; it is sent as soon as those before it are."""
        self._queue.put(moment)

    def close(self) -> None:
        """Stop serving the page, once all that was added has been sent."""
        self._queue.put(None)
        self._sender.join()
        self._connection.close()
        self._process.join()

    def _send(self) -> None:
        while (moment := self._queue.get()) is not None:
            try:
                self._connection.send(Moment(reduced(moment.step), moment.score, moment.by_hand))
            except OSError:
                return


def _serve(connection: Connection, title: str, support: SupportConfig, host: str, port: int) -> None:
    """Serve a page and show the moments that come, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    page = Page(title, support, host=host, port=port)
    connection.send(page.url)
    while True:
        try:
            page.add(connection.recv())
        except EOFError:
            break
    page.close()
