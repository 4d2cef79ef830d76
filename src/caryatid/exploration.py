"""The active vision loop: take a view, update the model, plan the next view, go there (section IV)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from types import NoneType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid.config import ActiveVisionConfig, Config, SegmentationMethod
from caryatid.errors import InputError, PlanningError, check_type
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import Change, SupportGraph, TakeStep
from caryatid.objects.reasons import Reasons
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision, Planner, PlanningState, check_candidates, path_cost
from caryatid.planning.expected_visibility import predict_goal, settled
from caryatid.planning.planners import make_planner
from caryatid.planning.planners.hidden_surface import SupportPlanner
from caryatid.robots import Posture, Robot, Unreachable, view_sphere_of, way_to
from caryatid.robots.arm import ArmRobot
from caryatid.robots.protocol import straight_lengths
from caryatid.runtime import Pictured
from caryatid.runtime.parallel import check_budget, one_blas_thread
from caryatid.scene import Scene, Stopwatch
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import Camera, Cloud, View
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.support.relations import Removal

log, progress = logging.getLogger(__name__), logging.getLogger("caryatid.progress")

UNTIL = 0.95
"""Default probability at which the effects of removing the goal count as known [1]."""
FARTHEST = 10.0
"""Distance of a candidate from the objects, at which it is not in metres [radii of the view sphere]."""
ATTEMPTS = 20
"""Views that the robot may refuse in one step before the loop stops [1]; a coarse map errs in one of ten."""


@dataclass(frozen=True, eq=False, slots=True)
class RobotPose:
    """Posture of a robot at a view.

    Attributes:
        posture: Pose of the platform, or of an arm's base, and gaze.
        T_world_camera: Camera pose (4, 4).
        footprint: Radius of the platform [m].
        arm: Whether it is an arm; the platform is then its base.
    """

    posture: Posture
    T_world_camera: Array
    footprint: float
    arm: bool


@dataclass(frozen=True, eq=False, slots=True)
class Step(Pictured):
    """One turn of the loop.

    Attributes:
        index: Number of the view, from 0.
        name: Name of the view or cloud.
        view: The view, or None for a cloud. Its pose is the reported one, or the registered one if there is
            none, or no robot.
        labels: Label image (H, W) of the view, or labels (N,) of a cloud.
        graph: The fused graph after this view.
        cloud: All points so far, downsampled, with labels.
        sphere: The view sphere of the robot.
        visited: Unit directions (V, 3) of the views so far from the sphere's centre.
        candidates: The views that could be reached next, or None if the loop stops.
        decision: The next view, or None if the loop stops. If the robot cannot go there, a warning says
            why, and the next step shows the view that was chosen instead.
        timings: Seconds of each stage.
        angle_travelled: Sum of the angles between consecutive views at the sphere's centre [rad].
        path_travelled: Path length [m] of a platform or of an arm's hand; without a robot, of the camera.
        stop: Why this is the last step, or None.
        robot: Posture of the robot, or None if unknown.
        changes: Changes of objects since the previous view, seen or reported.
        lift: The object removed after this view, or None.
        removal: With a goal that was found: what moves when it is removed; otherwise None.
        reasons: Why each object has its shape; empty before the last step.
        voxels: Which space was seen free; None before the last step.
    """

    index: int
    name: str
    view: View | None
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
    robot: RobotPose | None = None
    changes: tuple[Change, ...] = ()
    lift: TakeStep | None = None
    removal: Removal | None = None
    reasons: tuple[Reasons, ...] = ()
    voxels: VoxelMap | None = None

    def __repr__(self) -> str:
        following = f"stop: {self.stop}" if self.decision is None else f"next: {self.decision.why}"
        objects, supports = len(self.graph.movable), len(self.graph.supports)
        return f"Step(index={self.index}, objects={objects}, supports={supports}; {following})"


class Explorer:
    """Explores a scene one view at a time: call `look()`, `plan()` and `go()` in turn.

    If something else moves the camera, it takes the place of `go()`; call `put_aside` if it cannot go there.

    Between two calls, `use_planner` replaces the planner and `choose` replaces the next view.

    Args:
        camera: Camera that takes the views; None if they are passed to `look`.
        robot: Robot, placed at the first view; None without planning.
        planner: Planner of the next view, or its name.
        config: Settings of all stages.
        segmentation: `labels`, `auto`, or None to use labels if available.
        seed: Seed of every random choice.
        masks: Source of masks, or None to use those of the views.
        goal: Id or name of an object to remove, even if no view shows it yet. Planner `support` then looks
            at what its removal depends on, and the loop stops when that is known.
        until: Probability [1], above 0.5, at which a support counts as known; with a goal, whether an object
            moves. The loop stops when all are known. None = 0.95 with a goal, otherwise never.
        budget: Time that each `look` after the first takes [s], as for `Scene.update`; None = until the view
            is in the model. With a budget, `plan` uses what is in the model by then.

    Attributes:
        scene: The scene model.
        robot: The robot.
        goal: Id or name of the object to remove, or None.
        step: The newest step, or None before the first view.

    Raises:
        InputError: The planner is unknown, the masks would not be used, or `until` is out of range.
    """

    def __init__(
        self,
        camera: Camera | None = None,
        robot: Robot | None = None,
        *,
        planner: Planner | str = "support",
        config: Config | None = None,
        segmentation: SegmentationMethod | None = None,
        seed: int = 0,
        masks: Callable[[View], View] | None = None,
        goal: str | None = None,
        until: float | None = None,
        budget: float | None = None,
    ) -> None:
        check_type("until", until, (float, int, NoneType), "give a probability, such as 0.95")
        if camera is not None:
            check_type("camera", camera, "capture", "give an object with the methods of Camera")
        if robot is not None:
            check_type("robot", robot, "candidates", "give an object with the methods of Robot")
        if until is not None and not 0.5 < until <= 1.0:
            reason = f"{until:g} is not above 0.5 and at most 1"
            raise InputError("until", reason, "give a probability, such as 0.95")
        if masks is not None and segmentation == "auto":
            raise InputError("masks", "are not used by segmentation auto", "omit one of the two")
        self.scene = Scene(config, segmentation=segmentation, seed=seed)
        self._masks = masks
        self.goal = goal
        self._until = UNTIL if until is None and goal is not None else until
        self.robot = robot
        self.step: Step | None = None
        self._aside: list[tuple[Array, str]] = []
        self._budget = check_budget(budget)
        self._camera = camera
        self.use_planner(planner)

    def use_planner(self, planner: Planner | str) -> None:
        """Replace the planner.

        Raises:
            InputError: The planner is unknown.
        """
        self._planner = make_planner(planner)

    def look(self, given: View | Cloud | None = None) -> Step:
        """Take a view from the robot's current pose, and update the scene with it.

        Args:
            given: A view, or a cloud with z up, to use instead of the camera.

        Returns:
            The new step, without candidates and decision; with a budget, the newest one there is.

        Raises:
            NoSurfaceError: No support surface is known or visible. `scene` keeps a view that has a pose.
            CaryatidError: The view cannot be used, or neither a view nor a camera is given.
        """
        for _ in self.looks(given):
            pass
        return self._newest()

    def looks(self, given: View | Cloud | None = None) -> Iterator[Step]:
        """Look, and yield the steps of the kept views, then the step of the new one.

        With a budget, yield those of the views that are in the model by then; later ones yield the others.

        Args:
            given: As for `look`.

        Raises:
            CaryatidError: As for `look`.
        """
        watch = Stopwatch()
        if given is None:
            if self._camera is None:
                raise PlanningError("the explorer has no camera; pass a view to look()")
            given = self._camera.capture(self._moving().T_world_camera)
        if self._masks is not None and isinstance(given, View):
            given = self._masks(given)
        watch.lap("capture")
        self._aside = []
        budget = None if self.step is None else self._budget
        for taken in self.scene.updates(given, budget=budget):
            yield self._step(taken, watch.laps["capture"], kept=taken is not given)

    def finish(self) -> list[Step]:
        """Wait until all views are in the model; with a budget, some may be open.

        Returns:
            Their steps, without candidates and decision.

        Raises:
            CaryatidError: As for `look`.
        """
        return [self._step(taken, 0.0, kept=True) for taken in self.scene.updates()]

    def _step(self, source: View | Cloud, captured: float, *, kept: bool) -> Step:
        """Make the step of the newest view of the scene, with its capture time [s]."""
        scene, robot, before = self.scene, self.robot, self.step
        assert scene.sphere is not None
        assert scene.labels is not None
        view = source if isinstance(source, View) else None
        found = scene.T_world_camera
        if view is not None and found is not None and (robot is None or view.T_world_camera is None):
            view = view.with_pose(found)
        T_world_camera = found if robot is None or kept else robot.T_world_camera
        sphere = view_sphere_of(robot, scene.sphere)
        visited, angle, path = np.zeros((0, 3)), 0.0, 0.0
        if before is None and len(scene.T_world_cameras) > 1:  # a scene that others explored before
            visited = sphere.direction_of(np.stack(scene.T_world_cameras[:-1]))
        if before is not None:
            visited, angle, path = before.visited, before.angle_travelled, before.path_travelled
            if robot is None and view is not None and before.view is not None:
                path += float(np.linalg.norm(view.pose[:3, 3] - before.view.pose[:3, 3]))
        if T_world_camera is not None:
            visited = np.concatenate([visited, sphere.direction_of(T_world_camera)[None]])
            if len(visited) > 1:
                angle += float(transforms.angle_between(visited[-2], visited[-1]))
        posture, pose = None if kept or robot is None else robot.solve(robot.T_world_camera), None
        if robot is not None and isinstance(posture, Posture):
            footprint = scene.config.robot.footprint
            pose = RobotPose(posture, robot.T_world_camera, footprint, isinstance(robot, ArmRobot))
        self.step = Step(
            scene.views - 1, source.name, view, scene.labels, scene.graph, scene.cloud, sphere, visited,
            None, None, {"capture": captured} | scene.timings, angle, path, None, pose, scene.new_changes,
        )  # fmt: skip
        return self.step

    def plan(self) -> Step:
        """Choose the next view; if the robot refuses it after a closer check, choose among the others.

        Returns:
            The newest step, with candidates and decision; if no view is reachable, `stop` gives the reason.

        Raises:
            PlanningError: No view was taken yet, or the explorer has no robot.
        """
        step, robot = self._newest(), self._moving()
        watch = Stopwatch()
        decision, stop = None, None
        candidates: Candidates | None = None
        try:
            candidates = reachable_views(robot, step.sphere)
            for T_world_camera, why in self._aside:
                candidates = candidates.without(T_world_camera, why)
            if len(self._aside) >= ATTEMPTS:
                raise _refused_all(self._aside[-1][1])
            decision, candidates = _decide(self._state(candidates), robot, self._planner, self.scene.seed)
        except PlanningError as error:
            stop = str(error)
        watch.lap("plan")
        timings = step.timings | watch.laps
        self.step = replace(step, candidates=candidates, decision=decision, stop=stop, timings=timings)
        return self.step

    def reason_to_stop(self) -> str | None:
        """After `plan`, return why another view may not be worth its path, or None.

        Raises:
            PlanningError: No view was taken yet.
        """
        step = self._newest()
        if step.decision is None or step.candidates is None:
            return step.stop
        state, goal, until = self._state(step.candidates), self._goal_id(), self._until
        # Without a goal, nothing checks whether objects are hidden in the first view.
        asked = until if goal is not None or step.index > 0 else None
        if asked is not None and settled(state.graph, goal, asked, self.predict().removal):
            if goal is None:
                return f"every support is known with probability {asked:g}"
            return f"whether each object moves without {goal} is known with probability {asked:g}"
        return reason_to_stop(state, self.scene.changed, self._planner, step.decision)

    def predict(self) -> Step:
        """Predict what moves when the goal is removed: the `removal` of the newest step, which is returned.

        Raises:
            PlanningError: No view was taken yet.
        """
        step, scene, goal = self._newest(), self.scene, self._goal_id()
        if step.removal is None or step.removal.object_id != goal:
            assert scene.voxels is not None
            removal = predict_goal(step.graph, goal, scene.voxels, scene.config.support)
            self.step = replace(step, removal=removal)
        return self._newest()

    def conclude_step(self, step: Step) -> Step:
        """Add to the last step what only it tells: why each object has its shape, and free space."""
        return replace(step, reasons=self.scene.reasons(), voxels=self.scene.voxels)

    def choose(self, chosen: Decision | int) -> Step:
        """Choose another view instead of the planner's, and return the newest step with it and its waypoints.

        Args:
            chosen: A decision, or the index of one of the newest step's candidates.

        Raises:
            PlanningError: The candidate does not exist, the robot refuses it, or nothing was planned.
        """
        remedy = "give a decision or the index of a candidate"
        check_type("chosen", chosen, (Decision, int, np.integer), remedy)
        step = self._newest()
        if isinstance(chosen, Decision):
            decision = chosen
        else:
            index, candidates = int(chosen), step.candidates
            if step.decision is None or candidates is None or not 0 <= index < len(candidates):
                raise PlanningError(f"candidate {index} does not exist; choose an index of step.candidates")
            rated, T_world_camera = step.decision.candidate_saliency, candidates.T_world_camera[index]
            saliency = 0.0 if rated is None else float(rated[index])
            cost = float(path_cost(self._state(candidates))[index])
            decision = replace(step.decision, saliency=saliency, cost=cost, score=saliency - cost)
            decision = replace(decision, T_world_camera=T_world_camera, index=index, why="chosen by hand")
        way = way_to(self._moving(), decision.T_world_camera)
        if isinstance(way, Unreachable):
            raise PlanningError(way.reason)
        self.step = replace(step, decision=decision.with_fields(waypoints=way), stop=None)
        return self.step

    def go(self) -> Step:
        """Move the robot to the next view; put views aside to which it cannot go, and go to another.

        Returns:
            The newest step, with the view to which the robot went; if it can go to none, without a decision,
            and `stop` gives the reason.

        Raises:
            PlanningError: No view is planned.
        """
        step, robot = self._newest(), self._moving()
        if step.decision is None:
            raise PlanningError("no next view is planned; call plan() first")
        while step.decision is not None:
            try:
                path = step.path_travelled + robot.move_to(step.decision.T_world_camera)
                self.step = replace(step, path_travelled=path)
                return self.step
            except PlanningError as error:
                step = self.put_aside(str(error))
        return step

    def put_aside(self, why: str) -> Step:
        """Put the next view aside, because the robot cannot go there for a reason, and `plan` again.

        Raises:
            PlanningError: No view is planned.
        """
        step = self._newest()
        if step.decision is None:
            raise PlanningError("no next view is planned; call plan() first")
        self._aside.append((step.decision.T_world_camera, why))
        log.warning("%s: the robot cannot go to the next view, which is put aside: %s", step.name, why)
        return self.plan()

    def _state(self, candidates: Candidates) -> PlanningState:
        step = self._newest()
        poses = [v.pose for v in self.scene.open if isinstance(v, View) and v.T_world_camera is not None]
        visited = np.concatenate([step.visited, *(step.sphere.direction_of(T)[None] for T in poses)])
        return planning_state(self.scene, step.sphere, visited, candidates, self._goal_id())

    def _goal_id(self) -> str | None:
        """The goal's id, if it is known by its name and was found."""
        return None if self.goal is None else self._newest().graph.find_id(self.goal) or self.goal

    def _moving(self) -> Robot:
        if self.robot is None:
            raise PlanningError("the explorer has no robot to move")
        return self.robot

    def _newest(self) -> Step:
        if self.step is None:
            raise PlanningError("the scene has no views; call look() first")
        return self.step


