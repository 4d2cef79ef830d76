"""Every setting of caryatid: one frozen dataclass per stage, with the unit and reason of each value.

A value outside its range raises `pydantic.ValidationError`. Values are the paper's where it gives them.
"""

from __future__ import annotations

from dataclasses import field, replace
from math import inf, prod
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo
from pydantic.dataclasses import dataclass

from caryatid.config.choices import (
    CameraAxes,
    DepthKind,
    FusionMethod,
    GripperKind,
    MaskIdentity,
    ShapeKind,
)

CHECKED = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


def _rising(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] > values[1]:
        raise ValueError("values should be in ascending order")
    return values


def _few_voxels(extent: tuple[float, float, float], info: ValidationInfo) -> tuple[float, float, float]:
    size, most = info.data.get("size", inf), info.data.get("max_voxels", inf)
    if (voxels := prod(length / size for length in extent)) > most:
        need = f"{voxels:.3g} voxels of {size} m take {2e-9 * voxels:.3g} GB"
        raise ValueError(f"{need}, more than voxels.max_voxels = {most}")
    return extent


Positive = Annotated[float, Field(gt=0, le=1e18)]
NotNegative = Annotated[float, Field(ge=0, le=1e18)]
Length = Annotated[float, Field(gt=0, le=1000)]
"""A longer one is no room; in its square, that of the smallest error of depth would be rounded away."""
HandSize = Annotated[float, Field(gt=0, le=1)]
"""A length of a gripper [m]; a longer one is in millimetres."""
Distance = Annotated[float, Field(ge=0, le=1000)]
Share = Annotated[float, Field(ge=0, le=1)]
Likelihood = Annotated[float, Field(gt=0, lt=1)]
"""A probability that is neither impossible nor certain: its odds are finite."""
Factor = Annotated[float, Field(ge=1, le=1e18)]
Angle = Annotated[float, Field(ge=0, le=180)]
Acute = Annotated[float, Field(ge=0, lt=90)]
"""An angle whose cosine is divided by."""
Elevation = Annotated[float, Field(ge=-90, le=90)]
Azimuth = Annotated[float, Field(ge=-360, le=360)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
WholeNumber = Annotated[int, Field(ge=0, le=1_000_000)]
Most = Annotated[int, Field(ge=1, le=1_000_000_000)]
"""A limit on what a machine can hold."""
Repeats = Annotated[int, Field(ge=0, le=1000)]
"""Number of times something is tried or repeated; more would take minutes per view."""
Lengths = Annotated[tuple[Length, Length], AfterValidator(_rising)]
"""Smallest and largest length."""
Range = Annotated[tuple[Positive, Positive], AfterValidator(_rising)]
"""Smallest and largest value."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class CloudConfig:
    """From depth image to oriented points."""

    max_coordinate: Positive = 1e4
    """Maximum depth [m]; larger values mean wrong units."""
    max_depth: Length = 3.0
    """Readings beyond this depth are dropped [m]; the paper's working range."""
    min_depth: Distance = 0.1
    """Readings nearer than this are dropped [m]; the robot's hand, or below any sensor's range."""
    normal_window: Count = 7
    """Maximum side of the window in which normals are fitted [px]; 7 × 7 reduces the noise to a quarter."""
    normal_size: Length = 0.02
    """Side of that window on the surface, at the median distance [m]: 7 px at 1.5 m with f = 525 px; fewer
    in coarse images, where 7 px would span an object."""
    edge_jump: Distance = 0.01
    """A larger depth step between neighbouring pixels separates two surfaces [m]; at 1 m, grows with z²."""
    max_slope: NotNegative = 0.004
    """Change of inverse depth allowed within one surface in addition to edge_jump [1/m per px]; a tilt of 80°
    at 2.7 m with f = 525 px. Grows with pixel size in coarser images."""
    voxel: Length = 0.005
    """Spacing of an object's points, pooled over views [m]; about the noise of one reading at 1.5 m."""
    views: Count = 10
    """Number of views whose points and segments are all kept [1]."""
    depth: Count = 3
    """Points kept per voxel of an object that more views show [1]; a fit uses the one nearest their mean."""
    neighbours: Count = 16
    """Number of neighbours that define the normal of a point in an unorganised cloud [1]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SurfaceConfig:
    """The support surface (table top)."""

    tolerance: Length = 0.01
    """Distance within which a point belongs to the plane [m]; 3σ of the sensor at 1.8 m."""
    max_tilt: Angle = 10.0
    """Maximum angle between its normal and the vertical, if the view has a pose [deg]."""
    max_deviation: Angle = 25.0
    """Maximum angle between the normals of a point and its plane [deg]; 3σ of normals from depth."""
    gap: Length = 0.3
    """Regions of one plane farther apart than this are two surfaces [m]; occlusion shadows are narrower."""
    min_width: Distance = 0.24
    """Minimum width of furniture [m]; a large hand spans as much, and holds no object that is wider."""
    min_points: Count = 200
    """Minimum number of inliers of a table [points]; a tenth of `min_area` at 5 mm."""
    search: Length = 0.05
    """Maximum change in height of a known table between views [m]; 5σ of registration and tilt."""
    spacing: Length = 0.02
    """Spacing of the table's points kept for later views [m]; fine enough for its outline."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class RegistrationConfig:
    """Registration of views to each other, starting from the reported poses."""

    enabled: bool = True
    """Whether poses are refined, and changes between views detected."""
    translation: Length = 0.01
    """Expected error of a reported position, per axis [m]; about twice the usual error."""
    rotation: Positive = 0.5
    """Expected error of a reported orientation, per axis, about the camera [deg]."""
    noise: Annotated[float, Field(ge=1e-6, le=1e18)] = 0.001
    """Expected point-to-plane distance of two matched patches, beyond the noise of their readings [m]."""
    spacing: Length = 0.01
    """Size of the patches on objects, over which readings are averaged [m]; a dozen pixels at 1.5 m."""
    spacing_far: Length = 0.03
    """Size of the patches on the support surface [m]."""
    sample: Count = 600
    """Number of patches of a view that are matched with each other view [1]."""
    reaches: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.1, 0.05, 0.025)
    """Maximum distance of a match [m], coarse to fine."""
    min_points: Count = 100
    """Minimum number of matches that determine a pose [1]."""
    kept: Count = 12
    """Number of earlier views that a new one is registered to; they move too [1]. 30° apart on a circle."""
    max_translation: Distance = 0.1
    """Maximum correction of a position [m]; a larger one is rejected."""
    max_rotation: Angle = 5.0
    """Maximum correction of an orientation [deg]; a larger one is rejected."""
    common: Share = 0.25
    """Minimum share of the points around the table in an unregistered view that lie on surfaces of earlier
    views [1]: a third with the right pose, even from the other side; a fifth with a wrong one."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SegmentationConfig:
    """Automatic segmentation by local convexity."""

    stride: Count = 2
    """Pixels between samples of the organised image; 2 keeps 6 mm at 1.5 m. 1 in images below 320 px."""
    margin: Distance = 0.05
    """Points farther than this outside the support surface's outline belong to no object [m]."""
    edge_jump: Length = 0.006
    """Distance of a sample from its neighbour's plane that separates surfaces [m]; at 1 m, grows with z²."""
    surfel: Length = 0.015
    """Size of the surfels whose edges are classified as convex or concave [m]; 4σ of the noise at 1.5 m."""
    crease: NotNegative = 4.0
    """Length that a change of the normal by 90° adds to a path on the surface [surfels]."""
    step: Distance = 0.0035
    """Surfels more than this above their neighbour's plane are another layer [m]; 2σ after smoothing."""
    reach: Length = 0.012
    """Maximum distance of connected points in an unorganised cloud [m]; twice the usual spacing."""
    concavity: Angle = 15.0
    """Angle between normals above which a concave edge separates two surfaces [deg]; LCCP's 10 plus noise."""
    rise: Distance = 0.01
    """Two places of a segment are concave if one lies this far above the other's tangent plane [m]."""
    min_area: NotNegative = 0.0011
    """Minimum area of a segment [m²]; noise at depth edges and shiny surfaces leaves smaller ones."""
    min_width: Distance = 0.02
    """A segment narrower than this beside larger ones belongs to one [m]; noise rounds creases by as much."""
    alike: Share = 0.3
    """Affinity above which samples attract each other [1]: 0 undecided, 1 certain; 0.3 is 65 % likely."""
    merge_gap: Distance = 0.25
    """Maximum length hidden by a nearer object across which two segments are merged [m]."""
    clearance: Distance = 0.008
    """Points nearer than this to the support surface belong to it [m]; 2σ of the sensor at 1.5 m."""
    max_height: Length = 0.6
    """Points higher than this above the table belong to no object [m]; size of table-top objects."""
    overlap: Share = 0.3
    """Minimum share of a segment's points on an object for the two to be associated [1]."""
    overlap_reach: Distance = 0.02
    """Maximum distance of a point that lies on an object [m]; 2σ of both views' registration error."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class MaskConfig:
    """Masks of a learned segmenter."""

    min_pixels: WholeNumber = 200
    """Minimum size of a mask in 640 × 480 pixels [px], without those that smaller masks take from it; in
    another image, the same share."""
    max_share: Share = 0.4
    """Maximum share of the image that a mask covers [1]; a larger one is the table or the background."""
    min_score: float = 0.0
    """Minimum score of a mask [the segmenter's unit]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class FitConfig:
    """Primitive fitting."""

    shapes: Annotated[tuple[ShapeKind, ...], Field(min_length=1)] = ("box", "cylinder", "sphere")
    """Primitives to fit; the paper's three."""
    hypotheses: Count = 100
    """Maximum number of RANSAC hypotheses per shape [1]."""
    max_points: Count = 800
    """Maximum number of points that score a shape [1]; 1.5 cm apart on the largest objects."""
    search_points: Count = 250
    """Number of points in the search, or up to twice that [1]; the best hypotheses are refined on all
    points."""
    min_points: Count = 12
    """Minimum number of points of an object [1]; a box has nine parameters."""
    threshold: Length = 0.01
    """MSAC truncation of the distance to the surface [m]; 2σ of registration error."""
    polish: Annotated[Repeats, Field(ge=1)] = 3
    """Number of best hypotheses per shape that least squares refines [1]."""
    steps: Repeats = 25
    """Maximum number of least-squares steps [1]."""
    max_extent: Length = 0.5
    """Maximum extent of a shape [m]; table-top objects."""
    min_extent: Annotated[float, Field(gt=0, le=1)] = 0.008
    """Minimum extent of a shape [m]; below the sensor's resolution."""
    max_radius: Length = 0.15
    """Maximum radius of a cylinder or sphere [m]."""
    normal_weight: Distance = 0.004
    """Cost of a normal that is wrong by 90°, in model selection [m]: half the registration error."""
    correlated: Factor = 4.0
    """Number of neighbouring points that share one error [1]; depth is smoothed over 2 × 2 pixels."""
    registration: Distance = 0.002
    """Standard deviation of registration [m]; more points do not average it out."""
    rim: Distance = 0.003
    """Standard deviation of the border of a point set at a depth edge [m]: one pixel at 1.5 m."""
    max_residual: Length = 0.008
    """Maximum mean distance of points to their shape [m]; a worse shape is marked `poor_fit`."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SplitConfig:
    """Model split: one automatic segment may be several objects."""

    cuts: Repeats = 5
    """Number of cuts tried along each direction [1]; a sixth of the points apart."""
    rounds: Repeats = 3
    """Number of times points are assigned to the better shape and both shapes are refitted [1]."""
    min_points: Count = 20
    """Minimum number of downsampled points on each side [1]; 1.5 times what a shape needs."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ExplanationConfig:
    """Description length of points explained by shapes, which decides between one object and two."""

    parameter_cost: NotNegative = 4.5
    """Cost of each parameter of a shape [nats]; precision is a ninetieth of the parameter's range."""
    outlier: NotNegative = 4.0
    """Cost of a point that no shape explains [nats]; as likely as a 2.8σ deviation."""
    irregular: NotNegative = 1.4
    """Cost of a point on an object that no shape fits [nats]."""
    normal_weight: NotNegative = 4.0
    """Cost of a normal that is wrong by 90° [nats]; normals, blurred at edges, are accurate to 30°."""
    reading: Positive = 0.0002
    """Area whose points share one error [m²]; half of the 2 cm square that a registration error affects."""
    sighted: NotNegative = 2.0
    """Cost of a point separated from its segment in a view [nats]; one in eight is in a wrong segment."""
    border: NotNegative = 4.0
    """Cost of a point surrounded by points of the other object, on a surface without a crease [nats]."""
    free_cost: NotNegative = 0.5
    """Cost of a voxel inside a shape that is observed free [nats]; four outliers at 5 mm spacing."""
    usual: NotNegative = 0.9
    """Maximum mean cost of a well explained neighbourhood of points [nats]; holds for 9 in 10 true shapes."""
    spacing: Length = 0.008
    """Spacing to which points are downsampled [m]; a third of the area that shares one error."""
    reach: Length = 0.03
    """Maximum gap between objects to merge [m]; the width of an occlusion shadow."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class CompletionConfig:
    """Extension of shapes into the unseen space below them."""

    enabled: bool = True
    """Whether unseen faces are extended."""
    max_tilt: Angle = 30.0
    """Maximum angle between an unseen face's normal and straight down [deg]; only such faces bear weight."""
    overlap: Distance = 0.004
    """Maximum overlap of the extended face, or its walls, with another shape [m]; the fits' uncertainty."""
    max_free: Share = 0.15
    """Maximum share of the face's rim in voxels observed free [1]; half of one side of four."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class PlausibilityConfig:
    """Correction of shapes that overlap or float."""

    rounds: Repeats = 3
    """Maximum number of corrections [1]; 0 leaves shapes as fitted."""
    touch: Distance = 0.001
    """Maximum gap or overlap of two shapes in contact [m]; round edges, soft surfaces."""
    sigmas: NotNegative = 3.0
    """Maximum gap that the fits' uncertainty explains, in standard deviations [1]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SupportConfig:
    """Support relations, section III-A."""

    contact_margin: Distance = 0.005
    """Maximum gap of two shapes in contact if `stability` is `area` [m]; 2.5σ of a fit."""
    reach: Distance = 0.012
    """Maximum gap of two shapes that may touch, or that an object tips across [m]; 2.5σ of the gap."""
    max_tilt: Angle = 75.0
    """Maximum tilt of the separating plane of a support from below [deg]; from there on, objects lean."""
    patch_depth: Distance = 0.003
    """Surfaces within this distance of the first contact also touch [m]; noise of one reading at 1.5 m."""
    min_area_ratio: Share = 0.1
    """r_s,min of eq. 1 [1]."""
    overhang: Distance = 0.003
    """An object tips if its centre of mass is this far outside the support polygon [m]; 1σ of a fit."""
    stability: Literal["area", "balance"] = "balance"
    """What decides: separating planes and r_s of eq. 1 (`area`, the paper's rules; everything on top of an
    object with r_s < r_s,min also supports it), or the forces that hold the scene at rest (`balance`)."""
    draws: Annotated[Repeats, Field(ge=1)] = 12
    """Number of scenes sampled from the fits' uncertainty [1]; a probability near 0.5 is accurate to 0.14."""
    force_share: Share = 0.03
    """Minimum share of an object's weight [1] that a supporter bears in a sample, as in the ground truth."""
    at_rest: Share = 0.05
    """Acceleration below which an object is at rest in a sample [g]: it closes a gap of at most 2 mm."""
    unexplained: Share = 0.1
    """Weight of a sample for an object not at rest in it [1]: how often an unseen object supports one."""
    friction: Range = (0.4, 1.0)
    """Range of sliding friction that objects are sampled from [1]: wood on cardboard to rubber on glass."""
    density: Range = (100.0, 8000.0)
    """Range of density that objects are sampled from [kg/m³]: half-empty packets to steel."""
    touch: Length = 0.0005
    """Standard deviation of the gap of two shapes in contact [m]; round edges, soft surfaces."""
    max_drop: Distance = 0.04
    """Maximum hidden gap between an unsupported object and its supporter [m]; 0 leaves it unsupported."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class FusionConfig:
    """Fusion over views, section III-B."""

    method: FusionMethod = "pc+sg"
    """Fuse points (`pc`), graphs (`sg`) or both (Table I)."""
    matching: Literal["points", "shapes"] = "points"
    """Match vertices by their points or, as in the paper, by shape, pose and extent."""
    masks: MaskIdentity = "scene"
    """A mask's number identifies an object in all views (`scene`) or a segment of one view (`per-view`)."""
    max_distance: Distance = 0.05
    """Maximum distance between centres of one object, plus half the smaller object's size [m]."""
    max_angle: Angle = 20.0
    """Maximum angle between axes of one object [deg], up to the shape's symmetry."""
    max_ratio: Factor = 1.6
    """Maximum ratio between sorted extents of one object [1]."""
    settled: Distance = 0.005
    """A shape that moves, grows or turns by less than this is unchanged [m]; σ of registration error."""
    keep_share: Share = 0.5
    """Minimum occurrences / opportunities of a support to keep [1]; 0 is the union of Table I."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class VoxelConfig:
    """The voxel map for occlusion tests."""

    size: Length = 0.01
    """Edge of a voxel [m]; the paper's leaf size."""
    max_voxels: Most = 64_000_000
    """Maximum number of voxels [1]: 25 times the default map; such a map takes 128 MB."""
    extent: Annotated[
        tuple[Positive, Positive, Positive], AfterValidator(_few_voxels), Field(validate_default=True)
    ] = (1.6, 1.6, 1.0)
    """Size of the map around the view sphere's centre [m]: a table with its margin."""
    below: Distance = 0.1
    """Depth of the map below the view sphere's centre [m]."""
    stride: Count = 2
    """Pixels between traced rays [px]; 2 is 6 mm at 1.5 m, below the voxel size."""
    margin: Distance = 0.01
    """Distance in front of a reading that its ray does not clear [m]; depth noise then carves no surface."""
    hit: Likelihood = 0.7
    """Occupancy probability after one view with a reading in a voxel [1]; the usual sensor model."""
    miss: Likelihood = 0.4
    """Occupancy probability after one view with a ray through a voxel [1]; the usual sensor model."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ActiveVisionConfig:
    """Points of interest, view sphere and next best view, section IV."""

    sphere_points: Count = 40_000
    """Number of points of the view sphere [1]; the paper's."""
    sphere_radius: Length = 1.5
    """Radius of the view sphere [m]; the paper's."""
    saliency_weight: Share = 0.75
    """λ_s of eq. 2 [1]; the paper's."""
    saliency: Literal["paper", "decreasing"] = "decreasing"
    """Eq. 2 with 2π as printed (`paper`), or with π: relations seen often count less (`decreasing`)."""
    edge_point: Literal["midpoint", "contact"] = "contact"
    """Point of interest of a relation: midway between the centres, or at the contact patch."""
    occlusion: Literal["invert", "ignore"] = "invert"
    """Saliency of a hidden point: negated, as in the paper, or the same as if it were visible."""
    propagation: bool = True
    """Whether saliency spreads to neighbouring views, as in the paper; otherwise only the nearest gets it."""
    spread: Positive = 20.0
    """Angle on the sphere at which saliency has fallen to exp(−½) [deg]."""
    inhibition: NotNegative = 1.0
    """Depth of the negative bump at every visited view [1]; 0 disables inhibition of return."""
    path_cost: Literal["angle", "path", "none"] = "path"
    """h of eq. 3: sin(α/2), path length in sphere diameters (halves the distance travelled), or 0."""
    stop: Literal["gain", "unchanged"] = "gain"
    """Stop when no view is worth its path (`gain`: c = s − h of planner `support` is at most 0 everywhere)
    or, as in the paper, after a view that does not change the graph (`unchanged`)."""
    max_views: Count = 10
    """Maximum number of views, including the first; the paper's."""
    look_directions: Count = 1200
    """Maximum number of directions that planners evaluate, over the whole sphere [1]; about 6° apart."""
    effort: NotNegative = 0.05
    """Share of all unseen surface that is worth a path of one sphere diameter, for planner `support` [1]."""
    view_cone: Acute = 30.0
    """Maximum angle from the optical axis of a point in the image [deg]; 57° × 43° sensor."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class RobotConfig:
    """The simulated humanoid: holonomic platform, torso lift, head with yaw and pitch."""

    footprint: Length = 0.35
    """Radius of the platform's disc [m]."""
    camera_height: Lengths = (1.30, 1.90)
    """Range of the camera's height above the floor [m], by the torso lift."""
    pitch: Annotated[tuple[Elevation, Elevation], AfterValidator(_rising)] = (-60.0, 20.0)
    """Range of head pitch, down to up [deg]."""
    yaw: Annotated[tuple[Azimuth, Azimuth], AfterValidator(_rising)] = (-80.0, 80.0)
    """Range of head yaw relative to the platform [deg]."""
    camera_forward: Distance = 0.1
    """Distance of the camera in front of the platform's centre [m]."""
    cell: Length = 0.05
    """Edge of a cell of the floor grid [m]."""
    floor: Length = 3.0
    """Half the side of the square floor area around the table that the robot may use [m]."""
    head_yaws: Count = 9
    """Number of head yaws tried to keep the platform clear of obstacles, straight ahead first [1]."""
    home: tuple[Azimuth, Elevation] = (180.0, 35.0)
    """Azimuth and elevation on the view sphere of the first view [deg]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ArmConfig:
    """An arm with a wrist camera."""

    base: tuple[float, float, float] = (-0.5, 0.0, 0.0)
    """Position of a simulated arm, from the centre of the table top [m]; 0.2 m beside a built-in table."""
    base_yaw: Azimuth = 0.0
    """Direction of the base's x axis, from the world's x towards y [deg]; 0 points to the table."""
    radius: Lengths = (0.4, 1.0)
    """Range of view sphere radii to try [m]: any smaller, the camera hits objects; any larger, a common arm
    does not reach. Equal values fix the radius."""
    radius_views: Count = 400
    """Number of views tried on each sphere to choose a radius [1]; about 10° apart."""
    sphere_points: Count = 4000
    """Number of points of the view sphere [1]; about 3° apart, a tenth of the humanoid's since reachability
    is slow."""
    rolls: Count = 8
    """Number of camera rolls about the optical axis to try, level first [1]; 45° apart, 1 = level only."""
    clearance: Distance = 0.15
    """Minimum height of the camera above the sphere's centre [m]; lower, the hand hits the table."""
    cell: Length = 0.08
    """Edge of a cell of a sampled map [m]; the number of samples needed grows with its inverse cube."""
    view_directions: Count = 150
    """Number of viewing directions in a sampled map [1]; about 16° apart."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SensorConfig:
    """The simulated depth camera: a Carmine 1.09's image."""

    width: Count = 640
    """Image width [px]."""
    height: Count = 480
    """Image height [px]."""
    focal: Positive = 525.0
    """Focal length [px]; the driver's nominal value."""
    far: Length = 10.0
    """Maximum depth that is rendered [m]; noise limits readings to the sensor's range."""
    light: tuple[float, float, float] = (-0.4, 0.3, 0.87)
    """Direction to the light in the world frame; not vertical, so that faces of a box differ."""
    ambient: Share = 0.45
    """Share of a surface's colour that is visible without the light [1]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class NoiseConfig:
    """Depth noise of a Carmine 1.09, and registration error."""

    axial: tuple[NotNegative, NotNegative, NotNegative] = (0.0012, 0.0019, 0.4)
    """(a, b, z0) of σ(z) = a + b·(z − z0)² [m]."""
    disparity_step: Positive = 0.00285
    """Quantisation step of 1/z [1/m]: 1/8 px of disparity, f = 580 px, baseline 75 mm."""
    grazing: Angle = 80.0
    """Maximum angle of incidence that gives a reading [deg]."""
    range: Lengths = (0.35, 3.0)
    """Range of readings [m]."""
    edge_jump: Distance = 0.03
    """Pixels beside a larger depth step give no reading [m]."""
    translation: Distance = 0.005
    """σ of the registration error's translation, each view [m]."""
    rotation: Angle = 0.3
    """σ of the registration error's rotation, each view [deg]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class PhysicsConfig:
    """Simulated scenes at rest, and their ground truth from physics."""

    rest_window: Positive = 0.25
    """Time over which motion is measured to decide whether an object is at rest [s]."""
    rest_distance: Length = 0.001
    """Maximum motion within that time of an object at rest [m]; soft contacts creep at up to 3 mm/s."""
    rest_angle: Angle = 1.0
    """Maximum rotation within that time of an object at rest [deg]."""
    settle_time: NotNegative = 6.0
    """Maximum time to settle [s]; the scene is used afterwards, at rest or not."""
    force_share: NotNegative = 0.03
    """Minimum upward part of a contact force that supports an object, as a share of its weight [1]."""
    removal_time: Positive = 1.0
    """Time for which the others are observed after an object is removed [s]."""
    moved: Distance = 0.01
    """Displacement above which an object has moved [m]."""
    turned: Angle = 8.0
    """Rotation above which an object has moved [deg]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class EvaluationConfig:
    """Scores against a ground truth, section V."""

    min_iou: Share = 0.5
    """Minimum IoU of volumes or masks for an object to match the ground truth [1]."""
    table_tolerance: Distance = 0.02
    """Maximum error in height for the table to match the ground truth [m]."""
    samples: Count = 10_000
    """Number of points that measure the overlap of two volumes [1]; σ is at most 0.01, usually 0.005."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class OracleConfig:
    """The planner `oracle`, which knows the ground truth."""

    candidates: Count = 32
    """Maximum number of views tried, apart from the default planner's [1]; about 20° apart, 0.7 s each."""
    stride: Count = 2
    """Pixels between the rays that sample true surfaces [px]; 6 mm at 1.5 m, below the cell size."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ReportConfig:
    """Images in the report; these settings change no result."""

    image_width: Count = 640
    """Maximum width of camera images [px]; keeps a report of four views below 3 MB."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class RecordingConfig:
    """Selection of the frames of a recording that become views."""

    max_pixels: Most = 16_000_000
    """Maximum number of pixels of any image [1]; bounds memory, several times a depth camera's."""
    max_views: Count = 30
    """Maximum number of views [1]; those farthest apart are kept. A table needs 5 to 10."""
    min_distance: Length = 0.10
    """Distance at which a view is new, whatever its direction [m]; objects then show other sides."""
    min_angle: Annotated[float, Field(gt=0, le=180)] = 10.0
    """Rotation at which a view is new, whatever its position [deg]; objects then show other sides."""
    sharp_window: NotNegative = 0.5
    """Time within which frames are compared by sharpness [s]; they show nearly the same scene."""
    sharp_share: Share = 0.7
    """Minimum sharpness, relative to the sharpest frame in that time [1]; varies by 10 % at rest."""
    colour_gap: NotNegative = 0.02
    """Maximum time between a depth image and its colour image [s]; just over half of 1/30 s."""
    pose_gap: Positive = 0.2
    """Maximum time between two poses to interpolate [s]; robots publish at least 10 a second."""
    min_readings: Likelihood = 0.1
    """Minimum share of pixels with a depth reading [1]; a camera too close to a surface has fewer."""
    far: Annotated[float, Field(gt=0, le=65)] = 10.0
    """Readings beyond this depth are dropped [m]; beyond the range of RGB-D cameras."""
    axes: CameraAxes = "optical"
    """Axes of the camera frame in the poses: optical (x right, y down, z forward), opengl (y up, z backward)
    or body (x forward, y left, z up)."""
    depth: DepthKind = "axis"
    """Whether depth is along the optical axis, or the distance along the ray of each pixel."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ExportConfig:
    """Properties that other programs need and the scene model lacks."""

    density: Positive = 600.0
    """Density of objects [kg/m³]; as in the simulated scenes: wood or a filled carton."""
    friction: NotNegative = 0.8
    """Sliding friction of objects [1]; as in the simulated scenes."""
    corners: Annotated[int, Field(ge=8)] = 48
    """Number of corners of a cylinder's ends in meshes [1]; the radius is then accurate to 0.2 %."""
    frame: str = "world"
    """Name of the world frame in tf, for MoveIt."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SessionConfig:
    """Limits on the files of a session and on the sessions of a service."""

    max_bytes: Most = 100_000_000
    """Maximum size of a file [bytes]; larger than any camera's image."""
    max_sessions: Count = 1000
    """Maximum number of sessions of a service [1]; their folders remain until deleted by hand."""
    min_free: NotNegative = 1e9
    """Minimum free disk space for a service to accept data [bytes]; other programs write there too."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class LiftConfig:
    """A lift straight up, and what counts as a disturbance of the other objects."""

    speed: Positive = 0.1
    """Speed of the lift [m/s]; that of a careful arm."""
    watch: NotNegative = 2.0
    """Time for which the others are observed after the lift [s]; long enough for slow tipping."""
    moved: Distance = 0.02
    """Displacement above which an object was disturbed [m]: it slid or fell, rather than settled."""
    turned: Angle = 15.0
    """Rotation above which an object was disturbed [deg]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class RehearsalConfig:
    """Simulation of lifts with the extracted shapes before they are carried out."""

    draws: Count = 32
    """Maximum number of scenes in which a lift is rehearsed [1]: the extracted shapes, and samples of their
    uncertainty. 24 without a disturbance bound the risk to 0.02."""
    risk: Share = 0.02
    """Maximum probability that a safe lift moves another object [1]; with 0, no lift is safe."""
    max_objects: Count = 300
    """Maximum number of objects within 4 cm of each other [1]; 300 take 0.6 GB per thread, 1,000 4.7 GB."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class GripperConfig:
    """The gripper that lifts; its dimensions are those of a common wide two-finger gripper."""

    kind: GripperKind = "none"
    """Parallel jaw or suction disc; with none, every object can be grasped."""
    opening: HandSize = 0.14
    """Maximum opening of a parallel jaw [m]."""
    finger: HandSize = 0.014
    """Thickness of a finger along the closing direction, and half of its breadth [m]."""
    length: HandSize = 0.06
    """Length of the fingers, or of the tube behind the disc [m]."""
    hand: HandSize = 0.08
    """Length of the hand behind them, and its depth across the closing direction [m]."""
    breadth: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Breadth of the hand along the closing direction [m], at least the opening and both fingers."""
    turn: Annotated[float, Field(ge=-180.0, le=180.0)] = 0.0
    """Angle about the approach from the closing direction to the x axis of the gripper's own frame [deg]."""
    disc: HandSize = 0.015
    """Radius of a suction disc [m]."""
    tilt: Acute = 60.0
    """Maximum angle between approach and straight down [deg]; flatter, the wrist hits the table."""
    clearance: HandSize = 0.005
    """Minimum distance from other objects, and of an open finger from its object [m]: the error of a fit."""
    travel: HandSize = 0.1
    """Length of the straight approach, and of the lift along which the gripper touches nothing [m]."""
    seen: Share = 0.95
    """Minimum share of the space along the approach that was seen to be free [1]; the rest is noise."""

    @property
    def title(self) -> str:
        """What lifts, such as `with a franka gripper, opening 80 mm`; empty without a gripper."""
        known = {} if self == GripperConfig(kind=self.kind) else GRIPPERS
        name = next((name for name, gripper in known.items() if gripper == self), self.kind)
        jaw = f", opening {1e3 * self.opening:.0f} mm" if self.kind == "parallel" else ""
        return "" if self.kind == "none" else f"with a {name} gripper{jaw}"


Gripper = GripperConfig
"""`GripperConfig`, as `caryatid` exports it."""
GRIPPERS: dict[str, GripperConfig] = {
    # Fingers and hand of its URDF; `panda_hand_tcp` closes along y.
    "franka": GripperConfig(kind="parallel", opening=0.08, length=0.045, breadth=0.204, turn=90.0),
    "robotiq-85": GripperConfig(kind="parallel", opening=0.085),
    "robotiq-140": GripperConfig(kind="parallel", opening=0.14),
    "so-101": GripperConfig(kind="parallel", opening=0.09, finger=0.01, hand=0.06),
}
"""Grippers by name; what is not known of one is as by default."""


def choose_gripper(name: str, other: GripperConfig) -> GripperConfig:
    """Return the gripper of a name in `GRIPPERS`, or another one with the name as its kind."""
    kind: Any = name
    return GRIPPERS.get(name) or replace(other, kind=kind)


@dataclass(frozen=True, slots=True, config=CHECKED)
class Config:
    """All stages."""

    cloud: CloudConfig = field(default_factory=CloudConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    explanation: ExplanationConfig = field(default_factory=ExplanationConfig)
    completion: CompletionConfig = field(default_factory=CompletionConfig)
    plausibility: PlausibilityConfig = field(default_factory=PlausibilityConfig)
    support: SupportConfig = field(default_factory=SupportConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    voxels: VoxelConfig = field(default_factory=VoxelConfig)
    active: ActiveVisionConfig = field(default_factory=ActiveVisionConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
    arm: ArmConfig = field(default_factory=ArmConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    rehearsal: RehearsalConfig = field(default_factory=RehearsalConfig)
    gripper: GripperConfig = field(default_factory=GripperConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    oracle: OracleConfig = field(default_factory=OracleConfig)
    session: SessionConfig = field(default_factory=SessionConfig)

    @classmethod
    def paper(cls) -> Config:
        """The settings of the paper, without the changes that the defaults make to it.

        Eq. 1 over contact points, without the centre of mass (III-A); vertices matched by shape and the union
        of graphs (III-B, Table I); eqs. 2 and 3 as printed (IV); poses as given; shapes as fitted.
        """
        return cls(
            registration=RegistrationConfig(enabled=False),
            completion=CompletionConfig(enabled=False),
            plausibility=PlausibilityConfig(rounds=0),
            support=SupportConfig(stability="area"),
            fusion=FusionConfig(matching="shapes", keep_share=0.0),
            active=ActiveVisionConfig(
                saliency="paper", edge_point="midpoint", path_cost="angle", stop="unchanged"
            ),
        )
