"""Layout of an MJCF scene: the keyframe it starts from, what is an object, and what is held still."""

from __future__ import annotations

import logging
from collections import Counter
from typing import Any, NamedTuple

import mujoco
import numpy as np

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.simulation.world import compile_spec, mujoco_warnings_ignored, quaternion

log = logging.getLogger(__name__)

HOME = "home"
"""Name of the keyframe that a scene with several starts from."""

NAMED = 5
"""Maximum number of bodies that a message names."""


class _Tree(NamedTuple):
    """Bodies that move together or in each other, and what they are.

    Attributes:
        links: Their numbers, the root first.
        joints: Number of their joints.
        is_driven: Whether actuators move them.
        is_solid: Whether anything can touch them.
        is_object: Whether they are a single solid body that moves freely.
    """

    links: list[int]
    joints: int
    is_driven: bool
    is_solid: bool
    is_object: bool


def lay_out(spec: Any, source: str, keyframe: str | None = None) -> list[int]:
    """Put a scene into its start: afterwards, its only joints are the free joints of its objects.

    An object is a body that can move in all six directions, with a free joint or with slides and hinges
    instead, that has no joints inside, touches something, and is not driven by an actuator. Everything else
    that has joints is held still, as it is at the start. A line says so, and which keyframe is used.

    Args:
        spec: `mujoco.MjSpec` of the scene; it is changed.
        source: Its file, for messages.
        keyframe: Name or number of the keyframe to start from. None = `home` or the only one.

    Returns:
        The numbers of the bodies of robots, which are driven by actuators.

    Raises:
        InputError: MuJoCo rejects the scene, a pose is not finite, there is no such keyframe, or gravity does
            not point down.
    """
    spec.compiler.fusestatic = False  # which would delete the bodies that carry objects
    model = compile_spec(spec, source)
    gravity = 0.0 if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY else 1.0
    gravity *= model.opt.gravity
    if not gravity[2] < -100.0 * np.hypot(gravity[0], gravity[1]):
        reason = f"its gravity is {' '.join(f'{g + 0.0:g}' for g in gravity)} m/s², not along -z"
        raise InputError(source, reason, "turn the scene so that z points up, or correct option gravity")
    data = mujoco.MjData(model)
    _compute(model, data, source)
    trees = _find_trees(model, data)
    held = [tree for tree in trees if not tree.is_object]
    key = _chosen_keyframe(model, source, keyframe)
    placed = [link for tree in held for link in tree.links]
    if key is not None:
        mujoco.mj_resetDataKeyframe(model, data, key)
        _compute(model, data, source)
        placed += np.flatnonzero(model.body_mocapid >= 0).tolist()
    bodies = {body.id: body for body in spec.bodies}  # their ids change with the spec
    for link in list(placed):
        _delete(bodies[link].joints, spec)
    for tree in trees:
        if tree.is_object:
            root = bodies[tree.links[0]]
            root.name = root.name or f"body {tree.links[0]}"
            if tree.joints > 1:
                how = "a free joint replaces its slides and hinges"
                log.info("%s: body '%s' is free: %s", source, root.name, how)
                _delete(root.joints, spec)
                root.add_freejoint()
            if tree.joints > 1 or key is not None:
                placed.append(tree.links[0])
    for number in placed:
        _place(bodies[number], number, model, data)
    _delete(spec.keys, spec)  # whose numbers no longer fit
    if len(spec.joints) < model.njnt:
        of_joints = (mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON)
        equalities = [each for each in spec.equalities if each.type in of_joints]
        for elements in (spec.actuators, spec.sensors, spec.tendons, spec.tuples, equalities):
            _delete(elements, spec)
    if held:
        log.info("%s: %s", source, _what_is_held(model, held))
    return [link for tree in held if tree.is_driven for link in tree.links]


def _compute(model: Any, data: Any, source: str) -> None:
    """Compute all that follows from the positions of a state; reject NaN."""
    with mujoco_warnings_ignored():
        mujoco.mj_fwdPosition(model, data)
    if not all(np.isfinite(found).all() for found in (data.xpos, data.xquat, data.cdof)):
        reason = "the pose of a body or joint contains NaN or infinity"
        raise InputError(source, reason, "give finite positions")


