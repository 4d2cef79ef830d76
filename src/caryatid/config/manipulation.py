"""Settings of taking objects away: how they are lifted, and how that is rehearsed."""

from __future__ import annotations

from dataclasses import dataclass

from caryatid.config.ranges import Angle, Count, Lengths, NotNegative, Positive, Stage


@dataclass(frozen=True, slots=True)
class LiftConfig(Stage):
    """One object lifted straight up, and what counts as harm to the others."""

    speed: Positive = 0.1
    """Speed of the lift [m/s]; a careful arm's."""
    watch: NotNegative = 2.0
    """How long the others are watched after that [s]; long enough for what tips slowly."""
    moved: NotNegative = 0.02
    """An object displaced by more than this has been disturbed [m]: it slid or fell, and did not settle."""
    turned: Angle = 15.0
    """An object turned by more than this has been disturbed [deg]."""


@dataclass(frozen=True, slots=True)
class RehearsalConfig(Stage):
    """Lifts tried in physics on the extracted shapes before they are done."""

    draws: Count = 8
    """Scenes that a lift is rehearsed in [1]: the shapes as extracted, and others as likely by their
    uncertainty; a risk of a third shows in one of eight with 96 %."""
    friction: Lengths = (0.4, 1.0)
    """Sliding friction is drawn from this range [1]: wood on cardboard to rubber on glass."""
    density: Lengths = (300.0, 1200.0)
    """Density of each object is drawn from this range [kg/m³]: half-empty packets to full bottles."""
    settling: NotNegative = 0.5
    """The extracted shapes are let come to rest for this long [s]; gaps of a millimetre close at once."""
