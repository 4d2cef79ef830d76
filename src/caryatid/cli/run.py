"""`caryatid demo`, `explore`, `extract` and `dismantle`: commands that write a run folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from caryatid.cli.options import (
    Count,
    ExploringCommand,
    Flag,
    ModellingCommand,
    OptionalCount,
    OptionalPath,
    OutPath,
    Segmentation,
    SourceName,
    defaults_to,
    shown_as,
)
from caryatid.errors import InputError

if TYPE_CHECKING:
    from caryatid.cli.output import Output
    from caryatid.config import Config
    from caryatid.exploration import Step
    from caryatid.io.runs import RunWriter
    from caryatid.runs import RunRecorder
    from caryatid.sources import Source
    from caryatid.viewer.process import PageProcess

DEMO_VIEWS = 5
"""Views of the demo [1]: half as many as usual, enough for its scene."""


@dataclass(frozen=True, kw_only=True)
class Explore(ExploringCommand):
    """Explore a scene until it is known which object supports which.

    SOURCE is one of
      an MJCF scene: an .xml file, or the folder of a scene.xml; robot and camera are simulated
      the name of a built-in scene: tower, clutter, pile-8-0, dense-12-0, …
      a recording: a folder in the BOP format; the camera can only be where a recorded view is

    To try:
      caryatid explore tower --noise carmine --out run
      caryatid explore scene.xml --views 5 --out run
      caryatid explore tower --robot arm:arm.npz --out run
      caryatid explore recording/ --segmentation auto --out run
    """

    source: SourceName
    """Scene or recording."""
    out: OutPath
    """Run folder to write; replaces an earlier run."""
    no_early_stop: Flag = False
    """Continue to the maximum number of views; otherwise stop when a view changes nothing."""
    no_report: Flag = False
    """Leave out report.html."""
    view: Flag = False
    """Show every view in the browser; the page then stays until Ctrl-C."""
    profile: Flag = False
    """Print the time of each stage at the end; with --json as part of the document."""

    def __call__(self) -> None:
        self.run(self.settings())

    def run(self, config: Config) -> None:
        """Explore with these settings."""
        from caryatid.cli.output import Output
        from caryatid.cli.view import watched
        from caryatid.io.runs import RunWriter

        out = Output(self.general)
        with watched(self.source, config, out) if self.view else nullcontext() as page:
            with RunWriter(self.out) as writer:
                source, recorder = _open(self, config, out, writer)
                _take(recorder, _explored(self, source, config), out, page)
                recorder.finish()
            _tell(self, recorder, source.name, out)


@dataclass(frozen=True, kw_only=True)
class Demo(ModellingCommand):
    """Explore a built-in cluttered table in simulation and print what every view finds.

    To try:
      caryatid demo --out run
    """

    out: OutPath = Path("demo-run")
    """Run folder to write; replaces an earlier run."""
    scene: Annotated[str, tyro.conf.arg(metavar="NAME")] = "clutter"
    """A built-in scene, such as tower, bridge or dense-12-0."""
    views: Annotated[OptionalCount, defaults_to(DEMO_VIEWS)] = None
    """Maximum number of views, including the first."""
    view: Flag = False
    """Show every view in the browser; the page then stays until Ctrl-C."""
    profile: Flag = False
    """Print the time of each stage at the end; with --json as part of the document."""

    def __call__(self) -> None:
        from caryatid.config.settings import read_settings

        fewer = read_settings(None, [f"active.max_views={DEMO_VIEWS}"])
        config = self.modelling.read({"active.max_views": self.views}, fewer)
        shared = {name: getattr(self, name) for name in ("out", "view", "profile", "modelling", "general")}
        Explore(source=self.scene, noise="carmine", **shared).run(config)


@dataclass(frozen=True, kw_only=True)
class Extract(ModellingCommand):
    """Extract shapes and support graph from all views of a recording, or from one cloud.

    To try:
      caryatid extract recording/ --out run
      caryatid extract table.pcd --segmentation auto --out run
    """

    source: SourceName
    """Recording (folder in the BOP format) or cloud (.pcd, .ply)."""
    out: OutPath
    """Run folder to write; replaces an earlier run."""
    segmentation: Annotated[Segmentation, defaults_to("labels where the source has them")] = None
    """Use the masks or labels that are given, or segment automatically."""
    label_divisor: Count = 1
    """For clouds whose labels number parts of objects: object = label // N."""
    no_report: Flag = False
    """Leave out report.html."""
    profile: Flag = False
    """Print the time of each stage at the end; with --json as part of the document."""

    def __call__(self) -> None:
        from caryatid.cli.output import Output
        from caryatid.io.runs import RunWriter
        from caryatid.runs import RunRecorder
        from caryatid.sources import CLOUD_SUFFIXES

        config, out = self.modelling.read(), Output(self.general)
        is_cloud = Path(self.source).suffix.lower() in CLOUD_SUFFIXES
        options = {"segmentation": self.segmentation, "label_divisor": self.label_divisor}
        with RunWriter(self.out) as writer:
            steps = (self._of_cloud if is_cloud else self._of_recording)(config, out)
            recorder = RunRecorder(
                command="extract",
                source=self.source,
                seed=self.modelling.seed,
                options=options,
                config=config,
                writer=writer,
            )
            _take(recorder, steps, out)
            recorder.finish()
        _tell(self, recorder, Path(self.source).name, out)

    def _of_recording(self, config: Config, out: Output) -> Iterator[Step]:
        from caryatid.exploration import Explorer
        from caryatid.sources import open_recording

        with out.working("reading the recording"):
            recording = open_recording(self.source, config, self.segmentation)
        out.compile()
        explorer = Explorer(config=config, segmentation=self.segmentation, seed=self.modelling.seed)
        return (explorer.look(frame.load()) for frame in recording.frames)

    def _of_cloud(self, config: Config, out: Output) -> Iterator[Step]:
        import numpy as np

        from caryatid.exploration import Explorer
        from caryatid.io.point_clouds import read_stored_cloud
        from caryatid.segmentation.observation import level_cloud
        from caryatid.sources import check_segments

        with out.working("reading the cloud"):
            stored = read_stored_cloud(self.source, self.label_divisor)
            if self.segmentation == "labels" and stored.labels is None:
                raise InputError(self.source, "has no field label", "use --segmentation auto")
            if self.segmentation != "auto" and stored.labels is not None:
                check_segments(self.source, Counter(stored.labels[stored.kept].tolist()), config)
        out.compile()
        explorer = Explorer(config=config, segmentation=self.segmentation, seed=self.modelling.seed)
        with out.working("extracting"):
            rng = np.random.default_rng(self.modelling.seed)
            cloud = stored.to_cloud(config.cloud)
            cloud = level_cloud(cloud, config, segmentation=self.segmentation, rng=rng)
            step = explorer.look(cloud)
        yield replace(step, labels=stored.spread(step.labels))


