"""`caryatid demo`, `explore`, `view`, `extract` and `clear`: from views to a graph, and the viewer."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from caryatid.cli import options
from caryatid.errors import GoalError, InputError

if TYPE_CHECKING:
    from caryatid.cli.output import Output
    from caryatid.config import Config
    from caryatid.evaluation.scores import TrueScene
    from caryatid.exploration import Step
    from caryatid.graph import TakeStep
    from caryatid.io.mask_sources import MaskSource
    from caryatid.sources import Source
    from caryatid.steps import RunWriter
    from caryatid.viewer.page import Page, PageProcess

PORT = 8770
"""Default port of the viewer; if taken, the next free one."""


@dataclass(frozen=True, kw_only=True)
class RunCommand(options.ComputingCommand):
    """A command that writes a run folder."""

    source: str
    settings: options.Modelling = options.Modelling()
    out: options.OutPath = Path("run")
    """Run folder to write; replaces an existing run."""
    no_report: options.Flag = False
    """Do not write report.html."""
    profile: options.Flag = False
    """Print the time of each stage; with --json, add it to the document."""

    def open(self, config: Config) -> tuple[str, TrueScene | None, Iterator[Step]]:
        """Open the source; returns its name, its ground truth, and the steps of the run."""
        raise NotImplementedError

    def run(self, config: Config, page: PageProcess | None = None) -> None:
        """Save all steps, write the report and print the result.

        Raises:
            GoalError: No view shows the goal; the run folder keeps the views.
        """
        from caryatid.cli.output import profile
        from caryatid.io.graph_json import graph_to_json
        from caryatid.steps import RunWriter
        from caryatid.viz.tables import census, count_of

        output = self.output
        with RunWriter(self.out, config, _about(self)) as writer:
            name, truth, steps = self.open(config)
            writer.more["conditions"] = conditions = _conditions(self)
            last = _record(writer, steps, truth, output, f"{name} ({conditions})", page)
        if not self.no_report:
            _draw_report(self.out, output)
        _check_found(getattr(self, "goal", None), last)
        output.say(f"{name}: {census(last.graph)} after {count_of(len(writer.steps), 'view')}")
        output.say(f"run: {self.out}" if self.no_report else f"report: {self.out / 'report.html'}")
        document: dict[str, Any] = {"run": str(self.out), "stop": last.stop}
        if last.removal is not None:
            document["removal"] = last.removal.to_json()
        document |= {"graph": graph_to_json(last.graph), "warnings": output.warnings}
        if self.profile:
            document["profile"], shown = profile(writer.steps)
            output.result(document, shown)
        else:
            output.result(document, "")


@dataclass(frozen=True, kw_only=True)
class Explore(RunCommand, options.ExploringCommand):
    """Explore a scene view by view and infer which object supports which.

    SOURCE is one of:
      a built-in scene: tower, clutter, pile-8-0, dense-12-0, …
      an MJCF scene, simulated with robot and camera: an .xml file, or a folder with a scene.xml
      a recording: a folder in the BOP format; next views are chosen from its views

    Usage examples:
      caryatid explore tower --out run
      caryatid explore clutter --goal o3 --out run
      caryatid explore scene.xml --views 5 --out run
      caryatid explore tower --robot arm:arm.npz --out run
      caryatid explore recording/ --segmentation auto --out run
    """

    source: options.SourceName
    """Scene or recording."""
    no_early_stop: options.Flag = False
    """Continue to the maximum number of views, even if no view is worth its path."""
    goal: Annotated[str | None, options.shown("ID")] = None
    """Object to remove: explore only what matters for it, and stop when it is clear what else would move."""
    until: Annotated[float | None, options.shown("P", "0.95 with --goal, else never")] = None
    """Stop when every support (with --goal, every effect of the removal) is known with this probability."""
    view: options.Flag = False
    """Show the exploration in the browser; Ctrl-C closes the page."""

    def open(self, config: Config) -> tuple[str, TrueScene | None, Iterator[Step]]:
        from caryatid.evaluation.oracle import planner_for
        from caryatid.exploration import explore

        known: dict[str, Any] = {"segmentation": self.segmentation, "seed": self.settings.seed}
        with self.output.working("opening"):
            masks = self.mask_source(config)
            source = _opening(self, masks)(config)
        _check_goal(self, source, config)
        planner, camera = planner_for(self.chosen_planner, source.camera, source.truth, config, **known)
        known |= {"planner": planner, "config": config, "masks": masks}
        known |= {"goal": self.goal, "until": self.until, "early_stop": not self.no_early_stop}
        return source.name, source.truth, explore(camera, source.robot, **known)

    def __call__(self) -> None:
        config = self.config()
        with _watched(self.source, config, self.output) if self.view else nullcontext() as page:
            self.run(config, page)


@dataclass(frozen=True, kw_only=True)
class Demo(RunCommand):
    """Explore a built-in cluttered table in simulation, and print what each view adds.

    Usage examples:
      caryatid demo
      caryatid demo --scene bridge --view
    """

    source: Annotated[str, tyro.conf.arg(name="scene", metavar="NAME")] = "clutter"
    """Built-in scene, such as tower, bridge or dense-12-0."""
    views: Annotated[options.OptionalCount, options.default_of("active.max_views")] = None
    """Maximum number of views, including the first."""
    view: options.Flag = False
    """Show the exploration in the browser; Ctrl-C closes the page."""

    def __call__(self) -> None:
        Explore(**{field.name: getattr(self, field.name) for field in fields(self)})()


@dataclass(frozen=True, kw_only=True)
class View(options.ExploringCommand):
    """Show a finished run in the browser, or explore a scene or recording interactively.

    SOURCE is one of:
      a run folder written by explore, extract or clear, or a session; it is not modified
      a built-in scene, an MJCF scene or a recording, as for explore

    By default, only this machine can open the page. The page works offline; Ctrl-C closes it.

    Usage examples:
      caryatid view run
      caryatid view clutter
      caryatid view recording/ --segmentation auto --port 8080 --no-browser
    """

    source: options.SourceName
    """Run, session, scene or recording."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on; with any but 127.0.0.1, other machines can open the page by its full address."""
    port: options.Port = PORT
    """Port to listen on; if taken, the next free one; 0 = any free port."""
    no_browser: options.Flag = False
    """Print the address of the page, but do not open a browser."""

    def __call__(self) -> None:
        from caryatid.sources import kind_of

        config, output, path = self.config(), self.output, Path(self.source)
        finished = kind_of(self.source) in ("run", "session")
        # The page shares the interpreter with the loop: a tenth of Python's interval lets it answer at once.
        sys.setswitchinterval(0.0005)
        with closing(self._open_run(path) if finished else self._open_loop(config)) as page:
            output.result({"address": page.url, "source": self.source}, "")
            output.say(f"{self.source} at {page.url}")
            output.say("press Ctrl-C to quit")
            if not self.no_browser:
                webbrowser.open(page.url)
            wait_for_interrupt()

    def _open_run(self, folder: Path) -> Page:
        from caryatid.evaluation.truths import evaluate_run
        from caryatid.sources import open_run
        from caryatid.steps import read_config, read_steps
        from caryatid.viewer.page import Page

        with open_run(folder) as run:
            steps, scores = read_steps(run), [score["f1"] for score in run.record.get("scores", ())]
            if not scores:
                with suppress(InputError), self.output.working("evaluating"):
                    scores = [score.f1 for score in evaluate_run(run)]
            title = f"caryatid: {run.folder.name}"
            page = Page(title, read_config(run).support, host=self.host, port=self.port)
            for step in steps:
                page.add(step, scores[step.index] if scores else None)
        return page

    def _open_loop(self, config: Config) -> Page:
        from caryatid.viewer.loop import LoopPage

        masks = self.mask_source(config)
        known: dict[str, Any] = {"segmentation": self.segmentation, "seed": self.settings.seed}
        known |= {"masks": masks, "planner": self.chosen_planner, "host": self.host, "port": self.port}
        with self.output.working("opening"):
            page = LoopPage(_opening(self, masks), config, **known)
        page.start()
        return page


