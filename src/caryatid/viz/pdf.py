"""The report as a PDF, set by typst: A4, with bookmarks, and nothing in it that depends on the clock."""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

from caryatid.errors import InputError
from caryatid.viz.contents import Report
from caryatid.viz.page import Figure, ViewPage
from caryatid.viz.style import LIGHT, alone
from caryatid.viz.summary import cards, charts


def check_typst() -> None:
    """Make sure that PDFs can be written.

    Raises:
        InputError: typst is not installed.
    """
    try:
        import typst  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name != "typst":
            raise
        raise InputError("report", "a PDF needs typst", 'pip install "caryatid[pdf]"') from None


def render_pdf(report: Report) -> bytes:
    """Write a report as a PDF; the same report gives the same bytes.

    Raises:
        InputError: typst is not installed.
    """
    check_typst()
    import matplotlib as mpl
    import typst

    source = resources.files("caryatid.viz").joinpath("page.typ").read_bytes()
    fonts = Path(mpl.get_data_path()) / "fonts/ttf"
    written: bytes = typst.compile(
        source,
        font_paths=typst.Fonts(
            include_system_fonts=False, include_embedded_fonts=False, font_paths=[str(fonts)]
        ),
        sys_inputs={"report": json.dumps(_document(report), ensure_ascii=False)},
    )
    return written


def _document(report: Report) -> dict[str, Any]:
    """What the print shows, with drawings that stand alone."""
    scores = [f"{score.f1:.3f}" for score in report.scores] or [""] * len(report.pages)
    return {
        "title": report.title,
        "colours": LIGHT,
        "cards": cards(report),
        "charts": [{"name": name, "svg": alone(chart)} for name, chart in charts(report).items()],
        "contacts": [
            {"number": c.number, "svg": alone(c.svg), "score": c.score, "reason": c.reason}
            for c in (report.contacts if len(report.pages) > 1 else ())
        ],
        "pages": [
            _page(page, score, changed)
            for page, score, changed in zip(report.pages, scores, report.changes, strict=True)
        ],
        "strip": [_figure(figure) for figure in report.strip],
        "settings": report.settings,
    }


def _page(page: ViewPage, score: str, changed: str) -> dict[str, Any]:
    return {
        "number": page.number,
        "name": page.name,
        "score": score,
        "changed": changed,
        "figures": [_figure(figure) for figure in page.figures],
        "objects": [asdict(row) for row in page.objects],
        "supports": [asdict(row) for row in page.supports],
        "points": [asdict(row) for row in page.points],
        "choice": page.choice,
        "stop": page.stop or "",
    }


def _figure(figure: Figure) -> dict[str, Any]:
    return asdict(figure) | {"svg": alone(figure.svg)}
