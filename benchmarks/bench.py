"""How fast it is: ours against open3d, pyransac3d, CGAL, volumetric planners and the machine's limit.

    python benchmarks/bench.py [--only turn fit.cylinder] [--quick] [--docs docs/performance] [--gate]

`make bench` installs the peers first and writes the page and the ratios to compare with; `make bench-gate`
compares. A peer that cannot be imported is a row that says so.
"""

from __future__ import annotations

import csv
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Annotated

import numba
import tyro
from measures import gate, read_baseline, write_baseline
from performance import limits, peers
from performance.calm import CALM, Watch
from performance.effort import FULL, QUICK, Effort
from performance.fitting import measure_fits
from performance.growth import AXES, Curve, measure_growth
from performance.mapping import measure_map
from performance.planning import measure_decision
from performance.rows import Row, measures
from performance.starting import measure_start
from performance.telling import COLUMNS, NOTHING, cells, notes
from performance.turns import measure_turns
from rich.console import Console
from rich.table import Table

from caryatid.benchmark.store import collect_provenance, describe_provenance
from caryatid.errors import CaryatidError, InputError

BASELINE = Path(__file__).with_name("performance_baseline.json")
"""The committed ratios."""

THREADS = ["omp", "tbb", "workqueue"]
"""Numba's threading layers, users' first: Open3D brings a TBB that numba would try, and warn of."""

Outcome = tuple[list[Row], list[Curve]]
Measurement = Callable[[Effort], Outcome]


def rows_only(measurement: Callable[[Effort], list[Row]], effort: Effort) -> Outcome:
    """A measurement that gives no curves."""
    return measurement(effort), []


MEASUREMENTS: dict[str, Measurement] = {
    "turn": partial(rows_only, measure_turns),
    "fit.cylinder": partial(rows_only, partial(measure_fits, "cylinder")),
    "fit.box": partial(rows_only, partial(measure_fits, "box")),
    "fit.sphere": partial(rows_only, partial(measure_fits, "sphere")),
    "decision": partial(rows_only, measure_decision),
    "map": partial(rows_only, measure_map),
    "start": partial(rows_only, measure_start),
    **{f"growth.{axis}": partial(measure_growth, axis) for axis in AXES},
}
"""Name → what is measured; `turn` gives the rows of perceiving and of the stages too."""