@dataclass(frozen=True, kw_only=True)
class Extract(RunCommand, options.LookingCommand):
    """Extract shapes and a support graph from all views of a recording, or from one cloud.

    Usage examples:
      caryatid extract recording/ --out run
      caryatid extract table.pcd --segmentation auto --out run
    """

    source: options.SourceName
    """Recording (folder in the BOP format) or cloud (.pcd, .ply)."""
    label_divisor: options.Count = 1
    """For clouds with labels of object parts: object = label // N."""
    level: options.Flag = False
    """Rotate the world frame of a recording so that the table is level; use it if z does not point up."""

    def open(self, config: Config) -> tuple[str, TrueScene | None, Iterator[Step]]:
        from caryatid.sources import extract

        with self.output.working("opening"):
            steps = extract(
                self.source,
                config,
                segmentation=self.segmentation,
                seed=self.settings.seed,
                label_divisor=self.label_divisor,
                masks=self.mask_source(config),
                ignore=self.ignore,
                level=self.level,
            )
        return Path(self.source).name, None, steps

    def __call__(self) -> None:
        self.run(self.settings.read(takes_views=True))


@dataclass(frozen=True, kw_only=True)
class Clear(options.LiftingCommand, options.ExploringCommand):
    """Clear a simulated table: look until the next lift is safe, remove the object, look again.

    Objects are lifted straight up, one by one. A lift disturbs another object if it moves that object by
    more than 2 cm or 15°. If interrupted, run the same command to continue.

    Usage examples:
      caryatid clear bridge
      caryatid clear clutter --goal o3 --hands 2
      caryatid clear scene.xml --risk 0.1 --out run
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Built-in or MJCF scene."""
    out: options.OutPath = Path("run")
    """Run folder to write, view by view; replaces an existing run, or continues it if interrupted."""
    views: Annotated[options.OptionalCount, options.default_of("active.max_views")] = None
    """Maximum number of views before each lift."""
    no_report: options.Flag = False
    """Do not write report.html."""

    def config(self) -> Config:
        """All settings."""
        return self.settings.read({"active.max_views": self.views} | self.lift_settings(), takes_views=True)

    def __call__(self) -> int:
        import numpy as np

        from caryatid.cli import NOT_SAFE
        from caryatid.cli.output import table
        from caryatid.exploration import Explorer
        from caryatid.io.json_files import plain
        from caryatid.manipulation.clearing import clear
        from caryatid.manipulation.dismantling import SimulatedHands
        from caryatid.runtime.parallel import cores
        from caryatid.simulation.camera import SimulatedCamera
        from caryatid.steps import RunWriter, lift_file, read_steps
        from caryatid.viz.report import draw_lift, lift_picture
        from caryatid.viz.tables import count_of

        config, seed, output = self.config(), self.settings.seed, self.output
        reachable = self.reachable(config)
        with output.working("opening"):
            masks = self.mask_source(config)
            source = _opening(self, masks)(config)
        camera = source.camera
        if not isinstance(camera, SimulatedCamera):
            raise InputError(self.source, "cannot be simulated", "give a built-in scene or an MJCF scene")
        _check_goal(self, source, config)
        known: dict[str, Any] = {"segmentation": self.segmentation, "seed": seed, "masks": masks}
        known |= {"planner": self.chosen_planner, "config": config}
        explorer = Explorer(camera, source.robot, **known)
        hands = SimulatedHands(camera.scene, config)
        with RunWriter(self.out, config, _about(self), stepwise=True) as writer:
            past = writer.past
            lifts: list[dict[str, Any]] = [] if past is None else past.record["lifts"]
            writer.more = {"lifts": lifts, "warnings": output.warnings}
            if past is not None:
                output.say(f"{self.source}: continuing after view {len(past.views)}")
                camera.captures = len(past.views)
            if lifts:
                hands.state = np.array(lifts[-1]["state"])
                camera.scene = hands.scene

            def take(step: TakeStep) -> bool:
                graph = explorer.scene.graph
                taken = hands.take(step, hands.bodies(graph))
                state = plain(hands.state)  # as it comes back from the file
                hands.state = np.array(state)
                camera.scene = hands.scene
                lifts.append({"view": len(writer.steps)} | taken.to_json() | {"state": state})
                if taken.body is not None and explorer.robot is not None:
                    drawn = draw_lift(camera.scene, taken, graph, explorer.robot.T_world_camera, config)
                    writer.files[lift_file(len(writer.steps))] = lift_picture(drawn)
                return taken.body is not None

            known = {"goal": self.goal, "hands": self.hands, "threads": cores(), "reachable": reachable}
            steps = clear(explorer, take, past=() if past is None else read_steps(past), **known)
            writer.more["conditions"] = conditions = _conditions(self)
            last = _record(writer, steps, None, output, f"{source.name} ({conditions})")
        if not self.no_report:
            _draw_report(self.out, output)
        if not lifts:
            _check_found(self.goal, last)
        harmed = sorted({body for lift in lifts for body in lift["disturbed"]})
        gone = {lift["object"] for lift in lifts if lift["body"] is not None}
        reached = self.goal in gone if self.goal else not hands.left
        taken = [{name: value for name, value in lift.items() if name != "state"} for lift in lifts]
        document = {"run": str(self.out), "success": reached and not harmed, "stop": last.stop}
        document |= {"views": last.index + 1, "steps": taken, "left": hands.left, "warnings": output.warnings}
        rows = [
            (str(number), lift["object"], lift["body"] or "nothing there", ", ".join(lift["held"]) or "–",
             ", ".join(lift["disturbed"]) or "–", lift["why"])
            for number, lift in enumerate(lifts, start=1)
        ]  # fmt: skip
        outcome = f"{', '.join(harmed)} disturbed" if harmed else "nothing disturbed"
        title = f"{source.name}: {last.stop}; {count_of(last.index + 1, 'view')}, {outcome}"
        shown = table(title, ("", "remove", "body", "hold", "disturbed", "reason"), rows)
        output.result(document, shown)
        return 0 if document["success"] else NOT_SAFE


