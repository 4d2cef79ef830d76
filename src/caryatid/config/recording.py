"""Settings of importing recordings, and of exporting scene models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from caryatid.config.ranges import Count, Likelihood, NotNegative, Positive, Range, Share, Stage


@dataclass(frozen=True, slots=True)
class RecordingConfig(Stage):
    """Which frames of a robot's recording become views."""

    max_views: Count = 30
    """Views at the most [1]; those farthest from each other stay. A table is known after 5 to 10."""
    min_distance: Positive = 0.10
    """A view is another one when its camera has moved by this from all others [m] …"""
    min_angle: Annotated[float, Range(0.0, 180.0, above=True)] = 10.0
    """… or has turned by this [deg]; from 10 cm or 10° on, sides of objects come into sight."""
    sharp_window: NotNegative = 0.5
    """A frame's sharpness is compared with that of frames within this [s]; they show nearly the same."""
    sharp_share: Share = 0.7
    """Least sharpness, as a share of the sharpest within the window [1]; a camera at rest varies by 10 %."""
    colour_gap: NotNegative = 0.02
    """Colour belongs to a depth image when it was taken within this [s]; just over half of 1/30 s."""
    pose_gap: Positive = 0.2
    """Poses further apart in time than this are not interpolated across [s]; robots send 10 a second."""
    min_readings: Likelihood = 0.1
    """Least share of pixels with a depth reading [1]; a camera held too near, or at the sky, has fewer."""
    far: Annotated[float, Range(0.0, 65.0, above=True)] = 10.0
    """Readings farther away than this are left out [m]; beyond what RGB-D cameras measure."""


@dataclass(frozen=True, slots=True)
class ExportConfig(Stage):
    """What other programs want to know that a scene model does not say."""

    density: Positive = 600.0
    """Density of objects [kg/m³]; that of the simulated scenes, wood or a filled carton."""
    friction: NotNegative = 0.8
    """Sliding friction of objects [1]; that of the simulated scenes."""
    corners: Annotated[int, Range(8)] = 48
    """Corners of a cylinder's ends in meshes [1]; its radius is then right to 0.2 %."""
