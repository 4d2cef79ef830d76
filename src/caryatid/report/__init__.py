"""The report: every view drawn, in one HTML file that opens anywhere.

`draw_view` turns each step of an exploration into a page as soon as it is there, so that its images and
clouds need not be kept; `draw_model` draws a model without planning; `render_report` puts the pages together.
"""

from caryatid.report.page import Figure, ViewPage, draw_model, draw_view, render_report

__all__ = ["Figure", "ViewPage", "draw_model", "draw_view", "render_report"]
