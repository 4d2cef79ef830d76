"""Equilibrium: the contact forces that hold a scene at rest, in draws of the uncertain quantities."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import ndtr

from caryatid.config import SupportConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject
from caryatid.support.contacts import Contact, find_contacts
from caryatid.support.plausibility import closing, deviations, effect, gap_rows
from caryatid.support.stability import contact_area

_GRAVITY = 9.81
"""[m/s²]."""
_SOFTNESS = 1e-3
"""Share of the load by which a contact yields [1]: undetermined forces then spread evenly."""
_SIGMAS = 3.0
"""Standard deviations beyond which no variable is drawn [1]."""
_SLIP = 30.0
"""How much more friction yields than pressure [1]: it carries what pressure cannot. Nothing presses
neighbours together sideways, and side by side they settle without holding each other up. What friction
holds alone yields by 3 % of its weight, and still counts as at rest."""


@dataclass(frozen=True, eq=False, slots=True)
class SupportForces:
    """Which object supports which, and by what force, over draws of a scene of N objects.

    Attributes:
        shares: Share (N, N) of draws in which each object supports each other one [1].
        forces: Mean force (N, N, 3) of each object on each other one, in weights of the latter, world frame.
        likeness: Share (N,) of draws in which each object agrees with the estimate by an intersection over
            union of 0.5 [1].
        contacts: K contacts of the scene.
        areas: Corners (M, 3) [m] of each contact's area.
    """

    shares: Array
    forces: Array
    likeness: Array
    contacts: Sequence[Contact]
    areas: Sequence[Array]


def support_forces(
    objects: Sequence[SceneObject], config: SupportConfig, rng: np.random.Generator
) -> SupportForces:
    """Find out how often objects support each other, in draws of the unknowns.

    A supports B in a draw if it carries more than a small share of B's weight, or if it presses on B, which
    is at rest with A and moves without it. The latter is asked if B moves faster without A in the estimated
    scene. A draw in which B does not rest, although the real one was seen at rest, counts little for B. Where
    B rests in no draw, or no draw closes the gap or overlap, an unseen object may carry it instead.

    Args:
        objects: The support surface and the objects.
        config: The unknowns, and when an object is at rest.
        rng: Source of the draws.
    """
    scene, count = Equilibrium(objects, config), len(objects)
    pressing, pressed = scene.pairs.T
    at_rest, moving = np.zeros((2, len(scene.pairs)))
    forces, total, alike = np.zeros((len(scene.pairs), 3)), np.zeros(count), np.zeros(count)
    needed = np.ones(len(scene.pairs), dtype=np.bool_)
    for number, draw in enumerate(scene.draws(rng)):
        balance = scene.solve(draw)
        rests = balance.motion <= config.at_rest
        trust = np.where(rests, 1.0, config.unexplained)
        carries = balance.pushes[:, 2] > config.force_share
        presses = (np.linalg.norm(balance.pushes, axis=1) > config.force_share) & ~carries & needed
        fell = np.zeros(len(scene.pairs), dtype=np.bool_)
        for group in scene.independent(np.unique(pressing[presses & ~scene.fixed[pressing]])):
            faster = scene.solve(draw, without=group).motion > balance.motion + config.at_rest
            fell |= presses & np.isin(pressing, group) & faster[pressed]
        if number == 0:
            needed = fell
        at_rest += (carries | fell) & rests[pressed]
        moving += (carries & ~rests[pressed]) * config.unexplained
        forces += balance.pushes * trust[pressed, None]
        total += trust
        alike += draw.likeness >= 0.5
    # Divided before they are weighted: rounding must not exceed the weight.
    resting, falling = at_rest / total[pressed], moving / total[pressed]
    visible = np.where(scene.explained, 1.0, 1.0 - config.unexplained)
    shares, means = np.zeros((count, count)), np.zeros((count, count, 3))
    shares[pressing, pressed] = (visible * resting + (1.0 - config.unexplained) * falling).clip(0.0, 1.0)
    means[pressing, pressed] = forces / total[pressed, None]
    return SupportForces(shares, means, alike / config.draws, scene.contacts, scene.areas)


def moved_without(
    objects: Sequence[SceneObject],
    index: int,
    beliefs: Array,
    config: SupportConfig,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Probability (D, N) that each object moves when one is removed, in each of D draws [1].

    Args:
        objects: The support surface and the objects.
        index: The one to remove.
        beliefs: Probability (N,) with which it supports each other one, NaN if nothing else is known: what
            the draws say less, an earlier view said; then the other one moves.
        config: The unknowns, and when an object is at rest.
        rng: Source of the draws.

    Returns:
        The probabilities, and how much a draw counts for each object (D, N) [1].
    """
    scene, moves, trusts = Equilibrium(objects, config), [], []
    own, held = np.flatnonzero(scene.pairs[:, 0] == index), np.zeros(len(objects))
    others, visible = scene.pairs[own, 1], np.full(len(objects), 1.0 - config.unexplained)
    visible[others[scene.explained[own]]] = 1.0
    for draw in scene.draws(rng):
        balance, after = scene.solve(draw), scene.solve(draw, without=[index]).motion
        rests = balance.motion <= config.at_rest
        trust, sure = np.where(rests, 1.0, config.unexplained), np.where(rests, 1.0, 1.0 - config.unexplained)
        fell = after > balance.motion + config.at_rest
        holds = fell.copy()
        holds[others] |= balance.pushes[own, 2] > config.force_share
        held += holds * sure * trust
        moves.append(fell * sure)
        trusts.append(trust)
    counts = np.array(trusts)
    unsaid = np.fmax(beliefs - held / counts.sum(axis=0) * visible, 0.0)
    probability: Array = 1.0 - (1.0 - np.array(moves)) * (1.0 - unsaid)
    probability[:, index] = 0.0
    return probability.clip(0.0, 1.0), counts


