"""A simulated scene: its model in physics, its table and solids, and its true shapes."""

from __future__ import annotations

import colorsys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere, fibonacci_sphere
from caryatid.geometry.solids import Polytope, Solid
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import SUPPORT_LABEL

_GEOM = mujoco.mjtGeom

TABLE = "table"
"""Name of the body that is the support surface."""


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedScene:
    """A settled table-top scene in physics.

    MuJoCo changes states in place, so nothing in caryatid steps the `data` of a loaded scene; simulations use
    a copy (`state_of`).

    Attributes:
        model: The compiled MuJoCo model.
        data: Its state, at rest, with positions and contacts computed.
        spec: The specification of the model.
        name: Short name of the scene.
        source: Its file or built-in name, for messages.
        object_bodies: Body name of each object by its label 1…n, in the order of the bodies.
        table: Body name of the support surface.
        geom_labels: Label (G,) of the object each geom belongs to, 0 for the table and everything else.
        at_rest: Whether nothing moved any more when settling ended.
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
        """MuJoCo's number of the body with this label; 0 is the table."""
        return int(self.model.body(self.object_bodies[label] if label else self.table).id)

    def geoms(self, label: int) -> list[int]:
        """Geoms of the object with this label, or of the table with 0, including bodies welded to it."""
        inside = np.isin(self.model.geom_bodyid, _subtree(self.model, self.body_id(label)))
        return np.flatnonzero(inside if label == 0 else self.geom_labels == label).tolist()


def scene_from_spec(
    spec: Any, name: str, source: str, config: PhysicsConfig | None = None, *, least: float = 0.0
) -> SimulatedScene:
    """Compile a MuJoCo spec and let it come to rest.

    A scene that is already at rest keeps its poses to the last digit, unless `least` is positive.

    Args:
        spec: `mujoco.MjSpec` with a static body `table` and bodies with free joints.
        name: Short name of the scene.
        source: File or built-in name, for messages.
        config: When an object is at rest.
        least: Minimum time to simulate [s], for poses that were designed and not simulated.

    Raises:
        InputError: It does not compile, lacks a static body `table` or objects, or is unstable.
    """
    try:
        with mujoco_warnings_ignored():
            model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(source, f"MuJoCo rejects it: {reason}", "correct the MJCF") from None
    rest, step = (config or PhysicsConfig()).rest_window, model.opt.timestep
    if not 1e-5 <= step <= rest:
        raise InputError(source, f"its time step is {step:g} s", f"give option timestep 0.00001 to {rest:g}")
    if not np.isfinite(model.qpos0).all():
        raise InputError(source, "the pose of a body contains NaN or infinity", "give finite positions")
    table = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TABLE)
    free = sorted(model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist())
    if table < 0:
        raise InputError(source, f"has no body '{TABLE}'", f"name the static support surface '{TABLE}'")
    if model.body_weldid[table] != 0:
        raise InputError(source, f"body '{TABLE}' can move", "remove its joints: the surface is static")
    if not np.isin(model.geom_bodyid, _subtree(model, table)).any():
        raise InputError(source, f"body '{TABLE}' has no geom", "give the table a top")
    if not free:
        raise InputError(source, "has no objects", "every object is a body with a free joint")
    if len(free) >= SUPPORT_LABEL:
        raise InputError(source, f"has {len(free)} objects", f"at most {SUPPORT_LABEL - 1} are supported")
    names = {label: str(model.body(body).name) for label, body in enumerate(free, start=1)}
    if "" in names.values():
        raise InputError(source, "an object has no name", "name every body with a free joint")
    geom_roots = model.body_rootid[model.geom_bodyid]
    geom_labels = np.where(np.isin(geom_roots, free), np.searchsorted(free, geom_roots) + 1, 0)
    if unseen := set(names) - set(geom_labels.tolist()):
        raise InputError(source, f"body '{names[min(unseen)]}' has no geom", "give every object a shape")
    data, labels = mujoco.MjData(model), geom_labels.astype(np.int32)
    at_rest = _settle(model, data, source, config or PhysicsConfig(), least=least)
    return SimulatedScene(model, data, spec, name, source, names, TABLE, labels, at_rest)


