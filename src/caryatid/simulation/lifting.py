"""Objects lifted, held and removed in MuJoCo, and the effect on the others.

A grasp is a weld to a body that moves as commanded (a mocap body), one per object. A lifted object follows it
straight up at constant speed; held objects stay in place. MuJoCo's no-slip solver is on: without it, contacts
creep by up to 3 mm/s, and objects that were seen at rest fall within seconds although nothing is lifted.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from numpy.typing import NDArray

from caryatid.config import LiftConfig
from caryatid.geometry.transforms import Array
from caryatid.simulation.world import mujoco_warnings_ignored, strayed

ASIDE = 50.0
"""Height at which lifted objects are put [m], out of the way."""

HAND = "caryatid-hand-"
"""Prefix of the names of the grasping bodies."""

_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_GRASPS = int(
    mujoco.mjtState.mjSTATE_EQ_ACTIVE | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)


@dataclass(frozen=True, eq=False, slots=True)
class Lift:
    """Result of a lift.

    Attributes:
        disturbed: Which objects (N,) moved or turned beyond the limits, except lifted and removed ones.
        film: States (T, N, 7) during the lift, one per quarter of a second; the last one is the final state.
    """

    disturbed: NDArray[np.bool_]
    film: Array


class Lifting:
    """A table in physics whose objects can be lifted one by one.

    States are arrays (N, 7): position [m] and quaternion (w first) of each object, at rest. Calls share no
    data, so several threads may lift at once.

    Args:
        spec: `mujoco.MjSpec` with free bodies; it is copied.
        bodies: Names of the objects among them, in order.
    """

    def __init__(self, spec: Any, bodies: Sequence[str]) -> None:
        spec = spec.copy()
        spec.option.noslip_iterations = max(spec.option.noslip_iterations, 5)
        for name in bodies:  # a hand each, which does not grasp yet
            spec.worldbody.add_body(name=HAND + name, mocap=True)
            weld = spec.add_equality(
                name=HAND + name, name1=HAND + name, name2=name, active=False, type=mujoco.mjtEq.mjEQ_WELD,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                # A grasp yields by well under a millimetre, at time steps up to 5 ms.
                solref=[0.01, 1.0], solimp=[0.95, 0.99, 0.001, 0.5, 2.0],
            )  # fmt: skip
            # Both in one place: anchor, relative position and quaternion, and the weight of rotation [m].
            weld.data = [*[0.0] * 6, 1.0, *[0.0] * 3, 1.0, 0.0]
        with mujoco_warnings_ignored():
            self.model = model = spec.compile()
        body = [model.body(name).id for name in bodies]
        joints = model.body_jntadr[body]
        self._qpos = model.jnt_qposadr[joints][:, None] + np.arange(7)
        self._qvel = model.jnt_dofadr[joints][:, None] + np.arange(6)
        self._weld = np.array([model.equality(HAND + name).id for name in bodies], dtype=np.intp)
        self._hand = np.array([model.body(HAND + name).mocapid[0] for name in bodies], dtype=np.intp)
        roots = model.body_rootid[model.geom_bodyid]
        self._geoms = [np.flatnonzero((roots == b) & (model.geom_contype != 0)) for b in body]

    @property
    def start(self) -> Array:
        """State (N, 7) of the objects in the spec."""
        return np.asarray(self.model.qpos0[self._qpos])

    def rest(
        self, state: Array, held: Collection[int], seconds: float, limits: LiftConfig | None = None
    ) -> Array:
        """State (N, 7) after some time [s] in which nothing is lifted and some objects are held.

        With limits, the time ends when all objects rest, or one moved or turned beyond the limits.
        """
        data = self._data(state, held)
        if limits is None:
            return self._after(data, 0.0, seconds)
        after = state
        for _ in range(int(np.ceil(seconds / 0.25))):
            before, after = after, self._after(data, 0.0, 0.25)
            if _still(before, after) or strayed(state, after, limits.moved, limits.turned).any():
                break
        return after

    def longest(self, state: Array, config: LiftConfig) -> float:
        """Maximum time [s] that a lift of any object takes in a state (N, 7), with the watch after it."""
        data = self._data(state, ())
        low, high = np.array([self._span(data, k) for k in range(len(state))]).T
        return float(high.max() - low.min() + 0.02) / config.speed + config.watch

    def lift(
        self,
        state: Array,
        index: int,
        config: LiftConfig,
        *,
        held: Collection[int] = (),
        to_the_end: bool = True,
    ) -> Lift:
        """Lift an object of a state (N, 7) straight up, put it aside and observe the others.

        Some objects may be held in place meanwhile. If it need not go on to the end, it stops as soon as an
        object is disturbed or all are at rest, and does not begin if there are no others; and the object is
        put aside as soon as the rest of its way is clear.
        """
        watched = state[:, 2] < ASIDE / 2.0
        watched[index] = False
        if not to_the_end and not watched.any():
            return Lift(watched, state[None])
        data = self._data(state, [*held, index])
        # Up until the object's lowest point is 2 cm above all others.
        low, _ = self._span(data, index)
        tops = [self._span(data, int(k))[1] for k in np.flatnonzero(watched)]
        lifted = (max(max(tops, default=low) - low, 0.0) + 0.02) / config.speed
        disturbed = np.zeros(len(state), dtype=np.bool_)
        film: list[Array] = []
        for speed, seconds in ((config.speed, lifted), (0.0, config.watch)):
            segments = max(1, int(np.ceil(seconds / 0.25)))  # a falling object is seen falling
            for left in reversed(range(segments)):
                film.append(self._after(data, speed, seconds / segments, index))
                disturbed |= watched & strayed(state, film[-1], config.moved, config.turned)
                at_rest = speed == 0.0 and _still(film[-2], film[-1])
                if not to_the_end and (at_rest or disturbed.any()):
                    return Lift(disturbed, np.array(film))
                way = speed * seconds * left / segments
                if not to_the_end and way and self._is_clear(data, index, way):
                    break
            if speed > 0.0:
                # Out of the way, at rest.
                place = np.array([0.0, 0.0, ASIDE + index])
                data.qpos[self._qpos[index, :3]] = data.mocap_pos[self._hand[index]] = place
                data.qvel[self._qvel[index]] = 0.0
        return Lift(disturbed, np.array(film))

    def _is_clear(self, data: Any, index: int, way: float) -> bool:
        """Whether an object touches nothing here and on its way up [m], in steps of a centimetre."""
        height, touches = self._qpos[index, 2], False
        here = float(data.qpos[height])
        for rise in np.append(np.arange(0.0, way, 0.01), way):
            data.qpos[height] = here + rise
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_collision(self.model, data)
            touches = touches or bool(np.isin(data.contact.geom, self._geoms[index]).any())
        data.qpos[height] = here
        mujoco.mj_kinematics(self.model, data)
        return not touches

    def _data(self, state: Array, grasped: Collection[int]) -> Any:
        """MuJoCo's data for a state; grasped and removed objects are held in place."""
        data = mujoco.MjData(self.model)
        data.qpos[self._qpos] = state
        data.mocap_pos[self._hand], data.mocap_quat[self._hand] = state[:, :3], state[:, 3:]
        aside = np.flatnonzero(state[:, 2] > ASIDE / 2.0)
        data.eq_active[self._weld] = False
        data.eq_active[self._weld[[*grasped, *aside]]] = True
        mujoco.mj_kinematics(self.model, data)
        return data

    def _after(self, data: Any, speed: float, seconds: float, index: int = 0) -> Array:
        """Simulate for some time [s] while one hand rises [m/s]; return the objects' new state."""
        model = self.model
        steps = max(1, round(seconds / model.opt.timestep))
        told = np.empty(mujoco.mj_stateSize(model, _GRASPS))
        mujoco.mj_getState(model, data, told, _GRASPS)
        path = np.tile(told, (1, steps, 1))
        height = model.neq + 3 * self._hand[index] + 2
        path[0, :, height] += speed * model.opt.timestep * np.arange(1, steps + 1)
        start = np.empty(mujoco.mj_stateSize(model, _STATE))
        mujoco.mj_getState(model, data, start, _STATE)
        with mujoco_warnings_ignored(), Rollout(nthread=0) as rollout:
            states, _ = rollout.rollout(model, data, start[None], path, control_spec=_GRASPS)
        mujoco.mj_setState(model, data, states[0, -1], _STATE)
        data.mocap_pos[self._hand[index], 2] = path[0, -1, height]
        return np.array(data.qpos[self._qpos])

    def _span(self, data: Any, index: int) -> tuple[float, float]:
        """Heights [m] of an object's lowest and highest point: of the boxes around its geoms."""
        geoms = self._geoms[index]
        boxes = self.model.geom_aabb[geoms]
        R = data.geom_xmat[geoms].reshape(-1, 3, 3)[:, 2]
        middle = data.geom_xpos[geoms, 2] + np.einsum("gi,gi->g", R, boxes[:, :3])
        reach = np.einsum("gi,gi->g", np.abs(R), boxes[:, 3:])
        return float((middle - reach).min()), float((middle + reach).max())


def _still(before: Array, after: Array) -> bool:
    """Whether objects rest in two states a quarter of a second apart, within 0.2 mm and 0.2°."""
    return not strayed(before, after, 2e-4, 0.2).any()
