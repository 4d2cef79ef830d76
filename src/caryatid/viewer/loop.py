"""The active vision loop worked by a person, turn by turn, and an order of removal played."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.config import Config, FusionMethod, SegmentationMethod
from caryatid.errors import PlanningError
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import score
from caryatid.exploration import Explorer, Step, reason_to_stop
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.manipulation.dismantling import bodies_of, dismantle, poses_of
from caryatid.manipulation.order import TakeStep
from caryatid.planning.decision import Decision, Planner
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.lifting import ASIDE
from caryatid.simulation.world import SimulatedScene
from caryatid.viewer.drawing import Moment

if TYPE_CHECKING:
    from caryatid.planning.candidates import Candidates
    from caryatid.sensing.view_sphere import ViewSphere
    from caryatid.sources import Source


class Loop:
    """An exploration that waits for its next turn to be asked for.

    It does not end by itself as `explore` does, but says when that would have: see `pause`.

    Args:
        open_source: Opens what is explored, again each time, for some settings.
        config: All settings; `config.active.max_views` is when it says that it would pause.
        planner: Name of who chooses the next view.
        segmentation: Where segments come from.
        seed: Seed of every random choice.

    Attributes:
        source: What is explored.
        planned: What the planner chose, also where a person has chosen otherwise.
        moments: What came of each view.
        ended: Why no further view can be taken, or None.
        pause: Why `explore` would have ended after the newest view, or None.

    Raises:
        CaryatidError: The source cannot be opened, or there is no such planner.
    """

    def __init__(
        self,
        open_source: Callable[[Config], Source],
        config: Config,
        *,
        planner: str = "support",
        segmentation: SegmentationMethod | None = None,
        seed: int = 0,
    ) -> None:
        self._open_source, self._began_with = open_source, planner
        self._options: dict[str, Any] = {"segmentation": segmentation, "seed": seed}
        self.config, self.planner = config, planner
        self._begin()

    def _begin(self) -> None:
        self.source = source = self._open_source(self.config)
        options = self._options | {"config": self.config}
        first, camera = planner_for(self._began_with, source.camera, source.truth, **options)
        self._planners: dict[str, Planner] = {self._began_with: first}
        chooser = self._planners.get(self.planner, self.planner)
        self._explorer = Explorer(camera, source.robot, planner=chooser, **options)
        self.moments: list[Moment] = []
        self.planned: Decision | None = None
        self.ended: str | None = None
        self.pause: str | None = None

    @property
    def fusion(self) -> FusionMethod:
        """What is fused over views."""
        return self.config.fusion.method

    def turn(self) -> Moment | None:
        """Go to the next view, look and plan; return what came of it, or None where no view can be taken.

        Raises:
            CaryatidError: The view cannot be used.
        """
        if self.ended is not None:
            return None
        if self.moments:
            self._explorer.go()
        self._explorer.look()
        step = self._explorer.plan()
        f1 = None
        if self.source.truth is not None:
            f1 = score(step.graph, self.source.truth, np.random.default_rng(0)).f1
        self.moments.append(Moment(step, f1))
        self.planned, self.ended = step.decision, step.stop
        self.pause = step.stop or reason_to_stop(
            step.index + 1, self._explorer.scene.changed, self.config.active
        )
        return self.moments[-1]

    def use_planner(self, name: str) -> Moment | None:
        """Let another planner choose, already the next view; the newest moment, with its choice.

        Raises:
            CaryatidError: There is no such planner, or it can choose no view.
        """
        self._explorer.use_planner(self._planners.get(name, name))
        self.planner = name
        if not self.moments or self.ended is not None:
            return None
        step = self._explorer.plan()
        if step.decision is None:
            raise PlanningError(step.stop or "no view can be chosen")
        self.planned = step.decision
        self.moments[-1] = replace(self.moments[-1], step=step, by_hand=False)
        return self.moments[-1]

    def use_fusion(self, method: FusionMethod) -> Iterator[Moment]:
        """Begin again with another fusion and take the same views again.

        Yields:
            What came of each view.
        """
        earlier = self.moments
        self.config = replace(self.config, fusion=replace(self.config.fusion, method=method))
        self._begin()
        for before in earlier:
            moment = self.turn()
            if moment is None:
                return
            if before is not earlier[-1] and before.step.decision is not None:
                moment = self._go_to(before.step.decision, by_hand=before.by_hand)
            yield moment

    def choose(self, index: int) -> Moment:
        """Go to this candidate next, whatever the planner says.

        Raises:
            PlanningError: There is no next view to choose, or the robot cannot take it.
        """
        return self._go_to(index, by_hand=True)

    def _go_to(self, chosen: Decision | int, *, by_hand: bool) -> Moment:
        step = self._explorer.choose(chosen)
        self.moments[-1] = replace(self.moments[-1], step=step, by_hand=by_hand)
        return self.moments[-1]


def candidate_under(
    origin_world: Array, direction_world: Array, sphere: ViewSphere, candidates: Candidates, within: float
) -> int | None:
    """Which candidate a ray from the eye points at, where it first meets the sphere or else behind.

    Args:
        origin_world: The eye (3,) [m].
        direction_world: Where the ray goes (3,).
        sphere: The view sphere.
        candidates: The views on it that can be reached.
        within: How far off the candidate may be, at the sphere's centre [rad].
    """
    ray = direction_world / np.linalg.norm(direction_world)
    offset = sphere.centre_world + sphere.radius * candidates.directions - origin_world
    along = offset @ ray
    aside = np.linalg.norm(offset - along[:, None] * ray, axis=1)
    hit = (along > 0.0) & (aside <= within * sphere.radius)
    if not hit.any():
        return None
    return int(np.argmin(np.where(hit & (along < along[hit].min() + sphere.radius / 2.0), aside, np.inf)))


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
