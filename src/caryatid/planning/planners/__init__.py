"""Planners choose the next best view; `make_planner` finds one by name."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING

from caryatid.errors import InputError, check_type

if TYPE_CHECKING:
    from caryatid.planning.decision import Planner

VOLUMETRIC = (
    "occlusion-aware", "unobserved-voxel", "rear-side-voxel", "rear-side-entropy", "proximity-count",
)  # fmt: skip
"""The planners that are a `VolumetricPlanner` of the formulation of that name."""

BUILT_IN: dict[str, tuple[str, ...]] = {
    "support": ("hidden_surface", "SupportPlanner"),
    "attention": ("saliency", "AttentionPlanner"),
    "paper": ("saliency", "PaperPlanner"),
    "random": ("baselines", "RandomPlanner"),
    "ring": ("baselines", "RingPlanner"),
    "farthest": ("baselines", "FarthestPlanner"),
    **{name: ("volumetric", "VolumetricPlanner", name) for name in VOLUMETRIC},
}
"""The planners that come with caryatid, the default first: name → module here, class, its arguments."""

ORACLE = "oracle"
"""Name of the planner that knows the ground truth; `caryatid.evaluation.oracle` makes it."""


def offered() -> dict[str, EntryPoint]:
    """Planners of other packages by name: callables without arguments that return a `Planner`.

    They are entry points in the group `caryatid.planners`. A name of ours stays ours.
    """
    points = entry_points(group="caryatid.planners")
    return {point.name: point for point in points if point.name not in {*BUILT_IN, ORACLE}}


def find_offered(name: str) -> EntryPoint | None:
    """Return the entry point of another package's planner, by its name or as `module:Class`.

    Raises:
        InputError: There is a colon, but not between a module and a name.
    """
    if ":" not in name:
        return offered().get(name)
    if not EntryPoint.pattern.match(name):
        raise InputError("planner", f"'{name}' names no planner", "give module:Class")
    return EntryPoint(name, name, "caryatid.planners")


def make_planner(name: Planner | str) -> Planner:
    """Return the planner of this name, or of `module:Class`; a planner is returned unchanged.

    Raises:
        InputError: There is none, and the message lists the known ones; or it is `oracle`.
    """
    if not isinstance(name, str):
        check_type("planner", name, "plan", "give the name of a planner, or an object with a method plan()")
        return name
    if name in BUILT_IN:
        module, maker, *arguments = BUILT_IN[name]
        return getattr(import_module(f"{__name__}.{module}"), maker)(*arguments)
    if point := find_offered(name):
        try:
            return point.load()()
        except (ImportError, AttributeError, TypeError) as error:
            remedy = "give module:Class, or module:function, callable without arguments"
            raise InputError("planner", f"'{name}' cannot be made: {error}", remedy) from None
    if name == ORACLE:
        reason = f"'{ORACLE}' requires the ground truth of a simulated scene"
        remedy = "give a scene, or create caryatid.evaluation.oracle.OraclePlanner"
        raise InputError("planner", reason, remedy)
    names = ", ".join([*BUILT_IN, *sorted(offered()), ORACLE])
    raise InputError("planner", f"unknown planner '{name}'", f"choose one of {names}, or give module:Class")
