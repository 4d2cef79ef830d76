"""What `--view` adds to exploring: a page that shows every view as soon as it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from caryatid.cli.output import Progress
from caryatid.config import Config
from caryatid.exploration import Step
from caryatid.sources import Source
from caryatid.viewer.apart import PageApart
from caryatid.viewer.loop import standing_of
from caryatid.viewer.moments import moment_of_step

PORT = 8770
"""Where the page is, or at the next port that is free; that of `caryatid view`."""


class Watcher:
    """Shows the steps of an exploration in a page.

    Args:
        page: Where.
        config: All settings.

    Attributes:
        ended: The exploration came to its end by itself.
    """

    def __init__(self, page: PageApart, config: Config) -> None:
        self._page, self._config = page, config
        self.ended = False

    def show(self, step: Step, source: Source, score: float | None) -> None:
        """Show a step; F1 is shown where it is known."""
        self.ended = step.stop is not None
        standing = standing_of(source.robot, self._config)
        self._page.add(moment_of_step(step, robot=standing, score=score))


@contextmanager
def watched(name: str, config: Config, progress: Progress, wait: Callable[[], None]) -> Iterator[Watcher]:
    """Open a page for an exploration; where that came to its end by itself, keep it open until Ctrl-C.

    Args:
        name: What is explored.
        config: All settings.
        progress: Told where the page is.
        wait: Returns when the page may be closed.
    """
    page = PageApart(f"caryatid: {name}", config.support, port=PORT)
    progress.say(f"{name} at {page.url}")
    page.open_browser()
    try:
        watcher = Watcher(page, config)
        yield watcher
        if watcher.ended:
            progress.say(f"the page stays at {page.url}; Ctrl-C ends")
            wait()
    finally:
        page.close()