def _opening(command: Explore | View | Clear, masks: MaskSource | None) -> Callable[[Config], Source]:
    """A function that opens the source of a command."""
    from caryatid.sources import open_source

    options: dict[str, Any] = {"noise": command.noise, "robot": command.robot, "masks": masks}
    options |= {"segmentation": command.segmentation, "seed": command.settings.seed}
    return partial(open_source, command.source, ignore=command.ignore, level=command.level, **options)


def wait_for_interrupt() -> None:
    """Return at Ctrl-C."""
    try:
        Event().wait()
    except KeyboardInterrupt:
        return


def _check_goal(command: Explore | Clear, source: Source, config: Config) -> None:
    """Reject a goal that is not among the simulator's labels, if objects are named by them."""
    from caryatid.graph import object_id
    from caryatid.simulation.camera import SimulatedCamera

    goal, camera = command.goal, source.camera
    others = command.segmentation == "auto" or command.settings.masks_from is not None
    if goal is None or others or config.fusion.masks != "scene" or not isinstance(camera, SimulatedCamera):
        return
    ids = [object_id(label) for label in camera.scene.object_bodies]
    if goal not in ids:
        reason = "is not an object of the scene"
        raise GoalError(f"--goal {goal}", reason, f"known objects: {', '.join(ids)}")


