"""`caryatid view`: a run, a scene or a recording in the browser; and the page of `--view`."""

from __future__ import annotations

import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from caryatid.cli.options import ExploringCommand, Flag, Port, SourceName

if TYPE_CHECKING:
    from contextlib import ExitStack

    from caryatid.cli.output import Output
    from caryatid.config import Config
    from caryatid.viewer.page import Page
    from caryatid.viewer.process import PageProcess

PORT = 8770
"""Where the page is, or at the next port that is free."""


@dataclass(frozen=True, kw_only=True)
class View(ExploringCommand):
    """Look at a finished run in the browser, or work the loop there on a scene or a recording.

    SOURCE is one of
      a run folder, as explore, extract and dismantle write it; it is shown, and not changed
      an MJCF scene, the name of a built-in one, or a recording, as of explore; the page takes view after
      view when it is told to

    The page is served to this machine only, loads nothing from elsewhere, and stays until Ctrl-C.

    To try:
      caryatid view run
      caryatid view clutter --noise carmine
      caryatid view recording/ --segmentation auto --port 8080 --no-browser
    """

    source: SourceName
    """Run, scene or recording."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen at; at any other than this one others can come, and nobody asks them who they are."""
    port: Port = PORT
    """Port to listen at, or the next one that is free; 0 = any that is free."""
    no_browser: Flag = False
    """Say where the page is, and leave it to you to open it."""

    def __call__(self) -> None:
        import sys
        from contextlib import ExitStack
        from pathlib import Path

        from caryatid.cli.output import Output
        from caryatid.io.runs import is_run

        config, out = self.settings(), Output(self.general)
        # The page shares the interpreter with the loop: a tenth of Python's interval lets it answer at once.
        sys.setswitchinterval(0.0005)
        with ExitStack() as stack:
            page = self._open_run(stack) if is_run(Path(self.source)) else self._open_loop(config, out, stack)
            if self.general.json:
                out.result({"address": page.url, "source": self.source})
            out.say(f"{self.source} at {page.url}; Ctrl-C ends")
            if not self.no_browser:
                webbrowser.open(page.url)
            wait_for_interrupt()

    def _open_run(self, stack: ExitStack) -> Page:
        from caryatid.io.runs import read_run
        from caryatid.steps import read_config, read_steps
        from caryatid.viewer.drawing import Moment
        from caryatid.viewer.page import Page

        run = read_run(self.source)
        steps = read_steps(run)
        title = f"caryatid: {run.folder.name}"
        page = Page(title, read_config(run).support, host=self.host, port=self.port)
        stack.callback(page.close)
        scores = [score["f1"] for score in run.record.get("scores", ())]
        for step in steps:
            page.add(Moment(step, scores[step.index] if scores else None))
        return page

    def _open_loop(self, config: Config, out: Output, stack: ExitStack) -> Page:
        from functools import partial

        from caryatid.sources import open_source
        from caryatid.viewer.controls import Controls
        from caryatid.viewer.loop import Loop
        from caryatid.viewer.page import Page

        shared: dict[str, Any] = {"segmentation": self.segmentation, "seed": self.modelling.seed}
        opening = partial(open_source, self.source, noise=self.noise, robot=self.robot, **shared)
        with out.working("opening"):
            loop = Loop(opening, config, planner=self.planner, **shared)
        out.compile()
        page = Page(f"caryatid: {loop.source.name}", config.support, host=self.host, port=self.port)
        stack.callback(page.close)
        controls = Controls(page, loop, seed=self.modelling.seed)
        stack.callback(controls.close)
        controls.start()
        return page


def wait_for_interrupt() -> None:
    """Return at Ctrl-C."""
    try:
        Event().wait()
    except KeyboardInterrupt:
        return


@contextmanager
def watched(name: str, config: Config, out: Output) -> Iterator[PageProcess]:
    """Open a page for an exploration; where that comes to its end by itself, keep it open until Ctrl-C.

    Args:
        name: What is explored.
        config: All settings.
        out: Says where the page is.
    """
    from caryatid.viewer.process import PageProcess

    page = PageProcess(f"caryatid: {name}", config.support, port=PORT)
    out.say(f"{name} at {page.url}")
    webbrowser.open(page.url)
    try:
        yield page
        out.say(f"the page stays at {page.url}; Ctrl-C ends")
        wait_for_interrupt()
    finally:
        page.close()
