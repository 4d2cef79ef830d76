"""The texts of a run's report, made while there is time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from caryatid.evaluation.scores import Score
from caryatid.runtime.interrupts import made_in_time
from caryatid.viz import Figure, ViewPage, compose_report, render_html, store_report


def report_in_time(
    pages: Sequence[ViewPage],
    name: str,
    settings: Mapping[str, object],
    *,
    scores: Sequence[Score] | None = None,
    strip: Sequence[Figure] = (),
) -> tuple[str | None, str | None]:
    """Return the texts of report.html and report.json, or None for both where Ctrl-C left no time for them.

    Args:
        pages: The views, in order.
        name: What was looked at.
        settings: What the report is to say of how.
        scores: Score after each view, where the truth is known.
        strip: Pictures for the end.
    """

    def make() -> tuple[str, str]:
        said = compose_report(pages, title=f"caryatid: {name}", settings=settings, scores=scores, strip=strip)
        return render_html(said), store_report(said)

    return made_in_time(make) or (None, None)
