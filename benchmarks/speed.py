"""How long one turn of the loop takes: perceive, fuse and plan on VGA views of ten objects, after warm-up.

python benchmarks/speed.py [--gate]
"""

from __future__ import annotations

import resource
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from measures import Measure, gate, write_baseline
from rich.console import Console
from rich.table import Table

from caryatid.commands.sources import open_source
from caryatid.config import Config
from caryatid.exploration import explore

BASELINE = Path(__file__).with_name("speed_baseline.json")


@dataclass(frozen=True)
class Speed:
    """Time the stages of the loop."""

    scene: str = "pile-10-1"
    """Scene to explore."""
    views: int = 7
    """Views of which all but the first are timed."""
    gate: bool = False
    """Fail where the turn is slower than the committed baseline allows."""
    update: bool = False
    """Make the figures the committed baseline."""


def episode(args: Speed) -> list[dict[str, float]]:
    """Explore once and return the timings of each view [s]."""
    config = Config()
    config = replace(config, active=replace(config.active, max_views=args.views))
    source = open_source(args.scene, config, noise="carmine", segmentation="labels", seed=0)
    steps = explore(source.camera, source.robot, config=config, segmentation="labels", early_stop=False)
    return [step.timings for step in steps]


def main() -> int:
    """Run the measurement."""
    args = tyro.cli(Speed)
    console = Console()
    episode(replace(args, views=2))
    timings = episode(args)[:-1]
    stages = [s for s in timings[-1] if s != "capture"]
    table = Table(title=f"{args.scene}, one turn after warm-up, median of {len(timings)} views")
    table.add_column("stage")
    table.add_column("median [ms]", justify="right")
    table.add_column("highest [ms]", justify="right")
    for stage in ("capture", *stages):
        values = [1000.0 * t[stage] for t in timings]
        table.add_row(stage, f"{np.median(values):.0f}", f"{max(values):.0f}")
    turns = [sum(t[s] for s in stages) for t in timings]
    table.add_row("turn without capture", f"{1000 * np.median(turns):.0f}", f"{1000 * max(turns):.0f}")
    console.print(table)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    console.print(f"peak memory {peak:.0f} MB")
    turn = Measure("turn", float(np.median(turns)), "s", "lower", 0.3)
    found = [turn, Measure("memory", peak, "MB", "lower", 200.0)]
    if args.update:
        write_baseline(found, BASELINE)
    return gate(found, BASELINE, console) if args.gate else 0


if __name__ == "__main__":
    sys.exit(main())
