"""Scenes designed to show one thing each, as short lists of solids."""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

from caryatid.config import PhysicsConfig
from caryatid.simulation.mjcf import Solid, box, build_spec, cylinder, sphere
from caryatid.simulation.world import SimulatedScene, scene_from_spec

DESIGNED: Final = MappingProxyType[str, tuple[Solid, ...]](
    {
        # Four on top of each other: each is held by the one below alone.
        "tower": (
            box((0.14, 0.14, 0.08), at=(0.0, 0.0, 0.04)),
            cylinder(0.05, 0.09, at=(0.0, 0.005, 0.125)),
            box((0.09, 0.08, 0.06), at=(0.005, 0.0, 0.2), turn=(0.0, 0.0, 30.0)),
            cylinder(0.03, 0.07, at=(0.0, 0.0, 0.265)),
            sphere(0.035, at=(-0.12, 0.18, 0.035)),
        ),
        # A plank on two pillars with a load in the middle: two supporters.
        "bridge": (
            box((0.07, 0.08, 0.12), at=(0.0, -0.13, 0.06)),
            cylinder(0.04, 0.12, at=(0.0, 0.13, 0.06)),
            box((0.1, 0.36, 0.025), at=(0.0, 0.0, 0.1325)),
            box((0.08, 0.08, 0.08), at=(0.0, 0.02, 0.185), turn=(0.0, 0.0, 20.0)),
            sphere(0.035, at=(0.02, 0.0, 0.035)),
        ),
        # A plank that would tip over its pedestal but for the weight on its short end: top-down.
        "counterweight": (
            box((0.11, 0.1, 0.1), at=(0.0, 0.0, 0.05)),
            box((0.07, 0.38, 0.02), at=(0.0, -0.13, 0.11), density=500.0),
            cylinder(0.04, 0.08, at=(0.0, 0.012, 0.16), density=3000.0),
            box((0.06, 0.06, 0.05), at=(0.02, -0.26, 0.025)),
        ),
        # A smooth plank that stands only because it leans on a heavy block.
        "leaning_plank": (
            box((0.1, 0.14, 0.28), at=(0.05, 0.0, 0.14), density=1200.0, friction=0.1),
            box((0.02, 0.09, 0.24), at=(-0.039, 0.0, 0.1215), turn=(0.0, 14.0, 0.0), friction=0.1),
            cylinder(0.035, 0.1, at=(-0.03, 0.2, 0.05)),
            box((0.05, 0.05, 0.05), at=(-0.03, 0.2, 0.125)),
        ),
        # What a big box hides from where the robot starts: a stack of three and a ball.
        "hidden_stack": (
            box((0.09, 0.3, 0.26), at=(-0.13, 0.0, 0.13)),
            box((0.12, 0.12, 0.06), at=(0.04, -0.02, 0.03)),
            box((0.09, 0.1, 0.05), at=(0.04, -0.02, 0.085)),
            cylinder(0.03, 0.08, at=(0.045, -0.02, 0.15)),
            sphere(0.04, at=(0.06, 0.13, 0.04)),
        ),
        # A board on two cans over things that stand under it: hidden from above, open at the sides.
        "shelf": (
            cylinder(0.035, 0.13, at=(0.0, -0.16, 0.065)),
            cylinder(0.035, 0.13, at=(0.0, 0.16, 0.065)),
            box((0.16, 0.42, 0.02), at=(0.0, 0.0, 0.14)),
            box((0.07, 0.09, 0.06), at=(0.01, 0.0, 0.03)),
            sphere(0.03, at=(0.01, 0.0, 0.09)),
            box((0.09, 0.07, 0.1), at=(0.0, -0.08, 0.2)),
            cylinder(0.03, 0.06, at=(0.0, 0.1, 0.18)),
        ),
        # The table of the paper's figures: stacks before and behind each other, a bridge, a ball.
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
)
"""Solids of each designed scene, by name; heights count from the table top."""


SETTLING = 1.0
"""Time the solids are given to find their contacts [s]."""


def designed_scene(name: str, config: PhysicsConfig | None = None) -> SimulatedScene:
    """Set up and settle one of the designed scenes.

    Args:
        name: A key of `DESIGNED`.
        config: When it is at rest.
    """
    return scene_from_spec(build_spec(DESIGNED[name], name), name, name, config, least=SETTLING)
