"""What `--view` adds to exploring: a page that shows every view as soon as it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event

from caryatid.cli.output import Progress
from caryatid.config import Config
from caryatid.exploration import Step
from caryatid.viewer.drawing import Moment
from caryatid.viewer.process import PageProcess

PORT = 8770
"""Where the page is, or at the next port that is free; that of `caryatid view`."""


def wait_for_interrupt() -> None:
    """Return at Ctrl-C."""
    try:
        Event().wait()
    except KeyboardInterrupt:
        return


class Watcher:
    """Shows the steps of an exploration in a page.

    Args:
        page: Where.

    Attributes:
        ended: The exploration came to its end by itself.
    """

    def __init__(self, page: PageProcess) -> None:
        self._page = page
        self.ended = False

    def show(self, step: Step, score: float | None) -> None:
        """Show a step; F1 is shown where it is known."""
        self.ended = step.stop is not None
        self._page.add(Moment(step, score))


@contextmanager
def watched(name: str, config: Config, progress: Progress, wait: Callable[[], None]) -> Iterator[Watcher]:
    """Open a page for an exploration; where that came to its end by itself, keep it open until Ctrl-C.

    Args:
        name: What is explored.
        config: All settings.
        progress: Told where the page is.
        wait: Returns when the page may be closed.
    """
    page = PageProcess(f"caryatid: {name}", config.support, port=PORT)
    progress.say(f"{name} at {page.url}")
    page.open_browser()
    try:
        watcher = Watcher(page)
        yield watcher
        if watcher.ended:
            progress.say(f"the page stays at {page.url}; Ctrl-C ends")
            wait()
    finally:
        page.close()
