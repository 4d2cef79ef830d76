"""Everything that is told of a result: tables for other programs, figures, one page, one document."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caryatid.benchmark.document import write_document
from caryatid.benchmark.export import write_csv, write_parquet
from caryatid.benchmark.figures import write_figures
from caryatid.benchmark.page import render_page
from caryatid.benchmark.provenance import Provenance
from caryatid.benchmark.records import Record
from caryatid.benchmark.sections import SuiteReport, report_suite
from caryatid.benchmark.statistics import summarise
from caryatid.benchmark.store import ResultStore
from caryatid.benchmark.suites import SUITES
from caryatid.errors import InputError

SEED = 0
"""Seed of the resamples, so that a result always gives the same figures."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a store holds of one suite.

    Attributes:
        name: Of the suite.
        records: What is done of it.
        planned: How many episodes it has.
    """

    name: str
    records: Sequence[Record]
    planned: int

    def said(self) -> str:
        """How much of it is done, in a line."""
        failed = sum(record.outcome.error is not None for record in self.records)
        done = f"{len(self.records)} of {self.planned} episodes"
        return f"{self.name}: {done}, {failed} failed" if failed else f"{self.name}: {done}"


def read_results(store: ResultStore) -> list[Result]:
    """Read every suite that was asked for, in the order in which suites are listed."""
    place = {name: k for k, name in enumerate(SUITES)}
    names = sorted(store.suites(), key=lambda name: place.get(name, len(place)))
    return [Result(name, store.records(name), store.planned(name)) for name in names]


def report_all(results: Sequence[Result], reference: str | None = None) -> list[SuiteReport]:
    """What there is to tell of every suite of which something is done.

    Args:
        results: Of a store.
        reference: Method the others are compared with, in the suites that have it, in place of the suite's.

    Raises:
        InputError: No suite has such a method.
    """
    check_reference(reference, {r.member.method: None for result in results for r in result.records})
    reports = []
    for result in results:
        if not result.records:
            continue
        known = SUITES.get(result.name)
        methods = {record.member.method for record in result.records}
        gap = known.gap if known is not None and methods.issuperset(known.gap or ()) else None
        wanted = (reference, None if known is None else known.reference)
        chosen = next((name for name in wanted if name in methods), None)
        summary = summarise(result.records, np.random.default_rng(SEED), reference=chosen, gap=gap)
        what = "" if known is None else known.what
        reports.append(report_suite(result.name, what, summary, result.planned))
    return reports


def check_reference(reference: str | None, methods: Collection[str]) -> None:
    """Refuse to compare with a method that is not there.

    Args:
        reference: The method, or None for the suite's own.
        methods: Those there are.

    Raises:
        InputError: It is none of them.
    """
    if reference is not None and reference not in methods:
        names = ", ".join(methods) or "none yet"
        raise InputError(f"--reference {reference}", "there is no such method", f"choose one of {names}")


def write_tables(results: Sequence[Result], folder: Path) -> list[str]:
    """Write all rows of each suite as `SUITE.csv` and, where pyarrow is installed, `SUITE.parquet`.

    Args:
        results: Of a store.
        folder: Where to.

    Returns:
        What is to be said: how to get what was left out.
    """
    for result in results:
        write_csv(result.records, folder / f"{result.name}.csv")
    try:
        for result in results:
            write_parquet(result.records, folder / f"{result.name}.parquet")
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