def _check_found(goal: str | None, last: Step) -> None:
    """Reject a goal that the last graph lacks."""
    from caryatid.viz.tables import count_of

    found = [o.id for o in last.graph.objects if o.role == "object"]
    if goal is not None and goal not in found:
        reason = f"was not found in {count_of(last.index + 1, 'view')}"
        raise GoalError(f"--goal {goal}", reason, f"objects found: {', '.join(found) or 'none'}")


@contextmanager
def _watched(name: str, config: Config, output: Output) -> Iterator[PageProcess]:
    """Open a page for an exploration; after its end, keep the page open until Ctrl-C."""
    from caryatid.viewer.page import PageProcess

    page = PageProcess(f"caryatid: {name}", config.support, port=PORT)
    output.say(f"{name} at {page.url}")
    webbrowser.open(page.url)
    try:
        yield page
        output.say("finished; the page stays open, press Ctrl-C to quit")
        wait_for_interrupt()
    finally:
        page.close()


def _conditions(command: RunCommand | Clear) -> str:
    """Source of the segments, and noise of a simulation."""
    from caryatid.sources import kind_of

    simulated = kind_of(command.source) == "scene"
    masks = command.settings.masks_from or ("simulator" if simulated else "from the source, if any")
    automatic = getattr(command, "segmentation", None) == "auto"
    text = "segments: automatic" if automatic else f"masks: {masks}"
    return f"{text}, noise: {getattr(command, 'noise', 'carmine')}" if simulated else text


def _about(command: RunCommand | Clear) -> dict[str, Any]:
    """Entries of run.json about the command."""
    from caryatid.sources import is_name

    names = ("robot", "segmentation", "noise", "label_divisor", "level", "goal", "until", "hands", "reach")
    options = {name: getattr(command, name) for name in names if hasattr(command, name)}
    options |= {"preset": command.settings.preset, "masks": command.settings.masks}
    if isinstance(command, Explore | Clear):
        options["planner"] = command.chosen_planner
    if isinstance(command, Explore):
        options["early_stop"] = not command.no_early_stop
    name, seed = type(command).__name__.lower(), command.settings.seed
    about = {"command": name, "source": command.source, "seed": seed, "options": options}
    if not is_name(command.source) and Path(command.source).exists():
        # Run and source may be moved together.
        about["source_path"] = os.path.relpath(Path(command.source).resolve(), command.out.resolve())
    return about


def _record(
    writer: RunWriter,
    steps: Iterable[Step],
    truth: TrueScene | None,
    output: Output,
    heading: str,
    page: PageProcess | None = None,
) -> Step:
    """Score, save, print and show every step; return the last."""
    from caryatid.evaluation.scores import score

    last = None
    writer.more["warnings"] = output.warnings
    for step in steps:
        scored = None if truth is None else score(step.graph, truth)
        writer.add(step, None if scored is None else asdict(scored))
        if last is None:
            output.say(heading)
        if last is not None and step.index == last.index:
            output.say(f"  done: {step.stop}")
        else:
            output.step(step, last, scored)
        if page is not None:
            page.add(step, None if scored is None else scored.f1)
        last = step
    assert last is not None, "the first view is always taken"
    return last


def _draw_report(folder: Path, output: Output) -> None:
    """Draw the report of a finished run folder."""
    from caryatid.cli.output import kept
    from caryatid.cli.results import write_report

    what = f"the run is kept in {folder}; `caryatid report {folder}` writes the report"
    with kept(what), output.working("drawing the report"):
        write_report(folder)