def explore(
    camera: Camera,
    robot: Robot,
    *,
    planner: Planner | str = "support",
    config: Config | None = None,
    segmentation: SegmentationMethod | None = None,
    seed: int = 0,
    masks: Callable[[View], View] | None = None,
    goal: str | None = None,
    until: float | None = None,
    budget: float | None = None,
    early_stop: bool = True,
) -> Iterator[Step]:
    """Explore until no view is worth its path, or `max_views` is reached.

    Args:
        camera: Camera that takes the views.
        robot: Robot, placed at the first view.
        planner: Planner of the next view, or its name.
        config: Settings of all stages; `config.active.max_views` limits the views.
        segmentation: `labels`, `auto`, or None to use labels if available.
        seed: Seed of every random choice.
        masks: Source of masks, or None to use those of the views.
        goal: As for `Explorer`.
        until: As for `Explorer`.
        budget: As for `Explorer`.
        early_stop: Whether to stop before `max_views`, by `config.active.stop` and `until`.

    Yields:
        A step for each view, without a decision if a later view was in the model before the robot went on;
        the last one again, with `stop`, if the robot can go to no further view.

    Raises:
        CaryatidError: A view cannot be used, or the planner is unknown.
    """
    known: dict[str, Any] = {"config": config, "segmentation": segmentation, "seed": seed, "masks": masks}
    explorer = Explorer(camera, robot, planner=planner, goal=goal, until=until, budget=budget, **known)
    unshown = list[Step]()
    while True:
        unshown += explorer.looks()
        reason = _plan(explorer, early_stop)
        if explorer.scene.open and (reason or explorer.predict().stop):
            unshown += explorer.finish()
            reason = _plan(explorer, early_stop)
        step = explorer.predict()
        if reason is not None:
            step = replace(step, candidates=None, decision=None, stop=reason)
        yield from unshown[:-1]
        if step.decision is not None:
            if unshown:
                yield step
            step = explorer.go()
        unshown = []
        if step.stop is not None:
            for late in explorer.finish():
                yield late
                step = replace(late, stop=step.stop)
            step = explorer.conclude_step(step)
            lost = goal is not None and step.graph.find_id(goal) is None
            yield replace(step, stop=f"{step.stop}; {goal} was not found") if lost else step
            return


