"""How well the loop finds support graphs: F1 per view over scenes, planners, seeds, and on real frames.

    python benchmarks/accuracy.py suite [NAMES…] [--gate]
    python benchmarks/accuracy.py extract RECORDINGS… --segmentation labels

`suite` measures the settings the committed baseline is of (see `suites.py`), all where no NAMES are
given; with `--gate` it fails where a figure is worse than the baseline by more than its tolerance. RECORDINGS
are BOP folders with masks and gt.json. `caryatid benchmark` compares planners and settings over scenes.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import suites
import tyro
from episodes import THREADS, Episode, Extraction, Row, run
from measures import gate, read_baseline, write_baseline
from rich.console import Console
from tables import show

from caryatid.config import SegmentationMethod
from caryatid.errors import CaryatidError

BASELINE = Path(__file__).with_name("accuracy_baseline.json")
"""The committed figures."""


@dataclass(frozen=True)
class SuiteRun:
    """Measure the settings the committed baseline is of."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Suites. [default: all]"""
    seeds: int = 1
    """Seeds 0…n−1."""
    jobs: int = 4
    """Processes."""
    out: Path | None = None
    """JSON file for the rows of each suite."""
    gate: bool = False
    """Fail where a figure is worse than the committed baseline."""
    update: bool = False
    """Make the figures the committed baseline; those of other suites stay."""

    def run(self, console: Console) -> int:
        """Measure, print, and compare."""
        unknown = [name for name in self.names if name not in suites.SUITES]
        if unknown:
            raise CaryatidError(f"no suite '{unknown[0]}': choose from {', '.join(suites.SUITES)}")
        names = self.names or tuple(suites.SUITES)
        tasks = [(name, task) for name in names for task in suites.SUITES[name].tasks(self.seeds)]
        rows: dict[str, list[Row]] = {name: [] for name in names}
        for (name, _), part in zip(tasks, run_all([t for _, t in tasks], self.jobs), strict=True):
            rows[name] += part
        for name, part in rows.items():
            show(part, console, title=name)
        measures = suites.measures(rows)
        suites.show(measures, console)
        if self.out is not None:
            write_json({name: [asdict(r) for r in part] for name, part in rows.items()}, self.out)
        if self.update:
            others = [m for m in read_baseline(BASELINE) if m.name.split(".")[0] not in names]
            write_baseline([m for m in others if m.name.split(".")[0] in suites.SUITES] + measures, BASELINE)
        return gate(measures, BASELINE, console) if self.gate else 0


@dataclass(frozen=True)
class Extract:
    """Extract graphs from recordings, frame after frame, and score them."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """BOP folders with masks and gt.json."""
    segmentation: SegmentationMethod = "labels"
    """Where parts come from."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Settings, e.g. `--set registration.enabled=false`."""
    jobs: int = 4
    """Processes."""
    out: Path | None = None
    """JSON file for all rows."""

    def run(self, console: Console) -> int:
        """Extract and print."""
        tasks = [Extraction(str(folder), self.segmentation, self.set) for folder in self.recordings]
        return show_and_write(run_all(tasks, self.jobs), self.out, console)


def run_all(tasks: Iterable[Episode | Extraction], jobs: int) -> list[list[Row]]:
    """Rows of each task, run in processes."""
    for name in THREADS:
        os.environ.setdefault(name, "1")
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        return list(pool.map(run, tasks))


def show_and_write(parts: list[list[Row]], out: Path | None, console: Console) -> int:
    """Print all rows, write them where asked to."""
    rows = [row for part in parts for row in part]
    show(rows, console)
    if out is not None:
        write_json([asdict(r) for r in rows], out)
    return 0


def write_json(document: object, path: Path) -> None:
    """Write rows for other programs."""
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def main() -> int:
    """Run the measurement."""
    args = tyro.extras.subcommand_cli_from_dict({"suite": SuiteRun, "extract": Extract})
    return args.run(Console(width=160))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CaryatidError as error:
        sys.exit(f"error: {error}")
