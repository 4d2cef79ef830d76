"""The scene model: objects, supports, and the space around them."""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import replace
from time import perf_counter
from types import NoneType
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid.config import GRIPPERS, Config, GripperConfig, GripperKind, SegmentationMethod, choose_gripper
from caryatid.errors import CaryatidError, InputError, NoSurfaceError, WrongViewError, check_type
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import UP, Array
from caryatid.graph import (
    Change,
    ChangeKind,
    SceneObject,
    SupportGraph,
    label_of,
    object_id,
)
from caryatid.objects.changes import ChangeDetector, appeared, describe_contradiction
from caryatid.objects.fusion import changed, fuse, fused_graph, renamed, without
from caryatid.objects.hidden_extents import complete
from caryatid.objects.models import ObjectModels
from caryatid.objects.reasons import Reasons
from caryatid.runtime import Pictured, call
from caryatid.runtime.parallel import check_budget, cores, in_background, one_blas_thread, read_compile_time
from caryatid.segmentation.diagnosis import (
    check_camera,
    check_depth,
    describe_centre,
    explain_mismatch,
    thin_view,
)
from caryatid.segmentation.holes import count_holes
from caryatid.segmentation.observation import Observation, label_image, observe
from caryatid.segmentation.support_plane import SupportSurface, find_surface_below, refitted
from caryatid.segmentation.view_checks import (
    check_masks,
    check_place,
    check_range,
    check_size,
)
from caryatid.sensing.registration import ViewRegistration
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import MAX_LABEL, SUPPORT_LABEL, Cloud, View, check_labels
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.support.plausibility import reconcile
from caryatid.support.relations import Effect, explain, infer, predict_removal

if TYPE_CHECKING:
    import networkx as nx

    from caryatid.manipulation.order import Order
    from caryatid.planning.decision import Decision, Planner


log, progress = logging.getLogger(__name__), logging.getLogger("caryatid.progress")

KEPT = "%s; this view is kept until a later one shows the table top"
"""Log message for a view without a support surface."""

LEFT_OUT = "%s; the view is ignored"
"""Log message for a view that cannot be correct."""