def _plan(explorer: Explorer, early_stop: bool) -> str | None:
    """Plan the next view; return why this one is the last, or None."""
    active, taken = explorer.scene.config.active, explorer.scene.views + len(explorer.scene.open)
    if (reason := used_up(taken, active)) is None and explorer.plan().stop is None and early_stop:
        reason = explorer.reason_to_stop()
    return reason


def reason_to_stop(state: PlanningState, changed: bool, planner: Planner, decision: Decision) -> str | None:
    """Return why another view may not be worth its path, or None.

    The planner chose this decision in this state. `changed` says whether the newest view changed the graph.
    """
    if len(state.visited) == 1:
        return None
    if state.config.stop == "unchanged":
        return None if changed else "the last view did not change the graph"
    if not isinstance(planner, SupportPlanner):
        decision = SupportPlanner().plan(state, np.random.default_rng(0))
    return "no further view is worth its path" if decision.score <= 0.0 else None


def used_up(views: int, config: ActiveVisionConfig) -> str | None:
    """Return that the maximum number of views is reached, or None."""
    return f"maximum of {views} views reached" if views >= config.max_views else None


def next_best_view(
    scene: Scene,
    robot: Robot | None = None,
    visited: Array | None = None,
    *,
    candidates: Candidates | ArrayLike | None = None,
    path_length: ArrayLike | None = None,
    planner: Planner | str = "support",
) -> Decision:
    """Choose where to look next (Algorithm 2).

    Args:
        scene: Scene model of at least one view.
        robot: Robot that must reach the view; None if `candidates` are given.
        visited: Unit directions (V, 3) of earlier views from the centre of the robot's view sphere, the
            current one last; None = those of the scene, or the robot's if they have no poses.
        candidates: Camera poses (N, 4, 4) to choose from; None = those the robot reaches.
        path_length: Path length (N,) [m] to each of these poses; None = straight lines.
        planner: Planner, or its name.

    Returns:
        The decision: `T_world_camera` is the view, `index` its index among the candidates, `waypoints` the
        path to it, `why` the reason, `stop` why another view may not be worth its path.

    Raises:
        InputError: The candidates are not poses, or differ in number from the path lengths; or `visited` are
            not unit directions.
        PlanningError: The scene has no view yet, or no view is reachable.
    """
    check_type("scene", scene, Scene, "give a Scene with at least one view")
    if scene.sphere is None:
        raise PlanningError("the scene has no views; update it with a first view")
    if robot is None and candidates is None:
        raise PlanningError("neither a robot nor candidates are given; give one of them")
    if robot is not None:
        check_type("robot", robot, "candidates", "give a Robot, or None with candidates")
    sphere, poses = view_sphere_of(robot, scene.sphere), scene.T_world_cameras
    if not poses and robot is not None:
        poses = (robot.T_world_camera,)
    if visited is None:
        if not poses:
            raise PlanningError("no view has a camera pose; give visited, the directions of earlier views")
        visited = sphere.direction_of(np.stack(poses))
    try:
        visited = np.asarray(visited, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("visited", "is not an array of numbers", "give unit directions (V, 3)") from None
    if visited.ndim != 2 or visited.shape[1] != 3 or len(visited) == 0:
        raise InputError("visited", f"has shape {visited.shape}", "give unit directions (V, 3), at least one")
    if not np.allclose(np.linalg.norm(visited, axis=1), 1.0, atol=1e-3):
        remedy = "give directions from the centre of the view sphere, of length 1"
        raise InputError("visited", "has rows that are not unit vectors", remedy)
    if candidates is None:
        assert robot is not None
        candidates = reachable_views(robot, sphere)
    elif not isinstance(candidates, Candidates):
        candidates = given_candidates(candidates, path_length, poses[-1] if poses else None, sphere)
    state, chooser = planning_state(scene, sphere, visited, candidates), make_planner(planner)
    decision, _ = _decide(state, robot, chooser, scene.seed)
    return decision.with_fields(stop=reason_to_stop(state, scene.changed, chooser, decision))


def reachable_views(robot: Robot, sphere: ViewSphere) -> Candidates:
    """Return the views of a sphere that a robot reaches.

    Raises:
        InputError: It returns neither `Candidates` nor poses.
    """
    reached: Any = robot.candidates(sphere)
    if isinstance(reached, Candidates):
        return reached
    return given_candidates(reached, None, robot.T_world_camera, sphere)


def given_candidates(
    poses: ArrayLike, path_length: ArrayLike | None, T_world_camera: Array | None, sphere: ViewSphere
) -> Candidates:
    """Check camera poses that a robot can reach from its camera pose (4, 4).

    Raises:
        InputError: They are not poses (N, 4, 4) or not in metres, or path lengths (N,) [m] differ in number
            or are negative.
    """
    try:
        named = enumerate(np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4))
        lengths = None if path_length is None else np.asarray(path_length, dtype=np.float64)
    except (TypeError, ValueError):
        remedy = "give camera poses (N, 4, 4) and, optionally, a path length (N,) [m] for each"
        raise InputError("candidates", "are not an array of poses", remedy) from None
    rigid = np.array([transforms.as_rigid(T, f"candidates[{n}]") for n, T in named]).reshape(-1, 4, 4)
    away, farthest = np.linalg.norm(rigid[:, :3, 3] - sphere.centre_world, axis=1), FARTHEST * sphere.radius
    if len(away) and away.min() > farthest:
        reason = f"are all more than {farthest:g} m from the objects"
        raise InputError("candidates", reason, "give camera poses in metres, in the world frame")
    if lengths is None:
        lengths = straight_lengths(T_world_camera, rigid)
    if lengths.shape != (len(rigid),) or not (lengths >= 0.0).all():
        reason = f"has shape {lengths.shape} or negative values for {len(rigid)} candidates"
        raise InputError("path_length", reason, "give one length of 0 or more for each candidate")
    return Candidates(rigid, sphere.direction_of(rigid), lengths, {})


