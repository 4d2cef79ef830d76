"""A simulated scene: its model in physics, its support surfaces and solids, and its true shapes."""

from __future__ import annotations

import colorsys
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import mujoco
import networkx as nx
import numpy as np
from numpy.typing import NDArray

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere, fibonacci_sphere
from caryatid.geometry.solids import Polytope, Solid
from caryatid.geometry.transforms import Array
from caryatid.robots.floor import STEP
from caryatid.sensing.views import MAX_LABEL

_GEOM = mujoco.mjtGeom

TABLE = "table"
"""Name of the body that is the main support surface where there is one."""

ENDLESS = 100.0
"""Half the side of a plane without end [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedScene:
    """A settled scene in physics.

    MuJoCo changes states in place, so nothing in caryatid steps the `data` of a loaded scene; simulations use
    a copy (`state_of`).

    Attributes:
        model: The compiled MuJoCo model.
        data: Its state, at rest, with positions and contacts computed.
        spec: The specification of the model.
        name: Short name of the scene.
        source: Its file or built-in name, for messages.
        object_bodies: Body name of each object by its label 1…n, in the order of the bodies.
        surfaces: Geoms of everything static that may carry objects, by name, the main surface first.
        geom_labels: Label (G,) of the object each geom belongs to, −1 for a robot, 0 for everything else.
        at_rest: Whether nothing moved any more when settling ended.
    """

    model: Any
    data: Any
    spec: Any
    name: str
    source: str
    object_bodies: dict[int, str]
    surfaces: dict[str, list[int]]
    geom_labels: NDArray[np.int32]
    at_rest: bool

    @property
    def table(self) -> str:
        """Name of the main surface: the body `table`, or else what most objects stand on."""
        return next(iter(self.surfaces))

    def body_id(self, label: int) -> int:
        """MuJoCo's number of the body of the object with this label."""
        return int(self.model.body(self.object_bodies[label]).id)


def scene_from_spec(
    spec: Any, name: str, source: str, config: PhysicsConfig | None = None, *, least: float = 0.0
) -> SimulatedScene:
    """Compile a MuJoCo spec and let it come to rest.

    A scene that is already at rest keeps its poses to the last digit, unless `least` is positive.

    Args:
        spec: `mujoco.MjSpec` with static bodies or geoms, and bodies with free joints.
        name: Short name of the scene.
        source: File or built-in name, for messages.
        config: When an object is at rest.
        least: Minimum time to simulate [s], for poses that were designed and not simulated.

    Raises:
        InputError: It does not compile, has no objects, nothing static carries one, or it is unstable.
    """
    model = compile_spec(spec, source)
    rest, step = (config or PhysicsConfig()).rest_window, model.opt.timestep
    if not 1e-5 <= step <= rest:
        raise InputError(source, f"its time step is {step:g} s", f"give option timestep 0.00001 to {rest:g}")
    table = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TABLE)
    free = sorted(model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist())
    if table >= 0 and model.body_weldid[table] != 0:
        raise InputError(source, f"body '{TABLE}' can move", "remove its joints: the surface is static")
    if table >= 0 and not np.isin(model.geom_bodyid, _subtree(model, table)).any():
        raise InputError(source, f"body '{TABLE}' has no geom", "give the table a top")
    if not free:
        raise InputError(source, "has no objects", "every object is a body with a free joint")
    if len(free) > MAX_LABEL:
        raise InputError(source, f"has {len(free)} objects", f"at most {MAX_LABEL} are supported")
    names = {label: str(model.body(body).name) for label, body in enumerate(free, start=1)}
    geom_roots = model.body_rootid[model.geom_bodyid]
    geom_labels = np.where(np.isin(geom_roots, free), np.searchsorted(free, geom_roots) + 1, 0)
    data, labels = mujoco.MjData(model), geom_labels.astype(np.int32)
    config = config or PhysicsConfig()
    at_rest = _settle(model, data, source, config, least=least)
    scene = SimulatedScene(model, data, spec, name, source, names, _static_geoms(model), labels, at_rest)
    return scene if table >= 0 else _with_main_surface(scene, config.force_share)


