"""A Gymnasium environment for learning planners: an action is the next view of a simulated table."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from caryatid.config import Config, NoiseModel, SegmentationMethod
from caryatid.errors import InputError, needs_extra
from caryatid.evaluation.scores import score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.exploration import Explorer, planning_state, used_up
from caryatid.geometry.shapes import fibonacci_sphere
from caryatid.geometry.transforms import Array
from caryatid.planning.decision import Decision, PlanningState, go_to, path_cost
from caryatid.simulation.generation import GeneratedKind, generate
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.world import SimulatedScene

with needs_extra("learn", "caryatid.learning"):
    import gymnasium

COLUMNS = ("reachable", "x", "y", "z", "saliency", "cost", "nearness", "views")
"""Columns of an observation."""


@dataclass(frozen=True, eq=False, slots=True)
class _Nearest:
    """Planner that goes to the candidate nearest to a unit direction (3,)."""

    direction: Array

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        nearest = int(np.argmax(state.candidates.directions @ self.direction))
        return go_to(state, nearest, "chosen by an action")


class ViewEnv(gymnasium.Env[NDArray[np.float32], np.int64]):
    """Explores random simulated tables: an action is one of K directions spread over the view sphere.

    The robot goes to the reachable view nearest to the direction, so every action is valid. The reward is
    what the view adds to F1, less `effort` times the path cost h of eq. 3. An episode terminates where the
    loop would stop (`config.active.stop`), or if no view is reachable, and is truncated after
    `config.active.max_views` views. The same seed gives the same bytes. `info` holds the name of the `scene`,
    `f1`, the length of the `path` [m], and at the end why, `stop`.

    An observation (K, 8) has a row for each action, with the `COLUMNS`: 1 if a view lies near the direction,
    else 0; the direction of the view to which the action leads; its saliency, what it is expected to show, by
    planner `support`; its path cost; the cosine of the angle to the nearest earlier view; and the share of
    `max_views` that is used. Without reachable views, all but the last are 0.

    Args:
        kind: Kind of the random scenes.
        size: Number of their objects.
        actions: K, the number of directions.
        effort: F1 that a path of one sphere diameter is worth [1].
        noise: Noise of the camera.
        segmentation: `labels` for the simulator's masks, or `auto`.
        config: All settings.

    Attributes:
        directions: Unit directions (K, 3) of the actions, from the centre of the view sphere.
        explorer: The exploration of this episode.
    """

    def __init__(
        self,
        kind: GeneratedKind = "pile",
        size: int = 6,
        *,
        actions: int = 64,
        effort: float = 0.05,
        noise: NoiseModel = "carmine",
        segmentation: SegmentationMethod = "labels",
        config: Config | None = None,
    ) -> None:
        self._kind, self._size, self._effort, self._noise = kind, size, effort, noise
        self._segmentation, self._config = segmentation, config or Config()
        self.directions = fibonacci_sphere(actions)
        self.action_space = gymnasium.spaces.Discrete(actions)
        shape = actions, len(COLUMNS)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Draw a scene, or load `options["scene"]`; return observation (K, 8) and info of the first view.

        Raises:
            InputError: There is no such scene, or the size is out of range.
        """
        super().reset(seed=seed)
        named = (options or {}).get("scene")
        scene = self._draw() if named is None else load_scene(named)
        self._truth, self._name = true_scene_from_simulation(scene), scene.name
        chance = int(self.np_random.integers(2**31))
        made = make_simulation(scene, self._config, noise=self._noise, seed=chance)
        known: dict[str, Any] = {"config": self._config, "segmentation": self._segmentation, "seed": chance}
        self.explorer = Explorer(made.camera, made.robot, **known)
        self._look()
        return self._observe(), self._info()

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take a view; return observation (K, 8), reward, whether terminated, whether truncated, and info."""
        explorer, before = self.explorer, self._f1
        explorer.use_planner(_Nearest(self.directions[action]))
        explorer.plan()
        gone = explorer.go()
        if gone.decision is None:
            self._step, self._stop = gone, gone.stop
            return self._observe(), 0.0, True, False, self._info()
        self._look()
        reward = self._f1 - before - self._effort * gone.decision.cost
        full = used_up(explorer.scene.views, self._config.active) is not None
        return self._observe(), reward, self._stop is not None, full, self._info()

    def _draw(self) -> SimulatedScene:
        """Generate a scene. Of some seeds, no scene stays in place: then try others."""
        first, *others = self.np_random.integers(2**31, size=20).tolist()
        for seed in others:
            with suppress(InputError):
                return generate(self._kind, self._size, seed, self._config.physics)
        return generate(self._kind, self._size, first, self._config.physics)

    def _look(self) -> None:
        """Take a view, and let the default planner say what the next ones would show."""
        self.explorer.look()
        self.explorer.use_planner("support")
        self._step = self.explorer.plan()
        self._f1: float = score(self._step.graph, self._truth, config=self._config.evaluation).f1
        self._stop = self.explorer.reason_to_stop()

    def _observe(self) -> NDArray[np.float32]:
        step, count = self._step, len(self.directions)
        found = np.zeros((count, len(COLUMNS)), np.float32)
        found[:, -1] = (step.index + 1) / self._config.active.max_views
        if step.decision is not None and step.candidates is not None:
            state = planning_state(self.explorer.scene, step.sphere, step.visited, step.candidates)
            distance, nearest = KDTree(step.candidates.directions).query(self.directions)
            reachable = distance < np.sqrt(np.pi / count)  # half the distance between two actions
            led = step.candidates.directions[nearest]
            saliency = np.asarray(step.decision.candidate_saliency)[nearest]
            nearness = (led @ step.visited.T).max(axis=1)
            found[:, :-1] = np.column_stack([reachable, led, saliency, path_cost(state)[nearest], nearness])
        return found

    def _info(self) -> dict[str, Any]:
        told = {"scene": self._name, "f1": self._f1, "path": self._step.path_travelled}
        return told if self._stop is None else told | {"stop": self._stop}
