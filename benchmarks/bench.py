"""Measure speed: ours against open3d, pyransac3d, CGAL, volumetric planners and the machine's limit.

    python benchmarks/bench.py [--only turn fit.cylinder] [--quick] [--docs docs/performance] [--gate]

`make bench` installs the peers, writes the tables of the documentation, and updates the baseline ratios;
`make bench-gate` compares with them. If a peer cannot be imported, its row says so.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numba
import peers
import psutil
import speed
import tyro
from fit_speed import measure_fits
from measures import gate, print_table, read_baseline, run_main, update_baseline
from rich.console import Console
from rows import FULL, NOTHING, QUICK, Effort, Row, machine, measures, table_of_rows
from viewer import measure_viewer

from caryatid.benchmark.store import collect_provenance, describe_provenance
from caryatid.errors import InputError

BASELINE = Path(__file__).with_name("performance_baseline.json")
"""The committed ratios."""
THREADS = ["omp", "tbb", "workqueue"]
"""Numba's threading layers, first the one users get; numba would otherwise try Open3D's TBB, and warn."""
CALM = 0.2
"""Background load: cores that other processes may use before a measurement without a warning [1]."""
MEASUREMENTS: dict[str, Callable[[Effort], list[Row]]] = {
    "turn": speed.measure_turns,
    "beside": speed.measure_beside,
    **{f"fit.{kind}": partial(measure_fits, kind) for kind in ("cylinder", "box", "sphere")},
    "decision": speed.measure_decision,
    "map": speed.measure_map,
    "real": speed.measure_real,
    "budget": speed.measure_budget,
    "start": speed.measure_start,
    **{f"growth.{axis}": partial(speed.measure_growth, axis) for axis in speed.AXES},
    "large": speed.measure_large,
    "viewer": measure_viewer,
}
"""Name → measurement; `turn` also gives the rows of perception and of the stages."""


@dataclass(frozen=True)
class Bench:
    """Measure speed."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME…")] = ()
    """Measurements to run, e.g. `turn`, `fit` or `growth.views`. [default: all]"""
    quick: bool = False
    """Do few runs at small sizes, in a few minutes: a check that the benchmark works, not for comparison."""
    real: Path = FULL.real
    """Folder that holds recordings of real frames (BOP folders)."""
    out: Path | None = None
    """Write the rows to this JSON file."""
    docs: Path | None = None
    """Write the documentation's tables to this folder: one CSV file per group of rows."""
    gate: bool = False
    """Fail if a ratio is worse than the committed baseline allows."""
    update: bool = False
    """Write the ratios to the committed baseline; ratios that could not be measured keep their values."""

    def run(self, console: Console) -> int:
        """Measure, print, write and compare."""
        if self.docs is not None and (self.only or self.quick):
            raise InputError("--docs", "the page needs all rows", "omit --only and --quick")
        if self.quick and (self.update or self.gate):
            raise InputError("--quick", "its figures cannot be compared", "omit it")
        numba.config.THREADING_LAYER_PRIORITY = THREADS
        rows_by_name: dict[str, list[Row]] = {}
        for name in selected(self.only):
            busy = psutil.cpu_percent(0.5) / 100.0 * (os.cpu_count() or 1)
            if busy > CALM:
                console.print(f"other processes use {busy:.1f} cores: the figures of {name} are unreliable")
            console.print(f"measuring {name} …", end="")
            started = time.perf_counter()
            rows_by_name[name] = MEASUREMENTS[name](replace(QUICK if self.quick else FULL, real=self.real))
            console.print(f" {time.perf_counter() - started:.0f} s")
        rows = [row for part in rows_by_name.values() for row in part]
        show(rows, console)
        if self.out is not None:
            told = [
                asdict(row) | {"to_peer": row.to_peer, "to_limit": row.to_limit, "met": row.met}
                for row in rows
            ]
            about = {"machine": machine(), "provenance": collect_provenance(), "peers": peers.versions()}
            self.out.write_text(json.dumps(about | {"rows": told}, indent=1) + "\n", encoding="utf-8")
        if self.docs is not None:
            write_docs(rows, self.docs)
        if self.update:  # keep the ratios of rows that were not requested or lack their peer
            known = {f"{row.name}{figure}" for row in rows for figure in ("", ".to_peer", ".to_limit")}
            update_baseline(measures(rows), BASELINE, lambda name: bool(self.only) or name in known)
        return compare(rows_by_name, bool(self.only), console) if self.gate else 0


def selected(wanted: Sequence[str]) -> list[str]:
    """Return the measurements whose names equal or begin with the wanted names; all if none are given."""
    chosen = [n for n in MEASUREMENTS if not wanted or f"{n}.".startswith(tuple(f"{w}." for w in wanted))]
    if not chosen:
        raise InputError("--only", "no measurement has this name", f"choose from {', '.join(MEASUREMENTS)}")
    return chosen


def show(rows: Sequence[Row], console: Console) -> None:
    """Print the table, its notes, and the number of targets met."""
    print_table(table_of_rows(rows).drop(columns="note"), console)
    for note in dict.fromkeys(row.note for row in rows if row.note):
        console.print(f"{next(row.name for row in rows if row.note == note)}: {note}", highlight=False)
    wanted = [row for row in rows if row.target is not None]
    told = [sum(row.met is met for row in wanted) for met in (True, False, None)]
    console.print("targets: {} met, {} missed, {} not measured".format(*told))


def write_docs(rows: Sequence[Row], folder: Path) -> None:
    """Write one CSV file per group of rows, without empty columns, and a description of the machine."""
    folder.mkdir(exist_ok=True)
    table = table_of_rows(rows)
    for group, part in table.groupby(table["row"].str.split(".").str[0], sort=False):
        shown = part.loc[:, (part != NOTHING).any()]
        shown.to_csv(folder / f"{group}.csv", index=False, lineterminator="\n")
    about = f"{describe_provenance(collect_provenance())}; {peers.versions()}"
    (folder / "machine.txt").write_text(f"Run by {about}.\n", encoding="utf-8")


def compare(rows_by_name: Mapping[str, Sequence[Row]], part: bool, console: Console) -> int:
    """Compare the ratios with the baseline, and return the exit status.

    A worse ratio is measured again, with the machine's speed, and the better figure counts: noise slows a run
    more often than it speeds one up. Ratios that lack a peer are reported; the gate fails only if no ratio
    was measured.
    """
    known = read_baseline(BASELINE)
    found = {m.name: m for rows in rows_by_name.values() for m in measures(rows)}
    for name in [] if part else [n for n in known if n not in found]:
        console.print(f"not measured: {name}")
    if not found:
        console.print("gate: no ratio was measured")
        return 1
    for name, rows in rows_by_name.items():
        if any(m.worse_than(known.get(m.name, m.value)) for m in measures(rows)):
            console.print(f"measuring {name} again, because a ratio is worse")
            machine.cache_clear()
            for again in measures(MEASUREMENTS[name](FULL)):
                found[again.name] = min(again, found.get(again.name, again), key=lambda m: m.value)
    return gate(found.values(), BASELINE, console)


if __name__ == "__main__":
    run_main(Bench)
