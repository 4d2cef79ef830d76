"""`caryatid view`: a run, a scene or a recording in the browser; and the page of `--view`."""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from caryatid.cli import options

if TYPE_CHECKING:
    from caryatid.cli.output import Output
    from caryatid.config import Config
    from caryatid.viewer.page import Page, PageProcess

PORT = 8770
"""Port of the page, or else the next free one."""


@dataclass(frozen=True, kw_only=True)
class View(options.ExploringCommand):
    """Show a finished run in the browser, or control there the exploration of a scene or a recording.

    SOURCE is one of
      a run folder, as explore, extract and dismantle write it; it is not changed
      an MJCF scene, the name of a built-in one, or a recording, as for explore

    The page is served to this machine only, loads nothing from elsewhere, and stays until Ctrl-C.

    To try:
      caryatid view run
      caryatid view clutter --noise carmine
      caryatid view recording/ --segmentation auto --port 8080 --no-browser
    """

    source: options.SourceName
    """Run, scene or recording."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen at; at any but 127.0.0.1, other machines can connect without a password."""
    port: options.Port = PORT
    """Port to listen at, or else the next free one; 0 = any free one."""
    no_browser: options.Flag = False
    """Print the address of the page without opening it."""

    def __call__(self) -> None:
        from caryatid.steps import is_run

        config, output = self.config(), self.output
        # The page shares the interpreter with the loop: a tenth of Python's interval lets it answer at once.
        sys.setswitchinterval(0.0005)
        with closing(self._open_run() if is_run(Path(self.source)) else self._open_loop(config)) as page:
            output.result({"address": page.url, "source": self.source}, "")
            output.say(f"{self.source} at {page.url}; Ctrl-C ends")
            if not self.no_browser:
                webbrowser.open(page.url)
            wait_for_interrupt()

    def _open_run(self) -> Page:
        from caryatid.steps import read_config, read_run, read_steps
        from caryatid.viewer.page import Page

        run = read_run(self.source)
        steps = read_steps(run)
        title = f"caryatid: {run.folder.name}"
        page = Page(title, read_config(run).support, host=self.host, port=self.port)
        scores = [score["f1"] for score in run.record.get("scores", ())]
        for step in steps:
            page.add(step, scores[step.index] if scores else None)
        return page

    def _open_loop(self, config: Config) -> Page:
        from caryatid.sources import open_source
        from caryatid.viewer.loop import LoopPage

        shared: dict[str, Any] = {"segmentation": self.segmentation, "seed": self.settings.seed}
        masks = self.mask_source(config)
        given: dict[str, Any] = {"noise": self.noise, "robot": self.robot, "masks": masks}
        given |= {"ignore": self.ignore, "level": self.level}
        opening = partial(open_source, self.source, **given, **shared)
        shared |= {"planner": self.chosen_planner, "host": self.host, "port": self.port}
        with self.output.working("opening"):
            page = LoopPage(opening, config, masks=masks, **shared)
        page.start()
        return page


def wait_for_interrupt() -> None:
    """Return at Ctrl-C."""
    try:
        Event().wait()
    except KeyboardInterrupt:
        return


@contextmanager
def watched(name: str, config: Config, output: Output) -> Iterator[PageProcess]:
    """Open a page for an exploration; when that ends by itself, keep the page until Ctrl-C."""
    from caryatid.viewer.page import PageProcess

    page = PageProcess(f"caryatid: {name}", config.support, port=PORT)
    output.say(f"{name} at {page.url}")
    webbrowser.open(page.url)
    try:
        yield page
        output.say(f"the page stays at {page.url}; Ctrl-C ends")
        wait_for_interrupt()
    finally:
        page.close()