@dataclass(frozen=True, eq=False, slots=True)
class Draw:
    """One possible scene of N objects and K contacts.

    Attributes:
        shifts: Offset of each centre of mass from its estimate (N, 3) [m], world frame.
        likeness: Intersection over union of each shape with its estimate (N,) [1].
        gaps: Gap at each contact (K,) [m]; infinite if it cannot press.
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
        pushes: Force (P, 3) of the first on the second of each pair, in the world frame, in weights of the
            latter [1].
        pressed: Which contacts (K,) carry a force.
    """

    motion: Array
    pushes: Array
    pressed: NDArray[np.bool_]


def touching(objects: Sequence[SceneObject], margin: float) -> list[Contact]:
    """Find the contacts of a scene up to a gap [m]; those with the support surface have its normal.

    Where a third object fills the gap, there is none: the floor of a tray parts its content from the table.
    """
    shapes = [o.shape for o in objects]
    low, high = Primitives.of(shapes).bounds()
    contacts = [c for c in find_contacts(shapes, margin) if not _parted(c, shapes, low, high)]
    for k, contact in enumerate(contacts):
        for index, sign in ((contact.a, 1.0), (contact.b, -1.0)):
            if objects[index].role == "support_surface":
                axes_world = objects[index].shape.T_world_object[:3, :3]
                up_world = axes_world[:, np.argmax(np.abs(axes_world[2]))]
                contacts[k] = replace(contact, normal_world=sign * np.sign(up_world[2]) * up_world)
    return contacts


def _parted(contact: Contact, shapes: Sequence[Shape], low: Array, high: Array) -> bool:
    """Whether a third shape fills the gap.

    Only one whose level box, from corners low to high (N, 3) [m], holds all the contact's points can.
    """
    if contact.distance <= 0.0:
        return False
    points = contact.points_world
    around = (low <= points.min(axis=0)) & (points.max(axis=0) <= high)
    others = set(np.flatnonzero(around.all(axis=1)).tolist()) - {contact.a, contact.b}
    return any((shapes[k].signed_distance(points) < 0.0).all() for k in others)