def _find_trees(model: Any, data: Any) -> list[_Tree]:
    """All that moves, in a state at which no two hinges of a body are parallel."""
    # Degrees of freedom that actuators move, directly, by tendons or at sites; adhesion moves nothing.
    driven = {
        int(data.moment_colind[data.moment_rowadr[k] + j])
        for k in np.flatnonzero(model.actuator_trntype != mujoco.mjtTrn.mjTRN_BODY)
        for j in range(data.moment_rownnz[k])
    }
    collides = model.geom_contype | model.geom_conaffinity
    trees = []
    for tree in range(model.ntree):
        dofs, links = (np.flatnonzero(of == tree) for of in (model.dof_treeid, model.body_treeid))
        joints, root = int(model.body_jntnum[links].sum()), links[0]
        is_driven, is_soft = not driven.isdisjoint(dofs), np.isin(model.flex_vertbodyid, links).any()
        is_solid = bool(is_soft or collides[np.isin(model.geom_bodyid, links)].any())
        is_alone = joints == model.body_jntnum[root] and model.body_parentid[root] == 0
        is_free = is_alone and len(dofs) == np.linalg.matrix_rank(data.cdof[dofs]) == 6
        is_object = bool(is_free and is_solid and not is_driven)
        trees.append(_Tree(links.tolist(), joints, is_driven, is_solid, is_object))
    return trees


def _chosen_keyframe(model: Any, source: str, wanted: str | None) -> int | None:
    """Number of the keyframe to start from, or None for the model's initial pose; say which one it is."""
    names = [model.key(k).name or str(k) for k in range(model.nkey)]
    if wanted is not None:
        numbers = {str(k): k for k in range(len(names))} | {name: k for k, name in enumerate(names)}
        if wanted not in numbers:
            raise unknown_keyframe(source, wanted, names)
        return numbers[wanted]
    if not names:
        return None
    if len(names) > 1 and HOME not in names:
        log.info("%s: starts from none of its keyframes %s; --keyframe chooses one", source, ", ".join(names))
        return None
    key = names.index(HOME) if HOME in names else 0
    log.info("%s: starts from its keyframe '%s'", source, names[key])
    return key


def unknown_keyframe(source: str, wanted: str, names: list[str]) -> InputError:
    """The error that a scene has no keyframe of this name or number."""
    remedy = f"its keyframes: {', '.join(names)}" if names else "it has none: omit --keyframe"
    return InputError(source, f"has no keyframe '{wanted}'", remedy)


def _place(body: Any, number: int, model: Any, data: Any) -> None:
    """Give a body of a spec the pose that the one of this number has in a state."""
    T_world_body, T_world_parent = (
        transforms.rigid(data.xmat[k].reshape(3, 3), data.xpos[k])
        for k in (number, model.body_parentid[number])
    )
    T_parent_body = transforms.invert(T_world_parent) @ T_world_body
    if body.frame is not None:
        body.set_frame(body.parent.add_frame())
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.pos, body.quat = T_parent_body[:3, 3], quaternion(T_parent_body[:3, :3])


def _what_is_held(model: Any, held: list[_Tree]) -> str:
    """The sentence that names what is held still, and why it is no object."""
    trees_on = Counter(int(model.body_rootid[each.links[0]]) for each in held)
    texts = []
    for each in held[:NAMED]:
        top = int(model.body_rootid[each.links[0]])
        number = top if trees_on[top] == 1 else each.links[0]
        name = model.body(number).name or model.body(each.links[0]).name or f"body {number}"
        count = f"{each.joints} joint{'s' if each.joints > 1 else ''}"
        if each.is_driven or each.is_solid:
            texts.append(f"{'robot' if each.is_driven else 'body'} '{name}' ({count})")
        else:
            texts.append(f"body '{name}' (touches nothing)")
    if len(held) > NAMED:
        texts.append(f"{len(held) - NAMED} more")
    names = " and ".join(filter(None, (", ".join(texts[:-1]), texts[-1])))
    is_one = len(held) == 1
    text = f"{names} {'is held still and is no object' if is_one else 'are held still and are no objects'}"
    if any(each.is_solid and not each.is_driven for each in held):
        needs = "a free joint, or three slides and three hinges, no other joints, and no body around it"
        return f"{text}: an object has {needs}"
    return text


def _delete(elements: Any, spec: Any) -> None:
    for element in list(elements):
        spec.delete(element)
