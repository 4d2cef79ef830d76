"""`caryatid report`: the report of a run, made anew or for print."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.options import SAID, General


@dataclass(frozen=True, kw_only=True)
class ReportCommand:
    """Write the report of a run anew, as a PDF for print too.

    To try:
      caryatid report run
      caryatid report run --pdf report.pdf
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, as explore, extract and dismantle write it; its report.html is replaced."""
    pdf: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.pdf"), SAID] = None
    """Write a PDF as well, A4; replaces one already there. Needs the extra `pdf`."""
    general: tyro.conf.OmitArgPrefixes[General] = field(default_factory=General)

    def __call__(self) -> int:
        """Run the command."""
        from caryatid.cli.progress import Progress
        from caryatid.io.json_files import json_text
        from caryatid.io.runs import read_run
        from caryatid.io.staging import write_file
        from caryatid.viz import read_report, render_html, render_pdf

        report = read_report(read_run(self.run).folder / "report.json")
        files = {} if self.pdf is None else {self.pdf: render_pdf(report)}
        files[self.run / "report.html"] = render_html(report).encode()
        for path, content in files.items():
            write_file(path, content)
        if self.general.json:
            pdf = None if self.pdf is None else str(self.pdf)
            sys.stdout.write(json_text({"html": str(self.run / "report.html"), "pdf": pdf}))
        progress = Progress(self.general.quiet or self.general.json)
        for path in files:
            progress.say(f"report: {path}")
        return 0
