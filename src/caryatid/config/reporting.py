"""Settings around the method: scores, reports, recordings, exports, sessions, and taking objects away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from caryatid.config.ranges import (
    Angle,
    Count,
    Lengths,
    Likelihood,
    NotNegative,
    Positive,
    Range,
    Share,
    Stage,
)


@dataclass(frozen=True, slots=True)
class EvaluationConfig(Stage):
    """Scores against a truth, method notes section 5."""

    min_iou: Share = 0.5
    """Volumes or masks that overlap by at least this are the same object [1]."""
    table_tolerance: NotNegative = 0.02
    """The table is found when its top is within this of the true height [m]."""
    samples: Count = 10_000
    """Points the overlap of two volumes is measured with [1]; σ is at most 0.01, 0.005 for most pairs."""


@dataclass(frozen=True, slots=True)
class OracleConfig(Stage):
    """The planner that knows the truth, method notes section 6."""

    candidates: Count = 32
    """Views tried beside the default planner's, at the most [1]; about 20° apart, 0.7 s each."""
    stride: Count = 2
    """Pixels between the rays that look for true surface [1]; 6 mm at 1.5 m, below the cell's size."""


@dataclass(frozen=True, slots=True)
class ReportConfig(Stage):
    """The pictures of the report; nothing here changes a result."""

    image_width: Count = 640
    """Width camera images are reduced to [px]; a report of ten views stays below 8 MB."""


@dataclass(frozen=True, slots=True)
class StatisticsConfig(Stage):
    """What is made of a benchmark's episodes; nothing here changes one."""

    resamples: Count = 2000
    """Bootstrap resamples of the scenes [1]; the ends of an interval then move by 3 % of its half width."""
    confidence: Likelihood = 0.95
    """Probability with which an interval covers the true mean [1]."""
    thresholds: tuple[Share, ...] = (0.94, 0.90)
    """F1 of which views and path to reach it are told [1]; the paper's, and what nearly all methods reach."""


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
