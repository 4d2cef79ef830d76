"""Planners choose the next best view; `make_planner` finds one by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import entry_points

from caryatid.errors import InputError
from caryatid.planners.decision import Decision, Planner, PlanningState
from caryatid.planners.farthest import FarthestPlanner
from caryatid.planners.paper import PaperPlanner
from caryatid.planners.random import RandomPlanner
from caryatid.planners.ring import RingPlanner
from caryatid.planners.support import SupportPlanner
from caryatid.planners.volumetric import FORMULATIONS, VolumetricPlanner

BUILT_IN: dict[str, Callable[[], Planner]] = {
    "support": SupportPlanner,
    "paper": PaperPlanner,
    "random": RandomPlanner,
    "ring": RingPlanner,
    "farthest": FarthestPlanner,
    **{name: partial(VolumetricPlanner, name) for name in FORMULATIONS},
}
"""The planners that come with caryatid, the default first."""

ENTRY_POINTS = "caryatid.planners"
"""Group under which other packages offer planners: callables without arguments that return a `Planner`."""


def make_planner(name: str) -> Planner:
    """Return the planner of this name.

    Raises:
        InputError: There is none; the message lists those there are.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]()
    offered = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    if name in offered:
        planner: Planner = offered[name].load()()
        return planner
    names = ", ".join([*BUILT_IN, *sorted(set(offered) - set(BUILT_IN))])
    raise InputError("planner", f"there is no planner '{name}'", f"choose one of {names}")


__all__ = [
    "BUILT_IN",
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
]
