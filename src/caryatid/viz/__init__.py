"""Drawings and tables of what is known: the report in HTML and PDF, notebook cells, pictures of the docs."""

from caryatid.viz.report import Figure, Report, ViewPage, draw_view, render_html, render_pdf

__all__ = ["Figure", "Report", "ViewPage", "draw_view", "render_html", "render_pdf"]
