"""The report as one HTML file."""

from __future__ import annotations

from importlib import resources

from caryatid.viz.contents import Report
from caryatid.viz.style import DARK, LIGHT, declared, drawing_rules
from caryatid.viz.summary import cards, charts


def render_html(report: Report) -> str:
    """Write a report as one HTML file that loads nothing from anywhere."""
    import jinja2

    source = resources.files("caryatid.viz").joinpath("page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(source).render(
        title=report.title,
        pages=report.pages,
        changes=report.changes,
        contacts=report.contacts if len(report.pages) > 1 else (),
        cards=cards(report),
        charts=charts(report).values(),
        scores=report.scores,
        settings=report.settings,
        strip=report.strip,
        drawings=drawing_rules(),
        light=declared(LIGHT),
        dark=declared(DARK),
    )
