"""The report in print: the same sections as on the page, on sheets of A4."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from itertools import groupby
from typing import Any

from caryatid.viz.pictures import DOUBT, INK, SOFT, own_style
from caryatid.viz.report import Figure, Report, Section
from caryatid.viz.tables import Entry, Table

WIDTH, HEIGHT, MARGIN = 8.27, 11.69, 0.55
"""Size of a page and its free border [in]."""


def render_pdf(report: Report) -> bytes:
    """Write a report as a PDF on A4; the same report gives the same bytes."""
    from matplotlib.backends.backend_pdf import PdfPages

    content = io.BytesIO()
    metadata = {"Title": report.title, "CreationDate": None, "Producer": None, "Creator": "caryatid"}
    with own_style(), PdfPages(content, metadata=metadata) as pdf:
        sheets = _Sheets(pdf, report.title)
        sheets.text(report.title, 15.0, bold=True)
        sheets.text(report.about, 9.0)
        for section in report.sections:
            sheets.section(section)
        sheets.finish()
    return content.getvalue()


class _Sheets:
    """Pages, filled from top to bottom."""

    def __init__(self, pdf: Any, title: str) -> None:
        self._pdf, self._title, self._number = pdf, title, 0
        self._chapters: list[tuple[str, int]] = []
        self._begin()

    def _begin(self) -> None:
        from matplotlib.figure import Figure as Sheet

        self._sheet, self._top = Sheet(figsize=(WIDTH, HEIGHT)), HEIGHT - MARGIN
        self._number += 1
        self._write(self._title, MARGIN, 7.0, MARGIN / 2.0, color=SOFT)
        self._write(str(self._number), WIDTH - MARGIN, 7.0, MARGIN / 2.0, color=SOFT, ha="right")

    def _room(self, height: float) -> None:
        """Begin a new page if less than this height is left [in]."""
        if self._top - height < MARGIN:
            self._pdf.savefig(self._sheet)
            self._begin()

    def _write(self, text: str, left: float, size: float, top: float | None = None, **look: Any) -> None:
        """Write lines below the top, or elsewhere, `left` inches from the page's edge."""
        at = self._top if top is None else top
        self._sheet.text(left / WIDTH, at / HEIGHT, text, fontsize=size, va="top", linespacing=1.3, **look)

    def section(self, section: Section) -> None:
        """Write a section; its heading stays with its first pictures."""
        self._room(0.5 + (7.2 / section.figures[0].share if section.figures else 0.6))
        self._chapters.append((section.title, self._number - 1))
        self.text(section.title, 13.0, bold=True)
        if section.text:
            self.text(section.text, 8.0)
        for share, group in groupby(section.figures, lambda figure: figure.share):
            figures = list(group)
            for start in range(0, len(figures), share):
                self._pictures(figures[start : start + share])
        for lead, remark in section.facts:
            self.text(f"{lead}: {remark}", 8.5, bold=True)
        for table in section.tables:
            self._table(table)

    def text(self, text: str, size: float, *, bold: bool = False) -> None:
        """Write a paragraph."""
        lines = _wrapped(text, WIDTH - 2.0 * MARGIN, size)
        height = 1.5 * size / 72.0 * len(lines)
        self._room(height)
        self._write("\n".join(lines), MARGIN, size, fontweight="bold" if bold else "normal")
        self._top -= height + 0.04

    def _pictures(self, figures: Sequence[Figure]) -> None:
        """Put pictures of one size side by side, with headings above and captions below them."""
        gap = 0.2
        width = (WIDTH - 2.0 * MARGIN + gap) / figures[0].share - gap
        heights = [min(width * f.picture.height / f.picture.width, 4.6) for f in figures]
        captions = [_wrapped(f.caption, width, 6.5) for f in figures]
        below = max(len(lines) for lines in captions) * 9.0 / 72.0 + 0.12
        self._room(0.2 + max(heights) + below)
        for k, (figure, height, lines) in enumerate(zip(figures, heights, captions, strict=True)):
            left, bottom = MARGIN + k * (width + gap), self._top - 0.2 - height
            drawn = height * figure.picture.width / figure.picture.height
            where = ((left + (width - drawn) / 2.0) / WIDTH, bottom / HEIGHT, drawn / WIDTH, height / HEIGHT)
            self._write(figure.heading, left, 8.5, fontweight="bold")
            figure.picture.put(self._sheet, where)
            self._write("\n".join(lines), left, 6.5, bottom - 0.04, color=SOFT)
        self._top -= 0.2 + max(heights) + below

    def _table(self, table: Table) -> None:
        """Write a table, over as many pages as it takes."""
        size = 6.5
        self._room(0.6)
        self.text(table.heading, 9.5, bold=True)
        if not table.rows:
            self.text("None.", 7.5)
            return
        heading, widths = tuple(Entry(name) for name in table.columns), _column_widths(table, size)
        for row in (heading, *table.rows):
            cells = [_wrapped(e.text, width - 0.06, size) for e, width in zip(row, widths, strict=True)]
            height = max(len(lines) for lines in cells) * 8.5 / 72.0 + 0.03
            self._room(height)
            left = MARGIN
            for entry, lines, width in zip(row, cells, widths, strict=True):
                if entry.colour:
                    self._write("■", left, size, color=entry.colour)
                colour = SOFT if row is heading else DOUBT if entry.doubt else INK
                self._write("\n".join(lines), left + 0.1 * bool(entry.colour), size, color=colour)
                left += width
            self._top -= height
        self._top -= 0.1

    def finish(self) -> None:
        """Write the last page, and the bookmarks, which `PdfPages` does not support."""
        from matplotlib.backends.backend_pdf import Name

        self._pdf.savefig(self._sheet)
        file = self._pdf._ensure_file()
        outline, *items = (file.reserveObject("outline") for _ in range(len(self._chapters) + 1))
        for k, (title, page) in enumerate(self._chapters):
            entry = {"Title": title, "Parent": outline, "Dest": [file.pageList[page], Name("Fit")]}
            entry |= {"Prev": items[k - 1]} if k else {}
            entry |= {"Next": items[k + 1]} if k + 1 < len(items) else {}
            file.writeObject(items[k], entry)
        ends = {"First": items[0], "Last": items[-1], "Count": len(items)}
        file.writeObject(outline, {"Type": Name("Outlines")} | ends)
        root = {"Type": Name("Catalog"), "Pages": file.pagesObject, "Outlines": outline}
        file.writeObject(file.rootObject, root)


def _letter(size: float) -> float:
    """Mean width of a letter of a size in points [in]."""
    return 0.56 * size / 72.0


def _wrapped(text: str, width: float, size: float) -> list[str]:
    """Lines of a text that fit into a width in inches."""
    return textwrap.wrap(text, max(int(width / _letter(size)), 4)) or [""]


def _column_widths(table: Table, size: float) -> list[float]:
    """Widths of the columns [in]: each as wide as its entries, but for the last, which takes what is left."""
    widths = []
    for name, *entries in zip(table.columns, *table.rows, strict=True):
        longest = max(len(e.text) + 2 * bool(e.colour) for e in entries)
        words = max(map(len, name.split()), default=2)
        widths.append((min(max(longest, words), 20) + 1.6) * _letter(size))
    return [*widths[:-1], WIDTH - 2.0 * MARGIN - sum(widths[:-1])]
