"""Rows of accuracy printed: one line a family of scenes and planner, and the worst scenes."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from episodes import Row, family, found, invented
from rich.console import Console
from rich.table import Table

COLUMNS = (
    ("scenes", "planner", "F1 by view", "edge P / R", "vertex P / R", "found", "invented", "IoU")
    + ("angle [rad]", "path [m]", "s/view")
)  # fmt: skip


def show(rows: list[Row], console: Console, title: str = "") -> None:
    """Print F1 per view and the rest of the last view, a line a family and planner, and the worst scenes."""
    last = max(r.view for r in rows)
    table = Table(title=f"{title} mean over scenes and seeds, views 1…{last + 1}".strip())
    for column in COLUMNS:
        table.add_column(column)
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[family(row.scene), row.planner].append(row)
        groups["easy" if family(row.scene) != "dense" else "all dense", row.planner].append(row)
    for (name, planner), part in sorted(groups.items()):
        table.add_row(f"{name} ({len({r.scene for r in part})})", planner, *_cells(part))
    console.print(table)
    worst = sorted((r for r in rows if r.view == last), key=lambda r: r.f1)[:6]
    console.print("lowest: " + ", ".join(f"{r.scene} ({r.planner}, seed {r.seed}) {r.f1:.3f}" for r in worst))


def _cells(rows: list[Row]) -> list[str]:
    """Figures of one line; a recording that is shorter than others counts where it ends."""
    last = max(r.view for r in rows)
    by_view = [[r for r in rows if r.view == v] for v in range(last + 1)]
    end = by_view[-1]

    def mean(name: str, part: list[Row] = end) -> float:
        return float(np.mean([getattr(r, name) for r in part]))

    return [
        " ".join(f"{mean('f1', view):.3f}" for view in by_view),
        f"{mean('edge_precision'):.3f} / {mean('edge_recall'):.3f}",
        f"{mean('vertex_precision'):.3f} / {mean('vertex_recall'):.3f}",
        f"{100.0 * found(end):.1f} %",
        f"{100.0 * invented(end):.1f} %",
        f"{mean('mean_iou'):.3f}",
        f"{mean('angle'):.2f}",
        f"{mean('path'):.2f}",
        f"{mean('seconds', rows):.2f}",
    ]
