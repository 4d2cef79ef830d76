"""`caryatid extract`: the scene model from all views of a recording, or from one cloud; no planning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from caryatid.cli.options import (
    SAID,
    ModellingCommand,
    OutPath,
    Profile,
    defaults_to,
    one_of,
    whole_number,
)
from caryatid.config import SegmentationMethod


@dataclass(frozen=True, kw_only=True)
class Extract(ModellingCommand):
    """Extract shapes and support graph from all views of a recording, or from one cloud.

    To try:
      caryatid extract recording/ --out run
      caryatid extract table.pcd --segmentation auto --out run
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Recording (folder in the BOP format) or cloud (.pcd, .ply)."""
    out: OutPath
    """Run folder to write; a run already there is replaced."""
    segmentation: Annotated[
        SegmentationMethod | None, one_of(SegmentationMethod), defaults_to("labels where the source has them")
    ] = None
    """Where parts come from: the masks or labels that are given, or automatic."""
    label_divisor: Annotated[int, whole_number(1)] = 1
    """For clouds whose labels number parts: object = label // N."""
    no_report: Annotated[bool, SAID] = False
    """Leave report.html out."""
    profile: Profile = False
    """Print the time of each stage when all is done; with --json into the document."""

    def __call__(self) -> int:
        """Run the command."""
        config = self.modelling.settings()
        from caryatid.cli.extracting import run_extraction

        return run_extraction(self, config)
