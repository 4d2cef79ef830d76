"""`caryatid demo`, `explore`, `extract` and `dismantle`: commands that write a run folder."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from caryatid.cli.options import (
    DEFAULTS,
    SAID,
    ExploringCommand,
    ModellingCommand,
    OutPath,
    Segmentation,
    SourceName,
    Views,
    defaults_to,
    whole_number,
    with_views,
)
from caryatid.config import Config
from caryatid.errors import InputError

if TYPE_CHECKING:
    from caryatid.cli.output import Progress
    from caryatid.cli.watching import Watcher
    from caryatid.evaluation.scores import Score, TrueScene
    from caryatid.exploration import Step
    from caryatid.io.runs import RunWriter
    from caryatid.manipulation.dismantling import Taken
    from caryatid.manipulation.order import Order
    from caryatid.sources import Source
    from caryatid.viz import Figure, ViewPage

PACKAGES = ("mujoco", "numpy", "scipy", "numba", "shapely")
"""Packages whose versions run.json records."""

NoReport = Annotated[bool, SAID]
Profile = Annotated[bool, SAID]


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
    no_early_stop: Annotated[bool, SAID] = False
    """Continue to the maximum number of views; otherwise stop when a view changes nothing."""
    no_report: NoReport = False
    """Leave out report.html."""
    view: Annotated[bool, SAID] = False
    """Show every view in the browser; the page then stays until Ctrl-C."""
    profile: Profile = False
    """Print the time of each stage at the end; with --json as part of the document."""

    def __call__(self) -> None:
        """Run the command."""
        self.run(self.settings())

    def run(self, config: Config) -> None:
        """Explore with these settings."""
        from caryatid.cli.output import Progress
        from caryatid.io.runs import RunWriter

        progress = Progress(self.general.silent)
        with _watched(self.source, config, progress) if self.view else nullcontext() as watcher:
            with RunWriter(self.out) as writer:
                source, steps = open_exploration(self, config, progress)
                run = _Run("explore", self.source, source.name, self, config, progress, writer)
                run.source, run.watcher, run.report = source, watcher, not self.no_report
                run.take(steps)
                run.finish(exploring_options(self))
            run.tell(self.profile)


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
    views: Annotated[Views, defaults_to(5)] = None
    """Maximum number of views, including the first."""
    view: Annotated[bool, SAID] = False
    """Show every view in the browser; the page then stays until Ctrl-C."""
    profile: Profile = False
    """Print the time of each stage at the end; with --json as part of the document."""

    def __call__(self) -> None:
        """Run the command."""
        config = with_views(self.modelling.settings(with_views(DEFAULTS, 5)), self.views)
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
    segmentation: Segmentation = None
    """Use the masks or labels that are given, or segment automatically."""
    label_divisor: Annotated[int, whole_number(1)] = 1
    """For clouds whose labels number parts of objects: object = label // N."""
    no_report: NoReport = False
    """Leave out report.html."""
    profile: Profile = False
    """Print the time of each stage at the end; with --json as part of the document."""

    def __call__(self) -> None:
        """Run the command."""
        config = self.modelling.settings()
        from caryatid.cli.output import Progress
        from caryatid.io.runs import RunWriter
        from caryatid.sources import CLOUD_SUFFIXES

        progress = Progress(self.general.silent)
        is_cloud = Path(self.source).suffix.lower() in CLOUD_SUFFIXES
        with RunWriter(self.out) as writer:
            steps = (self._of_cloud if is_cloud else self._of_recording)(config, progress)
            run = _Run("extract", self.source, Path(self.source).name, self, config, progress, writer)
            run.report = not self.no_report
            run.take(steps)
            run.finish({"segmentation": self.segmentation, "label_divisor": self.label_divisor})
        run.tell(self.profile)

    def _of_recording(self, config: Config, progress: Progress) -> Iterator[Step]:
        from caryatid.exploration import Explorer
        from caryatid.sources import open_recording

        with progress.working("reading the recording"):
            recording = open_recording(self.source, config, self.segmentation)
        _compile(progress)
        explorer = Explorer(config=config, segmentation=self.segmentation, seed=self.modelling.seed)
        return (explorer.look(frame.load()) for frame in recording.frames)

    def _of_cloud(self, config: Config, progress: Progress) -> Iterator[Step]:
        import numpy as np

        from caryatid.exploration import Explorer
        from caryatid.io.point_clouds import read_stored_cloud
        from caryatid.segmentation.observation import level_cloud
        from caryatid.sources import check_segments

        with progress.working("reading the cloud"):
            stored = read_stored_cloud(self.source, self.label_divisor)
            if self.segmentation == "labels" and stored.labels is None:
                raise InputError(self.source, "has no field label", "use --segmentation auto")
            if self.segmentation != "auto" and stored.labels is not None:
                check_segments(self.source, Counter(stored.labels[stored.kept].tolist()), config)
        _compile(progress)
        explorer = Explorer(config=config, segmentation=self.segmentation, seed=self.modelling.seed)
        with progress.working("extracting"):
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
    out: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="RUN"), SAID] = None
    """Run folder to write, its report with pictures of every lift; without it nothing is written."""
    hands: Literal[1, 2] = 2
    """With 2, another hand may hold one object while the first lifts one."""
    no_early_stop: Annotated[bool, SAID] = False
    """Continue to the maximum number of views; otherwise stop when a view changes nothing."""

    def __call__(self) -> None:
        """Run the command."""
        config = self.settings()
        from caryatid.cli.output import Progress, write_json
        from caryatid.io.runs import RunWriter
        from caryatid.manipulation.dismantling import bodies_of, dismantle, dismantling_record
        from caryatid.manipulation.order import Order, plan_order
        from caryatid.runtime.threads import cores
        from caryatid.sources import is_recording
        from caryatid.viz.strip import draw_lifts

        if is_recording(self.source):
            raise self._not_simulated()
        progress = Progress(self.general.silent)
        with RunWriter(self.out) if self.out is not None else nullcontext() as writer:
            source, steps = open_exploration(self, config, progress)
            run = _Run("dismantle", self.source, source.name, self, config, progress, writer)
            run.source, run.report = source, writer is not None
            scene, truth = self._simulated(source)
            order = Order((), "interrupted before an order was found")
            taken: list[Taken] = []
            strip: tuple[Figure, ...] = ()
            try:
                run.take(steps)
                if run.interrupted:
                    raise KeyboardInterrupt
                graph = run.newest.graph
                with progress.working("rehearsing"):
                    seed = self.modelling.seed
                    order = plan_order(graph, config, hands=self.hands, seed=seed, threads=cores())
                for t in dismantle(scene, order.steps, bodies_of(graph, truth), config):
                    taken.append(t)
                    disturbed = ", ".join(t.disturbed)
                    progress.say(f"{t.step.object_id}: " + (f"{disturbed} disturbed" if disturbed else "ok"))
                if writer is not None:
                    T_world_camera = run.newest.sphere.poses(run.newest.visited[:1])[0]
                    strip = draw_lifts(scene, taken, graph, T_world_camera, config)
            except KeyboardInterrupt:
                if run.last is None:
                    raise
                run.interrupted = True
            names = {t.body for t in taken}
            left = [name for name in scene.object_bodies.values() if name not in names]
            record = dismantling_record(order, taken, left)
            options = exploring_options(self)
            run.finish(options, {"dismantling": record}, strip)
        if self.general.json:
            write_json(record)
        else:
            _print_dismantling(order, taken, left, source.name)

    def _simulated(self, source: Source) -> tuple[Any, TrueScene]:
        """The scene in physics and its ground truth."""
        from caryatid.simulation.camera import SimulatedCamera

        if source.truth is None or not isinstance(source.camera, SimulatedCamera):
            raise self._not_simulated()
        return source.camera.scene, source.truth

    def _not_simulated(self) -> InputError:
        return InputError(
            self.source, "cannot be simulated", "give an MJCF scene; for a run, use `caryatid order`"
        )


