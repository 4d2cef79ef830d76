"""`caryatid demo`, `explore`, `view`, `extract` and `clear`: from views to a graph, and the viewer."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import closing, nullcontext, suppress
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from shlex import quote
from shutil import which
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np

from caryatid.cli import NOT_SAFE
from caryatid.cli.commands import Clear, Demo, Explore, Extract, View
from caryatid.cli.output import kept, table
from caryatid.cli.results import write_report
from caryatid.config import Config
from caryatid.errors import GoalError, InputError, did_you_mean
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import TrueScene, score
from caryatid.evaluation.truths import evaluate_run
from caryatid.exploration import Explorer, Step, explore
from caryatid.exports.streams import Stream
from caryatid.graph import TakeStep, object_id
from caryatid.io.graph_json import graph_to_json
from caryatid.io.json_files import plain
from caryatid.io.mask_sources import MaskSource
from caryatid.manipulation.clearing import SimulatedHands, clear
from caryatid.runtime.parallel import cores
from caryatid.simulation.camera import SimulatedCamera
from caryatid.sources import Source, extract, is_name, kind_of, open_run, open_source
from caryatid.steps import RunWriter, read_config, read_steps
from caryatid.viz.report import draw_lift
from caryatid.viz.tables import census, count_of

if TYPE_CHECKING:
    from caryatid.viewer.page import Page


def run_demo(command: Demo) -> None:
    explore_scene(Explore(**{field.name: getattr(command, field.name) for field in fields(command)}))


def explore_scene(command: Explore) -> None:
    config, looking = command.config(), command.looking
    with RunWriter(command.out, config, _about(command)) as writer:
        source, masks = _open(command, config)
        goal = _find_goal(command, source, config)
        writer.more |= {"goal": goal} if goal else {}
        name, truth = source.name, source.truth
        planner, camera = planner_for(command.chosen_planner, source.camera, truth, config, **looking)
        steps = explore(
            camera, source.robot, planner=planner, config=config, masks=masks, goal=goal,
            until=command.until, budget=command.budget, early_stop=not command.no_early_stop, **looking,
        )  # fmt: skip
        with Stream(command.stream) if command.stream else nullcontext() as stream:
            last = _record(command, writer, name, steps, truth, stream)
    _finish(command, writer, name, last, goal)


def extract_views(command: Extract) -> None:
    config = command.settings.read(takes_views=True)
    name = " + ".join(Path(source).name for source in (command.source, *command.more))
    with RunWriter(command.out, config, _about(command)) as writer:
        with command.output.working("opening"):
            masks = command.mask_source(config)
            steps = extract(
                command.source, config, masks=masks, ignore=command.ignore, level=command.level,
                label_divisor=command.label_divisor, more=command.more, **command.looking,
            )  # fmt: skip
        last = _record(command, writer, name, steps)
    _finish(command, writer, name, last)


def show_run(command: View) -> None:
    config, output, path = command.config(), command.output, Path(command.source)
    finished = kind_of(command.source) in ("run", "session")
    # The page shares the interpreter with the loop: a tenth of Python's interval lets it answer at once.
    sys.setswitchinterval(0.0005)
    with closing(_open_run(command, path) if finished else _open_loop(command, config)) as page:
        output.result({"address": page.url, "source": command.source}, "")
        output.say(f"{command.source} at {page.url}")
        output.say("press Ctrl-C to quit")
        if not command.no_browser:
            webbrowser.open(page.url)
        wait_for_interrupt()


def _open_run(command: View, folder: Path) -> Page:
    from caryatid.viewer.page import Page

    with open_run(folder) as run:
        steps, scores = read_steps(run), [score["f1"] for score in run.record.get("scores", ())]
        if not scores:
            with suppress(InputError), command.output.working("evaluating"):
                scores = [score.f1 for score in evaluate_run(run)]
        title = f"caryatid: {run.folder.name}"
        page = Page(title, read_config(run), host=command.host, port=command.port)
        for step in steps:
            page.add(step, scores[step.index] if scores else None)
    return page


def _open_loop(command: View, config: Config) -> Page:
    from caryatid.viewer.loop import LoopPage

    masks = command.mask_source(config)
    with command.output.working("opening"):
        page = LoopPage(
            partial(_open_source, command, masks), config, masks=masks, planner=command.chosen_planner,
            host=command.host, port=command.port, **command.looking,
        )  # fmt: skip
    page.start()
    return page


def clear_table(command: Clear) -> int:
    config, output = command.config(*command.lift_settings()), command.output
    reachable = command.reachable(config)
    source, masks = _open(command, config)
    camera = source.camera
    if not isinstance(camera, SimulatedCamera):
        raise InputError(command.source, "cannot be simulated", "give a built-in scene or an MJCF scene")
    goal = _find_goal(command, source, config)
    explorer = Explorer(
        camera, source.robot, planner=command.chosen_planner, config=config, masks=masks, **command.looking
    )
    with RunWriter(command.out, config, _about(command)) as writer:
        writer.more |= {"goal": goal} if goal else {}
        lifts = RecordedLifts(writer, explorer, camera, config)
        steps = clear(
            explorer, lifts.take, goal=goal, hands=command.hands, threads=cores(), reachable=reachable
        )
        last = _record(command, writer, source.name, steps)
    _draw_report(command)
    if not lifts.done:
        _check_found(goal, last)
    left, harmed = lifts.hands.left, sorted({body for lift in lifts.done for body in lift["disturbed"]})
    success = not harmed and (last.stop == f"{goal} is removed" if goal else not left)
    taken = [{name: value for name, value in lift.items() if name != "state"} for lift in lifts.done]
    document = {"run": str(command.out), "success": success, "stop": last.stop, "views": last.index + 1}
    document |= {"steps": taken, "left": left, "warnings": output.warnings}
    rows = [
        (str(number), lift["object"], lift["body"] or "nothing there", ", ".join(lift["held"]) or "–",
         ", ".join(lift["disturbed"]) or "–", lift["why"])
        for number, lift in enumerate(taken, start=1)
    ]  # fmt: skip
    outcome = f"{', '.join(harmed)} disturbed" if harmed else "nothing disturbed"
    name = f"{source.name} {config.gripper.title}".strip()
    title = f"{name}: {last.stop}; {count_of(last.index + 1, 'view')}, {outcome}"
    output.result(document, table(title, ("step", "remove", "body", "hold", "disturbed", "reason"), rows))
    return 0 if success else NOT_SAFE


class RecordedLifts:
    """Lifts in a simulation, recorded in a run folder.

    Attributes:
        hands: Hands that lift.
        done: Entries of run.json for each lift, with the state of the scene after it.
    """

    def __init__(
        self, writer: RunWriter, explorer: Explorer, camera: SimulatedCamera, config: Config
    ) -> None:
        self._writer, self._explorer, self._camera, self._config = writer, explorer, camera, config
        self.hands = SimulatedHands(camera.scene, config)
        self.done: list[dict[str, Any]] = []
        writer.more["lifts"] = self.done

    def take(self, step: TakeStep) -> bool:
        """Remove an object, and return whether it was in place."""
        writer, robot, graph = self._writer, self._explorer.robot, self._explorer.scene.graph
        taken = self.hands.take(step, self.hands.bodies(graph))
        state = plain(self.hands.state)
        self.hands.state = np.array(state)  # as `evaluate` reads it
        self._camera.scene = self.hands.scene
        self.done.append({"view": len(writer.steps)} | taken.to_json() | {"state": state})
        if taken.body is not None and robot is not None:
            lift = draw_lift(self._camera.scene, taken, graph, robot.T_world_camera, self._config)
            writer.files[f"lifts/{len(writer.steps):02d}.png"] = lift
        return taken.body is not None


def wait_for_interrupt() -> None:
    """Return at Ctrl-C."""
    with suppress(KeyboardInterrupt):
        Event().wait()


def _open(command: Explore | Clear, config: Config) -> tuple[Source, MaskSource | None]:
    """Open the source of a command, and that of its masks."""
    with command.output.working("opening"):
        masks = command.mask_source(config)
        return _open_source(command, masks, config), masks


def _open_source(command: Explore | View | Clear, masks: MaskSource | None, config: Config) -> Source:
    return open_source(
        command.source, config, noise=command.noise, robot=command.robot, masks=masks, ignore=command.ignore,
        level=command.level, keyframe=command.keyframe, **command.looking,
    )  # fmt: skip


def _find_goal(command: Explore | Clear, source: Source, config: Config) -> str | None:
    """Find the id of a goal that is one or a body's name, if objects are named by the simulator's labels."""
    goal, camera = command.goal, source.camera
    others = command.segmentation == "auto" or command.settings.masks_from is not None
    if goal is None or others or config.fusion.masks != "scene" or not isinstance(camera, SimulatedCamera):
        return goal
    bodies = {object_id(label): body for label, body in camera.scene.object_bodies.items()}
    found = goal if goal in bodies else next((i for i in bodies if bodies[i] == goal), None)
    if found is not None:
        return found
    known = ", ".join(f"{i} ({body})" for i, body in bodies.items())
    remedy = f"{did_you_mean(goal, bodies.values())}known objects: {known}"
    raise GoalError(f"--goal {goal}", "is not an object", remedy)


def _check_found(goal: str | None, last: Step) -> None:
    """Reject a goal that the last graph lacks."""
    if goal is not None and last.graph.find_id(goal) is None:
        reason = f"was not found in {count_of(last.index + 1, 'view')}"
        raise GoalError(f"--goal {goal}", reason, last.graph.suggest_objects(goal))


def _conditions(command: Explore | Extract | Clear, first: Step) -> str:
    """Tell where the segments of a run with this first step come from, and the noise of a simulation."""
    simulated, given = kind_of(command.source) == "scene", command.settings.masks_from
    text = "segments: automatic"
    if command.segmentation != "auto":
        text = f"masks: {given or ('simulator' if simulated else 'from the source')}"
        text += ", if any" * (first.view is None)  # A cloud's labels are not kept.
        if first.view is not None and first.view.labels is None:
            text = "segments: automatic, because the source has no masks"
    return text if isinstance(command, Extract) or not simulated else f"{text}, noise: {command.noise}"


def _about(command: Explore | Extract | Clear) -> dict[str, Any]:
    """Entries of run.json about the command."""
    names = (
        "robot", "segmentation", "noise", "label_divisor", "level", "goal", "until", "budget", "hands",
        "reach", "keyframe",
    )  # fmt: skip
    options = {name: getattr(command, name) for name in names if hasattr(command, name)}
    options |= {"preset": command.settings.preset, "masks": command.settings.masks}
    if not isinstance(command, Extract):
        options["planner"] = command.chosen_planner
    if isinstance(command, Extract) and command.more:
        options["more"] = list(command.more)
    if isinstance(command, Explore):
        options["early_stop"] = not command.no_early_stop
    name, seed = type(command).__name__.lower(), command.settings.seed
    about = {"command": name, "source": command.source, "seed": seed, "options": options}
    if not is_name(command.source) and Path(command.source).exists():
        # Run and source may be moved together.
        about["source_path"] = os.path.relpath(Path(command.source).resolve(), command.out.resolve())
    return about


def _finish(
    command: Explore | Extract, writer: RunWriter, name: str, last: Step, goal: str | None = None
) -> None:
    """Write the report and print the result."""
    output = command.output
    answer = _draw_report(command)
    _check_found(goal, last)
    output.say(f"{name}: {census(last.graph)} after {count_of(len(writer.steps), 'view')}")
    document: dict[str, Any] = {"run": str(command.out), "stop": last.stop}
    if last.removal is not None:
        document["removal"] = last.removal.to_json()
    document |= {"graph": graph_to_json(last.graph), "warnings": output.warnings}
    output.result(document, "" if command.general.quiet else "".join(f"{line}\n" for line in answer))
    output.say(f"run: {command.out}" if command.no_report else f"report: {command.out / 'report.html'}")
    program, out = "caryatid" if which("caryatid") else sys.argv[0], quote(str(command.out))
    output.say(f"next: {program} order {out} --gripper franka, or {program} view {out}")


def _record(
    command: Explore | Extract | Clear,
    writer: RunWriter,
    name: str,
    steps: Iterator[Step],
    truth: TrueScene | None = None,
    stream: Stream | None = None,
) -> Step:
    """Score, save, print and show every step; return the last."""
    output, last = command.output, None
    for step in steps:
        if last is None:
            conditions = _conditions(command, step)
            writer.more |= {"conditions": conditions, "warnings": output.warnings}
        scored = None if truth is None else score(step.graph, truth)
        writer.add(step, None if scored is None else asdict(scored))
        if last is None:
            output.say(f"{name} ({conditions})")
        if last is not None and step.index == last.index:
            output.say(f"  done: {step.stop}")
        else:
            output.step(step, last, scored)
        if stream is not None:
            stream.add(step, None if scored is None else scored.f1)
        last = step
    assert last is not None, "the first view is always taken"
    return last


def _draw_report(command: Explore | Extract | Clear) -> list[str]:
    """Draw the report of a finished run folder, unless it is not wanted; return its answer."""
    what = f"the run is kept in {command.out}; `caryatid report {command.out}` writes the report"
    if not command.no_report:
        with kept(what), command.output.working("drawing the report"):
            return write_report(command.out)[1]
    return []
