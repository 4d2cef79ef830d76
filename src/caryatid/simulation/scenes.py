"""Scenes by name or file: MJCF from disk, and what is built in."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import mujoco

from caryatid.config import PhysicsConfig
from caryatid.errors import InputError
from caryatid.simulation.world import SimulatedScene, one_line, scene_from_spec


def load_scene(source: str | PathLike[str], config: PhysicsConfig | None = None) -> SimulatedScene:
    """Load and settle a scene.

    Args:
        source: An MJCF file, or a folder with a `scene.xml`.
        config: When a scene is at rest.

    Raises:
        InputError: No such file or scene, broken XML, no static body `table`, no objects.
    """
    path = Path(source)
    if path.is_dir():
        path = path / "scene.xml"
    if not path.is_file():
        raise InputError(source, "no such scene file", "give an MJCF file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise InputError(path, f"is no MJCF: {one_line(error)}", "mend the XML") from None
    name = path.parent.name if path.stem == "scene" and path.parent.name else path.stem
    return scene_from_spec(spec, name, str(path), config)


__all__ = ["SimulatedScene", "load_scene"]