@dataclass(frozen=True)
class Bench:
    """Measure how fast it is."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PATTERN…")] = ()
    """What to measure, say `turn`, `fit` or `'growth.*'`. [default: all]"""
    quick: bool = False
    """Few runs and small sizes, in a few minutes: to see that it works, not to compare."""
    out: Path | None = None
    """JSON file for the rows and curves."""
    docs: Path | None = None
    """Folder for the tables the documentation shows: a CSV file for each group of rows."""
    gate: bool = False
    """Fail where a ratio is worse than the committed baseline allows."""
    update: bool = False
    """Make the ratios the committed baseline; those of what could not be measured stay."""


def selected(patterns: Sequence[str]) -> list[str]:
    """Names of the measurements that patterns, or beginnings of names, ask for; all where there are none.

    Raises:
        InputError: A pattern asks for nothing.
    """
    chosen = {p: [n for n in MEASUREMENTS if fnmatch(n, p) or n.startswith(f"{p}.")] for p in patterns}
    for pattern, names in chosen.items():
        if not names:
            raise InputError(
                "--only", f"nothing is called '{pattern}'", f"choose from {', '.join(MEASUREMENTS)}"
            )
    return [n for n in MEASUREMENTS if not patterns or any(n in names for names in chosen.values())]


def show(rows: Sequence[Row], console: Console) -> None:
    """Print the table."""
    table = Table(title="medians after warm-up")
    for column in COLUMNS:
        words = column in ("row", "what", "peer")
        table.add_column(column, justify="left" if words else "right", no_wrap=column != "what")
    for row in rows:
        table.add_row(*cells(row), style="red" if row.met is False else None)
    console.print(table)
    for note, which in notes(rows).items():
        console.print(f"{which}: {note}", highlight=False)
    wanted = [row for row in rows if row.target is not None]
    told = [sum(row.met is met for row in wanted) for met in (True, False, None)]
    console.print("targets: {} met, {} missed, {} not measured".format(*told))


def document(rows: Sequence[Row], curves: Sequence[Curve], disturbed: Sequence[str]) -> dict[str, object]:
    """Everything, for other programs."""
    figures = ("to_peer", "to_limit", "met")
    return {
        "machine": asdict(limits.machine()),
        "provenance": collect_provenance(),
        "peers": peers.versions(),
        "disturbed": list(disturbed),
        "rows": [asdict(row) | {name: getattr(row, name) for name in figures} for row in rows],
        "curves": [asdict(c) | {"exponent": c.exponent, "last_exponent": c.last_exponent} for c in curves],
    }


def write_docs(rows: Sequence[Row], folder: Path) -> None:
    """Write a CSV file for each group of rows, without empty columns, and what they were measured on."""
    folder.mkdir(exist_ok=True)
    for group in dict.fromkeys(row.group for row in rows):
        lines = [(*cells(row), row.note or NOTHING) for row in rows if row.group == group]
        columns = (*COLUMNS, "note")
        kept = [k for k in range(len(columns)) if any(line[k] != NOTHING for line in lines)]
        with (folder / f"{group}.csv").open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(
                [line[k] for k in kept] for line in [columns, *lines]
            )
    about = f"{describe_provenance(collect_provenance())}; {peers.versions()}"
    (folder / "machine.txt").write_text(f"Run by {about}.\n", encoding="utf-8")


def update(rows: Sequence[Row], patterns: Sequence[str]) -> None:
    """Make the ratios the baseline; those of rows not asked for, or without their peer, stay."""
    fresh = {m.name: m for m in measures(rows)}
    known = read_baseline(BASELINE) if BASELINE.is_file() else []
    wanting = {f"{row.name}{figure}" for row in rows for figure in ("", ".to_peer", ".to_limit")}
    kept = [m for m in known if m.name not in fresh and (patterns or m.name in wanting)]
    write_baseline([*kept, *fresh.values()], BASELINE)


def compare(rows_by_name: Mapping[str, Sequence[Row]], patterns: Sequence[str], console: Console) -> int:
    """Compare the ratios with the baseline; returns the exit status.

    What is worse is measured again, and the better figure counts: chance makes one worse more easily than
    better. What could not be measured, for want of a peer, is told and does not fail, unless nothing was.

    Args:
        rows_by_name: Rows of each of `MEASUREMENTS`.
        patterns: What was asked for; empty for all.
        console: Where it is told.
    """
    known = {m.name: m.value for m in read_baseline(BASELINE)}
    found = {m.name: m for part in rows_by_name.values() for m in measures(part)}
    if not patterns:
        for name in known:
            if name not in found:
                console.print(f"not measured: {name}")
    if not found:
        console.print("gate: no ratio was measured")
        return 1
    for name, part in rows_by_name.items():
        if any(m.worse_than(known.get(m.name, m.value)) for m in measures(part)):
            console.print(f"measuring {name} again, for what is worse")
            for again in measures(MEASUREMENTS[name](FULL)[0]):
                found[again.name] = min(again, found.get(again.name, again), key=lambda m: m.value)
    return gate(found.values(), BASELINE, console)


def measure(names: Sequence[str], effort: Effort, console: Console) -> tuple[dict[str, Outcome], list[str]]:
    """Measure one after the other; returns what came of each, and during which others held cores."""
    outcomes: dict[str, Outcome] = {}
    disturbed = []
    for name in names:
        console.print(f"measuring {name} …", end="")
        watch, started = Watch(), time.perf_counter()
        outcomes[name] = MEASUREMENTS[name](effort)
        console.print(f" {time.perf_counter() - started:.0f} s")
        if (others := watch.others()) > CALM:
            disturbed.append(name)
            console.print(f"other processes held {others:.1f} cores: figures of {name} are not right")
    return outcomes, disturbed


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, write and compare."""
    args = tyro.cli(Bench, args=arguments)
    if args.docs is not None and (args.only or args.quick):
        raise InputError("--docs", "the page is of all rows", "leave out --only and --quick")
    if args.quick and (args.update or args.gate):
        raise InputError("--quick", "its figures are no medians to compare", "leave it out")
    numba.config.THREADING_LAYER_PRIORITY = THREADS
    console = Console(width=None if sys.stdout.isatty() else 240)
    outcomes, disturbed = measure(selected(args.only), QUICK if args.quick else FULL, console)
    rows = [row for part, _ in outcomes.values() for row in part]
    curves = [curve for _, part in outcomes.values() for curve in part]
    show(rows, console)
    if args.out is not None:
        args.out.write_text(json.dumps(document(rows, curves, disturbed), indent=1) + "\n", encoding="utf-8")
    if args.docs is not None:
        write_docs(rows, args.docs)
    if args.update:
        update(rows, args.only)
    rows_by_name = {name: part for name, (part, _) in outcomes.items()}
    return compare(rows_by_name, args.only, console) if args.gate else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CaryatidError as error:
        sys.exit(f"error: {error}")
