"""Settings of sessions: what a view that is handed in must be like."""

from __future__ import annotations

from dataclasses import dataclass

from caryatid.config.ranges import Count, Positive, Share, Stage


@dataclass(frozen=True, slots=True)
class SessionConfig(Stage):
    """What is refused before a view is taken in."""

    max_pixels: Count = 16_000_000
    """Pixels of an image at the most [1]; several times what depth cameras have, and bounds memory."""
    max_bytes: Count = 100_000_000
    """Size of a file at the most [bytes]; an array of as many pixels would be larger than any camera's."""
    max_coordinate: Positive = 1e4
    """How far from the world's origin a camera may be along an axis [m]; beyond it units are others."""
    common: Share = 0.25
    """Share of what a view shows around the table that must lie where earlier views saw something [1], within
    what registration puts right; of right poses nearly all does, even from the other side, of wrong ones a
    fifth."""