def compile_spec(spec: Any, source: str) -> Any:
    """Compile a `mujoco.MjSpec`.

    Raises:
        InputError: MuJoCo rejects it, or a file of it is missing.
    """
    try:
        with mujoco_warnings_ignored():
            return spec.compile()
    except ValueError as error:
        raise rejection(error, source, spec) from None


def rejection(error: ValueError, source: str, spec: Any = None) -> InputError:
    """What MuJoCo says about an MJCF file, with the cause and the remedy."""
    reason = " ".join(str(error).split()).removeprefix("XML Error: ").removeprefix("Error: ")
    if missing := re.search(r"Error opening file '(.+?)'", reason):
        assets = () if spec is None else (*spec.meshes, *spec.textures, *spec.hfields, *spec.skins)
        users = [f"asset '{each.name}'" for each in assets if each.file and missing[1].endswith(each.file)]
        reason = f"{users[0] if users else 'it'} needs the file '{missing[1]}', which cannot be read"
        return InputError(source, reason, "put the file there, or correct its path")
    if "XML parse error" in reason or "XML model type" in reason:
        remedy = "correct the XML" if "parse" in reason else "give a file that begins with <mujoco>"
        return InputError(source, f"not an MJCF file ({reason})", remedy)
    return InputError(source, f"MuJoCo rejects it: {reason}", "correct the MJCF")


def _static_geoms(model: Any) -> dict[str, list[int]]:
    """Geoms of each static body by its name, and geoms of the world by their own, the table's first.

    A body without a name belongs to the one above it; everything below the table is the table.
    """
    table = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TABLE)
    inside = _subtree(model, table) if table >= 0 else []
    surfaces: dict[str, list[int]] = {TABLE: []} if table >= 0 else {}
    for geom, body in enumerate(model.geom_bodyid.tolist()):
        if body in inside:
            surfaces[TABLE].append(geom)
        elif model.body_weldid[body] == 0:
            while body and not model.body(body).name:
                body = int(model.body_parentid[body])
            name = str(model.body(body).name if body else model.geom(geom).name)
            is_body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) >= 0
            surfaces.setdefault(name if name and is_body == bool(body) else f"geom {geom}", []).append(geom)
    return surfaces


def _with_main_surface(scene: SimulatedScene, share: float) -> SimulatedScene:
    """Put first the surface that most objects stand on, directly or not; of several, the first."""
    held = nx.DiGraph(held_from_below(scene, mean_contact_forces(scene), share))
    held.add_nodes_from(-surface for surface in range(len(scene.surfaces)))
    counts = [len(nx.descendants(held, -surface)) for surface in range(len(scene.surfaces))]
    if not any(counts):
        reason = "nothing static carries an object when the scene is at rest"
        raise InputError(scene.source, reason, "put the objects on a static body or geom, such as a floor")
    main = list(scene.surfaces)[int(np.argmax(counts))]
    return replace(scene, surfaces={main: scene.surfaces[main], **scene.surfaces})


