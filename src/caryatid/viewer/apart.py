"""An order of removal played, picture by picture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.config import Config
from caryatid.exploration import Step
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.manipulation.dismantling import bodies_of, dismantle, poses_of
from caryatid.manipulation.order import TakeStep
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.lifting import ASIDE
from caryatid.simulation.world import SimulatedScene

if TYPE_CHECKING:
    from caryatid.sources import Source


def taken_apart(
    step: Step, steps: Sequence[TakeStep], source: Source, config: Config
) -> Iterator[tuple[Step, str]]:
    """Play an order: in physics where the source is simulated, else as the order says.

    Shapes that have moved leave their points behind, and so their points are not shown.

    Args:
        step: What is known.
        steps: The order.
        source: What was explored.
        config: How lifts go.

    Yields:
        Several pictures of each lift, with what came of it where it is done, else an empty text.
    """
    gone: set[str] = set()
    camera, lifts = source.camera, _lifts_as_ordered(steps)
    if isinstance(camera, SimulatedCamera) and source.truth is not None:
        lifts = _lifts_in_physics(camera.scene, steps, bodies_of(step.graph, source.truth), config)
    for number, (taken, moves, disturbed) in enumerate(lifts, start=1):
        for T_world_world in moves:
            yield _without(step, gone, taken.object_id, T_world_world), ""
        gone.add(taken.object_id)
        harm = f", {', '.join(disturbed)} disturbed" if disturbed else ""
        text = f"{number} of {len(steps)} taken: {taken.object_id}{harm}"
        yield _without(step, gone, taken.object_id, moves[-1] if moves else {}), text


Lift = tuple[TakeStep, list[dict[str, Array]], tuple[str, ...]]
"""What is taken, how far each object has moved (4, 4) by id in each picture, and what was disturbed."""


def _lifts_in_physics(
    scene: SimulatedScene, steps: Sequence[TakeStep], bodies: Mapping[str, str], config: Config
) -> Iterator[Lift]:
    """Take the scene apart in physics; the extracted shapes move as the bodies they stand for do."""
    names = list(scene.object_bodies.values())
    began = transforms.invert(_transforms(poses_of(scene)))
    for taken in dismantle(scene, steps, bodies, config):
        film = taken.film
        if taken.body is not None:
            film = film[film[:, names.index(taken.body), 2] < ASIDE / 2.0]
        moves = (_transforms(state) @ began for state in film)
        yield taken.step, [{i: T[names.index(b)] for i, b in bodies.items()} for T in moves], taken.disturbed


def _lifts_as_ordered(steps: Sequence[TakeStep]) -> Iterator[Lift]:
    """Take objects straight up by half a metre, where there is no physics to ask."""
    for step in steps:
        heights = np.linspace(0.0, 0.5, 8)[1:]
        yield step, [{step.object_id: transforms.rigid(np.eye(3), (0.0, 0.0, h))} for h in heights], ()


def _without(step: Step, gone: set[str], lifted: str, T_world_world: Mapping[str, Array]) -> Step:
    """A step as it looks while an object is being lifted and others are gone."""
    graph, cloud = step.graph, step.cloud
    objects = tuple(
        replace(o, shape=o.shape.moved(T_world_world.get(o.id, np.eye(4))))
        for o in graph.objects
        if o.id not in gone
    )
    supports = tuple(
        replace(s, contact_world=None, normal_world=None)
        for s in graph.supports
        if not {s.supporter, s.supported} & {lifted, *gone}
    )
    moved = {i for i, T in T_world_world.items() if np.abs(T - np.eye(4)).max() > 2e-3}
    away = [o.label for o in graph.objects if o.id in gone | moved]
    if away and cloud.labels is not None:
        cloud = cloud.select(~np.isin(cloud.labels, away))
    shown = replace(graph, objects=objects, supports=supports)
    return replace(step, graph=shown, cloud=cloud, decision=None, candidates=None)


def _transforms(state: Array) -> Array:
    """Poses (N, 4, 4) of a state (N, 7): positions and quaternions, w first."""
    T = np.tile(np.eye(4), (len(state), 1, 1))
    T[:, :3, 3] = state[:, :3]
    T[:, :3, :3] = Rotation.from_quat(state[:, [4, 5, 6, 3]]).as_matrix()
    return T
