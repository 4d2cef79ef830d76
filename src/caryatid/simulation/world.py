"""A table with free bodies on it in MuJoCo: which body is the table, which are objects, and their rest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import SUPPORT_LABEL

TABLE = "table"
"""Name of the body that is the support surface."""

INVISIBLE_GROUP = 3
"""Geoms of this group collide and are not seen."""


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedScene:
    """A settled table-top scene in physics.

    The model and its state belong to MuJoCo, which changes states in place: nothing in caryatid steps `data`
    of a scene once it is loaded; who simulates takes a copy (`state_of`).

    Attributes:
        model: The compiled MuJoCo model.
        data: Its state, at rest, with positions and contacts computed.
        spec: What the model was compiled from.
        name: Short name of the scene.
        source: File or built-in name it came from, for messages.
        object_bodies: Body name of each object by its label 1…n, in the order of the bodies.
        table: Body name of the support surface.
        geom_labels: Label (G,) of the object each geom belongs to, 0 for the table and everything else.
        at_rest: Nothing moved any more when settling ended.
    """

    model: Any
    data: Any
    spec: Any
    name: str
    source: str
    object_bodies: dict[int, str]
    table: str
    geom_labels: NDArray[np.int32]
    at_rest: bool

    def body_id(self, label: int) -> int:
        """MuJoCo's number of the body with this label; 0 is the table.

        Raises:
            InputError: No object carries the label.
        """
        if label != 0 and label not in self.object_bodies:
            raise InputError(
                self.source, f"has no object with label {label}", f"labels are 1…{len(self.object_bodies)}"
            )
        name = self.table if label == 0 else self.object_bodies[label]
        return int(self.model.body(name).id)

    def geoms(self, label: int) -> list[int]:
        """Geoms of the object with this label, or of the table with 0, bodies welded to it included.

        Raises:
            InputError: No object carries the label.
        """
        body = self.body_id(label)
        if label != 0:
            return [int(g) for g in np.flatnonzero(self.geom_labels == label)]
        below = _subtree(self.model, body)
        return [g for g in range(self.model.ngeom) if int(self.model.geom_bodyid[g]) in below]


def scene_from_spec(
    spec: Any, name: str, source: str, config: PhysicsConfig | None = None, *, least: float = 0.0
) -> SimulatedScene:
    """Compile a MuJoCo spec and let it come to rest.

    A scene that is at rest as described keeps its poses to the last digit, unless it is to run for a while.

    Args:
        spec: `mujoco.MjSpec` with a static body `table` and bodies with free joints.
        name: Short name of the scene.
        source: File or built-in name, for messages.
        config: When an object is at rest.
        least: Time simulated in any case [s], for poses that were only thought out.

    Raises:
        InputError: It does not compile, has no static body `table`, no object, or its simulation is unstable.
    """
    try:
        with mujoco_warnings_ignored():
            model = spec.compile()
    except ValueError as error:
        raise InputError(source, f"MuJoCo refuses it: {one_line(error)}", "mend the MJCF") from None
    if not np.isfinite(model.qpos0).all():
        raise InputError(source, "a body's pose holds NaN or infinity", "give finite positions")
    table = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TABLE)
    if table < 0:
        raise InputError(source, f"has no body '{TABLE}'", f"name the static support surface '{TABLE}'")
    if model.body_weldid[table] != 0:
        raise InputError(
            source, f"body '{TABLE}' can move", "take its joints out: the support surface is static"
        )
    if not any(int(model.geom_bodyid[g]) in _subtree(model, table) for g in range(model.ngeom)):
        raise InputError(source, f"body '{TABLE}' has no geom", "give the table a top")
    free = [int(model.jnt_bodyid[j]) for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)]
    if not free:
        raise InputError(source, "has no objects", "every object is a body with a free joint")
    if len(free) >= SUPPORT_LABEL:
        raise InputError(source, f"has {len(free)} objects", f"fewer than {SUPPORT_LABEL} can be told apart")
    label_of_root = {body: label for label, body in enumerate(sorted(free), start=1)}
    geom_roots = model.body_rootid[model.geom_bodyid]
    geom_labels = np.array([label_of_root.get(int(root), 0) for root in geom_roots], dtype=np.int32)
    unseen = [body for body, label in label_of_root.items() if not (geom_labels == label).any()]
    if unseen:
        raise InputError(
            source, f"body '{model.body(unseen[0]).name}' has no geom", "give every object a shape"
        )
    data = mujoco.MjData(model)
    at_rest = settle(model, data, source, config or PhysicsConfig(), least=least)
    names = {label: model.body(body).name for body, label in label_of_root.items()}
    if "" in names.values():
        raise InputError(source, "an object has no name", "name every body with a free joint")
    return SimulatedScene(model, data, spec, name, source, names, TABLE, geom_labels, at_rest)


def settle(model: Any, data: Any, source: str, config: PhysicsConfig, *, least: float = 0.0) -> bool:
    """Simulate until nothing moves, in place; leave a state that is at rest exactly as it is.

    Args:
        model: MuJoCo model.
        data: Its state, changed to the settled one, velocities zero.
        source: What to call it in the error.
        config: When an object is at rest, and how long to wait for it.
        least: Time simulated in any case [s].

    Returns:
        Whether rest was reached in time.

    Raises:
        InputError: The simulation blew up.
    """
    with mujoco_warnings_ignored():
        at_rest = _run_to_rest(model, data, source, config, least)
    data.qvel[:] = 0.0
    data.qacc_warmstart[:] = 0.0
    data.time = 0.0
    mujoco.mj_forward(model, data)
    return at_rest


def _run_to_rest(model: Any, data: Any, source: str, config: PhysicsConfig, least: float) -> bool:
    mujoco.mj_forward(model, data)
    mujoco.mj_step(model, data, nstep=round(least / model.opt.timestep))
    mujoco.mj_forward(model, data)
    steps = max(1, round(config.rest_window / model.opt.timestep))
    for _ in range(max(1, round(config.settle_time / config.rest_window))):
        before = data.qpos.copy()
        positions, rotations = data.xpos.copy(), data.xmat.copy()
        mujoco.mj_step(model, data, nstep=steps)
        mujoco.mj_forward(model, data)
        _check_stable(data, source)
        distance, angle = displacement(positions, rotations, data.xpos, data.xmat)
        if distance.max() <= config.rest_distance and angle.max() <= np.deg2rad(config.rest_angle):
            data.qpos[:] = before
            return True
    return False


def displacement(
    positions_a: Array, rotations_a: Array, positions_b: Array, rotations_b: Array
) -> tuple[Array, Array]:
    """How far N bodies moved and turned between two states.

    Args:
        positions_a: Body positions (N, 3) [m] before.
        rotations_a: Body rotations (N, 9), row by row.
        positions_b: Body positions (N, 3) [m] after.
        rotations_b: Body rotations (N, 9).

    Returns:
        Distances (N,) [m] and angles (N,) [rad].
    """
    trace = np.einsum("ni,ni->n", rotations_a, rotations_b)
    angle = np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))
    return np.linalg.norm(positions_b - positions_a, axis=-1), angle


def state_of(scene: SimulatedScene) -> Any:
    """Return a copy of the scene's settled `MjData`, for simulating on."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.data.qpos
    data.mocap_pos[:] = scene.data.mocap_pos
    data.mocap_quat[:] = scene.data.mocap_quat
    mujoco.mj_forward(scene.model, data)
    return data


def body_pose(scene: SimulatedScene, label: int) -> Array:
    """`T_world_body` (4, 4) of an object's body, or of the table's with label 0."""
    body = scene.body_id(label)
    T_world_body = np.eye(4)
    T_world_body[:3, :3] = scene.data.xmat[body].reshape(3, 3)
    T_world_body[:3, 3] = scene.data.xpos[body]
    return T_world_body


def one_line(error: Exception) -> str:
    """Return the text of an error on one line."""
    return " ".join(str(error).split())


def _subtree(model: Any, body: int) -> set[int]:
    inside = {body}
    for child in range(body + 1, model.nbody):
        if int(model.body_parentid[child]) in inside:
            inside.add(child)
    return inside


@contextmanager
def mujoco_warnings_ignored() -> Iterator[None]:
    """Keep MuJoCo from printing and from writing a log where the user is; the state counts its warnings."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


def _check_stable(data: Any, source: str) -> None:
    bad = (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
    if any(data.warning[int(kind)].number for kind in bad):
        raise InputError(
            source, "its simulation is unstable", "shorten the time step or mend overlapping bodies"
        )