def mean_contact_forces(scene: SimulatedScene) -> dict[tuple[int, int], Array]:
    """Mean force (3,) [N] of A on B over a fifth of a second, for each pair that touches.

    A and B are labels of objects, or −k for surface k of the scene; contacts with anything else are left out.
    Both directions of a pair are there. Soft contacts creep, so longer means would drift.
    """
    labels = np.where(scene.geom_labels > 0, scene.geom_labels, np.int32(-len(scene.surfaces)))
    for surface, geoms in enumerate(scene.surfaces.values()):
        labels[geoms] = -surface
    data = state_of(scene)
    steps = max(1, round(0.2 / scene.model.opt.timestep))
    sums: dict[tuple[int, int], Array] = {}
    wrench = np.zeros(6)
    for _ in range(steps):
        mujoco.mj_step(scene.model, data)
        for index, geoms in enumerate(data.contact.geom):
            a, b = (int(label) for label in labels[geoms])
            if min(a, b) > -len(scene.surfaces) and a != b:
                mujoco.mj_contactForce(scene.model, data, index, wrench)
                force = wrench[:3] @ data.contact.frame[index].reshape(3, 3)
                sums[a, b] = sums.get((a, b), np.zeros(3)) + force
                sums[b, a] = sums.get((b, a), np.zeros(3)) - force
    return {pair: total / steps for pair, total in sums.items()}


def held_from_below(
    scene: SimulatedScene, forces: dict[tuple[int, int], Array], share: float
) -> set[tuple[int, int]]:
    """Pairs of a supporter and an object that it carries, from forces (3,) [N] of `mean_contact_forces`.

    The upward part exceeds a share of the object's weight. That of a static body also exceeds the level part:
    a wall on which an object leans carries nothing.
    """
    gravity = np.linalg.norm(scene.model.opt.gravity)
    held = set()
    for (a, b), force in forces.items():
        steep = a > 0 or force[2] > np.hypot(force[0], force[1])
        if b > 0 and steep and force[2] > share * scene.model.body_subtreemass[scene.body_id(b)] * gravity:
            held.add((a, b))
    return held


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
    return np.asarray(scene.data.qpos[pose_addresses(scene)])


def posed(scene: SimulatedScene, state: Array) -> SimulatedScene:
    """Return a scene with its objects in another state (N, 7), as from `poses_of`."""
    data = state_of(scene)
    data.qpos[pose_addresses(scene)] = state
    mujoco.mj_forward(scene.model, data)
    return replace(scene, data=data)


def pose_addresses(scene: SimulatedScene) -> NDArray[np.intp]:
    """Where in MuJoCo's `qpos` the poses (N, 7) of a scene's objects are."""
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

BOARD: Vector = (0.72, 0.58, 0.42)
FRAME: Vector = (0.6, 0.48, 0.35)
"""Colours of what carries objects, and of what carries that."""


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


@dataclass(frozen=True, eq=False, slots=True)
class Part:
    """A box of furniture, along the axes of the world.

    Attributes:
        body: Name of its static body; empty for a geom of the world.
        centre: Its middle (3,) [m].
        half: Half its sizes (3,) [m].
        colour: Red, green and blue [1].
        name: Name of the geom, if it has one.
    """

    body: str
    centre: Array
    half: Array
    colour: Vector = BOARD
    name: str = ""