def _settle(model: Any, data: Any, source: str, config: PhysicsConfig, *, least: float) -> bool:
    """Simulate, at least for a time [s], until nothing moves; return whether that was in time."""
    window = max(1, round(config.rest_window / model.opt.timestep))
    kinds = mujoco.mjtWarning
    blown_up = kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC
    at_rest = False
    with mujoco_warnings_ignored():
        mujoco.mj_forward(model, data)
        mujoco.mj_step(model, data, nstep=round(least / model.opt.timestep))
        mujoco.mj_forward(model, data)
        for _ in range(max(1, round(config.settle_time / config.rest_window))):
            before, poses = data.qpos.copy(), body_poses(data)
            mujoco.mj_step(model, data, nstep=window)
            mujoco.mj_forward(model, data)
            if any(data.warning[int(kind)].number for kind in blown_up):
                remedy = "shorten the time step, or separate overlapping bodies"
                raise InputError(source, "its simulation is unstable", remedy)
            if not strayed(poses, body_poses(data), config.rest_distance, config.rest_angle).any():
                data.qpos[:] = before
                at_rest = True
                break
    data.qvel[:] = 0.0
    data.qacc_warmstart[:] = 0.0
    data.time = 0.0
    mujoco.mj_forward(model, data)
    return at_rest


def body_poses(data: Any) -> Array:
    """Position [m] and quaternion, w first, of every body of a state (B, 7)."""
    return np.hstack([data.xpos, data.xquat])


def strayed(before: Array, after: Array, moved: float, turned: float) -> NDArray[np.bool_]:
    """Which (N,) of poses (N, 7), positions and quaternions, moved or turned beyond limits [m, deg]."""
    cosine = np.abs(np.einsum("ni,ni->n", before[:, 3:], after[:, 3:]))
    angle = 2.0 * np.arccos(np.clip(cosine, 0.0, 1.0))
    return (np.linalg.norm(after[:, :3] - before[:, :3], axis=1) > moved) | (angle > np.deg2rad(turned))


def state_of(scene: SimulatedScene) -> Any:
    """Return a copy of the scene's settled `MjData`, to simulate further."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.data.qpos
    data.mocap_pos[:] = scene.data.mocap_pos
    data.mocap_quat[:] = scene.data.mocap_quat
    mujoco.mj_forward(scene.model, data)
    return data


def poses_of(scene: SimulatedScene) -> Array:
    """State (N, 7) of a scene's objects: positions [m] and quaternions, w first."""
    return np.asarray(scene.data.qpos[_addresses(scene)])


def posed(scene: SimulatedScene, state: Array) -> SimulatedScene:
    """Return a scene with its objects in another state (N, 7), as from `poses_of`."""
    data = state_of(scene)
    data.qpos[_addresses(scene)] = state
    mujoco.mj_forward(scene.model, data)
    return replace(scene, data=data)


def _addresses(scene: SimulatedScene) -> Array:
    joints = [scene.model.body_jntadr[scene.body_id(label)] for label in scene.object_bodies]
    return np.asarray(scene.model.jnt_qposadr[joints][:, None] + np.arange(7))


def _subtree(model: Any, body: int) -> list[int]:
    """A body and its descendants; MuJoCo numbers bodies after their parents."""
    inside = [body]
    for child in range(body + 1, model.nbody):
        if model.body_parentid[child] in inside:
            inside.append(child)
    return inside