def open_exploration(
    options: Explore | Dismantle, config: Config, progress: Progress
) -> tuple[Source, Iterator[Step]]:
    """Open what is to be explored, and return it with the steps of its exploration."""
    from caryatid.evaluation.oracle import planner_for
    from caryatid.exploration import explore
    from caryatid.sources import open_source

    seed, segmentation = options.modelling.seed, options.segmentation
    with progress.working("opening"):
        source = open_source(
            options.source,
            config,
            noise=options.noise,
            segmentation=segmentation,
            seed=seed,
            robot=options.robot,
        )
    _compile(progress)
    planner, camera = planner_for(
        options.planner, source.camera, source.truth, config, segmentation=segmentation, seed=seed
    )
    return source, explore(
        camera,
        source.robot,
        planner=planner,
        config=config,
        segmentation=segmentation,
        seed=seed,
        early_stop=not options.no_early_stop,
    )


def exploring_options(options: Explore | Dismantle) -> dict[str, Any]:
    """What run.json records of the options of an exploration."""
    names = ("planner", "robot", "segmentation", "noise")
    return {name: getattr(options, name) for name in names} | {"early_stop": not options.no_early_stop}


def _compile(progress: Progress) -> None:
    from caryatid.runtime.compiling import compile_kernels

    with progress.working("compiling"):
        compile_kernels(progress.say)


def _watched(source: str, config: Config, progress: Progress) -> AbstractContextManager[Watcher]:
    from caryatid.cli.watching import wait_for_interrupt, watched

    return watched(source, config, progress, wait_for_interrupt)


def _print_dismantling(order: Order, taken: Sequence[Taken], left: Sequence[str], name: str) -> None:
    from rich.text import Text

    from caryatid.cli.output import left_table, result_console
    from caryatid.manipulation.dismantling import succeeded

    outcome = "all taken, nothing disturbed" if succeeded(taken, left) else "not without harm"
    if left and all(t.ok for t in taken):
        outcome = f"nothing disturbed, but {', '.join(left)} left"
    table = left_table(f"{name}: {outcome}", "take", "body", "hold", "disturbed", "why")
    for number, t in enumerate(taken, start=1):
        disturbed = ", ".join(t.disturbed) or "–"
        cells = (t.step.object_id, t.body or "nothing there", ", ".join(t.held), disturbed)
        table.add_row(str(number), *cells, Text(t.step.why))
    console = result_console()
    console.print(table)
    if order.refusal:
        console.print(Text(order.refusal))


