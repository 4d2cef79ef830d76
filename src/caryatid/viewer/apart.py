"""A page in a process of its own, so that drawing it takes no time from the loop."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import webbrowser
from dataclasses import asdict
from importlib.util import find_spec
from queue import SimpleQueue
from threading import Thread

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.viewer.moments import Moment
from caryatid.viewer.page import Page, needs_viser
from caryatid.viewer.wire import MomentReader, MomentWriter

BEHIND = 10
"""How far drawing stands behind the loop where cores are short, as `nice` counts."""


class PageApart:
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
        told = json.dumps({"title": title, "support": asdict(support), "host": host, "port": port})
        command = [sys.executable, "-m", "caryatid.viewer.apart", told]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self.url = self._process.stdout.readline().decode().strip()
        if not self.url:
            self._process.wait()
            raise InputError("viewer", f"cannot be served at {host}:{port}", "choose another address")
        self._writer = MomentWriter(self._process.stdin)
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
        self._process.communicate()

    def _send(self) -> None:
        while (moment := self._queue.get()) is not None:
            try:
                self._writer.write(moment)
            except OSError:
                return


def main() -> int:
    """Serve a page and show the moments that come on stdin, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(BEHIND)
    told = json.loads(sys.argv[1])
    page = Page(told["title"], SupportConfig(**told["support"]), host=told["host"], port=told["port"])
    sys.stdout.write(f"{page.url}\n")
    sys.stdout.flush()
    reader = MomentReader(sys.stdin.buffer)
    while (moment := reader.read()) is not None:
        page.add(moment)
    page.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
