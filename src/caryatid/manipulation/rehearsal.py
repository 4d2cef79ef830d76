"""Lifts tried in physics before they are done: on the extracted shapes, and on others as likely.

What has been extracted is not at rest in physics to the millimetre, and friction and weights are not known.
So a lift is rehearsed in several scenes, drawn by the shapes' uncertainty, each of which is let come to rest
first. An object that does not, though the real one was seen at rest, is wrongly shaped or rests on what was
not seen: there it is held, and the support graph alone says what it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.simulation.lifting import ASIDE, Lift, Lifting
from caryatid.simulation.world import TABLE, Solid, add_solid, empty_spec, quaternion
from caryatid.support.plausibility import drawn, reconcile


@dataclass(frozen=True, eq=False, slots=True)
class Trial:
    """A lift rehearsed in every drawn scene.

    Attributes:
        object_id: What was lifted.
        hold: What the other hand held meanwhile.
        risk: Share of the scenes in which another object was disturbed [1].
        harmed: In what share of them each object was [1], by id; those that never were are left out.
        lifts: What came of it in each scene.
    """

    object_id: str
    hold: tuple[str, ...]
    risk: float
    harmed: dict[str, float]
    lifts: tuple[Lift, ...]


class Rehearsal:
    """Scenes in which to try lifts, and where their objects are once some have been taken.

    Args:
        graph: What has been extracted.
        config: How lifts go, and what the scenes are drawn from.
        rng: Source of the draws.
        threads: How many scenes are simulated at a time.

    Raises:
        InputError: The graph has no support surface, or no objects.
    """

    def __init__(
        self, graph: SupportGraph, config: Config, rng: np.random.Generator, *, threads: int = 1
    ) -> None:
        if graph.support_surface is None:
            raise InputError("graph", "has no support surface", "extract one; lifts need a table")
        self.ids = tuple(o.id for o in graph.objects if o.role == "object")
        if not self.ids:
            raise InputError("graph", "has no objects", "there is nothing to take away")
        self._graph, self._config, self._threads = graph, config, threads
        self._trials: dict[tuple[str, ...], Trial] = {}
        specs = [_drawn_scene(graph, number, config, rng) for number in range(config.rehearsal.draws)]
        settled = self._each(lambda k: _settled(specs[k], self.ids, config))
        self._liftings: list[Lifting] = [lifting for lifting, _, _ in settled]
        # Of D scenes with N objects: which do not stay where they were seen (D, N), and all states (D, N, 7).
        self._restless = np.stack([restless for _, restless, _ in settled])
        self._states = np.stack([state for _, _, state in settled])

    def left(self) -> list[str]:
        """Ids of the objects that have not been taken yet."""
        return [i for i, height in zip(self.ids, self._states[0, :, 2], strict=True) if height < ASIDE / 2.0]

    def try_lift(self, object_id: str, hold: Collection[str] = ()) -> Trial:
        """Lift an object in every scene, others being held; nothing changes, and it is done only once."""
        asked = (object_id, *sorted(hold))
        if asked not in self._trials:
            lifts = self._each(lambda k: self._lift(k, object_id, hold))
            harm = np.stack([lift.disturbed for lift in lifts])
            # What is held in a scene, because it does not stay there, must not lose a support of the graph.
            needs = {s.supported for s in self._graph.supports if s.supporter == object_id} - set(hold)
            harm |= self._restless & np.isin(self.ids, list(needs.intersection(self.left())))
            shares = zip(self.ids, harm.mean(axis=0).tolist(), strict=True)
            harmed = {i: share for i, share in shares if share > 0.0}
            risk = float(harm.any(axis=1).mean())
            self._trials[asked] = Trial(object_id, tuple(hold), risk, harmed, tuple(lifts))
        return self._trials[asked]

    def take(self, trial: Trial) -> None:
        """Go on without an object whose lift was tried: where others moved, they are put back."""
        index = self.ids.index(trial.object_id)
        self._trials.clear()
        moved = np.array([lift.disturbed.any() for lift in trial.lifts])
        stays = self._restless | moved[:, None]
        after = np.stack([lift.state for lift in trial.lifts])
        self._states = np.where(stays[..., None], self._states, after)
        self._states[:, index, :3] = (0.0, 0.0, ASIDE + index)

    def _lift(self, k: int, object_id: str, hold: Collection[str]) -> Lift:
        index = self.ids.index(object_id)
        held = {self.ids.index(i) for i in hold} | set(np.flatnonzero(self._restless[k]).tolist())
        return self._liftings[k].lift(
            self._states[k], index, self._config.lift, held=held - {index}, to_the_end=False
        )

    def _each(self, do: Callable[[int], Any]) -> list[Any]:
        """Do something for every scene, in order."""
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(do, range(self._config.rehearsal.draws)))


def _drawn_scene(graph: SupportGraph, number: int, config: Config, rng: np.random.Generator) -> Any:
    """A `mujoco.MjSpec` of the extracted shapes, or of others as likely for a number above 0."""
    objects = list(graph.objects)
    if number > 0:
        objects = [drawn(o, rng, config.plausibility) for o in objects]
        objects = reconcile(objects, config.plausibility)
    settings = config.rehearsal
    frictions = rng.uniform(*settings.friction, len(objects))
    densities = rng.uniform(*settings.density, len(objects))
    if number == 0:
        frictions[:], densities[:] = np.mean(settings.friction), np.mean(settings.density)
    spec = empty_spec("rehearsal")
    # Twice MuJoCo's own time step, which the implicit integrator bears, for half the time.
    spec.option.timestep = 0.004
    for o, friction, density in zip(objects, frictions, densities, strict=True):
        if o.role == "support_surface":
            _add_table(spec, o)
        else:
            add_solid(spec, o.id, Solid(o.shape, density, friction))
    return spec


def _add_table(spec: Any, table: SceneObject) -> None:
    """The table, 10 cm larger on each side than what was seen of it.

    It is slippery: contacts take the larger friction of two, and it is not to hide how slippery objects are.
    """
    T, extents = table.shape.T_world_object, table.shape.extents
    up = int(np.argmax(np.abs(T[2, :3])))
    half = extents / 2.0 + np.where(np.arange(3) == up, 0.0, 0.1)
    body = spec.worldbody.add_body(name=TABLE, pos=T[:3, 3], quat=quaternion(T[:3, :3]))
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, friction=[0.1, 0.005, 0.001])


def _settled(spec: Any, ids: Sequence[str], config: Config) -> tuple[Lifting, NDArray[np.bool_], Array]:
    """Let a scene come to rest: what moves too far is put back and held, until nothing else does.

    Returns:
        The scene, which objects (N,) had to be held, and the state (N, 7) of all.
    """
    lifting = Lifting(spec, ids)
    seen, restless = lifting.start, np.zeros(len(ids), dtype=np.bool_)
    while True:
        state = lifting.rest(seen, np.flatnonzero(restless).tolist(), config.rehearsal.settling)
        moved = lifting.strayed(seen, state, config.lift) & ~restless
        if not moved.any():
            return lifting, restless, np.where(restless[:, None], seen, state)
        restless |= moved
