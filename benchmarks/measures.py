"""Parts that the benchmarks share: measures, comparison with committed baselines, processes, tables."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, TypeVar

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
class OnScenes(Simulated):
    """Options of a benchmark that explores simulated scenes."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names of built-in scenes, or scene folders."""
    segmentation: SegmentationMethod = "labels"
    """Where segments come from."""

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

    def show(
        self,
        measure: Callable[[tuple[str, Any]], list[dict[str, Any]]],
        summary: Callable[[pd.DataFrame], dict[str, float]],
        console: Console,
    ) -> list[dict[str, Any]]:
        """Measure every scene, print a summary of each family, and return all rows."""
        rows = [row for part in self.each(measure, [(name, self) for name in self.scenes]) for row in part]
        frame = pd.DataFrame(rows)
        groups = {str(name): group for name, group in frame.groupby(frame["scene"].map(family))}
        shown = pd.DataFrame({name: summary(group) for name, group in (groups | {"all": frame}).items()})
        print_table(shown.round(3).rename_axis("scenes").reset_index(), console)
        self.write(rows)
        return rows


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
        rows = [(m.name, f"{m.value:.3f}", m.unit, m.better, f"{m.tolerance:.3g}") for m in found]
        columns = ["measure", "value", "unit", "better", "± tolerated"]
        print_table(pd.DataFrame(rows, columns=columns), console)
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
    console.print(table.to_string(index=False), markup=False, highlight=False, soft_wrap=True)


def run_main(main: Callable[[], int]) -> None:
    """Run a benchmark's main function, and exit with its status or its error."""
    try:
        sys.exit(main())
    except CaryatidError as error:
        sys.exit(f"error: {error}")
