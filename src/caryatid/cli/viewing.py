"""What `caryatid view` does: open the page, and keep it open."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from threading import Event, Thread

from caryatid.cli.output import Progress
from caryatid.cli.view import View
from caryatid.config import Config
from caryatid.errors import CaryatidError
from caryatid.io.json_files import json_text
from caryatid.io.runs import Run, is_run, read_run
from caryatid.runtime.compiling import compile_kernels
from caryatid.runtime.interrupts import interruptible
from caryatid.sources import open_recording, open_source
from caryatid.viewer.controls import Controls
from caryatid.viewer.loop import Loop
from caryatid.viewer.moments import Moment
from caryatid.viewer.page import Page
from caryatid.viewer.replay import replayed
from caryatid.viewer.runs import config_of_run, moments_of_run

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
        with interruptible():
            Event().wait()
    except KeyboardInterrupt:
        return


def _open_run(options: View, config: Config, progress: Progress, stack: ExitStack) -> Page:
    run = read_run(options.source)
    moments = moments_of_run(run)
    title = f"caryatid: {run.folder.name}"
    page = Page(title, config_of_run(run).support, host=options.host, port=options.port)
    stack.callback(page.close)
    for moment in moments:
        page.add(moment)
    left = Event()
    thread = Thread(target=_fill_in, args=(page, run, moments, left), name="replay", daemon=True)
    stack.callback(thread.join)
    stack.callback(left.set)
    thread.start()
    return page


def _fill_in(page: Page, run: Run, stored: Sequence[Moment], left: Event) -> None:
    """Compute a run again for what its folder does not hold, until somebody leaves."""
    page.say("Taking the run's views again, for the clouds …")
    found = 0
    try:
        moments = replayed(run, stored, config_of_run(run), open_source, open_recording)
        while not left.is_set():
            with page.working:
                moment = next(moments, None)
            if moment is None:
                break
            found += 1
            page.add(moment)
    except CaryatidError as error:
        page.say(f"Without clouds: {error}.")
        return
    if found < len(stored):
        page.say(
            f"View {found} comes out otherwise than in the run, so from there on clouds are left out: "
            "the source, or caryatid, is not what it was."
        )
    else:
        page.say("")


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
