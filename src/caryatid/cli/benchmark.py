"""`caryatid benchmark`: ways to look at clutter compared over scenes, sensors and seeds."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.names import PlannerName, SuiteName
from caryatid.cli.options import SAID, General, defaults_to, whole_number
from caryatid.config import FusionMethod, NoiseModel, SegmentationMethod

Count = Annotated[int | None, whole_number(1)]
CORES = os.cpu_count() or 1
"""Processes that are started where nobody says how many."""
GENERAL = General()


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Compare ways to look at clutter: methods × scenes × seeds, with figures.

    What is done is kept after every episode: stop it at any time and start it again. Without --suite the
    figures of what a folder holds are made again, and nothing is run.

    To try:
      caryatid benchmark --suite smoke --out bench
      caryatid benchmark --suite planners --planner support --planner random --out bench
      caryatid benchmark --suite fig5 --scenes my-scenes/ --seeds 1 --out bench
      caryatid benchmark --suite planners --segmentation auto --noise none --out bench
    """

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder of the results; those already there count."""
    suite: Annotated[SuiteName, SAID] = None
    """What to compare."""
    scenes: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="SCENE", help_behavior_hint="")
    ] = ()
    """Scenes in place of the suite's: a built-in name, a scene folder, a folder of them; may be repeated."""
    planner: Annotated[tyro.conf.UseAppendAction[tuple[PlannerName, ...]], SAID] = ()
    """Planner in place of the suite's methods; may be repeated. The others are compared with the first."""
    fusion: Annotated[tyro.conf.UseAppendAction[tuple[FusionMethod, ...]], SAID] = ()
    """Fusion in place of the suite's; may be repeated."""
    segmentation: Annotated[tyro.conf.UseAppendAction[tuple[SegmentationMethod, ...]], SAID] = ()
    """Where parts come from, in place of the suite's conditions; may be repeated. Without: labels."""
    noise: Annotated[tyro.conf.UseAppendAction[tuple[NoiseModel, ...]], SAID] = ()
    """Noise of the camera, in place of the suite's conditions; may be repeated. Without: carmine."""
    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="STAGE.NAME=VALUE", help_behavior_hint=""),
    ] = ()
    """One setting of all episodes, say `--set noise.translation=0.02`; may be repeated."""
    seeds: Annotated[Count, defaults_to("the suite's")] = None
    """Seeds 0…N−1 of every episode."""
    views: Annotated[Count, defaults_to("the suite's")] = None
    """Views of every episode, the first one too."""
    jobs: Annotated[Count, defaults_to(f"the cores of this machine, {CORES}")] = None
    """Processes of this machine."""
    scheduler: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="ADDRESS"), SAID] = None
    """Run on the workers of this dask.distributed scheduler instead, say tcp://10.0.0.5:8786."""
    retry: Annotated[bool, SAID] = False
    """Run episodes again that failed."""
    reference: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="METHOD"), SAID] = None
    """Method the others are compared with in the figures, in place of the suite's."""
    docs: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.md"), SAID] = None
    """Write the figures as a Markdown document too."""
    general: tyro.conf.OmitArgPrefixes[General] = GENERAL

    def __call__(self) -> int:
        """Run the command."""
        from caryatid.cli.benchmarking import run_benchmark

        return run_benchmark(self)
