"""Drawings and tables of what is known: the report in HTML and PDF, notebook cells, pictures of the docs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime import imported_late

if TYPE_CHECKING:
    from caryatid.viz.pdf import render_pdf
    from caryatid.viz.report import Figure, Report, Section, make_report, render_html

_HOMES = {"pdf": ["render_pdf"], "report": ["Figure", "Report", "Section", "make_report", "render_html"]}

__all__ = ["Figure", "Report", "Section", "make_report", "render_html", "render_pdf"]

if not TYPE_CHECKING:
    __getattr__ = imported_late(__name__, _HOMES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
