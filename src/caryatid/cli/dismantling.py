"""What `caryatid dismantle` does: explore, order, lift, and show it."""

from __future__ import annotations

import sys
from contextlib import nullcontext

from caryatid.cli.dismantle import Dismantle
from caryatid.cli.exploring import finish_run, look_around
from caryatid.cli.progress import Progress
from caryatid.cli.records import kept
from caryatid.cli.taking import print_dismantling
from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.evaluation.scores import TrueScene
from caryatid.io.json_files import json_text
from caryatid.io.runs import RunWriter
from caryatid.manipulation.dismantling import Taken, bodies_of, dismantle, dismantling_record
from caryatid.manipulation.order import Order, plan_order
from caryatid.runtime.interrupts import NOTHING, Interrupted, interrupted, interruptible
from caryatid.runtime.threads import cores
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.world import SimulatedScene
from caryatid.sources import Source, is_recording
from caryatid.viz import Figure
from caryatid.viz.strip import draw_lifts


@interruptible()
def run_dismantling(options: Dismantle, config: Config) -> int:
    """Explore a scene, take it apart by what was extracted, and say what came of it.

    Ctrl-C ends it with the views and lifts done so far.

    Raises:
        InputError: The source is no simulated scene.
    """
    if is_recording(options.source):
        raise _cannot_be_simulated(options.source)
    progress = Progress(options.general.quiet or options.general.json)
    report = options.out is not None
    with RunWriter(options.out) if options.out is not None else nullcontext() as writer:
        done = look_around(options, config, progress, writer, report=report)
        scene, truth = _simulated(options, done.source)
        order = Order((), "interrupted before an order was found")
        taken: list[Taken] = []
        strip: tuple[Figure, ...] = ()
        try:
            with interruptible():
                if done.interrupted or interrupted():
                    raise KeyboardInterrupt
                with progress.working("rehearsing"):
                    order = plan_order(
                        done.end.graph,
                        config,
                        hands=options.hands,
                        seed=options.modelling.seed,
                        threads=cores(),
                    )
                for t in dismantle(scene, order.steps, bodies_of(done.end.graph, truth), config):
                    taken.append(t)
                    ill = ", ".join(t.disturbed)
                    progress.say(f"{t.step.object_id}: " + (f"{ill} disturbed" if ill else "ok"))
                if writer is not None:
                    T_world_camera = done.end.sphere.poses(done.end.visited[:1])[0]
                    strip = draw_lifts(scene, taken, done.end.graph, T_world_camera, config)
        except KeyboardInterrupt:
            done.interrupted = True
        names = {t.body for t in taken}
        left = [name for name in scene.object_bodies.values() if name not in names]
        record = dismantling_record(order, taken, left)
        if writer is not None:
            more = {"dismantling": record}
            finish_run("dismantle", options, config, done, writer, report=report, more=more, strip=strip)
    if done.interrupted:
        views = len(done.steps)
        raise Interrupted(
            NOTHING if options.out is None else kept(views, options.out, reported=done.reported)
        )
    if options.general.json:
        sys.stdout.write(json_text(record))
    else:
        print_dismantling(order, taken, left, done.source.name)
    return 0


def _simulated(options: Dismantle, source: Source) -> tuple[SimulatedScene, TrueScene]:
    if source.truth is None or not isinstance(source.camera, SimulatedCamera):
        raise _cannot_be_simulated(options.source)
    return source.camera.scene, source.truth


def _cannot_be_simulated(source: str) -> InputError:
    return InputError(source, "is no scene that can be simulated", "give an MJCF scene; for a run, use order")
