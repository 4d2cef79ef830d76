"""Everything that is told of a result: tables for other programs, figures, one page, one document."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caryatid.benchmark.document import write_document
from caryatid.benchmark.export import write_csv, write_parquet
from caryatid.benchmark.figures import write_figures
from caryatid.benchmark.page import render_page
from caryatid.benchmark.provenance import Provenance
from caryatid.benchmark.sections import SuiteReport, report_suite
from caryatid.benchmark.statistics import summarise
from caryatid.benchmark.store import ResultStore
from caryatid.benchmark.suites import SUITES
from caryatid.errors import InputError

SEED = 0
"""Seed of the resamples, so that a result always gives the same figures."""


def report_all(store: ResultStore) -> list[SuiteReport]:
    """What there is to tell of every suite of which something is done.

    Args:
        store: A result.
    """
    reports = []
    for name in store.suites():
        records = store.records(name)
        if not records:
            continue
        known = SUITES.get(name)
        methods = {record.member.method for record in records}
        gap = known.gap if known is not None and methods.issuperset(known.gap or ()) else None
        reference = known.reference if known is not None and known.reference in methods else None
        summary = summarise(records, np.random.default_rng(SEED), reference=reference, gap=gap)
        reports.append(report_suite(name, "" if known is None else known.what, summary, store.planned(name)))
    return reports


def write_tables(store: ResultStore, folder: Path) -> list[str]:
    """Write all rows of each suite as `SUITE.csv` and, where pyarrow is installed, `SUITE.parquet`.

    Args:
        store: A result.
        folder: Where to.

    Returns:
        What is to be said: how to get what was left out.
    """
    for name in store.suites():
        write_csv(store.records(name), folder / f"{name}.csv")
    try:
        for name in store.suites():
            write_parquet(store.records(name), folder / f"{name}.parquet")
    except InputError as error:
        return [str(error)]
    return []


def write_page(reports: list[SuiteReport], store: ResultStore, folder: Path, command: str) -> Path:
    """Write `index.html`, and each suite's figures as SVG and PNG into a folder of its name.

    Args:
        reports: What there is to tell.
        store: The result.
        folder: Where to.
        command: What makes the page.

    Returns:
        The page.
    """
    for report in reports:
        write_figures(report.figures, folder / report.name)
    page = folder / "index.html"
    provenance = Provenance.from_strings(store.about())
    page.write_text(render_page(reports, provenance, command=command), encoding="utf-8")
    return page


def write_docs(reports: list[SuiteReport], store: ResultStore, path: Path, command: str) -> None:
    """Write the Markdown document, and its figures beside it.

    Args:
        reports: What there is to tell.
        store: The result.
        path: The document.
        command: What makes it.
    """
    provenance = Provenance.from_strings(store.about())
    write_document(reports, provenance, path, title="Benchmark", command=command)
