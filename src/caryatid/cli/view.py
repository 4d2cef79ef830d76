"""`caryatid view`: a run, a scene or a recording in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from caryatid.cli.options import SAID, ExploringCommand, SourceName, whole_number

if TYPE_CHECKING:
    from contextlib import ExitStack

    from caryatid.cli.output import Progress
    from caryatid.config import Config
    from caryatid.viewer.page import Page

SWITCH_INTERVAL = 0.0005
"""Interval at which Python turns to a thread that waits [s]; a tenth of the default."""

Port = Annotated[int, whole_number(0)]


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
    port: Port = 8770
    """Port to listen at, or the next one that is free; 0 = any that is free."""
    no_browser: Annotated[bool, SAID] = False
    """Say where the page is, and leave it to you to open it."""

    def __call__(self) -> None:
        """Show a run, a scene or a recording until Ctrl-C."""
        import sys
        from contextlib import ExitStack
        from pathlib import Path

        from caryatid.cli.output import Progress
        from caryatid.cli.watching import wait_for_interrupt
        from caryatid.io.json_files import json_text
        from caryatid.io.runs import is_run

        config = self.settings()
        # The page shares the interpreter with the loop and gives way to it at once.
        sys.setswitchinterval(SWITCH_INTERVAL)
        progress = Progress(self.general.silent)
        with ExitStack() as stack:
            if is_run(Path(self.source)):
                page = self._open_run(stack)
            else:
                page = self._open_loop(config, progress, stack)
            if self.general.json:
                sys.stdout.write(json_text({"address": page.url, "source": self.source}))
                sys.stdout.flush()
            progress.say(f"{self.source} at {page.url}; Ctrl-C ends")
            if not self.no_browser:
                page.open_browser()
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

    def _open_loop(self, config: Config, progress: Progress, stack: ExitStack) -> Page:
        from functools import partial

        from caryatid.runtime.compiling import compile_kernels
        from caryatid.sources import open_source
        from caryatid.viewer.controls import Controls
        from caryatid.viewer.loop import Loop
        from caryatid.viewer.page import Page

        seed = self.modelling.seed
        opening = partial(
            open_source,
            self.source,
            noise=self.noise,
            segmentation=self.segmentation,
            seed=seed,
            robot=self.robot,
        )
        with progress.working("opening"):
            loop = Loop(opening, config, planner=self.planner, segmentation=self.segmentation, seed=seed)
        with progress.working("compiling"):
            compile_kernels(progress.say)
        title = f"caryatid: {loop.source.name}"
        page = Page(title, config.support, host=self.host, port=self.port)
        stack.callback(page.close)
        controls = Controls(page, loop, seed=seed)
        stack.callback(controls.close)
        controls.start()
        return page