@contextmanager
def mujoco_warnings_ignored() -> Iterator[None]:
    """Keep MuJoCo from printing and from writing a log file; a state counts its warnings."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


TABLE_HEIGHT = 0.75
"""Height of the table tops built here [m]."""

TABLE_SIZE = (0.6, 0.9)
"""Depth (along world x, towards the robot) and width (along y) of the usual table top [m]."""

Side = Literal["+x", "+y", "-y"]
"""Possible sides of walls; the robot comes from -x."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """A free body of one shape.

    Attributes:
        shape: Its shape and initial pose, in the world.
        density: [kg/m³].
        friction: Sliding friction [1]; the larger one of two bodies in contact counts.
    """

    shape: Shape
    density: float = 600.0
    friction: float = 0.8


def box(size: Vector, at: Vector, turn: Vector = (0.0, 0.0, 0.0), **matter: float) -> Body:
    """A cuboid of a size [m], with its centre in x, y and, over the table top, z [m]; turned [deg]."""
    return Body(Box(_placed(at, turn), np.array(size)), **matter)


def cylinder(radius: float, height: float, at: Vector, **matter: float) -> Body:
    """An upright cylinder [m]; the other arguments are as in `box`."""
    return Body(Cylinder(_placed(at), radius, height), **matter)


def sphere(radius: float, at: Vector) -> Body:
    """A ball [m]; `at` is as in `box`."""
    return Body(Sphere(_placed(at), radius))


def empty_spec(name: str) -> Any:
    """An empty `mujoco.MjSpec` with a solver that keeps stacks standing."""
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.option.impratio = 10.0
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec


def build_spec(
    bodies: Sequence[Body],
    name: str,
    table_size: tuple[float, float] = TABLE_SIZE,
    walls: Sequence[Side] = (),
) -> Any:
    """Build the `MjSpec` of a floor, a table, walls beside it, and bodies `object0`, `object1`, … on it."""
    spec = empty_spec(name)
    spec.worldbody.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[10.0, 10.0, 0.1])
    table = spec.worldbody.add_body(name=TABLE)

    def put(body: Any, part: str, centre: ArrayLike, half: ArrayLike, colour: Vector) -> None:
        body.add_geom(name=part, type=_GEOM.mjGEOM_BOX, pos=centre, size=half, rgba=(*colour, 1.0))

    # 3.2 m long, 2 m high and 6 cm thick.
    half = np.array([0.03, 1.6, 1.0])
    for index, side in enumerate(walls):
        across = "xy".index(side[1])
        away = table_size[across] / 2.0 + (0.24, 0.32)[across] + half[0]
        order = [1, 0, 2] if across else [0, 1, 2]
        centre = np.array([away if side[0] == "+" else -away, 0.0, half[2]])
        put(spec.worldbody, f"wall{index}", centre[order], half[order], (0.85, 0.85, 0.82))
    # The top is 4 cm thick; the legs of 4 cm by 4 cm stand a little inside its corners.
    x, y, thick = table_size[0] / 2.0, table_size[1] / 2.0, 0.04
    under = TABLE_HEIGHT - thick
    middle = (0.0, 0.0, TABLE_HEIGHT - thick / 2.0)
    put(table, "table_top", middle, (x, y, thick / 2.0), (0.72, 0.58, 0.42))
    for index, (sign_x, sign_y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        foot = (sign_x * (x - 0.75 * thick), sign_y * (y - 0.75 * thick), under / 2.0)
        put(table, f"table_leg{index}", foot, np.array([thick, thick, under]) / 2.0, (0.6, 0.48, 0.35))
    for index, body in enumerate(bodies):
        add_body(spec, f"object{index}", body, palette(index))
    return spec


def palette(index: int) -> tuple[float, float, float, float]:
    """Colour of the object with this number; neighbours in number differ widely in hue."""
    hue = (0.02 + index * 0.618034) % 1.0  # multiples of the golden ratio stay apart
    return (*colorsys.hsv_to_rgb(hue, 0.75, (0.88, 0.7, 0.55)[(index // 7) % 3]), 1.0)


def quaternion(R: Array) -> Array:
    """Unit quaternion (4,), w first as in MuJoCo, of a rotation (3, 3)."""
    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, np.ascontiguousarray(R).reshape(-1))
    return wxyz


def _placed(at: Vector, turn: Vector = (0.0, 0.0, 0.0)) -> Array:
    R = transforms.rotation_from_vector(np.deg2rad(turn))
    return transforms.rigid(R, (at[0], at[1], TABLE_HEIGHT + at[2]))


def add_body(
    spec: Any, name: str, body: Body, rgba: tuple[float, float, float, float] = (0.7, 0.7, 0.7, 1.0)
) -> None:
    """Add a free body to a `mujoco.MjSpec`: a geom for each convex part, those of a solid as meshes."""
    shape = body.shape
    T_world_body = shape.T_world_object
    added = spec.worldbody.add_body(name=name, pos=T_world_body[:3, 3], quat=quaternion(T_world_body[:3, :3]))
    added.add_freejoint()
    kind, size, torsional, rolling = _GEOM.mjGEOM_BOX, shape.extents / 2.0, 0.005, 0.001
    if isinstance(shape, Cylinder):
        kind, size = _GEOM.mjGEOM_CYLINDER, np.array([shape.radius, shape.height / 2.0, 0.0])
    elif isinstance(shape, Sphere):
        kind, size = _GEOM.mjGEOM_SPHERE, np.array([shape.radius, 0.0, 0.0])
    elif isinstance(shape, Solid):
        kind = _GEOM.mjGEOM_MESH
    if isinstance(shape, Sphere | Solid):
        torsional, rolling = 0.01, 0.01
    matter: dict[str, Any] = {
        "condim": 4 if kind == _GEOM.mjGEOM_BOX else 6,
        "friction": [body.friction, torsional, rolling],
        "density": body.density,
        "rgba": rgba,
    }
    if not isinstance(shape, Solid):
        added.add_geom(type=kind, size=size, **matter)
        return
    for number, part in enumerate(shape.polytopes):
        mesh = f"{name}-{number}"
        spec.add_mesh(name=mesh, uservert=part.vertices.ravel().tolist())
        added.add_geom(type=kind, meshname=mesh, **matter)


def _outline(scene: SimulatedScene, geom: int) -> Array:
    """Points (N, 3) [m] whose convex hull is a geom; a round one to half a percent, with its volume."""
    shape, model, size = _primitive(scene, geom), scene.model, scene.model.geom_size[geom]
    if shape is not None:
        return shape.outline()
    ball = 1.0048 * fibonacci_sphere(400)  # so that its convex hull has the volume of a ball of radius 1
    match model.geom_type[geom]:
        case _GEOM.mjGEOM_ELLIPSOID:
            points = ball * size
        case _GEOM.mjGEOM_CAPSULE:
            points = ball * size[0] + np.sign(ball[:, 2:]) * (0.0, 0.0, size[1])
        case _GEOM.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            points = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]].astype(np.float64)
        case kind:
            body = model.body(model.geom_bodyid[geom]).name
            reason = f"a {_GEOM(kind).name.removeprefix('mjGEOM_').lower()} geom is not a solid shape"
            raise InputError(f"body '{body}'", reason, "use primitives or meshes")
    return transforms.transform(_geom_pose(scene, geom), points)


def bounds(scene: SimulatedScene, label: int) -> tuple[Array, Array]:
    """Lowest and highest corner, (3,) each [m], of the world-aligned box around an object (0: the table)."""
    lows, highs = [], []
    for geom in _solid_geoms(scene, label):
        shape = _primitive(scene, geom)
        points = _outline(scene, geom) if shape is None else shape.T_world_object[None, :3, 3]
        reach = np.zeros(3) if shape is None else shape.support(np.eye(3))
        if isinstance(shape, Cylinder):  # as `support` to the last digit but one, and seeds keep their scenes
            axis = np.abs(shape.T_world_object[:3, 2])
            reach = shape.height / 2.0 * axis + shape.radius * np.sqrt(np.clip(1.0 - axis**2, 0.0, None))
        lows.append(points.min(axis=0) - reach)
        highs.append(points.max(axis=0) + reach)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def true_shapes(scene: SimulatedScene) -> dict[int, Shape]:
    """Shape of every object by label: a box, a cylinder, a sphere, or a solid of its geoms."""
    shapes: dict[int, Shape] = {}
    for label in scene.object_bodies:
        geoms, body = _solid_geoms(scene, label), scene.body_id(label)
        shape = _primitive(scene, geoms[0]) if len(geoms) == 1 else None
        if shape is None:
            T_world_body = transforms.rigid(scene.data.xmat[body].reshape(3, 3), scene.data.xpos[body])
            T_body_world = transforms.invert(T_world_body)
            outlines = [transforms.transform(T_body_world, _outline(scene, geom)) for geom in geoms]
            parts = tuple(part for part in map(Polytope.around, outlines) if part is not None)
            shape = Solid(T_world_body, parts)
        shapes[label] = shape
    return shapes


def static_boxes(scene: SimulatedScene) -> tuple[Box, ...]:
    """Oriented boxes around all geoms that belong to no object, the table's first; planes are left out."""
    flat = (int(_GEOM.mjGEOM_PLANE), int(_GEOM.mjGEOM_HFIELD))
    geoms = dict.fromkeys([*scene.geoms(0), *np.flatnonzero(scene.geom_labels == 0).tolist()])
    return tuple(_geom_box(scene, g) for g in geoms if int(scene.model.geom_type[g]) not in flat)


