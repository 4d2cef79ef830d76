"""The report as one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from typing import TYPE_CHECKING

from caryatid.report.contents import Report, compose_report
from caryatid.report.page import Figure, ViewPage
from caryatid.report.style import DARK, LIGHT, declared, drawing_rules
from caryatid.report.summary import cards, charts

if TYPE_CHECKING:
    from caryatid.evaluation.scores import Score


def render_html(report: Report) -> str:
    """Write a report as one HTML file that loads nothing from anywhere."""
    import jinja2

    source = resources.files("caryatid.report").joinpath("page.html.jinja").read_text(encoding="utf-8")
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


def render_report(
    pages: Sequence[ViewPage],
    *,
    title: str,
    settings: Mapping[str, object],
    scores: Sequence[Score] | None = None,
    strip: Sequence[Figure] = (),
) -> str:
    """Write the report of some views: one HTML file that loads nothing from anywhere.

    Args:
        pages: The views, in order.
        title: Heading of the report.
        settings: Names and values of the run's settings; mappings and dataclasses in it are flattened.
        scores: Score after each view, where the truth is known; as many as pages.
        strip: Pictures of the objects being taken away, in order.

    Raises:
        ValueError: There are scores, but not one for each page, or there is no page.
    """
    return render_html(compose_report(pages, title=title, settings=settings, scores=scores, strip=strip))
