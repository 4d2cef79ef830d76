"""All rows as CSV and Parquet: the same table, complete, to the last digit."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import astuple, fields, replace

import numpy as np
import pytest
from benchmark_records import make_record, make_suite

from caryatid.benchmark.export import COLUMNS, write_csv, write_parquet
from caryatid.benchmark.records import Episode, Record, ViewRow
from caryatid.errors import InputError


@pytest.fixture
def records():
    failed = make_record(error='it "fell", twice\nover', scene="/heaps/a b", views=3)
    episode = replace(failed.member.episode, settings=("active.x=[1, 2]", "voxels.size=0.02"), seed=2**40)
    return [
        *make_suite(["support", "zufällig"], scenes=3, seeds=2, views=3),
        Record(replace(failed.member, episode=episode), failed.outcome),
    ]


def read_csv(path):
    """Lines of a CSV with the types its columns are said to have."""
    with path.open(encoding="utf-8", newline="") as file:
        return [
            {
                name: None if said == "" and (name in MAY_MISS) else COLUMNS[name](said)
                for name, said in line.items()
            }
            for line in csv.DictReader(file)
        ]


MAY_MISS = {"error", *(f.name for f in fields(ViewRow))}


def test_both_hold_the_same_table(records, tmp_path):
    from pyarrow import parquet

    write_csv(records, tmp_path / "rows.csv")
    write_parquet(records, tmp_path / "rows.parquet")
    table = parquet.read_table(tmp_path / "rows.parquet")
    assert table.column_names == list(COLUMNS)
    assert [str(t) for t in table.schema.types] == [
        {str: "string", int: "int64", float: "double"}[kind] for kind in COLUMNS.values()
    ]
    assert table.to_pylist() == read_csv(tmp_path / "rows.csv")


def test_nothing_is_lost(records, tmp_path):
    write_csv(records, tmp_path / "rows.csv")
    lines = iter(read_csv(tmp_path / "rows.csv"))
    for record in records:
        for row in record.outcome.rows or (None,):
            line = next(lines)
            assert line["error"] == record.outcome.error
            assert tuple(line[f.name] for f in fields(ViewRow)) == (
                astuple(row) if row else (None,) * len(fields(ViewRow))
            )
            settings = tuple(json.loads(line["settings"]))
            episode = Episode(**{f.name: line[f.name] for f in fields(Episode)} | {"settings": settings})
            assert episode == record.member.episode
            for name in ("method", "condition", "family"):
                assert line[name] == getattr(record.member, name)
    assert next(lines, None) is None


def test_numbers_of_numpy_are_numbers(tmp_path):
    write_csv([make_record([np.float64(0.5)], [np.float32(0.25)])], tmp_path / "rows.csv")
    (line,) = read_csv(tmp_path / "rows.csv")
    assert (line["f1"], line["path"]) == (0.5, 0.25)


def test_same_records_same_bytes(records, tmp_path):
    for write in (write_csv, write_parquet):
        written = []
        for name in ("one", "two"):
            write(records, tmp_path / name)
            written.append((tmp_path / name).read_bytes())
        assert written[0] == written[1]


def test_without_pyarrow_it_says_what_to_install(records, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r'pip install "caryatid\[benchmark\]"'):
        write_parquet(records, tmp_path / "rows.parquet")
    assert not (tmp_path / "rows.parquet").exists()
