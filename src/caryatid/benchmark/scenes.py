"""Which scenes a benchmark can be run on: built-in ones by name, folders of MJCF scenes with their truth."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from caryatid.errors import InputError
from caryatid.evaluation.scores import TrueScene
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.simulation.scenes import SCENE_FILE, TRUTH_FILE, is_builtin, list_scenes, load_scene
from caryatid.simulation.truth import ground_truth, read_truth
from caryatid.simulation.world import SimulatedScene

_KIND = re.compile(r"[A-Za-z_]+(?=[-_]?\d)")


def find_scenes(sources: Iterable[str]) -> list[str]:
    """Resolve what a user names as scenes.

    Args:
        sources: Names of built-in scenes, scene folders, or folders of scene folders.

    Returns:
        Names and folders, in order, each once.

    Raises:
        InputError: One is none of them, or a folder holds no scene with its truth.
    """
    found: list[str] = []
    for source in sources:
        found += [source] if is_builtin(source) else _in_folder(Path(source))
    return list(dict.fromkeys(found))


def content_of(scene: str) -> str:
    """Digest of a scene folder's files; empty for a built-in scene, which its name determines.

    Args:
        scene: Name or folder.
    """
    if is_builtin(scene):
        return ""
    digest = hashlib.sha256()
    folder = Path(scene)
    for file in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(file.relative_to(folder).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def short_name(scene: str) -> str:
    """Name of a scene: that of its folder, or the built-in one."""
    return scene if is_builtin(scene) else Path(scene).resolve().name


def family(scene: str) -> str:
    """Kind of a scene: the letters before the first number of its name, `designed` where there is none."""
    matched = _KIND.match(short_name(scene))
    return matched[0].rstrip("_-") if matched else "designed"


@lru_cache(maxsize=8)
def opened(scene: str, content: str = "") -> tuple[SimulatedScene, TrueScene]:
    """Load a scene and its truth; kept, as the episodes of a scene are run one after the other.

    Args:
        scene: Name or folder.
        content: Digest its files must have; empty where it does not matter.

    Raises:
        InputError: It cannot be loaded, or its files are not those the run was planned with.
    """
    if content and Path(scene).is_dir() and content_of(scene) != content:
        raise InputError(scene, "its files are not those this run was planned with", "start again")
    simulated = load_scene(scene)
    file = Path(scene) / TRUTH_FILE
    truth = ground_truth(simulated) if is_builtin(scene) else read_truth(file)
    return simulated, true_scene_from_simulation(simulated, truth)


def _in_folder(folder: Path) -> list[str]:
    if not folder.is_dir():
        raise InputError(
            folder,
            "is neither a built-in scene nor a folder",
            f"give a folder of scenes, or of {', '.join(list_scenes())}",
        )
    folders = (
        [folder]
        if (folder / SCENE_FILE).is_file()
        else sorted(p.parent for p in folder.glob(f"*/{SCENE_FILE}"))
    )
    if not folders:
        raise InputError(
            folder, f"holds no scene: no {SCENE_FILE}", "give a scene folder or a folder of them"
        )
    for scene in folders:
        if not (scene / TRUTH_FILE).is_file():
            raise InputError(scene, f"has no {TRUTH_FILE}", "write one: the benchmark compares with a truth")
    return [str(scene) for scene in folders]
