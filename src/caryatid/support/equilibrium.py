"""Equilibrium: the contact forces that hold a scene at rest, in draws of the uncertain quantities."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from caryatid.config import SupportConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.support.contacts import Contact, find_contacts
from caryatid.support.plausibility import closing, deviations, effect, gap_rows
from caryatid.support.stability import contact_area

_GRAVITY = 9.81
"""[m/s²]."""
_SOFTNESS = 1e-3
"""Share of the load by which a contact yields [1]: undetermined forces then spread evenly."""
_SLIP = 10.0
"""How much more friction yields than pressure [1]: it carries what pressure cannot. Nothing presses
neighbours together sideways, and side by side they settle without holding each other up."""
_SMOOTH = 1e-4
"""Coefficient of almost no friction [1]; MuJoCo needs some."""


def support_shares(
    graph: SupportGraph, config: SupportConfig, rng: np.random.Generator
) -> tuple[list[float], list[float]]:
    """How often each support of a graph is among those that hold the scene, in draws of the unknowns.

    A supports B in a draw if it carries more than a small share of B's weight; from the side or from above,
    also if B is at rest with A and moves without it. A draw in which B does not rest, although the real one
    was seen at rest, counts little for B.

    Args:
        graph: Objects, and the supports in question.
        config: The unknowns, and when an object is at rest.
        rng: Source of the draws.

    Returns:
        The share (E,) of draws with each support [1], and the share (N,) of draws in which each object
        agrees with that of the graph by an intersection over union of 0.5 [1].
    """
    scene = Equilibrium(graph.objects, config)
    index = {o.id: k for k, o in enumerate(graph.objects)}
    pairs = [(index[s.supporter], index[s.supported]) for s in graph.supports]
    holding, alike, total = np.zeros(len(pairs)), np.zeros(len(index)), np.zeros(len(index))
    for draw in scene.draws(rng):
        balance = scene.solve(draw)
        rests = balance.motion <= config.at_rest
        trust = np.where(rests, 1.0, config.unexplained)
        without: dict[int, Array] = {}
        for k, (a, b) in enumerate(pairs):
            held = balance.pushes[a, b, 2] > config.force_share
            if not held and rests[b] and graph.supports[k].kind != "bottom-up":
                if a not in without:
                    without[a] = scene.solve(draw, without=a).motion
                held = without[a][b] > balance.motion[b] + config.at_rest
            holding[k] += held * trust[b]
        total += trust
        alike += draw.likeness >= 0.5
    ends = [b for _, b in pairs]
    return (holding / total[ends]).clip(0.0, 1.0).tolist(), (alike / config.draws).tolist()


@dataclass(frozen=True, eq=False, slots=True)
class Draw:
    """One possible scene of N objects and K contacts.

    Attributes:
        shifts: Offset of each centre of mass from its estimate (N, 3) [m], world frame.
        likeness: Intersection over union of each shape with its estimate (N,) [1].
        gaps: Gap at each contact (K,) [m].
        frictions: Coefficient at each contact (K,) [1].
        densities: (N,) [kg/m³].
    """

    shifts: Array
    likeness: Array
    gaps: Array
    frictions: Array
    densities: Array


@dataclass(frozen=True, eq=False, slots=True)
class Balance:
    """The forces and motions in a draw.

    Attributes:
        motion: Acceleration (N,) of each object's centre, or of its rim if that is more [g]; 0 at rest.
        pushes: Force (N, N, 3) of each object on each other one, in weights of the latter [1], world frame.
        pressed: Which contacts (K,) carry a force.
    """

    motion: Array
    pushes: Array
    pressed: NDArray[np.bool_]


def touching(objects: Sequence[SceneObject], margin: float) -> list[Contact]:
    """Find the contacts of a scene; those with the support surface have its normal.

    Args:
        objects: The support surface and the objects.
        margin: Largest gap [m].
    """
    contacts = find_contacts([o.shape for o in objects], margin)
    for k, contact in enumerate(contacts):
        for index, sign in ((contact.a, 1.0), (contact.b, -1.0)):
            if objects[index].role == "support_surface":
                axes_world = objects[index].shape.T_world_object[:3, :3]
                up_world = axes_world[:, np.argmax(np.abs(axes_world[2]))]
                contacts[k] = replace(contact, normal_world=sign * np.sign(up_world[2]) * up_world)
    return contacts


class Equilibrium:
    """Rigid shapes that touch, or nearly do, under gravity.

    The forces are the solution of one convex program, Gauss's principle of least constraint: within the
    friction cones, with normal forces that only press, they hold all objects nearest to rest. MuJoCo solves
    it. An open contact presses only if an object closes its gap within the time of a fall of `max_drop`, so
    a gap is closed only where an object would fall or tip into it.

    Args:
        objects: The support surface, which does not move, and the objects; N in all. Without a surface those
            that touch nothing below them do not.
        config: The unknowns, and how far an object may fall.

    Attributes:
        contacts: K contacts.
        areas: Corners (M, 3) [m] of each contact's area.
    """

    def __init__(self, objects: Sequence[SceneObject], config: SupportConfig) -> None:
        self._objects, self._config = objects, config
        self._fall = max(config.max_drop, config.reach)
        shapes = [o.shape for o in objects]
        self.contacts = touching(objects, self._fall)
        self._pairs = np.array([(c.a, c.b) for c in self.contacts], dtype=np.intp).reshape(-1, 2)
        self._fixed = np.array([o.role == "support_surface" for o in objects], dtype=np.bool_)
        if not self._fixed.any():
            lifted = [c.b if c.normal_world[2] > 0.0 else c.a for c in self.contacts]
            self._fixed = ~np.isin(np.arange(len(objects)), lifted)
        self._volumes = np.array([s.volume for s in shapes])
        self._moments = np.array([s.moments for s in shapes]).reshape(-1, 3)
        self._centres = np.array([s.centre_of_mass for s in shapes]).reshape(-1, 3)
        self._reach = np.array([np.linalg.norm(s.extents) / 2.0 for s in shapes])
        self._axes = np.array([s.T_world_object[:3, :3] for s in shapes]).reshape(-1, 3, 3)
        self.areas = [contact_area(c, config) for c in self.contacts]
        self._points = np.concatenate([np.empty((0, 3)), *self.areas])
        self._contact = np.repeat(np.arange(len(self.areas)), [len(area) for area in self.areas])
        self._model = _engine(max(16, 1 << (len(objects) - 1).bit_length()), threading.get_ident())
        self._data = self._with_contacts()
        self._warm = np.zeros(self._model.nv)

    def draws(self, rng: np.random.Generator) -> Iterator[Draw]:
        """Draw scenes: first the estimated one, then others as likely.

        Shapes move, turn and grow by their fits' uncertainty. Each contact that weight can press shut, its
        normal within the friction cone around the vertical, is closed with the probability that its gap
        implies; before that, no gap is as likely as any gap up to `max_drop`. Closed gaps correct all
        shapes, as in `reconcile`. Gaps into which objects fall or tip in the first draw are closed in all.

        Args:
            rng: Source of the draws.
        """
        config, count = self._config, len(self.contacts)
        sigma = np.array([deviations(o) for o in self._objects]).reshape(-1, 9)
        variance = sigma**2
        effects = np.array([effect(o.shape.ties) for o in self._objects]).reshape(-1, 9, 9)
        half = np.array([o.shape.extents / 2.0 for o in self._objects]).reshape(-1, 3)
        found = np.array([c.distance for c in self.contacts])
        rows = gap_rows(self._objects, self.contacts, self._pairs)
        scatter = np.einsum("kpv,kpv->k", rows**2, variance[self._pairs]) + config.touch**2
        odds = np.exp(-(np.maximum(found, 0.0) ** 2) / (2.0 * scatter)) * self._fall
        shut = odds / (odds + np.sqrt(2.0 * np.pi * scatter))
        steepest = np.cos(np.arctan(np.mean(config.friction)))
        level = np.array([abs(c.normal_world[2]) >= steepest for c in self.contacts], dtype=np.bool_)
        shut *= level
        fallen = np.zeros(count, dtype=np.bool_)
        for number in range(config.draws):
            first = number == 0
            change = np.clip(rng.standard_normal(sigma.shape), -3.0, 3.0) * sigma * (not first)
            touching = shut > (0.5 if first else rng.random(count))
            gaps = found - np.einsum("kpv,kpv->k", rows, change[self._pairs])
            if touching.any():
                ends, ways = self._pairs[touching], rows[touching]
                change += closing(ends, ways, variance, gaps[touching], config.touch**2)
            gaps = found - np.einsum("kpv,kpv->k", rows, change[self._pairs]) - config.touch
            frictions = rng.uniform(*config.friction, len(self._objects))
            densities = rng.uniform(*config.density, len(self._objects))
            if first:
                frictions[:], densities[:] = np.mean(config.friction), np.mean(config.density)
            moved = np.einsum("nij,nj->ni", effects, change)
            draw = Draw(
                np.einsum("nij,nj->ni", self._axes, moved[:, :3]),
                _likeness(half, moved[:, :3], moved[:, 6:]),
                np.where(touching | fallen, 0.0, np.maximum(gaps, 0.0)),
                np.max(frictions[self._pairs], axis=1, initial=0.0),
                densities,
            )
            if first:
                # A wall does not hold an object that falls along it.
                falling = replace(draw, frictions=np.where(level, draw.frictions, _SMOOTH))
                fallen = self.solve(falling).pressed & (draw.gaps > config.at_rest * self._fall)
                draw = replace(draw, gaps=np.where(fallen, 0.0, draw.gaps))
            yield draw

    def solve(self, draw: Draw, without: int | None = None) -> Balance:
        """Find the forces that hold a draw, and the objects that still move.

        Args:
            draw: The scene.
            without: Index of an object to remove.
        """
        model, data, count = self._model, self._data, len(self._objects)
        self._set(draw)
        gone = (self._pairs[self._contact] == without).any(axis=1)
        data.qacc_warmstart[:] = self._warm
        if len(gone):
            data.contact.exclude[:] = gone
            data.contact.dist[:] = draw.gaps[self._contact]
            # Open contacts have no friction; otherwise objects sliding along them would push them away.
            rough = np.where(draw.gaps > 0.0, _SMOOTH, draw.frictions)
            data.contact.friction[:, :2] = rough[self._contact, None]
        for stage in (
            mujoco.mj_makeConstraint, mujoco.mj_projectConstraint, mujoco.mj_fwdVelocity,
            mujoco.mj_fwdActuation, mujoco.mj_fwdAcceleration, mujoco.mj_fwdConstraint,
        ):  # fmt: skip
            stage(model, data)
        if without is None:
            self._warm = data.qacc.copy()
        acceleration = data.qacc.reshape(-1, 6)[:count]
        turning = np.linalg.norm(acceleration[:, 3:], axis=1) * self._reach
        motion = np.maximum(np.linalg.norm(acceleration[:, :3], axis=1), turning) / _GRAVITY
        motion[self._fixed] = 0.0
        pushes, pressed = np.zeros((count, count, 3)), np.zeros(len(self.contacts), dtype=np.bool_)
        if len(gone):
            active = np.flatnonzero(~gone & (data.contact.efc_address >= 0))
            frames = data.contact.frame.reshape(-1, 3, 3)[active]
            forces = data.efc_force[data.contact.efc_address[active, None] + np.arange(3)]
            forces_world = np.einsum("ki,kij->kj", forces, frames)
            pressed[self._contact[active[forces[:, 0] > 0.0]]] = True
            a, b = self._pairs[self._contact[active]].T
            np.add.at(pushes, (a, b), forces_world)
            np.add.at(pushes, (b, a), -forces_world)
        return Balance(motion, pushes / (_GRAVITY * draw.densities * self._volumes)[:, None], pressed)

    def _set(self, draw: Draw) -> None:
        """Set masses and positions of the model's bodies to the draw's."""
        model, data, count = self._model, self._data, len(self._objects)
        masses, inertias = np.ones(model.nbody - 1), np.ones((model.nbody - 1, 3))
        masses[:count] = draw.densities * self._volumes
        inertias[:count] = masses[:count, None] * self._moments
        model.body_mass[1:], model.body_inertia[1:], model.body_subtreemass[1:] = masses, inertias, masses
        model.dof_M0[:] = np.concatenate([np.tile(masses[:, None], 3), inertias], axis=1).ravel()
        model.body_invweight0[1:] = np.stack([1.0 / masses, 1.0 / inertias.mean(axis=1)], axis=1)
        data.qpos.reshape(-1, 7)[:count, :3] = self._centres + draw.shifts
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_factorM(model, data)

    def _with_contacts(self) -> mujoco.MjData:
        """A state with a body for each object, and all contacts; the support surface is the world's."""
        data = mujoco.MjData(self._model)
        poses = data.qpos.reshape(-1, 7)
        for k, axes in enumerate(self._axes):
            mujoco.mju_mat2Quat(poses[k, 3:], np.ascontiguousarray(axes).ravel())
        mujoco.mj_kinematics(self._model, data)
        contact = mujoco.MjContact()
        contact.dim, contact.flex, contact.elem, contact.vert = 3, [-1, -1], [-1, -1], [-1, -1]
        contact.includemargin, contact.mu, contact.exclude = 0.0, 0.0, 0
        contact.friction[:] = _SMOOTH
        # An acceleration of one g closes an open gap as wide as the furthest fall.
        contact.solref[:], contact.solreffriction[:] = (-_GRAVITY / self._fall, -1.0), 0.0
        contact.solimp[:] = (1.0 - _SOFTNESS, 1.0 - _SOFTNESS, 1e-3, 0.5, 2.0)
        for _ in self._points:
            mujoco.mj_addContact(self._model, data, contact)
        if len(self._points):
            normals_world = np.array([c.normal_world for c in self.contacts])
            across = transforms.perpendicular(normals_world)
            frames = np.concatenate([normals_world, across, np.cross(normals_world, across)], axis=1)
            data.contact.pos[:], data.contact.frame[:] = self._points, frames[self._contact]
            data.contact.geom[:] = np.where(self._fixed[self._pairs], 0, self._pairs + 1)[self._contact]
        return data


