"""What `caryatid view` does: open the page, and keep it open."""

from __future__ import annotations

import sys
from threading import Event

from caryatid.commands.progress import Progress
from caryatid.commands.view import View
from caryatid.config import Config
from caryatid.formats.json_files import json_text
from caryatid.formats.runs import read_run
from caryatid.viewer.page import Page
from caryatid.viewer.runs import config_of_run, moments_of_run


def run_viewer(options: View, config: Config) -> int:
    """Show a run, a scene or a recording until Ctrl-C."""
    progress = Progress(options.general.quiet or options.general.json)
    run = read_run(options.source)
    moments = moments_of_run(run)
    page = Page(
        f"caryatid: {run.folder.name}", config_of_run(run).support, host=options.host, port=options.port
    )
    for moment in moments:
        page.add(moment)
    return _kept_open(page, options, progress)


def _kept_open(page: Page, options: View, progress: Progress) -> int:
    if options.general.json:
        sys.stdout.write(json_text({"address": page.url, "source": options.source}))
        sys.stdout.flush()
    progress.say(f"{options.source} at {page.url}; Ctrl-C ends")
    if not options.no_browser:
        page.open_browser()
    try:
        Event().wait()
    except KeyboardInterrupt:
        return 0
    finally:
        page.close()
    return 0
