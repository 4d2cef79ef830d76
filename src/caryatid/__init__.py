"""Active vision for physically plausible support relations in cluttered table-top scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime import hooks, imported_late

if TYPE_CHECKING:
    from caryatid.config import Config, Gripper
    from caryatid.errors import CaryatidError, InputError
    from caryatid.exploration import Explorer, Step, explore, next_best_view
    from caryatid.fitting.primitives import fit
    from caryatid.geometry.shapes import Box, Cylinder, Sphere
    from caryatid.graph import SceneObject, Support, SupportGraph
    from caryatid.io.bop import read_recording
    from caryatid.planning.decision import Planner
    from caryatid.robots import Robot
    from caryatid.scene import Scene
    from caryatid.sensing.views import Camera, Cloud, View
    from caryatid.sessions.session import Session
    from caryatid.sources import simulate

__version__ = "0.2.0"

hooks |= {
    "scene": "caryatid.paper:choose_scene",
    "notebook cell": "caryatid.viz.notebook:draw_cell",
    "next view": "caryatid.exploration:next_best_view",
    "order": "caryatid.manipulation.order:plan_order",
    "viewer": "caryatid.viewer:show",
}

__all__ = [
    "Box", "Camera", "CaryatidError", "Cloud", "Config", "Cylinder", "Explorer", "Gripper", "InputError",
    "Planner", "Robot", "Scene", "SceneObject", "Session", "Sphere", "Step", "Support", "SupportGraph",
    "View", "explore", "fit", "next_best_view", "read_recording", "simulate",
]  # fmt: skip

if not TYPE_CHECKING:
    __getattr__ = imported_late(
        __name__,
        {
            "config": ["Config", "Gripper"],
            "errors": ["CaryatidError", "InputError"],
            "exploration": ["Explorer", "Step", "explore", "next_best_view"],
            "graph": ["SceneObject", "Support", "SupportGraph"],
            "planning.decision": ["Planner"],
            "fitting.primitives": ["fit"],
            "robots": ["Robot"],
            "io.bop": ["read_recording"],
            "scene": ["Scene"],
            "sessions.session": ["Session"],
            "sources": ["simulate"],
            "geometry.shapes": ["Box", "Cylinder", "Sphere"],
            "sensing.views": ["Camera", "Cloud", "View"],
        },
    )


def __dir__() -> list[str]:
    return sorted(["__version__", *__all__])
