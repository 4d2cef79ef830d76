"""The report in print: the page, as Chromium prints it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from caryatid.errors import InputError

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
"""What the program is called, in order of preference; the environment's CHROMIUM goes before."""


def find_chromium() -> str | None:
    """Path of Chromium, if it is installed."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


def print_pdf(html: str) -> bytes:
    """Print a page on A4, with bookmarks.

    Raises:
        InputError: Chromium is not installed, or does not print the page.
    """
    program = find_chromium()
    if program is None:
        remedy = "install Chromium or Chrome, or set CHROMIUM to its path"
        raise InputError("the PDF", "is printed by Chromium, which was not found", remedy)
    with TemporaryDirectory() as folder:
        page, printed = Path(folder, "report.html"), Path(folder, "report.pdf")
        page.write_text(html, encoding="utf-8")
        options = ["--headless", "--disable-gpu", "--no-pdf-header-footer", "--generate-pdf-document-outline"]
        options += [f"--user-data-dir={folder}/profile", f"--print-to-pdf={printed}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            options.append("--no-sandbox")  # As root, Chromium has none.
        try:
            subprocess.run([program, *options, page.as_uri()], check=True, capture_output=True, timeout=120.0)
            return printed.read_bytes()
        except (OSError, subprocess.SubprocessError) as error:
            told = (getattr(error, "stderr", None) or b"").decode(errors="replace").strip() or str(error)
            reason = f"was not printed by {program} ({told.splitlines()[-1]})"
            raise InputError("the PDF", reason, "print report.html from a browser") from error
