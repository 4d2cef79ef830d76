"""What the page says as Markdown, for a documentation: the figures beside it, fewer tables.

Of a suite with several conditions it says how they compare, not what the methods do under each.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from caryatid.benchmark.figures import Figure
from caryatid.benchmark.provenance import Provenance
from caryatid.benchmark.sections import SuiteReport, Table, by_condition, describe, explain, failures, tables

LEFT_OUT = ("vertex-f1-over-views", "mean-iou-over-views")
"""Figures the document does not show: what their names begin with."""


def write_document(
    suites: Sequence[SuiteReport], provenance: Provenance, path: Path, *, title: str, command: str
) -> None:
    """Write the document, and its figures into a folder of its name beside it: `benchmark.md`, `benchmark/…`.

    Args:
        suites: What there is to tell of.
        provenance: Which code on which machine ran the episodes.
        path: File to write.
        title: Heading of the document.
        command: What was typed to get it.
    """
    folder = path.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    for suite in suites:
        for figure in _shown(suite):
            (folder / _file(suite, figure)).write_text(figure.svg, encoding="utf-8")
    text = render_document(suites, provenance, title=title, command=command, folder=folder.name)
    path.write_text(text, encoding="utf-8")


def render_document(
    suites: Sequence[SuiteReport], provenance: Provenance, *, title: str, command: str, folder: str
) -> str:
    """Return the document; the same suites and provenance give the same text.

    Args:
        suites: What there is to tell of.
        provenance: Which code on which machine ran the episodes.
        title: Heading of the document.
        command: What was typed to get it.
        folder: Where the figures are, seen from the document.

    Raises:
        ValueError: There is no suite.
    """
    if not suites:
        raise ValueError("a document needs one suite at least")
    parts = [
        f"# {title}",
        f"Run by {provenance.code}, on {provenance.machine}. This page is generated:",
        f"```\n{command}\n```",
    ]
    for suite in suites:
        parts += [f"## {suite.name}", f"{_plain(suite.what)} {describe(suite)}"]
        parts += [_draw(figure, suite, folder) for figure in _shown(suite) if not figure.condition]
        combined = by_condition(suite.summary)
        if combined is not None:
            parts.append(_show(combined))
        for group in suite.summary.groups if combined is None else ():
            of = f", {group.family} scenes only" if group.family else ""
            parts.append(f"### {suite.name}: {_plain(group.condition)}{of}")
            here = [f for f in _shown(suite) if (f.condition, f.family) == (group.condition, group.family)]
            parts += [_draw(figure, suite, folder) for figure in here]
            parts += [_show(table) for table in tables(group, suite.summary, brief=True)]
            if group.budget > 0.0 and not group.taken:
                parts.append(f"F1 along the path is over {group.budget:.2f} m.")
        if suite.summary.failures:
            parts.append(_show(failures(suite.summary)))
    parts += ["## How to read it", *explain(suites[0].summary.config)]
    return "\n\n".join(parts) + "\n"


def _shown(suite: SuiteReport) -> list[Figure]:
    several = len(suite.summary.conditions) > 1
    return [
        figure
        for figure in suite.figures
        if not figure.name.startswith(LEFT_OUT) and not (several and figure.condition)
    ]


def _file(suite: SuiteReport, figure: Figure) -> str:
    return f"{re.sub(r'[^a-z0-9]+', '-', suite.name.lower())}-{figure.name}.svg"


def _draw(figure: Figure, suite: SuiteReport, folder: str) -> str:
    return f"![{_plain(figure.title)}]({folder}/{_file(suite, figure)})\n\n*{_plain(figure.caption)}*"


def _show(table: Table) -> str:
    lines = [
        f"**{_plain(table.title)}.** {_plain(table.note)}".rstrip(),
        "",
        "| " + " | ".join(_plain(name) for name in table.head) + " |",
        "|" + " --- |" * len(table.head),
    ]
    for r, row in enumerate(table.rows):
        cells = [
            f"**{_plain(cell)}**" if (r, c) in table.strong else _plain(cell) for c, cell in enumerate(row)
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _plain(text: str) -> str:
    """Text that means nothing but itself in Markdown."""
    return re.sub(r"([\\`*_<>|~]|\](?=[(\[]))", r"\\\1", " ".join(text.split()))
