"""What is known so far: the objects of a scene, who supports whom, and the space around them."""

from __future__ import annotations

from dataclasses import replace

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from caryatid import association
from caryatid.clouds import thin
from caryatid.completion import complete
from caryatid.config import Config, SegmentationMethod
from caryatid.frames import Array
from caryatid.fusion import Evidence, absorbed, fuse, fused_graph
from caryatid.graph import SUPPORT_SURFACE_ID, SceneObject, SupportGraph, object_id
from caryatid.perception import UP, Percept, label_image, perceive
from caryatid.primitives import FitFailure, fit
from caryatid.registration import align
from caryatid.stopwatch import Stopwatch
from caryatid.support import explain, infer
from caryatid.surface import SupportSurface, find_support_surface
from caryatid.threads import one_blas_thread
from caryatid.view_sphere import ViewSphere
from caryatid.views import SUPPORT_LABEL, Cloud, View
from caryatid.visibility import seen_through
from caryatid.voxels import VoxelMap


class Scene:
    """The scene model of section III, updated view by view.

    Args:
        config: All stages' settings.
        segmentation: `labels` demands them of every view, `auto` ignores them, None takes them where given.
        seed: Seed of every random choice; the same seed and views give the same model.

    Attributes:
        graph: The fused support graph.
        labels: Label image (H, W) of the newest view, or labels (N,) of a cloud; 65535 = support surface.
        surface: The support surface, or None before the first view.
        voxels: Free, occupied and unknown space, or None before the first view.
        sphere: The view sphere around the table top, or None before the first view.
        T_world_camera: Pose (4, 4) of the newest view after registration, or None for a cloud.
        views: How many views the model is made of.
        timings: Seconds the stages of the newest update took.
    """

    def __init__(
        self, config: Config | None = None, *, segmentation: SegmentationMethod | None = None, seed: int = 0
    ) -> None:
        self.config = config or Config()
        self.segmentation = segmentation
        self.seed = seed
        self.graph = SupportGraph()
        self.labels: NDArray[np.int32] | None = None
        self.surface: SupportSurface | None = None
        self.voxels: VoxelMap | None = None
        self.sphere: ViewSphere | None = None
        self.T_world_camera: Array | None = None
        self.views = 0
        self.timings: dict[str, float] = {}
        self._points: dict[int, list[Cloud]] = {}
        self._fits: dict[int, SceneObject] = {}
        self._evidence = Evidence()
        self._contradicted: dict[str, int] = {}
        self._labels_used = 0

    @property
    def supports(self) -> nx.DiGraph:
        """The support graph as a DiGraph, supporter → supported."""
        return self.graph.to_networkx()

    @property
    def cloud(self) -> Cloud:
        """All points so far, thinned view by view, with the labels of their objects."""
        return _joined([c for _, clouds in sorted(self._points.items()) for c in clouds])

    def explain(self, supporter: str, supported: str) -> str:
        """Say why one object is, or is not, taken to support another; with figures.

        Args:
            supporter: Id of an object, such as `o1`.
            supported: Id of an object.
        """
        return explain(self.graph, supporter, supported, self.config.support)

    @one_blas_thread
    def update(self, source: View | Cloud) -> SupportGraph:
        """Take in one view, or one cloud with z up, and return the fused graph.

        Raises:
            InputError: Labels are demanded and missing, or a later view has no pose.
            PerceptionError: There are no readings, or no support surface.
        """
        watch = Stopwatch()
        rng = np.random.default_rng([self.seed, self.views])
        percept = perceive(source, self.config, segmentation=self.segmentation, known=self.surface, rng=rng)
        watch.lap("segment")
        percept = self._registered(percept)
        watch.lap("register")
        percept = self._associated(percept, source)
        self._keep(percept)
        self._map_space(percept)
        watch.lap("map")
        fitted, merged = self._fitted(percept)
        percept = percept.relabelled(merged)
        watch.lap("fit")
        if self.surface is None or self.voxels is None:
            raise RuntimeError("a percept brings a surface and a map")
        completed = complete(fitted, self.surface, self.voxels, self.config.completion)
        newest = infer([self._surface_object(), *completed], self.config.support)
        watch.lap("infer")
        names = self._fused(newest, percept)
        percept = percept.relabelled({int(o[1:]): int(n[1:]) for o, n in names.items() if o != n})
        self.labels = label_image(percept, source)
        self.T_world_camera = None if percept.view is None else percept.view.pose
        self.views += 1
        watch.lap("fuse")
        self.timings = watch.laps
        return self.graph

    def _registered(self, percept: Percept) -> Percept:
        """Lay the view onto the map, which the first view's pose ties to the world."""
        config = self.config
        if self.sphere is None or not config.registration.enabled:
            return percept
        cloud = percept.cloud.select(percept.labels != 0)
        cloud = cloud.select(thin(cloud.points_world, config.cloud.voxel * 2.0))
        if not self._labels_given(percept.view):
            cloud = replace(cloud, labels=None)
        return percept.moved(align(cloud, self.cloud, self.sphere.centre_world, config.registration).T)

    def _associated(self, percept: Percept, source: View | Cloud) -> Percept:
        """Give automatic parts the labels of the objects they belong to."""
        if self._labels_given(source) or self.config.fusion.method == "sg":
            return percept
        labels = np.where(percept.labels == SUPPORT_LABEL, 0, percept.labels)
        known = {k: c.points_world for k, c in self._pooled().items()}
        shapes = {k: o.shape for k, o in self._fits.items()}
        names = association.associate(
            percept.cloud.points_world, labels, known, shapes, self.config.segmentation, self._labels_used
        )
        self._labels_used = max(self._labels_used, *names.values(), 0)
        return percept.relabelled(names)

    def _keep(self, percept: Percept) -> None:
        """Add the view's points, thinned, to what is known of each object and of the support surface."""
        config = self.config
        for label in (int(k) for k in np.unique(percept.labels) if k != 0):
            part = percept.cloud.select(percept.labels == label)
            voxel = config.surface.spacing if label == SUPPORT_LABEL else config.cloud.voxel
            part = part.select(thin(part.points_world, voxel))
            self._points[label] = [*self._points.get(label, []), part]
        table = _joined(self._points.get(SUPPORT_LABEL, []))
        self.surface = percept.surface
        if self.views and len(table) >= config.surface.min_points:
            rng = np.random.default_rng(self.seed)
            self.surface = find_support_surface(
                table.points_world, table.normals_world, UP, config.surface, rng
            )

    def _map_space(self, percept: Percept) -> None:
        """Build view sphere and voxel map around the first view's table, and enter the view."""
        if self.sphere is None or self.voxels is None:
            centre = percept.surface.point_world
            self.sphere = ViewSphere.around(centre, self.config.active)
            self.voxels = VoxelMap.around(centre, self.config.voxels)
        if percept.view is not None:
            self.voxels = self.voxels.integrate(percept.view, self.config.cloud.max_depth)

    def _fitted(self, percept: Percept) -> tuple[list[SceneObject], dict[int, int]]:
        """Fit what this view changed; with `sg` from this view alone, else from all points so far.

        Returns:
            All objects, and labels that turned out to be another object's: old → new.
        """
        given_up: dict[int, int] = {}
        changed = {int(k) for k in np.unique(percept.labels)} - {0, SUPPORT_LABEL}
        pooled = self._pooled()
        if self.config.fusion.method == "sg":
            self._fits = {}
            pooled = {k: self._points[k][-1] for k in changed}
        self._fit_labels(sorted(changed), pooled)
        shapes = {k: o.shape for k, o in self._fits.items()}
        if self.segmentation == "auto" and self.config.fusion.method != "sg":
            points = {k: c.points_world for k, c in pooled.items()}
            given_up = association.duplicates(points, shapes, self.config.segmentation)
            for old, new in given_up.items():
                self._points[new] = [*self._points[new], *self._points.pop(old)]
                del self._fits[old]
            self._fit_labels(sorted(set(given_up.values())), self._pooled())
            names = {object_id(old): object_id(new) for old, new in given_up.items()}
            self._evidence = absorbed(self._evidence, names)
        return [self._fits[k] for k in sorted(self._fits)], given_up

    def _fit_labels(self, labels: list[int], pooled: dict[int, Cloud]) -> None:
        for label in labels:
            rng = np.random.default_rng([self.seed, label])
            cloud = pooled[label]
            result = fit(cloud.points_world, cloud.normals_world, config=self.config.fit, rng=rng)
            if isinstance(result, FitFailure):
                self._fits.pop(label, None)
                continue
            self._fits[label] = SceneObject(
                id=object_id(label),
                label=label,
                shape=result.shape,
                residual=result.residual,
                poor_fit=result.poor,
                seen=result.seen,
            )

    def _fused(self, newest: SupportGraph, percept: Percept) -> dict[str, str]:
        config = self.config.fusion
        same_labels = config.method != "sg" or percept.view is None or self._labels_given(percept.view)
        self._evidence, names = fuse(self._evidence, newest, config, same_labels=same_labels)
        found = set(names.values())
        if percept.view is not None:
            for o in self.graph.objects:
                if o.role == "object" and o.id not in found and seen_through(o.shape, percept.view):
                    self._contradicted[o.id] = self._contradicted.get(o.id, 0) + 1
        fused = fused_graph(self._evidence, config, self._contradicted)
        self.graph = replace(fused, stability=newest.stability)
        return names

    def _pooled(self) -> dict[int, Cloud]:
        """All points of each object."""
        return {k: _joined(clouds) for k, clouds in self._points.items() if k != SUPPORT_LABEL}

    def _surface_object(self) -> SceneObject:
        if self.surface is None:
            raise RuntimeError("a percept brings a surface")
        return SceneObject(SUPPORT_SURFACE_ID, SUPPORT_LABEL, self.surface.shape, "support_surface")

    def _labels_given(self, source: View | Cloud | None) -> bool:
        return source is not None and source.labels is not None and self.segmentation != "auto"


def _joined(clouds: list[Cloud]) -> Cloud:
    if not clouds:
        nothing: Array = np.zeros((0, 3))
        return Cloud(nothing, nothing, np.zeros(0, dtype=np.int32))
    rgb = [c.rgb for c in clouds if c.rgb is not None]
    labels = [c.labels for c in clouds if c.labels is not None]
    return Cloud(
        np.concatenate([c.points_world for c in clouds]),
        np.concatenate([c.normals_world for c in clouds]),
        np.concatenate(labels) if len(labels) == len(clouds) else None,
        np.concatenate(rgb) if len(rgb) == len(clouds) else None,
    )
