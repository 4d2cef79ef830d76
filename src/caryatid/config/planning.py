"""Settings of active vision: voxels, view sphere, points of interest, robots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from caryatid.config.ranges import (
    Acute,
    Azimuth,
    Count,
    Elevation,
    Lengths,
    Likelihood,
    NotNegative,
    Positive,
    Rising,
    Share,
    Stage,
)


@dataclass(frozen=True, slots=True)
class VoxelConfig(Stage):
    """The voxel map for the occlusion test."""

    size: Positive = 0.01
    """Edge of a voxel [m]; the paper's leaf size."""
    extent: tuple[Positive, Positive, Positive] = (1.6, 1.6, 1.0)
    """Size of the map around the view sphere's centre [m]: a table with its margin."""
    below: NotNegative = 0.1
    """How far the map reaches below the sphere's centre [m]."""
    stride: Count = 2
    """Pixels between the rays that are followed; 2 is 6 mm at 1.5 m, below the voxel's size."""
    margin: NotNegative = 0.01
    """Length before a reading that a ray does not clear [m]; depth noise within it carves no surface."""
    hit: Likelihood = 0.7
    """Occupancy one view with a reading in a voxel speaks for [1]; the usual sensor model."""
    miss: Likelihood = 0.4
    """Occupancy one view that looks through a voxel speaks for [1]; the usual sensor model."""


@dataclass(frozen=True, slots=True)
class ActiveVisionConfig(Stage):
    """Points of interest, view sphere and the choice of the next view, section IV."""

    sphere_points: Count = 40_000
    """Points the view sphere is discretised to; the paper's."""
    sphere_radius: Positive = 1.5
    """Radius of the view sphere [m]; the paper's."""
    saliency_weight: Share = 0.75
    """λ_s of eq. 2 [1]; the paper's."""
    saliency: Literal["paper", "decreasing"] = "decreasing"
    """Eq. 2 with 2π as printed, or with π so that relations seen often matter less."""
    edge_point: Literal["midpoint", "contact"] = "contact"
    """Where a relation's point of interest lies: the middle of the centres, or the contact patch."""
    occlusion: Literal["invert", "ignore"] = "invert"
    """Saliency of a point is negated where it is hidden, as in the paper; or hidden points count as seen."""
    propagation: bool = True
    """Saliency spreads to neighbouring views, as in the paper; or a point's nearest view alone gets it."""
    spread: Positive = 20.0
    """Angle on the sphere at which saliency has fallen to exp(−½) [deg]."""
    inhibition: NotNegative = 1.0
    """Depth of the negative bump at every visited view [1]; 0 is no inhibition of return."""
    path_cost: Literal["angle", "path", "none"] = "path"
    """h of eq. 3: sin(α/2), the path over the floor in sphere diameters, or nothing; the path halves it."""
    max_views: Count = 10
    """Views at the most, the first one too; the paper's."""
    look_directions: Count = 1200
    """Directions on the whole sphere that planners look in at the most [1]; about 6° apart."""
    effort: NotNegative = 0.05
    """Share of all there is to see for which the planner `support` goes one sphere diameter [1]."""
    view_cone: Acute = 30.0
    """Angle from the optical axis within which a point is in the image [deg]; 57° × 43° sensor."""


@dataclass(frozen=True, slots=True)
class RobotConfig(Stage):
    """The simulated humanoid: holonomic platform, torso lift, head with yaw and pitch."""

    footprint: Positive = 0.35
    """Radius of the platform's disc [m]."""
    camera_height: Lengths = (1.30, 1.90)
    """Lowest and highest camera centre over the floor [m], by the torso lift."""
    pitch: Annotated[tuple[Elevation, Elevation], Rising()] = (-60.0, 20.0)
    """Head pitch, down to up [deg]."""
    yaw: Annotated[tuple[Azimuth, Azimuth], Rising()] = (-80.0, 80.0)
    """Head yaw against the platform [deg]."""
    camera_forward: NotNegative = 0.1
    """How far the camera stands before the platform's centre [m]."""
    cell: Positive = 0.05
    """Edge of a cell of the floor grid [m]."""
    floor: Positive = 3.0
    """Half the side of the square of floor the robot may use, around the table [m]."""
    head_yaws: Count = 9
    """Head yaws tried within the limits, straight ahead first, to stand clear of an obstacle."""
    home: tuple[Azimuth, Elevation] = (180.0, 35.0)
    """Azimuth and elevation on the view sphere of the first view [deg]."""


@dataclass(frozen=True, slots=True)
class ArmConfig(Stage):
    """An arm with a camera in its hand."""

    base: tuple[float, float, float] = (-0.5, 0.0, 0.0)
    """Where a simulated arm stands, from the middle of the table top [m]; 0.2 m beside a built-in table."""
    base_yaw: Azimuth = 0.0
    """Where the x axis of its base points, from the world's x towards y [deg]; 0 is over the table."""
    radius: Lengths = (0.4, 1.0)
    """Smallest and largest view sphere tried [m]: nearer, the camera meets what is on the table, and the hand
    of a common arm gets no farther. Equal ends fix the radius."""
    radius_views: Count = 400
    """Views of each sphere tried to choose among them [1]; about 10° apart."""
    sphere_points: Count = 4000
    """Points of the view sphere [1]; about 3° apart, and a tenth of the humanoid's to ask a slow function."""
    rolls: Count = 8
    """Rolls of the camera about its optical axis that are tried, level first [1]; 45° apart, 1 = level."""
    clearance: NotNegative = 0.15
    """Height of the camera over the sphere's centre at least [m]; lower, the hand meets the table."""
    cell: Positive = 0.08
    """Edge of a cell of a sampled map [m]; finer ones need more samples, by the third power."""
    view_directions: Count = 150
    """Viewing directions a sampled map tells apart [1]; about 16° apart."""
