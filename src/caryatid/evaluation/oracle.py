"""The planner that knows the ground truth: an upper bound for planners that look one view ahead.

It tries candidates in simulation, each on a copy of the scene model, and chooses the one with the highest
score. No other planner may use the ground truth, so it is not in `caryatid.planning.planners.BUILT_IN`.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from caryatid.config import Config, SegmentationMethod
from caryatid.errors import CaryatidError, InputError
from caryatid.evaluation.scores import TrueScene, score
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.io.graph_json import graph_text
from caryatid.planning.decision import Decision, Planner, PlanningState, check_candidates, path_cost
from caryatid.planning.planners import ORACLE, make_planner
from caryatid.planning.planners.hidden_surface import SupportPlanner
from caryatid.scene import Scene
from caryatid.sensing.views import Camera, View
from caryatid.simulation.camera import SimulatedCamera, pixel_rays, render


class _WatchedCamera:
    """A camera that records the pose (4, 4) and view of each capture."""

    def __init__(self, camera: SimulatedCamera) -> None:
        self.taken: list[tuple[Array, View]] = []
        self._camera = camera

    def capture(self, T_world_camera: Array) -> View:
        view = self._camera.capture(T_world_camera)
        self.taken.append((T_world_camera, view))
        return view


class OraclePlanner:
    """Chooses the candidate with the highest F1, of vertices and edges together, after its view.

    Among equal ones it prefers the one that shows most true surface for the first time, then the shortest
    path, then the first. True surface is counted, for each object, in cells of the map's voxel size that a
    ray of a noise-free camera hits. The views tried are spread evenly over the candidates, away from earlier
    views. The default planner's choice is tried too, so that no step of that planner can be better.

    It serves one exploration. Its predictions are exact, because it knows the noise of the next view and uses
    the same configuration, segmentation and seed.

    Args:
        camera: Camera of the scene. Explore with the attribute `camera` instead.
        truth: The ground truth.
        config: All settings of the exploration.
        segmentation: Segmentation of the exploration.
        seed: Seed of the exploration.

    Attributes:
        camera: The camera to pass to `explore`.
    """

    def __init__(
        self,
        camera: SimulatedCamera,
        truth: TrueScene,
        config: Config | None = None,
        *,
        segmentation: SegmentationMethod | None = None,
        seed: int = 0,
    ) -> None:
        self.camera = _WatchedCamera(camera)
        self._simulated = camera
        self._truth = truth
        self._config = config or Config()
        self._scene = Scene(self._config, segmentation=segmentation, seed=seed)
        self._shown = np.zeros(0, dtype=np.int64)

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate after which F1 is highest.

        The decision's saliency is the resulting F1.

        Raises:
            PlanningError: There is no candidate.
            InputError: The exploration is not the one for which this planner was made.
        """
        check_candidates(state)
        self._catch_up(state)
        candidates = state.candidates
        tried = spread_out(candidates.directions, state.visited, self._config.oracle.candidates)
        tried = np.union1d(tried, SupportPlanner().plan(state, rng).index)
        shown = [self._surface(candidates.T_world_camera[i]) for i in tried]
        unseen = np.array([len(np.setdiff1d(cells, self._shown, assume_unique=True)) for cells in shown])
        # Ordered by the tie-breakers, so that the first candidate with the highest F1 wins.
        order = np.lexsort((tried, candidates.path_length[tried], -unseen))
        best, reached = int(order[0]), -1.0
        equal = 1e-9  # scores are ratios of small integers
        for k in order:
            scene, f1 = self._scene.copy(), -1.0  # for a view that cannot be used
            with suppress(CaryatidError):
                view = self._simulated.fork().capture(candidates.T_world_camera[tried[k]])
                f1 = self._f1(scene.update(view))
            if f1 > reached + equal:
                best, reached = int(k), f1
            if reached > 1.0 - equal:
                break
        index = int(tried[best])
        cost = float(path_cost(state)[index])
        area, now = float(unseen[best]) * self._config.voxels.size**2, self._f1(self._scene.graph)
        why = f"F1 goes from {now:.2f} to {reached:.2f}, the best of {len(tried)} views; "
        why += f"{1e4 * area:.0f} cm² of surface become visible"
        return Decision(candidates.T_world_camera[index], index, reached, cost, reached - cost, why)

    def _catch_up(self, state: PlanningState) -> None:
        """Update with the views since the last decision."""
        for T_world_camera, view in self.camera.taken:
            self._scene.update(view)
            self._shown = np.union1d(self._shown, self._surface(T_world_camera))
        self.camera.taken.clear()
        same_views = self._scene.views == len(state.visited)
        if not same_views or graph_text(self._scene.graph) != graph_text(state.graph):
            reason = "its views and settings differ from those of this exploration"
            remedy = "pass its camera to explore(), with the same configuration, segmentation and seed"
            raise InputError(f"planner {ORACLE}", reason, remedy)

    def _f1(self, graph: SupportGraph) -> float:
        return score(graph, self._truth, config=self._config.evaluation).f1

    def _surface(self, T_world_camera: Array) -> NDArray[np.int64]:
        """Cells (N,) of the objects' true surface seen from there, each a number of object and place."""
        config, camera = self._config.oracle, self._simulated
        K = np.diag([1.0 / config.stride, 1.0 / config.stride, 1.0]) @ camera.K
        width, height = camera.sensor.width // config.stride, camera.sensor.height // config.stride
        image = render(camera.scene, T_world_camera, K, replace(camera.sensor, width=width, height=height))
        rays_world, _ = pixel_rays(K, T_world_camera[:3, :3], width, height)
        labels = image.labels.ravel()
        on_object = labels > 0
        reach = image.depth.ravel()[on_object, None]
        points_world = T_world_camera[:3, 3] + reach * rays_world[on_object]
        cells = 4096  # along each axis around the world's origin: 41 m
        place = np.floor(points_world / self._config.voxels.size).astype(np.int64) + cells // 2
        counts = int(labels.max()) + 1, cells, cells, cells
        return np.unique(np.ravel_multi_index((labels[on_object], *np.clip(place, 0, cells - 1).T), counts))


def planner_for(
    name: str,
    camera: Camera,
    truth: TrueScene | None,
    config: Config,
    *,
    segmentation: SegmentationMethod | None,
    seed: int,
) -> tuple[Planner, Camera]:
    """Make a planner by its name, including `oracle` in simulation, and the camera to explore with.

    Raises:
        InputError: There is no such planner, or it is the oracle without a simulation.
    """
    if name != ORACLE or truth is None or not isinstance(camera, SimulatedCamera):
        return make_planner(name), camera
    oracle = OraclePlanner(camera, truth, config, segmentation=segmentation, seed=seed)
    return oracle, oracle.camera


def spread_out(directions: Array, visited: Array, count: int) -> NDArray[np.intp]:
    """Pick up to `count` directions (N, 3) one by one, each as far as possible from the earlier ones.

    These are the visited ones (V, 3), V ≥ 1, and the picked ones. Return indices (M,), each once; the first
    of equally far ones.
    """
    nearness = (directions @ visited.T).max(axis=1)
    picked = []
    for _ in range(min(count, len(directions))):
        farthest = int(np.argmin(nearness))
        picked.append(farthest)
        nearness = np.maximum(nearness, directions @ directions[farthest])
        nearness[farthest] = np.inf
    return np.array(picked, dtype=np.intp)
