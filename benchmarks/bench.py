"""How fast it is: ours against open3d, pyransac3d, CGAL, volumetric planners and the machine's limit.

    python benchmarks/bench.py [--only turn fit.cylinder] [--quick] [--docs docs/performance] [--gate]

`make bench` installs the peers first and writes the page and the ratios to compare with; `make bench-gate`
compares. A peer that cannot be imported is a row that says so.
"""

from __future__ import annotations

import json
import os
import sys
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
"""Numba's threading layers, users' first: Open3D brings a TBB that numba would try, and warn of."""
CALM = 0.2
"""So many cores taken by others before a measurement are a system's own business [1]."""
MEASUREMENTS: dict[str, Callable[[Effort], list[Row]]] = {
    "turn": speed.measure_turns,
    **{f"fit.{kind}": partial(measure_fits, kind) for kind in ("cylinder", "box", "sphere")},
    "decision": speed.measure_decision,
    "map": speed.measure_map,
    "real": speed.measure_real,
    "start": speed.measure_start,
    **{f"growth.{axis}": partial(speed.measure_growth, axis) for axis in speed.AXES},
    "large": speed.measure_large,
    "viewer": measure_viewer,
}
"""Name → what is measured; `turn` gives the rows of perceiving and of the stages too."""


@dataclass(frozen=True)
class Bench:
    """Measure how fast it is."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME…")] = ()
    """What to measure, say `turn`, `fit` or `growth.views`. [default: all]"""
    quick: bool = False
    """Few runs and small sizes, in a few minutes: to see that it works, not to compare."""
    real: Path = FULL.real
    """Folder of recordings of real frames, BOP folders."""
    out: Path | None = None
    """JSON file for the rows."""
    docs: Path | None = None
    """Folder for the tables the documentation shows: a CSV file for each group of rows."""
    gate: bool = False
    """Fail where a ratio is worse than the committed baseline allows."""
    update: bool = False
    """Make the ratios the committed baseline; those of what could not be measured stay."""


def selected(wanted: Sequence[str]) -> list[str]:
    """Names of the measurements that names or beginnings of names ask for; all where there are none."""
    chosen = [n for n in MEASUREMENTS if not wanted or f"{n}.".startswith(tuple(f"{w}." for w in wanted))]
    if not chosen:
        raise InputError("--only", "Nothing is called so", f"choose from {', '.join(MEASUREMENTS)}")
    return chosen


def show(rows: Sequence[Row], console: Console) -> None:
    """Print the table."""
    print_table(table_of_rows(rows).drop(columns="note"), console)
    for note in dict.fromkeys(row.note for row in rows if row.note):
        console.print(f"{next(row.name for row in rows if row.note == note)}: {note}", highlight=False)
    wanted = [row for row in rows if row.target is not None]
    told = [sum(row.met is met for row in wanted) for met in (True, False, None)]
    console.print("targets: {} met, {} missed, {} not measured".format(*told))


def write_docs(rows: Sequence[Row], folder: Path) -> None:
    """Write a CSV file for each group of rows, without empty columns, and what they were measured on."""
    folder.mkdir(exist_ok=True)
    table = table_of_rows(rows)
    for group, part in table.groupby(table["row"].str.split(".").str[0], sort=False):
        shown = part.loc[:, (part != NOTHING).any()]
        shown.to_csv(folder / f"{group}.csv", index=False, lineterminator="\n")
    about = f"{describe_provenance(collect_provenance())}; {peers.versions()}"
    (folder / "machine.txt").write_text(f"Run by {about}.\n", encoding="utf-8")


def compare(rows_by_name: Mapping[str, Sequence[Row]], part: bool, console: Console) -> int:
    """Compare the ratios with the baseline; returns the exit status.

    What is worse is measured again, and the better figure counts: chance makes one worse more easily than
    better. What could not be measured, for want of a peer, is reported and does not fail, unless nothing was.
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
            console.print(f"measuring {name} again, for what is worse")
            for again in measures(MEASUREMENTS[name](FULL)):
                found[again.name] = min(again, found.get(again.name, again), key=lambda m: m.value)
    return gate(found.values(), BASELINE, console)


def main() -> int:
    """Measure, print, write and compare."""
    args = tyro.cli(Bench)
    if args.docs is not None and (args.only or args.quick):
        raise InputError("--docs", "the page is of all rows", "leave out --only and --quick")
    if args.quick and (args.update or args.gate):
        raise InputError("--quick", "its figures are no medians to compare", "leave it out")
    numba.config.THREADING_LAYER_PRIORITY = THREADS
    console = Console(width=None if sys.stdout.isatty() else 240)
    rows_by_name: dict[str, list[Row]] = {}
    for name in selected(args.only):
        busy = psutil.cpu_percent(0.5) / 100.0 * (os.cpu_count() or 1)
        if busy > CALM:
            console.print(f"other processes hold {busy:.1f} cores: figures of {name} are not right")
        console.print(f"measuring {name} …", end="")
        started = time.perf_counter()
        rows_by_name[name] = MEASUREMENTS[name](replace(QUICK if args.quick else FULL, real=args.real))
        console.print(f" {time.perf_counter() - started:.0f} s")
    rows = [row for part in rows_by_name.values() for row in part]
    show(rows, console)
    if args.out is not None:
        told = [
            asdict(row) | {"to_peer": row.to_peer, "to_limit": row.to_limit, "met": row.met} for row in rows
        ]
        about = {"machine": machine(), "provenance": collect_provenance(), "peers": peers.versions()}
        args.out.write_text(json.dumps(about | {"rows": told}, indent=1) + "\n", encoding="utf-8")
    if args.docs is not None:
        write_docs(rows, args.docs)
    if args.update:  # the ratios of rows not asked for, or without their peer, stay
        known = {f"{row.name}{figure}" for row in rows for figure in ("", ".to_peer", ".to_limit")}
        update_baseline(measures(rows), BASELINE, lambda name: bool(args.only) or name in known)
    return compare(rows_by_name, bool(args.only), console) if args.gate else 0


if __name__ == "__main__":
    run_main(main)
