"""One HTML page of all suites of a result, which loads nothing from anywhere."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import resources

from caryatid.benchmark.figures import Figure
from caryatid.benchmark.provenance import Provenance
from caryatid.benchmark.sections import SuiteReport, by_condition, describe, explain, failures, tables


def render_page(
    suites: Sequence[SuiteReport], provenance: Provenance, *, title: str = "Benchmark", command: str = ""
) -> str:
    """Write the page.

    Args:
        suites: What there is to tell of.
        provenance: Which code on which machine ran the episodes.
        title: Heading of the page.
        command: What was typed to get it; empty to say nothing of it.

    Raises:
        ValueError: There is no suite.
    """
    import jinja2

    if not suites:
        raise ValueError("a page needs one suite at least")
    source = resources.files("caryatid.benchmark").joinpath("page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(source).render(
        title=title,
        command=command,
        provenance=provenance,
        suites=suites,
        inline=inline,
        by_condition=by_condition,
        describe=describe,
        failures=failures,
        tables=tables,
        notes=explain(suites[0].summary.config),
    )


def inline(figure: Figure, suite: str) -> str:
    """Make a figure's SVG part of a page: ids of its own, as wide as there is room, the drawing alone."""
    place = re.sub(r"[^a-z0-9]+", "-", f"{suite}-{figure.name}".lower())
    svg = figure.svg[figure.svg.index("<svg") :]
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = re.sub(r"\s*<style\b.*?</style>", "", svg, flags=re.S)
    svg = re.sub(r'\b(id="|xlink:href="#|url\(#)', rf"\g<1>{place}-", svg)
    svg = re.sub(r'(<svg\b[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg\b[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    return svg.replace("<svg", f'<svg role="img" aria-label="{figure.title.translate(_ESCAPED)}"', 1)


_ESCAPED = str.maketrans({"&": "&amp;", '"': "&quot;", "<": "&lt;"})
