"""Scenes by name or file: MJCF from disk, designed and generated ones."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import Final, cast

import mujoco
import numpy as np

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError, did_you_mean
from caryatid.simulation import world
from caryatid.simulation.generation import SIZES, GeneratedKind, generate
from caryatid.simulation.layout import lay_out, unknown_keyframe
from caryatid.simulation.world import Body, SimulatedScene, box, cylinder, sphere

log = logging.getLogger(__name__)

DESIGNED: Final[Mapping[str, tuple[Body, ...]]] = {
    "tower": (
        box((0.14, 0.14, 0.08), at=(0.0, 0.0, 0.04)),
        cylinder(0.05, 0.09, at=(0.0, 0.005, 0.125)),
        box((0.09, 0.08, 0.06), at=(0.005, 0.0, 0.2), turn=(0.0, 0.0, 30.0)),
        cylinder(0.03, 0.07, at=(0.0, 0.0, 0.265)),
        sphere(0.035, at=(-0.12, 0.18, 0.035)),
    ),
    "bridge": (
        box((0.07, 0.08, 0.12), at=(0.0, -0.13, 0.06)),
        cylinder(0.04, 0.12, at=(0.0, 0.13, 0.06)),
        box((0.1, 0.36, 0.025), at=(0.0, 0.0, 0.1325)),
        box((0.08, 0.08, 0.08), at=(0.0, 0.02, 0.185), turn=(0.0, 0.0, 20.0)),
        sphere(0.035, at=(0.02, 0.0, 0.035)),
    ),
    "counterweight": (
        box((0.11, 0.1, 0.1), at=(0.0, 0.0, 0.05)),
        box((0.07, 0.38, 0.02), at=(0.0, -0.13, 0.11), density=500.0),
        cylinder(0.04, 0.08, at=(0.0, 0.012, 0.16), density=3000.0),
        box((0.06, 0.06, 0.05), at=(0.02, -0.26, 0.025)),
    ),
    "leaning_plank": (
        box((0.1, 0.14, 0.28), at=(0.05, 0.0, 0.14), density=1200.0, friction=0.1),
        box((0.02, 0.09, 0.24), at=(-0.039, 0.0, 0.1215), turn=(0.0, 14.0, 0.0), friction=0.1),
        cylinder(0.035, 0.1, at=(-0.03, 0.2, 0.05)),
        box((0.05, 0.05, 0.05), at=(-0.03, 0.2, 0.125)),
    ),
    "hidden_stack": (
        box((0.09, 0.3, 0.26), at=(-0.13, 0.0, 0.13)),
        box((0.12, 0.12, 0.06), at=(0.04, -0.02, 0.03)),
        box((0.09, 0.1, 0.05), at=(0.04, -0.02, 0.085)),
        cylinder(0.03, 0.08, at=(0.045, -0.02, 0.15)),
        sphere(0.04, at=(0.06, 0.13, 0.04)),
    ),
    "shelf": (
        cylinder(0.035, 0.13, at=(0.0, -0.16, 0.065)),
        cylinder(0.035, 0.13, at=(0.0, 0.16, 0.065)),
        box((0.16, 0.42, 0.02), at=(0.0, 0.0, 0.14)),
        box((0.07, 0.09, 0.06), at=(0.01, 0.0, 0.03)),
        sphere(0.03, at=(0.01, 0.0, 0.09)),
        box((0.09, 0.07, 0.1), at=(0.0, -0.08, 0.2)),
        cylinder(0.03, 0.06, at=(0.0, 0.1, 0.18)),
    ),
    "clutter": (
        box((0.17, 0.22, 0.1), at=(0.07, 0.02, 0.05)),
        box((0.1, 0.13, 0.06), at=(0.07, -0.01, 0.13)),
        cylinder(0.034, 0.12, at=(0.07, -0.02, 0.22)),
        box((0.07, 0.18, 0.2), at=(-0.11, 0.14, 0.1)),
        cylinder(0.04, 0.14, at=(-0.07, -0.19, 0.07)),
        box((0.07, 0.07, 0.14), at=(0.07, -0.19, 0.07)),
        box((0.22, 0.06, 0.03), at=(0.0, -0.19, 0.155)),
        sphere(0.04, at=(0.2, 0.23, 0.04)),
        box((0.08, 0.1, 0.05), at=(-0.11, 0.14, 0.225), turn=(0.0, 0.0, 15.0)),
    ),
}
"""Bodies of each designed scene, by name; heights are above the table top."""

DESCRIPTIONS: Final[Mapping[str, str]] = {
    "tower": "a stack of four and a ball",
    "bridge": "a plank on two pillars with a load in the middle: two supporters",
    "counterweight": "a plank that tips unless the weight on its short end stays: top-down support",
    "leaning_plank": "a smooth plank that stands only because it leans on a heavy block",
    "hidden_stack": "a stack of three and a ball, hidden behind a large box at first",
    "shelf": "a board on two cans above other objects: hidden from above, visible from the sides",
    "clutter": "the table in the paper's figures: stacks in front of each other, a bridge, a ball",
    "pile": "primitives dropped in a pile",
    "dense": "a heap between screens and walls",
    "packed": "objects that touch each other",
    "house": "household objects on and in each other: trays, bowls, mugs, plates, books, bottles",
    "blocks": "equal boxes in a row, a wall or a pyramid",
    "boards": "a board, plank or tray on two pillars, over other objects",
    "overhang": "boards over the edge of the table or of a block, held down by weights, and other objects",
    "storeys": "primitives on several levels: floor and low table, step, shelf, cart, bin, two tables",
}
"""Descriptions of the designed scenes and of the generated kinds."""

SCENE_FILE = "scene.xml"
"""Name of the MJCF file in a scene folder."""

TRUTH_FILE = "gt.json"
"""Name of the ground truth beside it."""

_GENERATED = re.compile(rf"({'|'.join(SIZES)})-(\d+)-(\d+)")


HEAVY = 10.0
"""Weight of a body that is not on a table as a rule [kg]."""


def load_scene(
    source: str | PathLike[str], config: PhysicsConfig | None = None, keyframe: str | None = None
) -> SimulatedScene:
    """Load a scene and let it come to rest.

    Built-in names come before files: a designed scene (`tower`, `bridge`, …), or KIND-SIZE-SEED for a scene
    from `generate`, such as `pile-8-3`. For a folder of such a name, write `./tower`.

    Args:
        source: A built-in name, an MJCF file, or a folder with a `scene.xml`.
        config: When a scene is at rest.
        keyframe: Name or number of a keyframe of an MJCF file to start from; None = `home` or the only one.

    Raises:
        InputError: No such file, scene or keyframe, broken XML, no objects, nothing carries them, or it is
            unstable.
    """
    text = fspath(source)
    if keyframe is not None and is_builtin(text):
        raise unknown_keyframe(text, keyframe, [])
    if text in DESIGNED:  # give the solids a second to find their contacts
        return world.scene_from_spec(world.build_spec(DESIGNED[text], text), text, text, config, least=1.0)
    if match := _GENERATED.fullmatch(text):
        return generate(cast(GeneratedKind, match[1]), int(match[2]), int(match[3]), config)
    path, listed = Path(text), "`caryatid scenes` lists the built-in ones"
    if not path.exists():
        remedy = did_you_mean(text, DESIGNED) + listed
        raise InputError(text, "no such file, folder or built-in scene", remedy)
    if path.is_dir():
        path = path / SCENE_FILE
        if not path.exists():
            remedy = f"give the folder of a scene, or of a recording (scene_camera.json, depth.txt); {listed}"
            raise InputError(text, f"a folder without {SCENE_FILE}", remedy)
    if path.suffix.lower() != ".xml" or not path.is_file():
        remedy = f"give an .xml file or a folder with a {SCENE_FILE}; {listed}"
        raise InputError(path, "not an MJCF file", remedy)
    try:
        with world.mujoco_warnings_ignored():
            spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise world.rejection(error, str(path)) from None
    name = path.resolve().parent.name if path.name == SCENE_FILE else path.stem
    try:
        robots = lay_out(spec, str(path), keyframe)
        scene = world.scene_from_spec(spec, name or path.stem, str(path), config)
    except UnicodeDecodeError:
        raise InputError(path, "has a name that is not UTF-8", "correct the XML") from None
    scene.geom_labels[np.isin(scene.model.geom_bodyid, robots)] = -1
    top, bodies = world.table_centre(scene)[2], scene.object_bodies
    started = scene.model.qpos0[world.pose_addresses(scene)][:, 2]
    below = [world.bounds(scene, label)[1][2] < top for label in bodies]
    fallen = [name for name, z, low in zip(bodies.values(), started, below, strict=True) if low and z > top]
    if fallen:
        log.warning("%s: %s fell off the %s before the first view", path, ", ".join(fallen), scene.table)
    for name in bodies.values():
        if (mass := float(scene.model.body(name).subtreemass[0])) > HEAVY:
            hint = "%s: %s (%.3g kg) counts as an object; if it is none, remove its joint"
            log.info(hint, path, name, mass)
    if not scene.at_rest:
        log.warning("%s: the scene still moves; its ground truth may change between views", path)
    return scene


def list_scenes() -> dict[str, str]:
    """Names for `load_scene`, and descriptions: the designed scenes, then the generated kinds."""
    generated = {f"{kind}-SIZE-SEED": f"{DESCRIPTIONS[kind]}; SIZE {a}–{b}" for kind, (a, b) in SIZES.items()}
    return {name: DESCRIPTIONS[name] for name in DESIGNED} | generated


def is_builtin(source: str | PathLike[str]) -> bool:
    """Whether this is the name of a built-in scene."""
    return fspath(source) in DESIGNED or bool(_GENERATED.fullmatch(fspath(source)))
