"""`caryatid evaluate`: a run against the truth."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.options import General


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Score each view of a run: precision, recall and F1 of vertices and edges, mean IoU.

    To try:
      caryatid evaluate run scenes/tower
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, as explore and extract write it."""
    truth: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="GT")]
    """Scene folder (scene.xml and gt.json), or recording with masks and gt.json."""
    general: tyro.conf.OmitArgPrefixes[General] = field(default_factory=General)

    def __call__(self) -> int:
        """Run the command."""
        from rich.table import Table
        from rich.text import Text

        from caryatid.cli.consoles import result_console
        from caryatid.evaluation.truths import evaluate_run
        from caryatid.io.json_files import json_text

        scores = evaluate_run(self.run, self.truth)
        if self.general.json:
            sys.stdout.write(json_text({"views": [s.to_json() for s in scores]}))
            return 0
        table = Table(title=Text(f"{self.run} against {self.truth}"), title_justify="left")
        for column in ("view", "precision", "recall", "F1", "edge precision", "edge recall", "mean IoU"):
            table.add_column(column, justify="right")
        for view in scores:
            s = view.score
            figures = (s.precision, s.recall, s.f1, s.edge_precision, s.edge_recall, s.mean_iou)
            table.add_row(f"{view.view:02d}", *(f"{f:.3f}" for f in figures))
        result_console().print(table)
        return 0
