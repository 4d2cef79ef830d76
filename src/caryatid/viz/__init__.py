"""Drawings and tables of what is known: the report in HTML and PDF, notebook cells, pictures of the docs."""

from caryatid.viz.pdf import render_pdf
from caryatid.viz.report import Figure, Report, Section, make_report, render_html

__all__ = ["Figure", "Report", "Section", "make_report", "render_html", "render_pdf"]
