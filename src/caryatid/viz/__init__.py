"""The report: every view drawn, in one HTML file that opens anywhere, and as a print.

`draw_view` turns each step of an exploration into a page as soon as it is there, so that its images and
clouds need not be kept; `draw_model` draws a model without planning. `compose_report` puts pages together;
`render_html` and `render_pdf` write them; `store_report` and `read_report` keep them.
"""

from caryatid.viz.contents import Report, compose_report
from caryatid.viz.html import render_html
from caryatid.viz.page import Figure, ViewPage, draw_model, draw_view
from caryatid.viz.pdf import render_pdf
from caryatid.viz.stored import read_report, store_report

__all__ = [
    "Figure",
    "Report",
    "ViewPage",
    "compose_report",
    "draw_model",
    "draw_view",
    "read_report",
    "render_html",
    "render_pdf",
    "store_report",
]