@dataclass(slots=True)
class _Run:
    """A run in the making: its folder, its report and what is printed of it."""

    command: str
    given: str
    name: str
    options: ModellingCommand
    config: Config
    progress: Progress
    writer: RunWriter | None
    source: Source | None = None
    watcher: Watcher | None = None
    report: bool = True
    last: Step | None = None
    pages: list[ViewPage] = field(default_factory=list)
    steps: list[dict[str, Any]] = field(default_factory=list)
    scores: list[Score] = field(default_factory=list)
    interrupted: bool = False

    @property
    def newest(self) -> Step:
        """The newest step."""
        if self.last is None:
            raise RuntimeError("a run has at least one view")
        return self.last

    def take(self, steps: Iterable[Step]) -> None:
        """Keep every step as it comes; Ctrl-C ends the run after the views so far."""
        try:
            for step in steps:
                self._keep(step)
        except KeyboardInterrupt:
            if self.last is None:
                raise
            self.interrupted = True

    def _keep(self, step: Step) -> None:
        import numpy as np

        from caryatid.evaluation.scores import score
        from caryatid.steps import write_step
        from caryatid.viz import draw_view

        before, newest = self.last, None
        if self.source is not None and self.source.truth is not None:
            newest = score(step.graph, self.source.truth, np.random.default_rng(0))
        if self.watcher is not None and self.source is not None:
            self.watcher.show(step, None if newest is None else newest.f1)
        page = [draw_view(step, self.config.report)] if self.report else []
        if self.writer is not None:
            write_step(self.writer, step)
        self.last = step
        self.pages += page
        self.scores += [] if newest is None else [newest]
        names = ("timings", "angle_travelled", "path_travelled", "stop")
        self.steps.append({"view": step.index} | {name: getattr(step, name) for name in names})
        self.progress.step(step, None if before is None else before.graph, newest)

    def finish(
        self,
        options: Mapping[str, Any],
        more: Mapping[str, Any] | None = None,
        strip: tuple[Figure, ...] = (),
    ) -> None:
        """Write what a run folder holds beside its views, and put it in its place.

        Args:
            options: What run.json records of the options.
            more: What else run.json is to hold.
            strip: Pictures for the end of the report.

        Raises:
            KeyboardInterrupt: The run was interrupted; says what was kept.
        """
        if self.writer is not None:
            html = self._html(options, strip) if self.report and not self.interrupted else None
            from caryatid.viz.strip import stored_figures

            record = self._record(options, self.writer.views) | dict(more or {})
            self.writer.finish(self.newest.graph, record, html, stored_figures(strip))
        if self.interrupted and self.writer is not None:
            kept = "1 view is" if self.writer.views == 1 else f"{self.writer.views} views are"
            out = self.writer.folder
            raise KeyboardInterrupt(f"{kept} kept in {out}; `caryatid report {out}` makes the report")
        if self.interrupted:
            raise KeyboardInterrupt

    def _html(self, options: Mapping[str, Any], strip: tuple[Figure, ...]) -> str:
        from caryatid.viz import Report, render_html

        settings = {"source": self.given, "seed": self.options.modelling.seed} | dict(options)
        settings |= {"fusion": self.config.fusion.method, "views": self.config.active.max_views}
        scores = [asdict(score) for score in self.scores]
        return render_html(Report(f"caryatid: {Path(self.given).name}", self.pages, settings, scores, strip))

    def _record(self, options: Mapping[str, Any], views: int) -> dict[str, Any]:
        """What run.json holds."""
        from importlib.metadata import version

        from caryatid import __version__

        versions = {"caryatid": __version__, "python": platform.python_version()}
        record: dict[str, Any] = {
            "command": self.command,
            "source": self.given,
            "seed": self.options.modelling.seed,
            "options": dict(options),
            "settings": asdict(self.config),
            "versions": versions | {name: version(name) for name in PACKAGES},
            "angle_travelled": self.newest.angle_travelled,
            "path_travelled": self.newest.path_travelled,
            "steps": self.steps[:views],
        }
        if self.scores:
            record["scores"] = [asdict(score) for score in self.scores[:views]]
        return record | ({"interrupted": True} if self.interrupted else {})

    def tell(self, profile: bool) -> None:
        """Print what came of the run."""
        from caryatid.cli.output import counted, print_profile, profile_record, summary, write_json
        from caryatid.io.graph_json import graph_to_json

        graph, general = self.newest.graph, self.options.general
        out = "" if self.writer is None else str(self.writer.folder)
        if general.json:
            document = {"run": out, "graph": graph_to_json(graph)}
            write_json(document | (profile_record(self.steps) if profile else {}))
        self.progress.say(f"{self.name}: {summary(graph)} after {counted(len(self.steps), 'view')}")
        self.progress.say(f"run: {out}" + (", open its report.html" if self.report else ""))
        if profile and not general.json:
            print_profile(self.steps)
