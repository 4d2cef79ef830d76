"""Who supports whom by physics: contact forces, and what moves when an object is taken away."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict, cast, get_args

import mujoco
import numpy as np
from numpy.typing import NDArray

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.graph import Kind
from caryatid.io.json_files import json_text, read_json
from caryatid.simulation.world import SimulatedScene, displacement, state_of

ASIDE = 100.0
"""How far up an object is lifted to take it away [m]; it falls 5 m in the second the others are watched."""

FORCE_WINDOW = 0.2
"""Contact forces are averaged over this long [s]; soft contacts creep, longer ones drift."""
LEAN_ANGLE = 30.0
"""A force nearer to the horizontal than this leans, a steeper one that points down presses [deg]."""
DISTURBED = 0.02
"""`removal` lists what is displaced by more than this [m]: it slid or fell, and did not merely settle."""
DISTURBED_TURN = 15.0
"""`removal` lists what is turned by more than this [deg]."""

_REMEDY = 'write {"vertices": […], "edges": [{"supporter", "supported", "kind"}, …]}'


class TrueEdge(TypedDict):
    """An edge of gt.json.

    Attributes:
        supporter: Name of the body that holds.
        supported: Name of the body that is held.
        kind: How.
    """

    supporter: str
    supported: str
    kind: Kind


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """What gt.json holds.

    Attributes:
        vertices: Body names, the table first.
        edges: Supports, sorted by the order of the vertices: supporter first, then supported.
        removal: Per object, which others are disturbed when it is taken away; empty where nobody tried.
    """

    vertices: tuple[str, ...]
    edges: tuple[TrueEdge, ...]
    removal: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def pairs(self) -> set[tuple[str, str]]:
        """The directed pairs (supporter, supported)."""
        return {(edge["supporter"], edge["supported"]) for edge in self.edges}


def ground_truth(scene: SimulatedScene, config: PhysicsConfig | None = None) -> GroundTruth:
    """Ask physics what holds up what.

    A supports B `bottom-up` when the mean contact force of A on B has an upward part above 3 % of B's weight.
    Each object A is then taken away for a second: a B in contact with A that moves by more than 1 cm or 8°
    and is not held by A from below is supported by it all the same: `top-down` where A presses on B, `lean`
    where the force between them is mostly horizontal.

    Args:
        scene: A settled scene; its state is not changed.
        config: The thresholds.
    """
    config = config or PhysicsConfig()
    names = {0: scene.table, **scene.object_bodies}
    forces = mean_contact_forces(scene, config)
    kinds: dict[tuple[int, int], Kind] = {}
    for (a, b), force in forces.items():
        if b != 0 and force[2] > config.force_share * _weight(scene, b):
            kinds[a, b] = "bottom-up"
    removals = {a: displaced_without(scene, a, config) for a in scene.object_bodies}
    presses = np.sin(np.deg2rad(LEAN_ANGLE))
    for (a, b), force in forces.items():
        if a != 0 and b != 0 and (a, b) not in kinds and _beyond(removals[a][b], config.moved, config.turned):
            kinds[a, b] = "top-down" if -force[2] > presses * np.linalg.norm(force) else "lean"
    removal = {
        a: [b for b, by in moves.items() if _beyond(by, DISTURBED, DISTURBED_TURN)]
        for a, moves in removals.items()
    }
    return GroundTruth(
        tuple(names.values()),
        tuple(TrueEdge(supporter=names[a], supported=names[b], kind=kinds[a, b]) for a, b in sorted(kinds)),
        {names[a]: tuple(names[b] for b in moved) for a, moved in removal.items()},
    )


def mean_contact_forces(scene: SimulatedScene, config: PhysicsConfig) -> dict[tuple[int, int], Array]:
    """Mean force of A on B over the window, for every pair of bodies that touch.

    Args:
        scene: The scene.
        config: Length of the window.

    Returns:
        (label of A, label of B) to the force (3,) [N] in the world frame, for both directions of a pair.
        Label 0 is the table; contacts with anything else are left out.
    """
    labels = _labels_with_table(scene)
    data = state_of(scene)
    steps = max(1, round(FORCE_WINDOW / scene.model.opt.timestep))
    sums: dict[tuple[int, int], Array] = {}
    for _ in range(steps):
        mujoco.mj_step(scene.model, data)
        for (a, b), force in _contact_forces(scene.model, data, labels):
            sums[a, b] = sums.get((a, b), np.zeros(3)) + force
            sums[b, a] = sums.get((b, a), np.zeros(3)) - force
    return {pair: total / steps for pair, total in sums.items()}


def displaced_without(
    scene: SimulatedScene, label: int, config: PhysicsConfig
) -> dict[int, tuple[float, float]]:
    """Take one object away and measure how far the others have moved when the time is over.

    Args:
        scene: The scene; its state is not changed.
        label: The object to take away.
        config: How long to watch.

    Returns:
        Distance [m] and angle [rad] of each other object, by label.
    """
    data = state_of(scene)
    take_away(scene, data, label)
    others = [other for other in scene.object_bodies if other != label]
    bodies = [scene.body_id(other) for other in others]
    positions, rotations = data.xpos[bodies].copy(), data.xmat[bodies].copy()
    mujoco.mj_step(scene.model, data, nstep=max(1, round(config.removal_time / scene.model.opt.timestep)))
    mujoco.mj_kinematics(scene.model, data)
    distance, angle = displacement(positions, rotations, data.xpos[bodies], data.xmat[bodies])
    return dict(zip(others, zip(distance.tolist(), angle.tolist(), strict=True), strict=True))


def take_away(scene: SimulatedScene, data: Any, label: int) -> None:
    """Lift an object of a simulation's state far above everything else, in place.

    Args:
        scene: Whose object it is.
        data: State of the simulation, `mujoco.MjData`; changed.
        label: Of the object.
    """
    joint = int(scene.model.body_jntadr[scene.body_id(label)])
    address = int(scene.model.jnt_qposadr[joint])
    data.qpos[address + 2] += ASIDE
    velocity = int(scene.model.jnt_dofadr[joint])
    data.qvel[velocity : velocity + 6] = 0.0
    mujoco.mj_forward(scene.model, data)


def read_truth(path: Path) -> GroundTruth:
    """Read a gt.json.

    Raises:
        InputError: The file is missing, is no JSON, or its edges do not fit its vertices.
    """
    document = read_json(path, _REMEDY)
    vertices = document.get("vertices")
    if not isinstance(vertices, list) or not vertices or not all(isinstance(v, str) for v in vertices):
        raise InputError(path, "'vertices' is no list of body names", _REMEDY)
    if len(set(vertices)) != len(vertices):
        raise InputError(path, "'vertices' names a body twice", "name each body once")
    entries = document.get("edges")
    if not isinstance(entries, list):
        raise InputError(path, "'edges' is no list", _REMEDY)
    edges = tuple(_edge(entry, index, set(vertices), path) for index, entry in enumerate(entries))
    removal = document.get("removal", {})
    if not isinstance(removal, dict) or not all(
        isinstance(moved, list) and all(name in vertices for name in moved) for moved in removal.values()
    ):
        raise InputError(
            path, "'removal' does not map objects to lists of vertices", "correct it or leave it out"
        )
    return GroundTruth(tuple(vertices), edges, {name: tuple(moved) for name, moved in removal.items()})


def write_truth(truth: GroundTruth, path: Path) -> None:
    """Write a gt.json.

    Args:
        truth: What is true.
        path: The file.

    Raises:
        InputError: The file cannot be written.
    """
    document: dict[str, Any] = {"vertices": truth.vertices, "edges": truth.edges}
    if truth.removal:
        document["removal"] = truth.removal
    try:
        path.write_text(json_text(document), encoding="utf-8")
    except OSError as error:
        raise InputError(path, f"cannot be written ({error.strerror})", "choose another place") from None


def _edge(entry: object, index: int, vertices: set[str], path: Path) -> TrueEdge:
    where = f"edge {index}"
    if not isinstance(entry, dict):
        raise InputError(path, f"{where} is no object", _REMEDY)
    supporter, supported, kind = (
        entry.get("supporter"),
        entry.get("supported"),
        entry.get("kind", "bottom-up"),
    )
    for role, name in (("supporter", supporter), ("supported", supported)):
        if not isinstance(name, str) or name not in vertices:
            raise InputError(path, f"{where}: {role} {name!r} is no vertex", "name one of the vertices")
    if kind not in get_args(Kind):
        raise InputError(path, f"{where}: kind {kind!r} is unknown", f"choose {', '.join(get_args(Kind))}")
    return TrueEdge(supporter=cast(str, supporter), supported=cast(str, supported), kind=kind)


def _labels_with_table(scene: SimulatedScene) -> NDArray[np.int32]:
    """Label of each geom (ngeom,), 0 for the table's and -1 for all that is neither table nor object."""
    labels = np.where(scene.geom_labels > 0, scene.geom_labels, np.int32(-1))
    labels[scene.geoms(0)] = 0
    return labels


def _contact_forces(model: Any, data: Any, labels: NDArray[np.int32]) -> list[tuple[tuple[int, int], Array]]:
    """Force (3,) [N] of the first on the second labelled body at each contact of this moment."""
    forces = []
    wrench = np.zeros(6)
    for index, (first, second) in enumerate(data.contact.geom):
        a, b = int(labels[first]), int(labels[second])
        if a >= 0 and b >= 0 and a != b:
            mujoco.mj_contactForce(model, data, index, wrench)
            forces.append(((a, b), wrench[:3] @ data.contact.frame[index].reshape(3, 3)))
    return forces


def _beyond(by: tuple[float, float], distance: float, angle: float) -> bool:
    """Whether a displacement ([m], [rad]) is more than a distance [m] or an angle [deg]."""
    return by[0] > distance or by[1] > np.deg2rad(angle)


def _weight(scene: SimulatedScene, label: int) -> float:
    mass = scene.model.body_subtreemass[scene.body_id(label)]
    return float(mass * np.linalg.norm(scene.model.opt.gravity))
