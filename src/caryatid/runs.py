"""A run from its first step to its report: each step is kept and scored, the report drawn from the folder."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np

from caryatid.config import Config
from caryatid.evaluation.scores import Score, TrueScene, score
from caryatid.exploration import Step
from caryatid.graph import SupportGraph
from caryatid.io.staging import write_file
from caryatid.steps import RunWriter, read_config, read_run, read_steps
from caryatid.viz.pdf import render_pdf
from caryatid.viz.report import make_report, read_lifts, render_html

PACKAGES = ("caryatid", "mujoco", "numpy", "scipy", "numba", "shapely")
"""Packages whose versions run.json records."""


@dataclass(slots=True, kw_only=True)
class RunRecorder:
    """Keeps and scores the steps of a run, in a `with` block, and writes the run folder at its end.

    Ctrl-C ends the block: the views so far are kept. Any other error leaves nothing behind.

    Attributes:
        command: Name of the command.
        source: What is explored, as the user gave it.
        seed: Seed of every random choice.
        options: What run.json records of the options.
        config: All settings.
        folder: The run folder; None where none is wanted.
        truth: What is really there, where known.
        more: What else run.json is to hold.
        files: Further files of the folder: path in it → content.
        steps: What run.json records of each view: its number, its timings [s], angle and path so far.
        graphs: The fused graph after each view.
        scores: The score of each view, where the truth is known.
    """

    command: str
    source: str
    seed: int
    options: Mapping[str, object]
    config: Config
    folder: Path | None
    truth: TrueScene | None = None
    more: dict[str, Any] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    steps: list[dict[str, Any]] = field(default_factory=list)
    graphs: list[SupportGraph] = field(default_factory=list)
    scores: list[Score] = field(default_factory=list)
    _writer: RunWriter | None = None

    @property
    def views(self) -> int:
        """Number of views that are kept; an interrupt may come before the newest one is written."""
        return len(self.graphs) if self._writer is None else self._writer.views

    def keep(self, step: Step) -> Score | None:
        """Score a step and write it to the run folder; returns the score.

        Raises:
            InputError: The disk is full or refuses.
        """
        if self.truth is not None:
            self.scores.append(score(step.graph, self.truth, np.random.default_rng(0)))
        names = ("timings", "angle_travelled", "path_travelled", "stop")
        self.steps.append({"view": step.index} | {name: getattr(step, name) for name in names})
        self.graphs.append(step.graph)
        if self._writer is not None:
            self._writer.add(step)
        return self.scores[-1] if self.scores else None

    def __enter__(self) -> Self:
        self._writer = None if self.folder is None else RunWriter(self.folder)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        interrupted = isinstance(error, KeyboardInterrupt) and self.views > 0
        if self._writer is None:
            return
        with self._writer as writer:
            if error is None or interrupted:
                more = self.more | ({"interrupted": True} if interrupted else {})
                writer.finish(self.graphs[self.views - 1], self._record() | more, self.files)
        if interrupted:
            count = "1 view is" if self.views == 1 else f"{self.views} views are"
            reason = f"{count} kept in {self.folder}; `caryatid report {self.folder}` makes the report"
            raise KeyboardInterrupt(reason) from None

    def _record(self) -> dict[str, Any]:
        """What run.json holds."""
        last = self.steps[self.views - 1]
        record: dict[str, Any] = {
            "command": self.command,
            "source": self.source,
            "seed": self.seed,
            "options": dict(self.options),
            "settings": asdict(self.config),
            "versions": {"python": platform.python_version()} | {name: version(name) for name in PACKAGES},
            "angle_travelled": last["angle_travelled"],
            "path_travelled": last["path_travelled"],
            "steps": self.steps[: self.views],
        }
        if self.truth is not None:
            record["scores"] = [asdict(score) for score in self.scores[: self.views]]
        return record


def write_report(folder: Path, pdf: Path | None = None) -> list[Path]:
    """Draw the report of a run folder and write its report.html.

    Args:
        folder: The run.
        pdf: Where to write it as a PDF too.

    Returns:
        The files that were written.

    Raises:
        InputError: It is no run, a file in it is broken, or a file cannot be written; an older report.html
            is left as it was.
    """
    run = read_run(folder)
    config, record = read_config(run), run.record
    settings = {"source": record["source"], "seed": record["seed"]} | record["options"]
    settings |= {"fusion": config.fusion.method, "views": config.active.max_views}
    report = make_report(
        f"caryatid: {Path(record['source']).name}",
        read_steps(run),
        settings=settings,
        scores=record.get("scores", ()),
        strip=read_lifts(folder),
        config=config.report,
    )
    files = {} if pdf is None else {pdf: render_pdf(report)}
    files[folder / "report.html"] = render_html(report).encode()
    for path, content in files.items():
        write_file(path, content)
    return list(files)