class Scene(Pictured):
    """The scene model of section III, updated view by view.

    The first scene after installation takes longer, because kernels are compiled.

    Args:
        config: Settings of all stages.
        segmentation: `labels` requires them in every view, `auto` ignores them, None uses them if available.
        seed: Seed of every random choice; the same seed and views give the same model.

    Attributes:
        graph: The fused support graph.
        labels: Label image (H, W) of the newest view, or labels (N,) of a cloud; 65535 = support surface.
        surfaces: The support surfaces, the main one first; none before the first view that shows one.
        voxels: Free, occupied and unknown space, or None before that view.
        sphere: The view sphere around the table top, or None before that view.
        T_world_camera: Pose (4, 4) of the newest view after registration, or None for a cloud.
        T_world_cameras: Poses (4, 4) of all views so far, each as registered when the view was new.
        views: Number of views in the model.
        waiting: Views kept until a later one shows the support surface.
        open: Views and clouds that are still to be added, after an `update` with a budget.
        changed: Whether the newest view changed the graph.
        identified: Whether the labels given with the newest view are those of the objects in all views.
        timings: Time of each stage of the newest update [s].
    """

    def __new__(cls, config: Config | None = None, *_: Any, **__: Any) -> Scene:
        """Make a scene; `caryatid.paper` has the classes for settings of the paper."""
        chosen = cls is Scene and isinstance(config, Config)
        scene: Scene = object.__new__(call("scene", config) if chosen else cls)
        return scene

    def __init__(
        self, config: Config | None = None, *, segmentation: SegmentationMethod | None = None, seed: int = 0
    ) -> None:
        check_type("config", config, (Config, NoneType), "give a caryatid.Config")
        check_type("seed", seed, (int, np.integer), "give an integer of at least 0")
        if segmentation not in (None, "labels", "auto"):
            raise InputError("segmentation", f"'{segmentation}' is unknown", "choose labels, auto or None")
        if seed < 0:
            raise InputError("seed", f"{seed} is negative", "give an integer of at least 0")
        self.config = config or Config()
        if not isinstance(self, kind := call("scene", self.config)):
            remedy = f"derive {type(self).__name__} from caryatid.paper.{kind.__name__}"
            raise InputError("config", "has settings of the paper, which this class lacks", remedy)
        self.segmentation = segmentation
        self.seed = seed
        self.graph = SupportGraph()
        self.labels: NDArray[np.int32] | None = None
        self.surfaces: tuple[SupportSurface, ...] = ()
        self.voxels: VoxelMap | None = None
        self.sphere: ViewSphere | None = None
        self.T_world_camera: Array | None = None
        self.T_world_cameras: tuple[Array, ...] = ()
        self.views = 0
        self.waiting: tuple[View, ...] = ()
        self.open: tuple[View | Cloud, ...] = ()
        self._work: tuple[Scene, Iterator[View | Cloud], Future[View | Cloud | None]] | None = None
        self._bare: tuple[View | Cloud, ...] = ()
        self.changed = False
        self.identified = False
        self.timings: dict[str, float] = {}
        self._models = ObjectModels(self.config, seed)
        self._registration: ViewRegistration | None = None
        self._graphs: tuple[SupportGraph, ...] = ()
        self._shown: tuple[frozenset[str], ...] = ()
        self._ids: dict[int, str] = {}
        self._detector = ChangeDetector()
        self._labelled: bool | None = None
        self._names: dict[str, dict[str, int]] = {}
        self._notes: frozenset[str] = frozenset()
        self._first: View | None = None

    @property
    def surface(self) -> SupportSurface | None:
        """The main support surface, or None before the first view that shows one."""
        return next(iter(self.surfaces), None)

    @property
    def supports(self) -> nx.DiGraph:
        """The support graph as a DiGraph, supporter → supported."""
        return self.graph.to_networkx()

    @property
    def changes(self) -> tuple[Change, ...]:
        """Changes of objects since the first view, in order."""
        return self._detector.history

    @property
    def new_changes(self) -> tuple[Change, ...]:
        """Changes that the newest view shows, or that were reported since the view before it."""
        return tuple(change for change in self.changes if change.view >= self.views - 1)

    @property
    def cloud(self) -> Cloud:
        """All points so far, downsampled view by view, with the labels of their objects."""
        cloud = self._models.points.everything()
        assert cloud.labels is not None
        return cloud.select(self._shown_labels(cloud.labels) > 0)

    def __repr__(self) -> str:
        objects, supports = len(self.graph.movable), len(self.graph.supports)
        return f"Scene(views={self.views}, objects={objects}, supports={supports})"

    def explain(self, supporter: str, supported: str) -> str:
        """Explain why one object supports another, or why not, with numbers.

        Args:
            supporter: Id or name of an object, such as `o1`.
            supported: Id or name of an object.
        """
        a, b = (self.graph.find_id(word) or word for word in (supporter, supported))
        return explain(self.graph, a, b, self.config.support)

    def why(self, object_id: str, other: str | None = None) -> Reasons:
        """Say what an object's explanation costs, and what others would; or why two objects are two.

        Args:
            object_id: Id or name of an object, such as `o3`.
            other: Id or name of another one.

        Raises:
            InputError: An object is unknown, or has no points, or both are the same.
        """
        words, labels = [object_id] if other is None else [object_id, other], list[int]()
        ids = [self._object(word).id for word in words]
        for id_ in ids:
            label = self._label_of(id_)
            if label is None or label not in self._models.fits:
                raise InputError(id_, "has no points in the newest model", "ask about another object")
            labels.append(label)
        if len({*ids}) < len(ids):
            raise InputError(object_id, "is the same object", "ask about two different objects")
        return replace(self._models.reasons(labels, self.voxels), subject=tuple(ids))

    def reasons(self) -> tuple[Reasons, ...]:
        """Say why each object has its shape: `why` of all that have points."""
        known = (o.id for o in self.graph.movable)
        return tuple(self.why(id_) for id_ in known if self._label_of(id_) in self._models.fits)

    def predict_removal(self, object_id: str) -> tuple[Effect, ...]:
        """Predict which objects move when one is removed, with probability and reason.

        Args:
            object_id: Id or name of an object, such as `o3`.

        Raises:
            InputError: The object is unknown, or it is the support surface.
        """
        return predict_removal(self.graph, self._object(object_id).id, self.config.support)

    def order(
        self,
        *,
        goal: str | None = None,
        gripper: str | GripperConfig | None = None,
        hands: int = 1,
        risk: float | None = None,
        steps: int | None = None,
        threads: int | None = None,
    ) -> Order:
        """Find a safe order in which to remove all objects, or to reach one.

        A gripper moves only through space that was seen empty.

        Args:
            goal: Id or name of the object to reach; only objects in its way are removed.
            gripper: Kind or name of a gripper, such as `franka`, or its settings; None = that of the
                configuration, without which every object can be grasped.
            hands: 2 if another hand can hold one object, else 1.
            risk: Maximum probability that a lift moves another object [1]; None = that of the configuration.
            steps: Maximum number of steps; None = all.
            threads: Number of parallel rehearsals; None = all cores.

        Returns:
            The order: its `steps`, whether it is `safe`, and the `risk` of all lifts together.

        Raises:
            GoalError: The goal is not an object of the graph, or the name of several.
            InputError: The gripper is unknown, or the scene has no objects.
        """
        names = {*GRIPPERS, *get_args(GripperKind)}
        if isinstance(gripper, str) and gripper not in names:
            remedy = f"choose one of {', '.join(sorted(names))}"
            raise InputError("gripper", f"'{gripper}' is unknown", remedy)
        if isinstance(gripper, str):
            gripper = choose_gripper(gripper, self.config.gripper)
        check_type("gripper", gripper, (GripperConfig, NoneType), "give a name or a caryatid.Gripper")
        if not self.graph.objects:
            raise InputError("scene", "has no views", "update it with a first view")
        rehearsal = self.config.rehearsal
        if risk is not None:
            if not 0.0 <= risk <= 1.0:
                raise InputError("risk", f"{risk:g} is not a probability", "give a number from 0 to 1")
            rehearsal = replace(rehearsal, risk=risk)
        config = replace(self.config, gripper=gripper or self.config.gripper, rehearsal=rehearsal)
        order: Order = call(
            "order", self.graph, config, goal=goal, hands=hands, steps=steps, seed=self.seed,
            threads=cores() if threads is None else threads, voxels=self.voxels,
        )  # fmt: skip
        return order

    def next_view(self, candidates: ArrayLike, *, planner: Planner | str = "support") -> Decision:
        """Choose where to look next; `caryatid.next_best_view` has more options.

        Args:
            candidates: Camera poses (N, 4, 4) to choose from.
            planner: Planner, or its name.

        Returns:
            The decision: `index` of the pose, `why` says why, and `stop` why to look no further, or None.

        Raises:
            InputError: The candidates are not poses.
            PlanningError: The scene has no view yet.
        """
        decision: Decision = call("next view", self, candidates=candidates, planner=planner)
        return decision

    def show(self) -> Any:
        """Open the viewer in the browser, or in the cell of a notebook.

        Returns:
            A handle with the page's `url`; `update(scene)` adds the scene's current state, `close()` ends it.

        Raises:
            InputError: viser (extra `view`) is not installed, or no port is free.
        """
        return call("viewer", self)

    def copy(self) -> Scene:
        """Return an independent copy, without the views in `open`.

        Both give the same graphs for the same further views. Data that no update changes in place is shared,
        so a copy costs almost nothing.
        """
        other = copy.copy(self)
        other._models = other._models.copy()
        other._registration = None if other._registration is None else other._registration.copy()
        other._detector = other._detector.copy()
        return other

    def __getstate__(self) -> dict[str, Any]:
        """The state to store, without the views in `open`."""
        return vars(self) | {"open": (), "_work": None}

    def removed(self, object_id: str) -> SupportGraph:
        """Report that an object was removed; the model deletes it, and its space becomes unknown.

        Args:
            object_id: Id of an object, such as `o3`.

        Returns:
            The graph without it.

        Raises:
            InputError: The object is unknown, or it is the support surface.
        """
        self._finish()
        removed = self._object(object_id)
        self._forget(removed)
        self._reported("removed", removed.id)
        return self.graph

    def moved(self, object_id: str, T: Array) -> SupportGraph:
        """Report that an object was moved; its points and shape move too, and its supports are recomputed.

        Args:
            object_id: Id of an object, such as `o3`.
            T: The object's motion as a rigid transform (4, 4) in the world frame.

        Returns:
            The graph with the object at its new pose.

        Raises:
            InputError: The object is unknown, it is the support surface, or T is not a rigid transform.
        """
        self._finish()
        moved = self._object(object_id)
        self._forget(moved, transforms.as_rigid(T, "T"))
        self._reported("moved", moved.id)
        return self.graph

    def added(self, shape: Shape, label: int | None = None) -> str:
        """Report that an object was added.

        Args:
            shape: Its shape and pose, in the world frame.
            label: Its number in the masks of later views; None if it has none yet.

        Returns:
            Id of the new object.

        Raises:
            InputError: The scene has no views, the shape is not in metres, or the label is not free.
        """
        self._finish()
        if self.voxels is None:
            raise InputError("scene", "has no views", "add a view first")
        check_type("shape", shape, Shape, "give a Box, a Cylinder, a Sphere or a Solid")
        if shape.extents.max() > self.config.cloud.max_depth:
            reason = f"has extents of {shape.extents.round(3).tolist()} m"
            raise InputError("shape", reason, "give lengths in metres")
        label = self._free_label() if label is None else label
        if label in self._labels() or not 0 < label < SUPPORT_LABEL:
            remedy = f"give a number from 1 to {SUPPORT_LABEL - 1} that no other object has"
            raise InputError("label", f"{label} is not free", remedy)
        self._models.put(shape, label, self.views - 1)
        self._ids = self._ids | {label: object_id(label)}
        self.voxels = self.voxels.forgotten(self.voxels.within(shape, np.zeros((0, 3))))
        self._reported("added", object_id(label))
        return object_id(label)

    def _finish(self) -> None:
        """Add the open views before something is reported; one that cannot be added is left out."""
        try:
            self.update()
        except CaryatidError as error:
            log.warning(LEFT_OUT, error)

    def _object(self, object_id: str) -> SceneObject:
        """The object with this id or name.

        Raises:
            InputError: The id is unknown, or it is the support surface.
        """
        for o in self.graph.objects:
            if o.id == self.graph.find_id(object_id) and o.role == "object":
                return o
        raise InputError(object_id, "is not an object of the graph", self.graph.suggest_objects(object_id))

    def _labels(self) -> set[int]:
        """Labels of the objects, in the models and in the graph."""
        own = {o.label for o in self.graph.movable}
        return {*self._models.points.objects, *own}

    def _free_label(self) -> int:
        """A label that no object has or had."""
        return max(self._models.points.labels_used, *self._labels(), 0) + 1

    def _forget(self, o: SceneObject, T: Array | None = None) -> None:
        """Forget an object, or move its points and shape by T; its supports are dropped."""
        label = self._label_of(o.id)
        points = np.zeros((0, 3)) if label is None else self._models.points.of(label).points_world
        if self.voxels is not None:
            which = self.voxels.within(o.shape, points)
            if T is not None:
                which |= self.voxels.within(o.shape.moved(T), np.zeros((0, 3)))
            self.voxels = self.voxels.forgotten(which)
        if T is not None and label in self._models.fits:
            self._models.relocate(label, T)
        else:
            self._models.forget(set() if label is None else {label})
            if T is not None:
                label = self._free_label()
                self._models.put(o.shape.moved(T), label, self.views - 1)
                self._ids = self._ids | {label: o.id}
        self._graphs = tuple(without(graph, {o.id}) for graph in self._graphs)
        self._shown = tuple(ids - {o.id} for ids in self._shown)

    def _label_of(self, object_id: str) -> int | None:
        """Label of an object of the graph in the models, or None."""
        for label, known in self._ids.items():
            if known == object_id:
                return label
        label = label_of(object_id)
        return None if label in self._ids else label

    def _reported(self, kind: ChangeKind, object_id: str) -> None:
        """Record what the robot did, and derive the graph again."""
        assert self.voxels is not None
        self._detector.report(Change(kind, object_id, self.views, "reported by the robot"))
        newest = self._inferred(self.voxels)
        names = {o.id: self._ids.get(o.label, o.id) for o in newest.movable}
        newest = renamed(newest, names)
        self._graphs = (*self._graphs[:-1], newest)
        if kind != "removed":
            self._shown = (*self._shown[:-1], self._shown[-1] | {object_id})
        self._set_graph(newest)

    def update(self, source: View | Cloud | None = None, *, budget: float | None = None) -> SupportGraph:
        """Add one view, or one cloud with z up, and return the fused graph.

        A view with a pose but without a support surface is kept, with a warning, until a view shows one. Kept
        views are then added first.

        Args:
            source: The view or cloud; None goes on with those in `open`.
            budget: Time after which this returns [s]; None = all views are added first. The work goes on in
                the background, and the next call takes over what is done by then: the graph is always that
                of whole views, and after enough calls the same as without a budget. A call also raises the
                error of a view that was open; the one given to it then is open, and need not be given again.

        Raises:
            InputError: Required labels are missing, a later view has no pose, or the budget is negative.
            WrongViewError: The camera or its pose cannot be correct; the scene does not change.
            PerceptionError: The view has no readings; or no support surface, and no pose.
        """
        kept = len(self.waiting)
        try:
            for _ in self.updates(source, budget=budget):
                pass
        except NoSurfaceError as error:
            if len(self.waiting) == kept:
                raise
            log.warning(KEPT, error)
        return self.graph

    def updates(
        self, source: View | Cloud | None = None, *, budget: float | None = None
    ) -> Iterator[View | Cloud]:
        """Add views as `update` does; yield each when it is part of the model.

        Raises:
            NoSurfaceError: The view shows no support surface; if it has a pose, it is kept.
            CaryatidError: As for `update`.
        """
        budget, started, failure = check_budget(budget), perf_counter(), None
        if source is not None:
            check_type("source", source, (View, Cloud), "give a View or a Cloud")
            if budget is None and not self.open:
                yield from self._add(source)
                return
            self.open = (*self.open, source)
        while self.open:
            if self._work is None:
                ahead = self.copy()
                views = ahead._add(self.open[0])
                self._work = ahead, views, in_background(next, views, None)
            ahead, views, job = self._work
            left = None if budget is None else max(started + budget - perf_counter(), 0.0)
            if not wait([job], left).done:
                return
            # Kept views come before the one that is open.
            done, error = None, job.exception()
            if error is None and (done := job.result()) is not self.open[0]:
                vars(self).update(vars(ahead.copy()) | {"open": self.open})
                self._work = ahead, views, in_background(next, views, None)
            else:
                vars(self).update(vars(ahead) | {"open": self.open[1:], "_work": None})
            if error is not None:
                if budget is not None or not isinstance(error, CaryatidError):
                    raise error
                if failure is not None:
                    log.warning(LEFT_OUT, error)
                failure = failure or error
            elif done is not None:
                yield done
        if failure is not None:
            raise failure

    def _add(self, source: View | Cloud) -> Iterator[View | Cloud]:
        """Add a view or cloud, after the kept views; yield each when it is part of the model."""
        given = source
        if isinstance(source, View):
            check_camera(source, self.config.cloud.max_coordinate)
            if not self.views and not self.waiting:
                check_depth(source)
                if off_centre := describe_centre(source):
                    log.warning("%s: %s", source.name, off_centre)
                self._first = None if source.T_world_camera is None else thin_view(source)
        else:
            labels = None if source.labels is None else check_labels(source.labels, source.name)
            source = replace(source, normals_world=transforms.unit(source.normals_world), labels=labels)
        labelled = source.labels is not None
        if self.segmentation is None and self._labelled not in (None, labelled):
            reason = f"has {'' if labelled else 'no '}labels, unlike earlier views"
            raise InputError(source.name, reason, "give labels for every view, or for none")
        try:
            if self.waiting:
                self.surfaces = self._observed(source).surfaces
            for view in (*self.waiting, source):
                self.waiting = self.waiting[1:]
                try:
                    self._start_again(view)
                    self._take_in(view)
                except WrongViewError as error:
                    if view is source:
                        raise
                    log.warning(LEFT_OUT, error)
                else:
                    self._labelled = labelled
                    # A table that so many views show empty is one.
                    bare = self.views <= self.config.cloud.views and not self._models.points.objects
                    bare &= len(self._bare) == self.views - 1
                    self._bare = (*self._bare, view) if bare else ()
                    yield given if view is source else view
        except NoSurfaceError:
            if isinstance(source, View) and source.T_world_camera is not None:
                self.waiting, self._labelled = (*self.waiting, source), labelled
            raise

    def _start_again(self, source: View | Cloud) -> None:
        """Take all views in again, with the table of this one, if nothing stands on what they show.

        They may show the floor alone.
        """
        if not self._bare:
            return
        try:
            found = self._observed(source, anew=True)
        except NoSurfaceError:
            return
        if not found.shown_objects or found.surface.continues(self.surfaces[0], self.config.surface):
            return
        views, first = self._bare, self._first
        vars(self).update(vars(type(self)(self.config, segmentation=self.segmentation, seed=self.seed)))
        self.surfaces, self._first = found.surfaces, first
        for view in views:
            try:
                self._take_in(view)
            except WrongViewError as error:
                log.warning(LEFT_OUT, error)

    def _observed(self, source: View | Cloud, *, anew: bool = False) -> Observation:
        rng = np.random.default_rng([self.seed, self.views])
        carrying = {SUPPORT_LABEL - o.label for o in self.graph.support_surfaces}
        return observe(
            source, self.config, segmentation=self.segmentation, known=() if anew else self.surfaces,
            carrying=frozenset() if anew else carrying, rng=rng,
        )  # fmt: skip

    @one_blas_thread
    def _take_in(self, source: View | Cloud) -> None:
        watch = Stopwatch()
        given = source.labels is not None and self.segmentation != "auto"
        self.identified = named = given and self._named(source)
        observation = self._observed(source)
        if observation.view is not None and isinstance(source, View):
            self._say_resampled(source, observation.view)
            check_range(source, self.config)
            if given:
                check_masks(source, observation.cloud.viewpoint_world, observation.surface, self.config)
            else:  # masks show what has no depth
                self._check_holes(observation.view, observation.surface)
        self._check_found(observation, source.name, masks=given)
        for note in sorted({*observation.notes} - self._notes):
            log.warning("%s: %s", source.name, note)
        self._notes |= {*observation.notes}
        if not self.views:
            check_size(source.name, observation.surface, self.config.surface)
        watch.lap("segment")
        observation, moved = self._registered(observation)
        watch.lap("register")
        before = self.voxels
        missing, new = self._changes_seen(observation)
        if self.surface and before and self._registration and observation.view:
            # If everything it shows had changed, the pose would be wrong instead.
            objects = set(observation.shown_objects)
            # The room behind the surfaces belongs to nobody.
            unexplained = observation.cloud.select(
                np.isin(observation.labels, sorted(objects - new.keys() or objects))
            )
            if doubt := describe_contradiction(unexplained, self.surface, before, self.config):
                cause = self._cause_of_mismatch(observation.view)
                log.warning("%s: %s; %s", source.name, doubt, cause or "its pose is wrong, or objects moved")
        if not named:
            observation, new = self._associate_segments(observation, given, new)
        if named and self.views:
            self._check_identity(observation, source.name)
        shown = self._models.add(observation, self.views, masked=given) | moved
        self.surfaces = self._fused_surfaces(observation)
        carrying = self._carrying(observation)
        below = voxels = self._mapped(observation, carrying)
        watch.lap("map")
        for surface in carrying:
            lowest = surface.point_world[2] <= voxels.origin_world[2] + self.config.voxels.below
            depth = np.inf if lowest else float(surface.shape.extents[2])
            below = below.closed_below(surface.outline_world, surface.normal_world, depth)
        table = observation.footprint(self.surfaces, self.config.explanation.spacing)
        observation = self._form_objects(observation, shown, below, table, given)
        self._check_fitted(source.name)
        if not named:
            observation, new = self._reidentified(observation, new)
        watch.lap("fit")
        newest = self._inferred(voxels)
        watch.lap("infer")
        observation = self._fused(observation, newest, given)
        names = {k: self._ids.get(k, object_id(k)) for k in (*self._models.points.objects, *new)}
        present = {names[k] for k in self._models.points.objects}
        self._detector.record(self.views, missing, {names[k]: why for k, why in new.items()}, present)
        self.labels = self._shown_labels(label_image(observation, source))
        if isinstance(source, View) and given and source.names:
            self._name_objects(source, self.labels)
        self.T_world_camera = None if observation.view is None else observation.view.T_world_camera
        if self.T_world_camera is not None:
            self.T_world_cameras = (*self.T_world_cameras, self.T_world_camera)
        self.views += 1
        watch.lap("fuse")
        self.timings = watch.laps
        found, seconds = self.graph, sum(watch.laps.values()) - watch.laps.get("compile", 0.0)
        counts = len(found.objects), len(found.supports)
        progress.info("%s: %d vertices, %d edges, %.2f s", source.name, *counts, seconds)

    def _named(self, source: View | Cloud) -> bool:
        """Whether a label identifies the same object in all views."""
        if isinstance(source, View) and source.labels_are == "segments":
            return False
        return self.config.fusion.masks == "scene"

    def _list_known_objects(self) -> list[SceneObject]:
        """The objects that new segments may belong to."""
        return self._models.objects()

    def _associate_segments(
        self, observation: Observation, given: bool, new: dict[int, str]
    ) -> tuple[Observation, dict[int, str]]:
        """Give segments, and those among them that are new, the labels of their objects."""
        segments = observation.labels
        observation = self._models.associate(
            observation, self._list_known_objects(), masks=given, new=new.keys()
        )
        return observation, {int(observation.labels[segments == k][0]): why for k, why in new.items()}

    def _check_identity(self, observation: Observation, name: str) -> None:
        """Warn if most masks lie on objects that had other numbers in earlier masks."""
        wrong, shown = self._models.mislabelled(observation)
        if 2 * wrong > shown:
            log.warning(
                "%s: %d of %d masks lie on objects that had other numbers; if each view has its own numbers, "
                'use --masks per-view or View(labels_are="segments")',
                name, wrong, shown,
            )  # fmt: skip

    def _say_resampled(self, source: View, used: View) -> None:
        """Report once that only some pixels of large images are used."""
        (height, width), (rows, columns) = source.depth.shape, used.depth.shape
        if not self.views and rows < height:
            log.info(
                "%s: using %d×%d of %d×%d pixels, for samples cloud.voxel apart",
                source.name, columns, rows, width, height,
            )  # fmt: skip

    def _check_holes(self, view: View, surface: SupportSurface) -> None:
        """Warn of regions without depth that are as large as an object."""
        holes = count_holes(view, surface, self.config.segmentation)
        if holes:
            log.warning(
                "%s: no depth in %s above the table (transparent, black or shiny objects?); "
                "objects there will be missed",
                view.name, "1 region" if holes == 1 else f"{holes} regions",
            )  # fmt: skip

    def _check_found(self, observation: Observation, name: str, masks: bool) -> None:
        """Warn if there are readings above the support surface but no object."""
        if not observation.shown_objects:
            low, high = self.config.segmentation.clearance, self.config.segmentation.max_height
            over = observation.surface.over(observation.cloud.points_world, low, high, 0.0)
            if over.sum() * self.config.cloud.voxel**2 >= self.config.segmentation.min_area:
                remedy = "no mask covers them" if masks else "move closer, or give a larger image or masks"
                log.warning("%s: %d points above the table belong to no object; %s", name, over.sum(), remedy)

    def _check_fitted(self, name: str) -> None:
        """Warn, once, that something on the table is left out because it is too long for an object."""
        limit = self.config.fit.max_extent
        note = f"something longer than {limit:g} m is left out; if it is an object, raise fit.max_extent"
        if note in self._notes:
            return
        for label in sorted(set(self._models.points.objects) - self._models.fits.keys()):
            places = self._models.points.of(label).points_world
            if len(places) and np.linalg.norm(np.ptp(places, axis=0)) > limit:
                log.warning("%s: %s", name, note)
                self._notes |= {note}
                return

    def _registered(self, observation: Observation) -> tuple[Observation, set[int]]:
        """Register the view to the earlier ones, and correct their poses too.

        Returns:
            The registered observation, and the labels of the objects with moved points.

        Raises:
            WrongViewError: The pose cannot be correct; the scene does not change.
        """
        config = self.config
        if not config.registration.enabled:
            return observation, set()
        if self._registration is None:
            registration = ViewRegistration(observation.surface.point_world, config.registration)
        else:
            registration = self._registration.copy()
        moves = registration.add(observation.cloud, same_labels=self.identified)
        observation = observation.moved(moves.pop(self.views))
        seen = self._models.points.of(SUPPORT_LABEL)
        if self.voxels and observation.view and len(seen.points_world) >= config.surface.min_points:
            try:
                check_place(observation.cloud, registration.aligned, self.surfaces, self.voxels, config)
            except WrongViewError as error:
                cause = self._cause_of_mismatch(observation.view)
                raise WrongViewError(error.source, error.reason, cause or error.remedy) from None
        self._registration = registration
        return observation, {k for k in self._models.points.move(moves) if k <= MAX_LABEL}

    def _cause_of_mismatch(self, view: View) -> str:
        """Why a view's pose does not fit that of the first view, or ""."""
        if self._first is None:
            return ""
        return explain_mismatch(self._first, thin_view(view), self.config.surface.max_tilt)

    def _fused_surfaces(self, observation: Observation) -> tuple[SupportSurface, ...]:
        """The support surfaces from the points of all views."""
        fused, config = list(observation.surfaces), self.config.surface
        shown = {o.label for o in self.graph.support_surfaces}
        for k, known in enumerate(self.surfaces):
            if SUPPORT_LABEL - k not in shown:
                continue
            own = self._models.points.of(SUPPORT_LABEL - k)
            if len(own) >= config.min_points:
                fused[k] = refitted(known, own.points_world, own.normals_world, UP, config) or known
        return tuple(fused)

    def _shown_labels(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """Labels (...) with 0 for surfaces that carry nothing, which the graph lacks."""
        lacking = [SUPPORT_LABEL - k for k in range(len(self.surfaces))]
        known = {o.label for o in self.graph.support_surfaces}
        return np.where(np.isin(labels, [k for k in lacking if k not in known]), np.int32(0), labels)

    def _carrying(self, observation: Observation) -> list[SupportSurface]:
        """The main surface, and those that carry something as far as is known."""
        points = observation.cloud.points_world[(observation.labels > 0) & (observation.labels <= MAX_LABEL)]
        points = points[:: max(1, len(points) // 5_000)]  # some tell
        known = {SUPPORT_LABEL - o.label for o in self.graph.support_surfaces}
        numbers = {0, *known, *find_surface_below(self.surfaces, points).tolist()}
        return [self.surfaces[k] for k in sorted(numbers) if k < len(self.surfaces)]

    def _mapped(self, observation: Observation, carrying: Sequence[SupportSurface]) -> VoxelMap:
        """Add the view to the map, which reaches below all surfaces that carry something."""
        if self.sphere is None or self.voxels is None:
            centre = observation.surface.point_world
            self.sphere = ViewSphere.around(centre, self.config.active)
            self.voxels = VoxelMap.around(centre, self.config.voxels)
        lowest = min(float(surface.point_world[2]) for surface in carrying)
        self.voxels = self.voxels.lowered(lowest - self.config.voxels.below)
        if observation.view is not None:
            self.voxels = self.voxels.integrate(observation.view, self.config.cloud.max_depth)
        return self.voxels

    def _form_objects(
        self, observation: Observation, shown: set[int], voxels: VoxelMap, table: Array, given: bool
    ) -> Observation:
        """Fit the objects this view changed; split and merge automatic segments as the shapes suggest."""
        shown = self._models.find_outdated(shown, voxels)
        self._models.fit_all(shown, voxels)
        if self.identified:
            self._models.form(shown, voxels, table)
            return observation
        changed = set() if given else self._models.divide(shown, voxels)
        if changed:
            observation = self._models.nearest(observation, changed)
        given_up = self._models.unite(shown | changed, voxels)
        self._models.form(shown | changed | set(given_up.values()), voxels, table)
        return self._renamed(observation, given_up)

    def _renamed(self, observation: Observation, given_up: Mapping[int, int]) -> Observation:
        """Relabel objects, now and in the graphs so far: old → new."""
        if given_up:
            self._rename_objects({object_id(old): object_id(new) for old, new in given_up.items()})
        return observation.relabelled(dict(given_up))

    def _rename_objects(self, names: dict[str, str]) -> None:
        """Rename objects in the graphs so far: old → new id."""
        self._graphs = tuple(renamed(graph, names) for graph in self._graphs)
        self._shown = tuple(frozenset(names.get(i, i) for i in ids) for ids in self._shown)

    def _changes_seen(self, observation: Observation) -> tuple[dict[str, str], dict[int, str]]:
        """Find objects that changed, and delete them before anything is added.

        Only a registered view can show a change: an error of its pose looks the same.

        Returns:
            Ids of the objects that are no longer in place, and labels of the segments in space that was free;
            each with a reason.
        """
        view, voxels, registration = observation.view, self.voxels, self._registration
        if view is None or voxels is None or registration is None or not registration.aligned:
            return {}, {}
        missing = self._detector.missing(view, self._surfaces())
        new = self._find_appeared(observation, voxels)
        if self.identified:
            moved = {object_id(k): why for k, why in new.items() if k in self._models.points.objects}
            missing = moved | missing
        for id_ in missing:
            o = next((o for o in self.graph.objects if o.id == id_), None)
            self._detector.lose(id_, o)
            if o is not None:
                self._forget(o)
            elif (label := self._label_of(id_)) is not None:
                self._models.forget({label})
        if new:
            pixels = np.zeros(view.depth.shape, dtype=np.bool_)
            pixels.ravel()[observation.pixels] = np.isin(observation.labels, sorted(new))
            assert self.voxels is not None
            which = self.voxels.behind(view, pixels, self.config.fit.max_extent)
            self.voxels = self.voxels.forgotten(which & (self.voxels.hits == 0))
        return missing, new

    def _find_appeared(self, observation: Observation, voxels: VoxelMap) -> dict[int, str]:
        """Labels of the segments in space that was free, each with a reason."""
        assert observation.view is not None
        rows = np.flatnonzero((observation.labels > 0) & (observation.labels <= MAX_LABEL))
        points = observation.cloud.points_world[rows]
        return appeared(observation.view.name, points, observation.labels[rows], voxels.states_around(points))

    def _surfaces(self) -> dict[str, tuple[Array, Array]]:
        """Points and normals of the objects by id."""
        models, found = self._models.points, dict[str, tuple[Array, Array]]()
        for label in models.objects:
            cloud = models.of(label, self.config.cloud.voxel)
            found[self._ids.get(label, object_id(label))] = cloud.points_world, cloud.normals_world
        return found

    def _reidentified(
        self, observation: Observation, new: dict[int, str]
    ) -> tuple[Observation, dict[int, str]]:
        """Give new segments the labels of missing objects with similar shapes."""
        new = {k: why for k, why in new.items() if k in self._models.fits}
        found = self._detector.found_again(self._models.fits, new, self._label_of)
        for old, label in found.items():
            self._models.rename(old, label)
        return self._renamed(observation, found), {found.get(k, k): why for k, why in new.items()}

    def _inferred(self, voxels: VoxelMap) -> SupportGraph:
        """The support graph of the objects, and of the surfaces that carry something beside the main one."""
        fitted = self._models.objects()
        if self.config.completion.enabled:
            fitted = complete(fitted, self.surfaces, voxels, self.config.completion)
        surfaces = [
            SceneObject(object_id(SUPPORT_LABEL - k), SUPPORT_LABEL - k, surface.shape, "support_surface")
            for k, surface in enumerate(self.surfaces)
        ]
        graph = self._infer_supports(reconcile([*surfaces, *fitted], self.config.plausibility))
        carrying = {s.supporter for s in graph.supports}
        return without(graph, {o.id for o in surfaces[1:] if o.id not in carrying})

    def _infer_supports(self, objects: Sequence[SceneObject]) -> SupportGraph:
        """The support graph of shapes."""
        return infer(objects, self.config.support)

    def _fused(self, observation: Observation, newest: SupportGraph, given: bool) -> Observation:
        """Add the newest graph to the earlier ones; its labels become those of the fused objects."""
        whole = self.config.fusion.method == "sg"
        self._graphs, names = fuse(self._graphs, newest, self._match_objects(newest, given), whole=whole)
        self._ids = {label_of(o): n for o, n in names.items()}
        observation = observation.relabelled({k: label_of(n) for k, n in self._ids.items()})
        seen = set(map(object_id, observation.shown))
        self._shown = (*self._shown, frozenset(seen))
        self._set_graph(renamed(newest, names))
        return observation

    def _match_objects(self, newest: SupportGraph, given: bool) -> dict[str, str] | None:
        """Known ids of the newest graph's objects; None where a label means the same object in every view."""
        return None

    def _fuse_graphs(self) -> SupportGraph:
        """The graph of all views."""
        return fused_graph(self._graphs, self.config.fusion, shown=self._shown)

    def _set_graph(self, newest: SupportGraph) -> None:
        """Derive the fused graph from all graphs; stability is that of the newest one, with fused ids."""
        fused = self._fuse_graphs()
        ids = {o.id for o in fused.objects}
        stability = {i: verdict for i, verdict in newest.stability.items() if i in ids}
        before, self.graph = self.graph, self._with_names(replace(fused, stability=stability))
        self.changed = changed(before, self.graph, self.config.fusion)

    def _name_objects(self, view: View, labels: NDArray[np.int32]) -> None:
        """Vote for the object that fills most of each named mask, by the labels (H, W) of objects."""
        assert view.names is not None
        for label, name in view.names.items():
            found = labels[(view.labels == label) & (labels > 0) & (labels <= MAX_LABEL)]
            if found.size:
                pixels = np.bincount(found)
                votes = self._names.get(id_ := object_id(int(pixels.argmax())), {})
                votes = votes | {name: votes.get(name, 0) + int(pixels.max())}
                self._names = self._names | {id_: votes}
        self.graph = self._with_names(self.graph)

    def _with_names(self, graph: SupportGraph) -> SupportGraph:
        """The graph with the name of each object that most pixels of its masks have."""
        if not self._names:
            return graph
        names = {id_: max(votes, key=votes.__getitem__) for id_, votes in self._names.items()}
        return replace(graph, objects=tuple(replace(o, name=names.get(o.id)) for o in graph.objects))


class Stopwatch:
    """Measures the time of each stage of a step.

    Attributes:
        laps: Stage → seconds it took, without compiling kernels, which is the stage `compile` if it happened.
    """

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._started = perf_counter(), read_compile_time()

    def lap(self, stage: str) -> None:
        """End a stage and start the next one."""
        (started, before), self._started = self._started, (perf_counter(), read_compile_time())
        whole = self._started[0] - started
        compiling = min(self._started[1] - before, whole)  # Other threads compile too.
        self.laps[stage] = self.laps.get(stage, 0.0) + whole - compiling
        if compiling > 0.0:
            self.laps["compile"] = self.laps.get("compile", 0.0) + compiling
