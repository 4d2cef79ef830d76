"""Planners choose the next best view; `make_planner` finds one by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING

from caryatid.errors import InputError
from caryatid.planning.decision import Decision, Planner, PlanningState
from caryatid.runtime.late import imported_late

if TYPE_CHECKING:
    from caryatid.planning.planners.attention import AttentionPlanner
    from caryatid.planning.planners.farthest import FarthestPlanner
    from caryatid.planning.planners.paper import PaperPlanner
    from caryatid.planning.planners.random import RandomPlanner
    from caryatid.planning.planners.ring import RingPlanner
    from caryatid.planning.planners.support import SupportPlanner
    from caryatid.planning.planners.volumetric import VolumetricPlanner

VOLUMETRIC = (
    "occlusion-aware",
    "unobserved-voxel",
    "rear-side-voxel",
    "rear-side-entropy",
    "proximity-count",
)
"""The planners that are a `VolumetricPlanner` of the formulation of that name."""


_imported = imported_late(
    __name__,
    {
        "attention": ["AttentionPlanner"],
        "farthest": ["FarthestPlanner"],
        "paper": ["PaperPlanner"],
        "random": ["RandomPlanner"],
        "ring": ["RingPlanner"],
        "support": ["SupportPlanner"],
        "volumetric": ["VolumetricPlanner"],
    },
)


def _make(name: str, *arguments: str) -> Planner:
    """Import a planner of ours and make it."""
    planner: Planner = _imported(name)(*arguments)
    return planner


BUILT_IN: dict[str, Callable[[], Planner]] = {
    "support": partial(_make, "SupportPlanner"),
    "attention": partial(_make, "AttentionPlanner"),
    "paper": partial(_make, "PaperPlanner"),
    "random": partial(_make, "RandomPlanner"),
    "ring": partial(_make, "RingPlanner"),
    "farthest": partial(_make, "FarthestPlanner"),
    **{name: partial(_make, "VolumetricPlanner", name) for name in VOLUMETRIC},
}
"""The planners that come with caryatid, the default first."""

ORACLE = "oracle"
"""Name of the planner that knows the truth; `caryatid.evaluation.oracle` makes it, not `make_planner`."""

ENTRY_POINTS = "caryatid.planning.planners"
"""Group under which other packages offer planners: callables without arguments that return a `Planner`."""


def offered() -> dict[str, EntryPoint]:
    """Planners of other packages by name; a name of ours stays ours."""
    return {p.name: p for p in entry_points(group=ENTRY_POINTS) if p.name not in {*BUILT_IN, ORACLE}}


def make_planner(name: str) -> Planner:
    """Return the planner of this name.

    Raises:
        InputError: There is none, then the message lists those there are; or it is `oracle`.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]()
    others = offered()
    if name in others:
        planner: Planner = others[name].load()()
        return planner
    if name == ORACLE:
        raise InputError(
            "planner",
            f"'{ORACLE}' needs a simulated scene, whose truth is known",
            "give a scene, or make it with caryatid.evaluation.oracle.OraclePlanner",
        )
    names = ", ".join([*BUILT_IN, *sorted(others), ORACLE])
    raise InputError("planner", f"there is no planner '{name}'", f"choose one of {names}")


__all__ = [
    "BUILT_IN",
    "ORACLE",
    "VOLUMETRIC",
    "AttentionPlanner",
    "Decision",
    "FarthestPlanner",
    "PaperPlanner",
    "Planner",
    "PlanningState",
    "RandomPlanner",
    "RingPlanner",
    "SupportPlanner",
    "VolumetricPlanner",
    "make_planner",
    "offered",
]

if not TYPE_CHECKING:
    __getattr__ = _imported


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
