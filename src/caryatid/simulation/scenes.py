"""Scenes by name or file: MJCF from disk and what is built in; and scenes written to disk."""

from __future__ import annotations

import re
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import mujoco

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.simulation.designed import DESIGNED, designed_scene
from caryatid.simulation.generate import DENSE_SIZES, PILE_SIZES, generate_dense, generate_pile
from caryatid.simulation.mjcf import quaternion
from caryatid.simulation.packed import PACKED_SIZES, generate_packed
from caryatid.simulation.truth import ground_truth, write_truth
from caryatid.simulation.world import (
    SimulatedScene,
    body_pose,
    mujoco_warnings_ignored,
    one_line,
    scene_from_spec,
)

SCENE_FILE = "scene.xml"
"""Name of the MJCF file in a scene folder."""

TRUTH_FILE = "gt.json"
"""Name of the ground truth beside it."""

_GENERATED = re.compile(r"(pile|dense|packed)-(\d+)-(\d+)")


def load_scene(source: str | PathLike[str], config: PhysicsConfig | None = None) -> SimulatedScene:
    """Load a scene and let it come to rest.

    Built-in names come before files: a designed scene (`tower`, `bridge`, …), or `pile-SIZE-SEED`,
    `dense-SIZE-SEED` and `packed-SIZE-SEED` for a generated one, say `pile-8-3`. A folder of such a name is
    reached as `./tower`.

    Args:
        source: A built-in name, an MJCF file, or a folder with a `scene.xml`.
        config: When a scene is at rest.

    Raises:
        InputError: No such file or scene, broken XML, no static body `table`, no objects, or it is unstable.
    """
    text = fspath(source)
    if text in DESIGNED:
        return designed_scene(text, config)
    if match := _GENERATED.fullmatch(text):
        generate = {"pile": generate_pile, "dense": generate_dense, "packed": generate_packed}[match[1]]
        return generate(int(match[2]), int(match[3]), physics=config)
    return _load_file(text, config)


def list_scenes() -> list[str]:
    """Names `load_scene` knows: the designed scenes, then the generators with their range of sizes."""
    return [
        *DESIGNED,
        f"pile-SIZE-SEED (SIZE {PILE_SIZES[0]}…{PILE_SIZES[1]})",
        f"dense-SIZE-SEED (SIZE {DENSE_SIZES[0]}…{DENSE_SIZES[1]})",
        f"packed-SIZE-SEED (SIZE {PACKED_SIZES[0]}…{PACKED_SIZES[1]})",
    ]


def is_builtin(source: str | PathLike[str]) -> bool:
    """Whether `load_scene` takes this for the name of a built-in scene."""
    return fspath(source) in DESIGNED or _GENERATED.fullmatch(fspath(source)) is not None


def write_scene(scene: SimulatedScene, folder: str | PathLike[str]) -> Path:
    """Write a scene as it lies, with its ground truth: `scene.xml`, `gt.json` and meshes in `assets/`.

    Args:
        scene: The scene.
        folder: Where to; made if missing.

    Returns:
        The path of `scene.xml`.

    Raises:
        InputError: The folder cannot be written.
    """
    target = Path(folder)
    spec = scene.spec.copy()
    for label, name in scene.object_bodies.items():
        T_world_body = body_pose(scene, label)
        body = spec.body(name)
        body.pos, body.quat = T_world_body[:3, 3], quaternion(T_world_body[:3, :3])
    try:
        target.mkdir(parents=True, exist_ok=True)
        _collect_assets(spec, target)
        spec.compile()
        (target / SCENE_FILE).write_text(spec.to_xml(), encoding="utf-8")
    except OSError as error:
        raise InputError(target, f"cannot be written ({error.strerror})", "choose another folder") from None
    write_truth(ground_truth(scene), target / TRUTH_FILE)
    return target / SCENE_FILE


def _load_file(source: str, config: PhysicsConfig | None) -> SimulatedScene:
    path = Path(source)
    if path.is_dir():
        path = path / SCENE_FILE
    if not path.exists():
        built_in = ", ".join(list_scenes())
        raise InputError(
            path, "no such scene", f"give an MJCF file or one of the built-in scenes: {built_in}"
        )
    if not path.is_file():
        raise InputError(path, "is no file", "give an MJCF file")
    try:
        with mujoco_warnings_ignored():
            spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise InputError(path, f"is no MJCF ({one_line(error)})", "mend the XML") from None
    name = path.resolve().parent.name if path.name == SCENE_FILE else path.stem
    return scene_from_spec(spec, name or path.stem, str(path), config)


def _collect_assets(spec: Any, target: Path) -> None:
    """Copy the files a spec names into `target`/assets and name those."""
    origin = Path(spec.modelfiledir)
    files = [(asset, spec.compiler.meshdir) for asset in spec.meshes]
    files += [(asset, spec.compiler.texturedir) for asset in spec.textures]
    files += [(asset, "") for asset in spec.hfields]
    assets: dict[str, bytes] = {}
    for asset, directory in files:
        if asset.file:
            content = (origin / (directory or "") / asset.file).read_bytes()
            asset.file = f"assets/{Path(asset.file).name}"
            assets[asset.file] = content
    for name, content in assets.items():
        (target / name).parent.mkdir(exist_ok=True)
        (target / name).write_bytes(content)
    spec.compiler.meshdir = spec.compiler.texturedir = ""
    spec.modelfiledir = str(target)


__all__ = [
    "SCENE_FILE",
    "TRUTH_FILE",
    "SimulatedScene",
    "is_builtin",
    "list_scenes",
    "load_scene",
    "write_scene",
]
