"""The true support graph from physics: contact forces, and what moves when an object is removed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.graph import Kind
from caryatid.io.json_files import json_text, parse_json, read_json
from caryatid.io.staging import write_file
from caryatid.runtime.parallel import on_threads
from caryatid.simulation.world import (
    SimulatedScene,
    held_from_below,
    mean_contact_forces,
    pose_addresses,
    poses_of,
    state_of,
    strayed,
)

_REMEDY = 'write in gt.json {"vertices": […], "edges": [{"supporter", "supported", "kind"}, …]}'


@dataclass(frozen=True, slots=True)
class TrueEdge:
    """An edge of gt.json.

    Attributes:
        supporter: Name of the supporting body.
        supported: Name of the supported body.
        kind: Kind of the support.
    """

    supporter: str
    supported: str
    kind: Kind = "bottom-up"


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Content of gt.json.

    Attributes:
        vertices: Names of the support surfaces, the main one first, and then of the objects.
        edges: Supports, sorted by supporter and then supported, in the order of the vertices.
        surfaces: Height, x and y of the middle, and half sizes along x and y of the top of support surfaces
            by name [m]; those that it lacks are as in the scene.
    """

    vertices: tuple[str, ...]
    edges: tuple[TrueEdge, ...]
    surfaces: Mapping[str, tuple[float, float, float, float, float]] = field(default_factory=dict)

    @property
    def pairs(self) -> set[tuple[str, str]]:
        """The directed pairs (supporter, supported)."""
        return {(edge.supporter, edge.supported) for edge in self.edges}


def ground_truth(scene: SimulatedScene, config: PhysicsConfig | None = None) -> GroundTruth:
    """Derive the support graph from the physics of a settled scene, whose state does not change.

    The vertices are the main surface, everything else static that carries an object, and the objects. A
    supports B `bottom-up` if the upward part of the mean contact force of A on B exceeds 3 % of B's weight.
    Each object A is then removed for a second. A also supports an object B in contact with it that moves by
    more than 1 cm or 8° without it: `top-down` if A presses on B, `lean` if the force between them is mostly
    horizontal.
    """
    config = config or PhysicsConfig()
    forces = mean_contact_forces(scene)
    held = held_from_below(scene, forces, config.force_share)
    carrying = {0} | {a for a, _ in held}
    surfaces = {-k: name for k, name in enumerate(scene.surfaces) if -k in carrying}
    names = {**surfaces, **scene.object_bodies}
    kinds: dict[tuple[int, int], Kind] = dict.fromkeys(held, "bottom-up")
    others = [(a, b) for a, b in forces if a > 0 < b and (a, b) not in held]
    labels = sorted({a for a, _ in others})
    moved = on_threads(lambda k: displaced_without(scene, labels[k], config), len(labels))
    falling = dict(zip(labels, moved, strict=True))
    for a, b in others:
        if b in falling[a]:
            # A force within 30° of the horizontal leans, a steeper one that points down presses.
            force = forces[a, b]
            steep = -force[2] > np.sin(np.deg2rad(30.0)) * np.linalg.norm(force)
            kinds[a, b] = "top-down" if steep else "lean"
    rank = {label: place for place, label in enumerate(names)}
    order = sorted(kinds, key=lambda pair: (rank[pair[0]], rank[pair[1]]))
    edges = [TrueEdge(names[a], names[b], kinds[a, b]) for a, b in order]
    return GroundTruth(tuple(names.values()), tuple(edges))


def displaced_without(scene: SimulatedScene, label: int, config: PhysicsConfig) -> set[int]:
    """Labels of the objects that have moved beyond the limits some time after a removal."""
    data, labels = state_of(scene), list(scene.object_bodies)
    places, before = pose_addresses(scene), poses_of(scene)
    # 100 m up, it falls 5 m in the second in which the others are observed.
    data.qpos[places[labels.index(label), 2]] += 100.0
    mujoco.mj_forward(scene.model, data)
    mujoco.mj_step(scene.model, data, nstep=max(1, round(config.removal_time / scene.model.opt.timestep)))
    moved = strayed(before, data.qpos[places], config.moved, config.turned)
    return {other for other, far in zip(labels, moved, strict=True) if far and other != label}


def read_truth(path: Path) -> GroundTruth:
    """Read a gt.json.

    Raises:
        InputError: The file is missing, is not JSON, or its edges or surfaces do not fit its vertices.
    """
    if path.parent.is_dir() and not path.exists():
        raise InputError(path.parent, f"has no {path.name}, the ground truth to compare with", _REMEDY)
    truth = parse_json(GroundTruth, read_json(path, _REMEDY), path, _REMEDY)
    if not truth.vertices:
        raise InputError(path, "'vertices' is empty", _REMEDY)
    if len(set(truth.vertices)) != len(truth.vertices):
        raise InputError(path, "'vertices' names a body twice", "name each body once")
    ends = [name for edge in truth.edges for name in (edge.supporter, edge.supported)]
    for name in [*ends, *truth.surfaces]:
        if name not in truth.vertices:
            raise InputError(path, f"names {name!r}, which is not a vertex", "name one of the vertices")
    return truth


def write_truth(truth: GroundTruth, path: Path) -> None:
    """Write a gt.json.

    Raises:
        InputError: The file cannot be written.
    """
    surfaces = {"surfaces": truth.surfaces} if truth.surfaces else {}
    write_file(path, json_text({"vertices": truth.vertices, "edges": truth.edges} | surfaces).encode())