def _likeness(half: Array, moved: Array, grown: Array) -> Array:
    """Intersection over union (N,) of boxes with half extents (N, 3) and the same moved and grown (N, 3)."""
    other = np.maximum(half + grown, 0.0)
    shared = np.minimum(half, moved + other) - np.maximum(-half, moved - other)
    common = np.prod(np.maximum(shared, 0.0), axis=1)
    ratio: Array = common / (8.0 * (np.prod(half, axis=1) + np.prod(other, axis=1)) - common)
    return ratio


@lru_cache(maxsize=8)
def _engine(capacity: int, thread: int) -> mujoco.MjModel:
    """Free bodies with given contacts; one per thread, because masses are set before each use."""
    spec = mujoco.MjSpec()
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 1.0 / _SLIP
    spec.option.tolerance, spec.option.gravity = 1e-8, (0.0, 0.0, -_GRAVITY)
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    spec.memory = 1 << 26  # Address space; only what contacts fill is used.
    bodies = [
        spec.worldbody.add_body(mass=1.0, inertia=np.ones(3), explicitinertial=True) for _ in range(capacity)
    ]
    for body in bodies:
        body.add_freejoint()
    for body in (spec.worldbody, *bodies):
        body.add_geom(size=np.ones(3), contype=0, conaffinity=0)
    return spec.compile()