def table_centre(scene: SimulatedScene) -> Array:
    """Middle (3,) [m] of the table's largest upper face, world frame."""
    faces = []
    for box in (_geom_box(scene, g) for g in scene.geoms(0)):
        R, half = box.T_world_object[:3, :3], box.extents / 2.0
        up = int(np.argmax(np.abs(R[2])))
        area = float(abs(R[2, up]) * np.prod(np.delete(half, up)))
        faces.append((area, box.T_world_object[:3, 3] + np.copysign(half[up], R[2, up]) * R[:, up]))
    return max(faces, key=lambda face: face[0])[1]


def _solid_geoms(scene: SimulatedScene, label: int) -> list[int]:
    """Geoms that make up the solid of an object (0 = table): those that collide, or all if none does."""
    geoms, model = scene.geoms(label), scene.model
    return [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]] or geoms


def _geom_pose(scene: SimulatedScene, geom: int) -> Array:
    return transforms.rigid(scene.data.geom_xmat[geom].reshape(3, 3), scene.data.geom_xpos[geom])


def _primitive(scene: SimulatedScene, geom: int) -> Shape | None:
    size, T_world_geom = scene.model.geom_size[geom], _geom_pose(scene, geom)
    match scene.model.geom_type[geom]:
        case _GEOM.mjGEOM_BOX:
            return Box(T_world_geom, 2.0 * size)
        case _GEOM.mjGEOM_CYLINDER:
            return Cylinder(T_world_geom, float(size[0]), 2.0 * float(size[1]))
        case _GEOM.mjGEOM_SPHERE:
            return Sphere(T_world_geom, float(size[0]))
    return None


def _geom_box(scene: SimulatedScene, geom: int) -> Box:
    """Return the box around a geom along the geom's own axes."""
    centre, half = scene.model.geom_aabb[geom, :3], scene.model.geom_aabb[geom, 3:]
    return Box(_geom_pose(scene, geom) @ transforms.rigid(np.eye(3), centre), 2.0 * half)