def make_table(
    size: tuple[float, float] = TABLE_SIZE,
    walls: Sequence[Side] = (),
    height: float = TABLE_HEIGHT,
    at: tuple[float, float] = (0.0, 0.0),
    name: str = TABLE,
) -> list[Part]:
    """Build a table with four legs, its size along x and y [m], and walls around it."""
    parts = []
    # 3.2 m long, 2 m high and 6 cm thick.
    half = np.array([0.03, 1.6, 1.0])
    for index, side in enumerate(walls):
        across = "xy".index(side[1])
        away = size[across] / 2.0 + (0.24, 0.32)[across] + half[0]
        order = [1, 0, 2] if across else [0, 1, 2]
        centre = np.array([away if side[0] == "+" else -away, 0.0, half[2]])
        parts.append(Part("", centre[order], half[order], (0.85, 0.85, 0.82), f"wall{index}"))
    # The top is 4 cm thick; the legs of 4 cm by 4 cm stand a little inside its corners.
    x, y, thick = size[0] / 2.0, size[1] / 2.0, 0.04
    under = height - thick
    middle = np.array([*at, height - thick / 2.0])
    parts.append(Part(name, middle, np.array([x, y, thick / 2.0]), BOARD, f"{name}_top"))
    for index, (sign_x, sign_y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        foot = np.array([sign_x * (x - 0.75 * thick), sign_y * (y - 0.75 * thick), under / 2.0])
        leg = np.array([thick, thick, under]) / 2.0
        parts.append(Part(name, foot + (*at, 0.0), leg, FRAME, f"{name}_leg{index}"))
    return parts


def build_spec(bodies: Sequence[Body], name: str, furniture: Sequence[Part] | None = None) -> Any:
    """Build the `MjSpec` of a floor, furniture (by default a table), and bodies `object0`, `object1`, …."""
    spec = empty_spec(name)
    spec.worldbody.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[10.0, 10.0, 0.1])
    static = {"": spec.worldbody}
    for part in make_table() if furniture is None else furniture:
        if part.body not in static:
            static[part.body] = spec.worldbody.add_body(name=part.body)
        static[part.body].add_geom(
            name=part.name, type=_GEOM.mjGEOM_BOX, pos=part.centre, size=part.half, rgba=(*part.colour, 1.0)
        )
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
            body, name = model.body(model.geom_bodyid[geom]).name, model.geom(geom).name or str(geom)
            shape_name = _GEOM(kind).name.removeprefix("mjGEOM_").lower()
            reason = f"geom '{name}' of body '{body}' is of the type {shape_name}"
            raise InputError(scene.source, reason, "use primitives or meshes")
    return transforms.transform(_geom_pose(scene, geom), points)


def bounds(scene: SimulatedScene, label: int) -> tuple[Array, Array]:
    """Lowest and highest corner, (3,) each [m], of the world-aligned box around an object."""
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
    static = np.flatnonzero(scene.geom_labels <= 0).tolist()
    geoms = dict.fromkeys([*scene.surfaces[scene.table], *static])
    return tuple(_geom_box(scene, g) for g in geoms if int(scene.model.geom_type[g]) not in flat)


def table_centre(scene: SimulatedScene) -> Array:
    """Middle (3,) [m] of the main surface's top, world frame; on the ground, the middle of the objects."""
    height, x, y, _, _ = surface_of(scene, scene.table)
    if height <= STEP:
        x, y = np.median([shape.T_world_object[:2, 3] for shape in true_shapes(scene).values()], axis=0)
    return np.array([x, y, height])


def surface_of(scene: SimulatedScene, name: str) -> tuple[float, float, float, float, float]:
    """Height of a surface's top, x and y of its middle, and half its sizes along x and y [m].

    The top is its largest upper face.
    """
    faces = []
    for box in (_geom_box(scene, g) for g in scene.surfaces[name]):
        R, half = box.T_world_object[:3, :3], box.extents / 2.0
        up = int(np.argmax(np.abs(R[2])))
        area = float(abs(R[2, up]) * np.prod(np.delete(half, up)))
        x, y, height = (box.T_world_object[:3, 3] + np.copysign(half[up], R[2, up]) * R[:, up]).tolist()
        half_x, half_y = (np.abs(R[:2]) @ np.where(np.arange(3) == up, 0.0, half)).tolist()
        faces.append((area, (height, x, y, half_x, half_y)))
    return max(faces, key=lambda face: face[0])[1]


def _solid_geoms(scene: SimulatedScene, label: int) -> list[int]:
    """Geoms that make up the solid of an object: those that collide, or all if none does."""
    geoms, model = np.flatnonzero(scene.geom_labels == label).tolist(), scene.model
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
    if scene.model.geom_type[geom] == _GEOM.mjGEOM_PLANE:
        across = scene.model.geom_size[geom, :2]
        half = np.append(np.where(across > 0.0, across, ENDLESS), 0.01)
        centre = np.array([0.0, 0.0, -half[2]])
    return Box(_geom_pose(scene, geom) @ transforms.rigid(np.eye(3), centre), 2.0 * half)