class Equilibrium:
    """Rigid shapes that touch, or nearly do, under gravity.

    The forces are the solution of one convex program, Gauss's principle of least constraint: within the
    friction cones, with normal forces that only press, they hold all objects nearest to rest. MuJoCo solves
    it. An open contact presses only if an object closes its gap within the time of a fall of `max_drop`, so
    a gap is closed only where an object would fall or tip into it.

    Args:
        objects: The support surface, which does not move, and the objects; N in all. Something unseen holds
            the lowest of those that nothing carries, so that it does not move either.
        config: The unknowns, and how far an object may fall.

    Attributes:
        contacts: K contacts.
        areas: Corners (M, 3) [m] of each contact's area.
        pairs: Pairs (P, 2) of objects with contacts, in both orders.
        fixed: Which objects (N,) do not move.
        explained: For which pairs (P,) some draw may close the nearest gap or overlap.
    """

    def __init__(self, objects: Sequence[SceneObject], config: SupportConfig) -> None:
        self._objects, self._config = objects, config
        self._fall = max(config.max_drop, config.reach)
        shapes = [o.shape for o in objects]
        self.contacts = touching(objects, self._fall)
        self._pairs = np.array([(c.a, c.b) for c in self.contacts], dtype=np.intp).reshape(-1, 2)
        self._uppers = np.array(
            [c.b if c.normal_world[2] > 0.0 else c.a for c in self.contacts], dtype=np.intp
        )
        self.fixed = np.array([o.role == "support_surface" for o in objects], dtype=np.bool_)
        ends, count = self._pairs[~self.fixed[self._pairs].any(axis=1)].T, len(objects)
        graph = coo_array((np.ones(len(ends[0])), tuple(ends)), shape=(count, count))
        self._islands = connected_components(graph, directed=False)[1]
        self._volumes = np.array([s.volume for s in shapes])
        self._moments = np.array([s.moments for s in shapes]).reshape(-1, 3)
        self._centres = np.array([s.centre_of_mass for s in shapes]).reshape(-1, 3)
        self._reach = np.array([np.linalg.norm(s.extents) / 2.0 for s in shapes])
        self._axes = np.array([s.T_world_object[:3, :3] for s in shapes]).reshape(-1, 3, 3)
        self.areas = [contact_area(c, config) for c in self.contacts]
        self._sigma = np.array([deviations(o) for o in objects]).reshape(-1, 9)
        self._rows = gap_rows(objects, self.contacts, self._pairs)
        self._gaps = np.array([c.distance for c in self.contacts])
        scatter = np.einsum("kpv,kpv->k", self._rows**2, self._sigma[self._pairs] ** 2) + config.touch**2
        self._spread = np.sqrt(scatter)
        ways = np.concatenate([self._pairs, self._pairs[:, ::-1]])
        self.pairs, number = np.unique(ways, axis=0, return_inverse=True)
        self._numbers = number.reshape(2, -1)
        self.explained = np.zeros(len(self.pairs), dtype=np.bool_)
        for k in np.argsort(-self._gaps, kind="stable"):  # The smallest gap of a pair counts.
            self.explained[self._numbers[:, k]] = abs(self._gaps[k]) <= _SIGMAS * self._spread[k]
        self._points = np.concatenate([np.empty((0, 3)), *self.areas])
        self._contact = np.repeat(np.arange(len(self.areas)), [len(area) for area in self.areas])
        self._model = _engine(max(16, 1 << (len(objects) - 1).bit_length()), threading.get_ident())
        self._data = self._with_contacts()
        self._warm = np.zeros(self._model.nv)
        lowest = Primitives.of(shapes).bounds()[0][:, 2]
        while len(falling := self._falling()):
            self.fixed[falling[np.argmin(lowest[falling])]] = True
            self._data = self._with_contacts()

    def _falling(self) -> NDArray[np.intp]:
        """Objects (M,) that nothing carries in the estimated scene, by index."""
        balance = self.solve(next(self.draws(np.random.default_rng(0))))
        return np.flatnonzero(self._find_uncarried_mask(balance))

    def _find_uncarried_mask(self, balance: Balance) -> NDArray[np.bool_]:
        """Which objects (N,) may fall: nothing carries them."""
        upwards = np.bincount(self.pairs[:, 1], balance.pushes[:, 2], len(self._objects))
        return (upwards <= self._config.force_share) & ~self.fixed

    def draws(self, rng: np.random.Generator) -> Iterator[Draw]:
        """Draw scenes: first the estimated one, then others as likely.

        Shapes move, turn and grow by their fits' uncertainty. Each contact is closed with the probability
        that its gap implies; before that, no gap is as likely as any gap up to `reach`. Closed gaps correct
        all shapes, as in `reconcile`. Gaps into which objects fall or tip close too. Those are wider than the
        uncertainty explains, so hidden sides are further out, nobody knows which: where objects fall in the
        first draw, further ones take a random share off each gap.
        """
        config, count = self._config, len(self.contacts)
        sigma, found, rows = self._sigma, self._gaps, self._rows
        variance = sigma**2
        effects = np.array([effect(o.shape.ties) for o in self._objects]).reshape(-1, 9, 9)
        half = np.array([o.shape.extents / 2.0 for o in self._objects]).reshape(-1, 3)
        z, width = np.maximum(found, 0.0) / self._spread, config.reach / self._spread
        odds = width * np.exp(-(z**2) / 2.0) / np.sqrt(2.0 * np.pi)
        shut = odds / np.maximum(odds + ndtr(width - z) - ndtr(-z), 1e-300)
        loose = np.zeros(count, dtype=np.bool_)
        for number in range(config.draws):
            first = number == 0
            change = np.clip(rng.standard_normal(sigma.shape), -_SIGMAS, _SIGMAS) * sigma * (not first)
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
                np.where(touching, 0.0, np.maximum(gaps, 0.0)),
                np.max(frictions[self._pairs], axis=1, initial=0.0),
                densities,
            )
            hidden = np.where(loose & ~touching, draw.gaps * rng.random(count), draw.gaps)
            if first or loose.any():
                far, fallen = self._landings(draw, hidden)
            if first:
                loose = np.isin(self._uppers, self._uppers[fallen])
            yield replace(draw, gaps=np.where(far, np.inf, np.where(fallen, 0.0, draw.gaps)))

    def _landings(self, draw: Draw, hidden: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Contacts (K,) that are too far apart to press, and those that objects fall or tip onto.

        Objects tip as far as `reach`; those that nothing carries fall as far as `max_drop`, onto what the
        hidden gaps (K,) [m] let them meet first.
        """
        far = draw.gaps > self._config.reach
        loose = self._find_uncarried_mask(self.solve(replace(draw, gaps=np.where(far, np.inf, hidden))))
        far &= ~loose[self._pairs].any(axis=1)
        pressed = self.solve(replace(draw, gaps=np.where(far, np.inf, hidden))).pressed
        return far, pressed & (draw.gaps > self._config.at_rest * self._fall)

    def independent(self, indices: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
        """Divide objects (M,) into groups of which no two touch each other, even through others."""
        islands = self._islands[indices]
        turns = np.array([np.sum(islands[:k] == island) for k, island in enumerate(islands)], dtype=np.intp)
        for turn in range(turns.max(initial=-1) + 1):
            yield indices[turns == turn]

    def solve(self, draw: Draw, without: Sequence[int] | NDArray[np.intp] = ()) -> Balance:
        """Find the forces that hold a draw without some objects (M,), by index, and what still moves."""
        model, data, count = self._model, self._data, len(self._objects)
        self._set(draw)
        apart = np.isinf(draw.gaps)
        gone = (apart | np.isin(self._pairs, without).any(axis=1))[self._contact]
        data.qacc_warmstart[:] = self._warm
        if len(gone):
            data.contact.exclude[:] = gone
            data.contact.dist[:] = np.where(apart, 1.0, draw.gaps)[self._contact]
            data.contact.friction[:, :2] = draw.frictions[self._contact, None]
            # Open contacts have no friction; otherwise objects sliding along them would push them away.
            data.contact.dim[:] = np.where(draw.gaps > 0.0, 1, 3)[self._contact]
        for stage in (
            mujoco.mj_makeConstraint, mujoco.mj_projectConstraint, mujoco.mj_fwdVelocity,
            mujoco.mj_fwdActuation, mujoco.mj_fwdAcceleration, mujoco.mj_fwdConstraint,
        ):  # fmt: skip
            stage(model, data)
        if not len(without):
            self._warm = data.qacc.copy()
        acceleration = data.qacc.reshape(-1, 6)[:count]
        turning = np.linalg.norm(acceleration[:, 3:], axis=1) * self._reach
        motion = np.maximum(np.linalg.norm(acceleration[:, :3], axis=1), turning) / _GRAVITY
        motion[self.fixed] = 0.0
        pushes, pressed = np.zeros((len(self.pairs), 3)), np.zeros(len(self.contacts), dtype=np.bool_)
        if len(gone):
            active = np.flatnonzero(~gone & (data.contact.efc_address >= 0))
            frames = data.contact.frame.reshape(-1, 3, 3)[active]
            rows = data.contact.efc_address[active, None] + np.arange(3)
            forces = data.efc_force.take(rows, mode="clip") * (np.arange(3) < data.contact.dim[active, None])
            forces_world = np.einsum("ki,kij->kj", forces, frames)
            pressed[self._contact[active[forces[:, 0] > 0.0]]] = True
            forth, back = self._numbers[:, self._contact[active]]
            np.add.at(pushes, forth, forces_world)
            np.add.at(pushes, back, -forces_world)
        weights = (_GRAVITY * draw.densities * self._volumes)[self.pairs[:, 1], None]
        return Balance(motion, pushes / weights, pressed)

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
            data.contact.geom[:] = np.where(self.fixed[self._pairs], 0, self._pairs + 1)[self._contact]
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
