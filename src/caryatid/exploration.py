"""The active vision loop: look, model, choose where to look next, go there (section IV)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import Config, SegmentationMethod
from caryatid.errors import PlanningError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.objects.change import changed
from caryatid.planning.candidates import Candidates
from caryatid.planning.planners import Decision, Planner, PlanningState, make_planner
from caryatid.robots.humanoid import Robot, refusal_of, view_sphere_of
from caryatid.runtime.display import Pictured
from caryatid.runtime.stopwatch import Stopwatch
from caryatid.runtime.threads import one_blas_thread
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import Camera, Cloud, View


@dataclass(frozen=True, eq=False, slots=True)
class Step(Pictured):
    """One turn of the loop.

    Attributes:
        index: Number of the view, 0 the first.
        view: What the camera gave; a view without a pose has the one the table gave it.
        labels: Label image (H, W) of the view.
        graph: The fused graph after this view.
        cloud: All points so far, thinned, with labels.
        sphere: The view sphere, as the robot has it.
        visited: Unit directions (V, 3) of the views so far from the sphere's centre.
        candidates: The views that could be reached next, or None where the loop stops.
        decision: The next view, or None where the loop stops.
        timings: Seconds each stage took.
        angle_travelled: Sum of the angles between consecutive views at the sphere's centre [rad].
        path_travelled: Way of the robot [m], as it measures it: a platform over the floor, an arm its hand.
        stop: Why this is the last step, or None.
    """

    index: int
    view: View
    labels: NDArray[np.int32]
    graph: SupportGraph
    cloud: Cloud
    sphere: ViewSphere
    visited: Array
    candidates: Candidates | None
    decision: Decision | None
    timings: dict[str, float]
    angle_travelled: float
    path_travelled: float
    stop: str | None

    def __repr__(self) -> str:
        following = f"stop: {self.stop}" if self.decision is None else f"next: {self.decision.why}"
        vertices, edges = len(self.graph.objects), len(self.graph.supports)
        return f"Step(index={self.index}, vertices={vertices}, edges={edges}; {following})"


def explore(
    camera: Camera,
    robot: Robot,
    *,
    planner: Planner | str = "support",
    config: Config | None = None,
    segmentation: SegmentationMethod | None = None,
    seed: int = 0,
    early_stop: bool = True,
) -> Iterator[Step]:
    """Look around until the graph does not change any more, or the views are used up.

    Args:
        camera: Gives views.
        robot: Stands where the first view is taken.
        planner: Chooses the next view, or the name of one that does.
        config: All stages' settings; `config.active.max_views` limits the views.
        segmentation: `labels`, `auto`, or None to use labels where views have them.
        seed: Seed of every random choice.
        early_stop: Stop when a view did not change the graph.

    Yields:
        A step after each view.

    Raises:
        CaryatidError: A view cannot be used, or the planner does not exist.
    """
    config = config or Config()
    scene = Scene(config, segmentation=segmentation, seed=seed)
    chooser = make_planner(planner) if isinstance(planner, str) else planner
    visited: list[Array] = []
    angle, path = 0.0, 0.0
    while True:
        watch = Stopwatch()
        view = camera.capture(robot.T_world_camera)
        watch.lap("capture")
        before = scene.graph
        graph = scene.update(view)
        labels = scene.labels
        if scene.sphere is None or labels is None:
            raise RuntimeError("an updated scene has a sphere and labels")
        sphere = view_sphere_of(robot, scene.sphere)
        if view.T_world_camera is None and scene.T_world_camera is not None:
            view = view.with_pose(scene.T_world_camera)
        visited.append(sphere.direction_of(robot.T_world_camera))
        if len(visited) > 1:
            angle += float(transforms.angle_between(visited[-2], visited[-1]))
        stop = _reason_to_stop(before, graph, len(visited), config, early_stop)
        watch.lap("update")
        decision, candidates = None, None
        if stop is None:
            try:
                candidates = robot.candidates(sphere)
                decision, candidates = _decided(
                    scene, robot, sphere, candidates, np.array(visited), chooser, seed
                )
            except PlanningError as error:
                stop = str(error)
        watch.lap("plan")
        laps = {"capture": watch.laps["capture"]} | scene.timings | {"plan": watch.laps["plan"]}
        yield Step(
            len(visited) - 1, view, labels, graph, scene.cloud, sphere, np.array(visited),
            candidates, decision, laps, angle, path, stop,
        )  # fmt: skip
        if decision is None:
            return
        path += robot.move_to(decision.T_world_camera)


def next_best_view(
    scene: Scene,
    robot: Robot,
    visited: Array | None = None,
    *,
    planner: Planner | str = "support",
    seed: int = 0,
) -> Decision:
    """Choose where to look next (Algorithm 2).

    Args:
        scene: What is known, of at least one view.
        robot: Says which views it can reach.
        visited: Unit directions (V, 3) of earlier views from the centre of the robot's view sphere, the
            current one last; None = where the robot is.
        planner: Chooses among them, or the name of one that does.
        seed: Seed of random planners.

    Returns:
        The decision: `T_world_camera` is the view, `why` the reason.

    Raises:
        PlanningError: No view is known yet, or none can be reached.
    """
    if scene.sphere is None:
        raise PlanningError("nothing has been seen yet; update the scene with a first view")
    chooser = make_planner(planner) if isinstance(planner, str) else planner
    sphere = view_sphere_of(robot, scene.sphere)
    if visited is None:
        visited = sphere.direction_of(robot.T_world_camera)[None]
    return _decided(scene, robot, sphere, robot.candidates(sphere), visited, chooser, seed)[0]


@one_blas_thread
def _decided(
    scene: Scene,
    robot: Robot,
    sphere: ViewSphere,
    candidates: Candidates,
    visited: Array,
    planner: Planner,
    seed: int,
) -> tuple[Decision, Candidates]:
    """Plan; where the robot, looking closer, cannot take the view, plan anew among the others.

    Returns:
        The decision, and the candidates it was taken among.

    Raises:
        PlanningError: No view is left, or the robot could take none of as many as it may try.
    """
    if scene.voxels is None:
        raise PlanningError("nothing has been seen yet; update the scene with a first view")
    rng = np.random.default_rng([seed, len(visited)])
    for _ in range(scene.config.active.attempts):
        state = PlanningState(scene.graph, sphere, scene.voxels, visited, candidates, scene.config.active)
        decision = planner.plan(state, rng)
        refused = refusal_of(robot, decision.T_world_camera)
        if refused is None:
            return decision, candidates
        why = refused.reason
        candidates = candidates.without(decision.index, why)
    raise PlanningError(f"the robot could take none of {scene.config.active.attempts} views: {why}")


def _reason_to_stop(
    before: SupportGraph, after: SupportGraph, views: int, config: Config, early_stop: bool
) -> str | None:
    if views >= config.active.max_views:
        return f"{views} views were asked for"
    if early_stop and views > 1 and not changed(before, after, config.fusion):
        return "the last view changed nothing"
    return None
