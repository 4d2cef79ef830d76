"""What `caryatid view` does: open the page, and keep it open."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from threading import Event

from caryatid.cli.output import Progress
from caryatid.cli.view import View
from caryatid.config import Config
from caryatid.io.json_files import json_text
from caryatid.io.runs import is_run, read_run
from caryatid.runtime.compiling import compile_kernels
from caryatid.sources import open_source
from caryatid.steps import read_config, read_steps
from caryatid.viewer.controls import Controls
from caryatid.viewer.drawing import Moment
from caryatid.viewer.loop import Loop
from caryatid.viewer.page import Page

SWITCH_INTERVAL = 0.0005
"""After which Python turns to another thread that waits [s]; a tenth of its own."""


def run_viewer(options: View, config: Config) -> int:
    """Show a run, a scene or a recording until Ctrl-C."""
    # Drawing is to give way to the loop at once, which it shares the interpreter with.
    sys.setswitchinterval(SWITCH_INTERVAL)
    progress = Progress(options.general.silent)
    with ExitStack() as stack:
        opened = _open_run if is_run(Path(options.source)) else _open_loop
        page = opened(options, config, progress, stack)
        if options.general.json:
            sys.stdout.write(json_text({"address": page.url, "source": options.source}))
            sys.stdout.flush()
        progress.say(f"{options.source} at {page.url}; Ctrl-C ends")
        if not options.no_browser:
            page.open_browser()
        wait_for_interrupt()
    return 0


def wait_for_interrupt() -> None:
    """Return at Ctrl-C."""
    try:
        Event().wait()
    except KeyboardInterrupt:
        return


def _open_run(options: View, config: Config, progress: Progress, stack: ExitStack) -> Page:
    run = read_run(options.source)
    steps = read_steps(run)
    support = read_config(run).support
    page = Page(f"caryatid: {run.folder.name}", support, host=options.host, port=options.port)
    stack.callback(page.close)
    scores = [score["f1"] for score in run.record.get("scores", ())]
    for step in steps:
        page.add(Moment(step, scores[step.index] if scores else None))
    return page


def _open_loop(options: View, config: Config, progress: Progress, stack: ExitStack) -> Page:
    seed = options.modelling.seed
    opening = partial(
        open_source,
        options.source,
        noise=options.noise,
        segmentation=options.segmentation,
        seed=seed,
        robot=options.robot,
    )
    with progress.working("opening"):
        loop = Loop(opening, config, planner=options.planner, segmentation=options.segmentation, seed=seed)
    with progress.working("compiling"):
        compile_kernels(progress.say)
    title = f"caryatid: {loop.source.name}"
    page = Page(title, config.support, host=options.host, port=options.port)
    stack.callback(page.close)
    controls = Controls(page, loop, seed=seed)
    stack.callback(controls.close)
    controls.start()
    return page