@dataclass(frozen=True, kw_only=True)
class Dismantle(ExploringCommand):
    """Explore a scene, find a safe order to take it apart, and try it in physics.

    Objects are lifted straight up, one by one. A step fails when any other object moves by more than 2 cm
    or 15°.

    To try:
      caryatid dismantle bridge --noise carmine
      caryatid dismantle scene.xml --views 5 --hands 1 --out run
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """An MJCF scene, or the name of a built-in one."""
    out: Annotated[OptionalPath, shown_as("RUN")] = None
    """Run folder to write, its report with pictures of every lift; without it nothing is written."""
    hands: Literal[1, 2] = 2
    """With 2, another hand may hold one object while the first lifts one."""
    no_early_stop: Flag = False
    """Continue to the maximum number of views; otherwise stop when a view changes nothing."""

    def __call__(self) -> None:
        from rich.text import Text

        from caryatid.cli.output import Output, numbered_table
        from caryatid.io.runs import RunWriter
        from caryatid.manipulation.dismantling import bodies_of, dismantle, dismantling_record, succeeded
        from caryatid.manipulation.order import Order, plan_order
        from caryatid.runtime.threads import cores
        from caryatid.simulation.camera import SimulatedCamera
        from caryatid.viz.strip import draw_lifts, stored_figures

        config, out = self.settings(), Output(self.general)
        with RunWriter(self.out) if self.out is not None else nullcontext() as writer:
            source, recorder = _open(self, config, out, writer)
            if source.truth is None or not isinstance(source.camera, SimulatedCamera):
                remedy = "give an MJCF scene; for a run, use `caryatid order`"
                raise InputError(self.source, "cannot be simulated", remedy)
            scene = source.camera.scene
            order, taken, files = Order((), "interrupted before an order was found"), [], {}
            try:
                last = _take(recorder, _explored(self, source, config), out)
                if last is None:
                    raise KeyboardInterrupt
                with out.working("rehearsing"):
                    seed = self.modelling.seed
                    order = plan_order(last.graph, config, hands=self.hands, seed=seed, threads=cores())
                for t in dismantle(scene, order.steps, bodies_of(last.graph, source.truth), config):
                    taken.append(t)
                    disturbed = ", ".join(t.disturbed)
                    out.say(f"{t.step.object_id}: " + (f"{disturbed} disturbed" if disturbed else "ok"))
                if writer is not None:
                    T_world_camera = last.sphere.poses(last.visited[:1])[0]
                    files = stored_figures(draw_lifts(scene, taken, last.graph, T_world_camera, config))
            except KeyboardInterrupt:
                recorder.interrupted = True
                if recorder.views == 0:
                    raise
            bodies = {t.body for t in taken}
            left = [name for name in scene.object_bodies.values() if name not in bodies]
            record = dismantling_record(order, taken, left)
            recorder.finish({"dismantling": record}, files)
        if self.out is not None:
            _draw_report(self.out, out)
        outcome = "all taken, nothing disturbed" if succeeded(taken, left) else "not without harm"
        if left and all(t.ok for t in taken):
            outcome = f"nothing disturbed, but {', '.join(left)} left"
        table = numbered_table(f"{source.name}: {outcome}", "take", "body", "hold", "disturbed", "why")
        for number, t in enumerate(taken, start=1):
            disturbed = ", ".join(t.disturbed) or "–"
            cells = (t.step.object_id, t.body or "nothing there", ", ".join(t.held), disturbed)
            table.add_row(str(number), *cells, Text(t.step.why))
        out.result(record, table, *([Text(order.refusal)] if order.refusal else []))


def _open(
    command: Explore | Dismantle, config: Config, out: Output, writer: RunWriter | None
) -> tuple[Source, RunRecorder]:
    """Open what is to be explored, and the record of its exploration."""
    from caryatid.runs import RunRecorder
    from caryatid.sources import open_source

    with out.working("opening"):
        source = open_source(
            command.source,
            config,
            noise=command.noise,
            segmentation=command.segmentation,
            seed=command.modelling.seed,
            robot=command.robot,
        )
    out.compile()
    names = ("planner", "robot", "segmentation", "noise")
    recorder = RunRecorder(
        command=type(command).__name__.lower(),
        source=command.source,
        seed=command.modelling.seed,
        options={name: getattr(command, name) for name in names} | {"early_stop": not command.no_early_stop},
        config=config,
        writer=writer,
        truth=source.truth,
    )
    return source, recorder


def _explored(command: Explore | Dismantle, source: Source, config: Config) -> Iterator[Step]:
    """The steps of an exploration."""
    from caryatid.evaluation.oracle import planner_for
    from caryatid.exploration import explore

    known: dict[str, Any] = {"segmentation": command.segmentation, "seed": command.modelling.seed}
    planner, camera = planner_for(command.planner, source.camera, source.truth, config, **known)
    stop = not command.no_early_stop
    return explore(camera, source.robot, planner=planner, config=config, early_stop=stop, **known)


def _take(
    recorder: RunRecorder, steps: Iterable[Step], out: Output, page: PageProcess | None = None
) -> Step | None:
    """Keep, print and show every step; Ctrl-C ends the run after the views so far.

    Returns:
        The last step, or None after Ctrl-C.
    """
    from caryatid.viewer.drawing import Moment

    last = None
    try:
        for step in steps:
            score = recorder.keep(step)
            out.step(step, None if last is None else last.graph, score)
            if page is not None:
                page.add(Moment(step, None if score is None else score.f1))
            last = step
    except KeyboardInterrupt:
        recorder.interrupted = True
        if recorder.views == 0:
            raise
    return None if recorder.interrupted else last


def _tell(command: Explore | Extract, recorder: RunRecorder, name: str, out: Output) -> None:
    """Write the report and print what came of the run."""
    from caryatid.cli.output import counted, profile, summary
    from caryatid.io.graph_json import graph_to_json

    if not command.no_report:
        _draw_report(command.out, out)
    graph = recorder.graphs[-1]
    record, tables = profile(recorder.steps) if command.profile else ({}, [])
    out.say(f"{name}: {summary(graph)} after {counted(recorder.views, 'view')}")
    out.say(f"run: {command.out}" + ("" if command.no_report else ", open its report.html"))
    if tables or command.general.json:
        out.result({"run": str(command.out), "graph": graph_to_json(graph)} | record, *tables)


def _draw_report(folder: Path, out: Output) -> None:
    """Draw the report of a run that is in its place already."""
    from caryatid.runs import write_report

    try:
        with out.working("drawing the report"):
            write_report(folder)
    except KeyboardInterrupt:
        reason = f"the run is kept in {folder}; `caryatid report {folder}` makes the report"
        raise KeyboardInterrupt(reason) from None
