"""A measure: name, value, unit, direction and tolerance; and the comparison with a committed baseline."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Measure:
    """One figure of a benchmark.

    Attributes:
        name: What was measured.
        value: Its value.
        unit: `1` for shares, `s` for seconds.
        better: Which way is better, `higher` or `lower`.
        tolerance: How much worse than the baseline it may be, in its unit.
    """

    name: str
    value: float
    unit: str
    better: str
    tolerance: float

    def worse_than(self, baseline: float) -> bool:
        """Whether it is worse than the baseline by more than the tolerance."""
        loss = baseline - self.value if self.better == "higher" else self.value - baseline
        return loss > self.tolerance


def write_baseline(measures: Iterable[Measure], path: Path) -> None:
    """Write measures as the baseline to compare with from now on."""
    document = {m.name: asdict(m) for m in measures}
    path.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def read_baseline(path: Path) -> list[Measure]:
    """Read the measures of a baseline."""
    return [Measure(**known) for known in json.loads(path.read_text(encoding="utf-8")).values()]


def gate(measures: Iterable[Measure], path: Path, console: Console) -> int:
    """Compare with a baseline; returns the exit status, 1 where a measure is worse than it may be."""
    baseline = json.loads(path.read_text(encoding="utf-8"))
    failed = 0
    for measure in measures:
        known = baseline.get(measure.name)
        if known is None:
            console.print(f"new: {measure.name} = {measure.value:.4g} {measure.unit}")
        elif measure.worse_than(known["value"]):
            failed += 1
            console.print(
                f"worse: {measure.name} = {measure.value:.4g} {measure.unit}, "
                f"was {known['value']:.4g} ± {measure.tolerance:g}"
            )
    console.print("gate: " + (f"{failed} measures are worse" if failed else "nothing is worse"))
    return min(failed, 1)


def show(title: str, measures: Iterable[Measure], targets: Mapping[str, float], console: Console) -> None:
    """Print measures beside what is asked for."""
    table = Table(title=title)
    for column in ("measure", "value", "unit", "± tolerated", "asked for"):
        table.add_column(column)
    for m in measures:
        target, sign = targets.get(m.name), "≥" if m.better == "higher" else "≤"
        missed = target is not None and (m.value < target if m.better == "higher" else m.value > target)
        asked = "" if target is None else f"{sign} {target:g}" + (" missed" if missed else "")
        table.add_row(m.name, f"{m.value:.3f}", m.unit, f"{m.tolerance:.3g}", asked)
    console.print(table)