@one_blas_thread
def _decide(
    state: PlanningState, robot: Robot | None, planner: Planner, seed: int
) -> tuple[Decision, Candidates]:
    """Return the decision, and the candidates that the robot has not refused."""
    rng = np.random.default_rng([seed, len(state.visited)])
    why = ""
    for _ in range(ATTEMPTS):
        check_candidates(state)
        decision = planner.plan(state, rng)
        check_type("the planner's choice", decision, Decision, "return a Decision from plan()")
        way = way_to(robot, decision.T_world_camera)
        if not isinstance(way, Unreachable):
            progress.info("next view: %s", decision.why)
            return decision.with_fields(waypoints=way), state.candidates
        why = way.reason
        state = replace(state, candidates=state.candidates.without(decision.T_world_camera, why))
    raise _refused_all(why)


def _refused_all(why: str) -> PlanningError:
    return PlanningError(f"the robot refused {ATTEMPTS} views in a row: {why}")


def planning_state(
    scene: Scene, sphere: ViewSphere, visited: Array, candidates: Candidates, goal: str | None = None
) -> PlanningState:
    """What a planner is told about a scene, after views in directions (V, 3)."""
    assert scene.voxels is not None
    return PlanningState(scene.graph, sphere, scene.voxels, visited, candidates, scene.config.active, goal)
