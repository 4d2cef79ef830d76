"""Settings of scores, of the planner that knows the truth, and of reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from caryatid.config.ranges import Count, Likelihood, NotNegative, Positive, Range, Share, Stage


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
    thumbnail_width: Count = 320
    """Width camera images are reduced to in the contact sheet [px]; a third of a page at 120 dots an inch."""
    jpeg_quality: Annotated[int, Range(1, 95)] = 82
    """Quality of camera images, 1 … 95."""
    cloud_width: Count = 720
    """Width of the pictures of the cloud [px]."""
    cloud_points: Count = 200_000
    """Points drawn at the most, evenly picked; 0.1 s."""
    point_size: Positive = 0.0075
    """Side of a point as drawn [m], the surface's twice that; half more than the spacing leaves no gaps."""
    sphere_width: Count = 260
    """Width of the painted view sphere [px]; one cell of 40,000 is 2 px."""
    hidden: NotNegative = 0.02
    """A line further than this behind what is seen is drawn as hidden [m]; registration error and noise."""


@dataclass(frozen=True, slots=True)
class StatisticsConfig(Stage):
    """What is made of a benchmark's episodes; nothing here changes one."""

    resamples: Count = 2000
    """Bootstrap resamples of the scenes [1]; the ends of an interval then move by 3 % of its half width."""
    confidence: Likelihood = 0.95
    """Probability with which an interval covers the true mean [1]."""
    thresholds: tuple[Share, ...] = (0.94, 0.90)
    """F1 of which views and path to reach it are told [1]; the paper's, and what nearly all methods reach."""
