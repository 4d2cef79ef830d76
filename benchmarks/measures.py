"""Parts that the benchmarks share: measures, comparison with committed baselines, processes, tables."""

from __future__ import annotations

import json
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
import pandas as pd
import tyro
from rich.console import Console

from caryatid.benchmark.episodes import family
from caryatid.config import Config, NoiseModel, SegmentationMethod
from caryatid.errors import CaryatidError
from caryatid.exploration import Explorer
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.world import SimulatedScene

T = TypeVar("T")
R = TypeVar("R")
Row = dict[str, Any]


@dataclass(frozen=True)
class Measure:
    """One figure of a benchmark; `better` is `higher` or `lower`, and the tolerance is in `unit`."""

    name: str
    value: float
    unit: str
    better: str
    tolerance: float

    def worse_than(self, baseline: float, tolerance: float = 0.0) -> bool:
        """Return whether it is worse than a baseline by more than a tolerance."""
        loss = baseline - self.value if self.better == "higher" else self.value - baseline
        return loss > tolerance


@dataclass(frozen=True)
class Spread:
    """Options of a benchmark that spreads its tasks over processes."""

    jobs: int = 4
    """Number of processes."""
    out: Path | None = None
    """Write all rows to this JSON file."""

    def each(self, function: Callable[[T], R], tasks: Sequence[T], chunk: int = 1) -> list[R]:
        """Apply a function to each task, in several processes."""
        for library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
            os.environ.setdefault(f"{library}_NUM_THREADS", "1")
        with ProcessPoolExecutor(self.jobs, get_context("spawn")) as pool:
            return list(pool.map(function, tasks, chunksize=chunk))

    def write(self, rows: Any) -> None:
        """Write the rows to `out`, if it is given."""
        if self.out is not None:
            self.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class Simulated(Spread):
    """Options of a benchmark on simulated views."""

    noise: NoiseModel = "carmine"
    """Noise of the simulated camera."""
    seed: int = 0
    """Seed of the noise and of the choice of objects."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Settings, e.g. `--set active.effort=0.1`."""


@dataclass(frozen=True)
class OnScenes(Simulated, ABC):
    """A benchmark that explores simulated scenes; subclasses say what is measured and how it is summed up."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names of built-in scenes, or scene folders."""
    segmentation: SegmentationMethod = "labels"
    """Where segments come from."""
    groups: ClassVar[str] = "family"
    """Column whose values each get a summary."""

    @abstractmethod
    def measure(self, name: str) -> list[Row]:
        """Measure one scene."""

    @abstractmethod
    def summary(self, rows: pd.DataFrame) -> dict[str, float]:
        """Sum up rows."""

    def remark(self, row: Row) -> str:
        """What to print of a row; by default nothing."""
        return ""

    def start(self, scene: SimulatedScene, config: Config, **known: Any) -> tuple[Any, Explorer]:
        """Return the simulated camera in a scene, and an exploration with it."""
        simulation = make_simulation(scene, config, noise=self.noise, seed=self.seed)
        known |= {"segmentation": self.segmentation, "seed": self.seed, "config": config}
        return simulation.camera, Explorer(simulation.camera, simulation.robot, **known)

    def drawn(self, name: str, labels: Sequence[int], goals: int) -> list[int]:
        """Draw the labels of the goals in a scene."""
        rng = np.random.default_rng([self.seed, self.scenes.index(name)])
        chosen: list[int] = rng.choice(labels, min(goals, len(labels)), replace=False).tolist()
        return chosen

    def run(self, console: Console) -> int:
        """Measure every scene, and print a summary of each group of rows, and remarks."""
        rows = [row for part in self.each(self.measure, self.scenes) for row in part]
        frame = pd.DataFrame(rows)
        frame["family"] = frame["scene"].map(family)
        groups = {str(name): self.summary(group) for name, group in frame.groupby(self.groups, sort=False)}
        shown = pd.DataFrame(groups | {"all": self.summary(frame)})
        print_table(shown.round(3).rename_axis("scenes").reset_index(), console)
        for remark in filter(None, map(self.remark, rows)):
            console.print(remark)
        self.write(rows)
        return 0


@dataclass(frozen=True)
class Gated(Spread):
    """Options of a benchmark with a committed baseline."""

    gate: bool = False
    """Fail if a figure is worse than the committed baseline allows."""
    update: bool = False
    """Write the figures to the committed baseline; suites that were not run keep theirs."""

    def finish(
        self,
        found: Sequence[Measure],
        baseline: Path,
        console: Console,
        kept: Callable[[str], bool] = lambda name: False,
    ) -> int:
        """Print measures, write and compare them as the options ask, and return the exit status.

        Baseline entries that were not measured stay if `kept` returns True for their names.
        """
        table = pd.DataFrame(map(asdict, found)).rename(columns={"tolerance": "± tolerated"})
        print_table(table.round(3), console)
        if self.update:
            update_baseline(found, baseline, kept)
        return gate(found, baseline, console) if self.gate else 0


def update_baseline(found: Iterable[Measure], path: Path, kept: Callable[[str], bool]) -> None:
    """Write measures as the baseline; other entries stay if `kept` returns True for their names."""
    values = {name: value for name, value in read_baseline(path).items() if kept(name)}
    values |= {m.name: m.value for m in found}
    path.write_text(json.dumps(values, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def read_baseline(path: Path) -> dict[str, float]:
    """Read a baseline: the value of each measure by name."""
    values: dict[str, float] = json.loads(path.read_text(encoding="utf-8"))
    return values


def gate(measures: Iterable[Measure], path: Path, console: Console) -> int:
    """Compare with a baseline, and return the exit status: 1 if a measure is worse than tolerated."""
    baseline, failed = read_baseline(path), 0
    for m in measures:
        if m.name not in baseline:
            console.print(f"new: {m.name} = {m.value:.4g} {m.unit}")
        elif m.worse_than(baseline[m.name], m.tolerance):
            failed += 1
            was = f"was {baseline[m.name]:.4g} ± {m.tolerance:g}"
            console.print(f"worse: {m.name} = {m.value:.4g} {m.unit}, {was}")
    console.print("gate: " + (f"{failed} measures are worse" if failed else "no measure is worse"))
    return min(failed, 1)


def print_table(table: pd.DataFrame, console: Console) -> None:
    """Print a whole table."""
    console.print(table.to_string(index=False))


def run_main(command: Any) -> None:
    """Parse the options of a benchmark, or of one of several by name, and exit with its status or error."""
    try:
        args = (
            tyro.extras.subcommand_cli_from_dict(command) if isinstance(command, dict) else tyro.cli(command)
        )
        sys.exit(args.run(Console(soft_wrap=True, highlight=False, markup=False, emoji=False)))
    except CaryatidError as error:
        sys.exit(f"error: {error}")
