"""All rows of a benchmark as one table, a line a view: CSV and Parquet."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from caryatid.benchmark.records import Episode, Record, ViewRow
from caryatid.errors import InputError

MEMBER = ("method", "condition", "family")
"""Columns that say to what an episode belongs."""
COLUMNS: dict[str, type] = {
    **dict.fromkeys(MEMBER, str),
    **{f.name: int if f.type == "int" else str for f in fields(Episode)},
    **{f.name: int if f.type == "int" else float for f in fields(ViewRow)},
    "error": str,
}
"""Name and type of each column: whose the episode is, what determined it, what was measured, why it failed.

`settings` is a list in JSON, `views` how many views the episode was to have, and `view` the one the line is
about. An episode that failed has one line, with an error and no measures.
"""


def write_csv(records: Sequence[Record], path: Path) -> None:
    """Write all rows as CSV; numbers have all their digits, and what is missing is empty.

    Args:
        records: Of one suite.
        path: File to write.
    """
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(COLUMNS), lineterminator="\n")
        writer.writeheader()
        writer.writerows(_lines(records))


def write_parquet(records: Sequence[Record], path: Path) -> None:
    """Write all rows as Parquet, with the same columns as the CSV; what is missing is null.

    Args:
        records: Of one suite.
        path: File to write.

    Raises:
        InputError: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        remedy = 'pip install "caryatid[benchmark]"'
        raise InputError(path, "writing Parquet needs pyarrow", remedy) from error
    kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    schema = pyarrow.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    parquet.write_table(pyarrow.Table.from_pylist(_lines(records), schema=schema), path)


def _lines(records: Sequence[Record]) -> list[dict[str, Any]]:
    """The table, line by line; None where there is nothing."""
    lines = []
    for record in records:
        member, outcome = record.member, record.outcome
        known = {name: getattr(member, name) for name in MEMBER}
        known |= {f.name: getattr(member.episode, f.name) for f in fields(Episode)}
        known["settings"] = json.dumps(member.episode.settings, ensure_ascii=False)
        known["error"] = outcome.error
        for row in outcome.rows or (None,):
            measured = {f.name: None if row is None else getattr(row, f.name) for f in fields(ViewRow)}
            line = known | measured
            lines.append(
                {name: None if line[name] is None else kind(line[name]) for name, kind in COLUMNS.items()}
            )
    return lines
