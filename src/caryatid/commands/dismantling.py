"""What `caryatid dismantle` does: explore, order, lift, and show it."""

from __future__ import annotations

import sys
from contextlib import nullcontext

from caryatid.commands.dismantle import Dismantle
from caryatid.commands.exploring import finish_run, look_around
from caryatid.commands.progress import Progress
from caryatid.commands.taking import print_dismantling
from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.formats.json_files import json_text
from caryatid.formats.runs import RunWriter
from caryatid.manipulation.dismantling import Taken, bodies_of, dismantle
from caryatid.manipulation.order import plan_order
from caryatid.manipulation.telling import dismantling_record
from caryatid.report.strip import draw_lifts
from caryatid.simulation.camera import SimulatedCamera
from caryatid.threads import cores


def run_dismantling(options: Dismantle, config: Config) -> int:
    """Explore a scene, take it apart by what was extracted, and say what came of it.

    Raises:
        InputError: The source is no simulated scene.
    """
    progress = Progress(options.general.quiet or options.general.json)
    report = options.out is not None
    with RunWriter(options.out) if options.out is not None else nullcontext() as writer:
        done = look_around(options, config, progress, writer, report=report)
        camera, truth = done.source.camera, done.source.truth
        if truth is None or not isinstance(camera, SimulatedCamera):
            raise InputError(
                options.source,
                "is no scene that can be simulated",
                "give an MJCF scene; for a run, use order",
            )
        scene, graph, seed = camera.scene, done.end.graph, options.modelling.seed
        with progress.working("rehearsing"):
            order = plan_order(graph, config, hands=options.hands, seed=seed, threads=cores())
        taken: list[Taken] = []
        for t in dismantle(scene, order.steps, bodies_of(graph, truth), config):
            taken.append(t)
            progress.say(
                f"{t.step.object_id}: " + (", ".join(t.disturbed) + " disturbed" if t.disturbed else "ok")
            )
        names = {t.body for t in taken}
        left = [name for name in scene.object_bodies.values() if name not in names]
        record = dismantling_record(order, taken, left)
        if writer is not None:
            T_world_camera = done.end.sphere.poses(done.end.visited[:1])[0]
            strip = draw_lifts(scene, taken, graph, T_world_camera, config)
            more = {"dismantling": record}
            finish_run("dismantle", options, config, done, writer, report=report, more=more, strip=strip)
    if options.general.json:
        sys.stdout.write(json_text(record))
    else:
        print_dismantling(order, taken, left, done.source.name)
    return 0
