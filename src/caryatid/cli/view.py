"""`caryatid view`: a run, a scene or a recording in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from caryatid.cli.options import SAID, ExploringCommand, SourceName, whole_number

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
        """Run the command."""
        config = self.settings()
        from caryatid.cli.viewing import run_viewer

        run_viewer(self, config)
