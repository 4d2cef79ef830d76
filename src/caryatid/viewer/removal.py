"""A safe order played: the extracted shapes as they are taken away, picture by picture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.config import Config
from caryatid.evaluation.scores import TrueScene
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.manipulation.dismantling import bodies_of, dismantle, poses_of
from caryatid.manipulation.order import TakeStep
from caryatid.simulation.lifting import ASIDE
from caryatid.simulation.world import SimulatedScene
from caryatid.viewer.moments import Dots, Moment

PICTURES = 8
"""Of a lift that no physics is asked about."""
RISE = 0.5
"""How far up such a lift goes [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Picture:
    """One picture of objects being taken away.

    Attributes:
        number: Of the lift, 0 the first.
        step: What is taken.
        T_world_world: How far each object has moved from where it was seen, by id (4, 4).
        gone: Ids of what has been taken.
        disturbed: Names of what the lift disturbed, once it is done.
        done: The lift is.
    """

    number: int
    step: TakeStep
    T_world_world: Mapping[str, Array]
    gone: frozenset[str]
    disturbed: tuple[str, ...] = ()
    done: bool = False


def lifts_in_physics(
    scene: SimulatedScene, graph: SupportGraph, truth: TrueScene, steps: Sequence[TakeStep], config: Config
) -> Iterator[Picture]:
    """Take a scene apart in physics; the extracted shapes move as the bodies they stand for do.

    Args:
        scene: The scene in physics.
        graph: What was extracted of it.
        truth: What it really is.
        steps: The order.
        config: How lifts go.

    Yields:
        Several pictures of each lift, the last one `done`.
    """
    bodies = bodies_of(graph, truth)
    names = list(scene.object_bodies.values())
    began = _transforms(poses_of(scene))
    gone: frozenset[str] = frozenset()
    moved: dict[str, Array] = {}
    for number, taken in enumerate(dismantle(scene, steps, bodies, config)):
        for state in taken.film:
            now = _transforms(state)
            here = {i: names.index(body) for i, body in bodies.items() if i not in gone}
            moved = {i: now[k] @ transforms.invert(began[k]) for i, k in here.items()}
            if state[names.index(taken.body or names[0]), 2] < ASIDE / 2.0:
                yield Picture(number, taken.step, moved, gone)
        gone = gone | {taken.step.object_id}
        yield Picture(number, taken.step, moved, gone, taken.disturbed, done=True)


def lifts_told(steps: Sequence[TakeStep]) -> Iterator[Picture]:
    """Take objects straight up, where there is no physics to ask: what the order says, and no more.

    Yields:
        Several pictures of each lift, the last one `done`.
    """
    gone: frozenset[str] = frozenset()
    for number, step in enumerate(steps):
        for height in np.linspace(0.0, RISE, PICTURES)[1:]:
            up = transforms.rigid(np.eye(3), (0.0, 0.0, float(height)))
            yield Picture(number, step, {step.object_id: up}, gone)
        gone = gone | {step.object_id}
        yield Picture(number, step, {}, gone, done=True)


def pictured(moment: Moment, picture: Picture) -> Moment:
    """What is to be seen of a moment while its objects are being taken away.

    Shapes that have moved leave their points behind, and so their points are not shown.
    """
    graph = moment.graph
    objects = tuple(
        replace(o, shape=o.shape.moved(picture.T_world_world[o.id])) if o.id in picture.T_world_world else o
        for o in graph.objects
        if o.id not in picture.gone
    )
    held_up = {picture.step.object_id, *picture.gone}
    supports = tuple(
        replace(s, contact_world=None, normal_world=None)
        for s in graph.supports
        if s.supporter not in held_up and s.supported not in held_up
    )
    away = {*picture.gone, *(i for i, T in picture.T_world_world.items() if _has_moved(T))}
    labels = [o.label for o in graph.objects if o.id in away]
    dots = None if moment.dots is None else _without(moment.dots, labels)
    shown = SupportGraph(objects, supports, graph.stability)
    return replace(moment, graph=shown, dots=dots, decision=None, candidates=None)


def _has_moved(T: Array) -> bool:
    return bool(np.abs(T - np.eye(4)).max() > 2e-3)


def _without(dots: Dots, labels: Sequence[int]) -> Dots:
    if not labels:
        return dots
    kept = ~np.isin(dots.labels, labels)
    return Dots(dots.points_world[kept], dots.labels[kept], None if dots.rgb is None else dots.rgb[kept])


def _transforms(state: Array) -> Array:
    """Poses (N, 4, 4) of a state (N, 7): positions and quaternions, w first."""
    T = np.tile(np.eye(4), (len(state), 1, 1))
    T[:, :3, 3] = state[:, :3]
    T[:, :3, :3] = Rotation.from_quat(state[:, [4, 5, 6, 3]]).as_matrix()
    return T
