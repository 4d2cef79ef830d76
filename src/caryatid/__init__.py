"""Active vision for physically plausible support relations in cluttered table-top scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.late import imported_late

if TYPE_CHECKING:
    from caryatid.config import Config
    from caryatid.errors import CaryatidError, InputError
    from caryatid.exploration import Step, explore, next_best_view
    from caryatid.graph import SceneObject, Support, SupportGraph
    from caryatid.planners import Planner
    from caryatid.primitives import fit
    from caryatid.robot import Robot
    from caryatid.scene import Scene
    from caryatid.sessions.session import Session
    from caryatid.shapes import Box, Cylinder, Sphere
    from caryatid.views import Camera, Cloud, View

__version__ = "0.1.0"

__all__ = [
    "Box",
    "Camera",
    "CaryatidError",
    "Cloud",
    "Config",
    "Cylinder",
    "InputError",
    "Planner",
    "Robot",
    "Scene",
    "SceneObject",
    "Session",
    "Sphere",
    "Step",
    "Support",
    "SupportGraph",
    "View",
    "explore",
    "fit",
    "next_best_view",
]

if not TYPE_CHECKING:
    __getattr__ = imported_late(
        __name__,
        {
            "config": ["Config"],
            "errors": ["CaryatidError", "InputError"],
            "exploration": ["Step", "explore", "next_best_view"],
            "graph": ["SceneObject", "Support", "SupportGraph"],
            "planners": ["Planner"],
            "primitives": ["fit"],
            "robot": ["Robot"],
            "scene": ["Scene"],
            "sessions.session": ["Session"],
            "shapes": ["Box", "Cylinder", "Sphere"],
            "views": ["Camera", "Cloud", "View"],
        },
    )


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
