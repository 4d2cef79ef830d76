"""Every setting of caryatid: one frozen dataclass per stage, with unit and reason of each value.

A value outside its range raises `pydantic.ValidationError`. Values are the paper's where it gives them.
"""

from __future__ import annotations

from dataclasses import field
from math import inf, prod
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo
from pydantic.dataclasses import dataclass

from caryatid.config.choices import FusionMethod, MaskIdentity, ShapeKind

CHECKED = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


def _rising(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] > values[1]:
        raise ValueError("values should be in rising order")
    return values


def _few_voxels(extent: tuple[float, float, float], info: ValidationInfo) -> tuple[float, float, float]:
    size, most = info.data.get("size", inf), info.data.get("max_voxels", inf)
    if (voxels := prod(length / size for length in extent)) > most:
        need = f"{voxels:.3g} voxels of {size} m take {2e-9 * voxels:.3g} GB"
        raise ValueError(f"{need}, voxels.max_voxels = {most} are allowed")
    return extent


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Likelihood = Annotated[float, Field(gt=0, lt=1)]
"""A probability that is neither impossible nor certain: its odds are finite."""
Factor = Annotated[float, Field(ge=1)]
Angle = Annotated[float, Field(ge=0, le=180)]
Acute = Annotated[float, Field(ge=0, lt=90)]
"""An angle whose cosine is divided by."""
Elevation = Annotated[float, Field(ge=-90, le=90)]
Azimuth = Annotated[float, Field(ge=-360, le=360)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
WholeNumber = Annotated[int, Field(ge=0, le=1_000_000_000)]
Lengths = Annotated[tuple[Positive, Positive], AfterValidator(_rising)]
"""Smallest and largest length."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class CloudConfig:
    """From depth image to oriented points."""

    max_coordinate: Positive = 1e4
    """Maximum depth and coordinate of a camera [m]; beyond it, units are wrong."""
    max_depth: Positive = 3.0
    """Readings beyond this are dropped [m]; the paper's working range."""
    min_depth: NotNegative = 0.1
    """Nearer readings are the robot's own hand [m]; below any sensor's range."""
    normal_window: Count = 7
    """Largest side of the square window of the local planes [px]; 7 × 7 reduces the noise to a quarter."""
    normal_size: Positive = 0.02
    """The same on the surface at the median distance [m]: 7 px at 1.5 m with f = 525 px; fewer in coarse
    images, where 7 px would span an object."""
    edge_jump: NotNegative = 0.01
    """A larger depth step between neighbours separates two surfaces [m]; at 1 m, growing with z²."""
    max_slope: NotNegative = 0.004
    """Change of inverse depth within one surface beyond edge_jump [1/m per px]; a tilt of 80° at 2.7 m with
    f = 525 px. Grows with the size of the pixels in coarser images."""
    voxel: Positive = 0.005
    """Spacing of an object's points, pooled over views [m]; about the noise of one reading at 1.5 m."""
    depth: Count = 5
    """Points kept in a voxel that over twice as many views have shown [1]; their mean has half the noise."""
    neighbours: Count = 16
    """Neighbours from which a normal of an unorganised cloud is estimated [1]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SurfaceConfig:
    """The support surface (table top)."""

    tolerance: Positive = 0.01
    """Distance within which a point belongs to the plane [m]; 3σ of the sensor at 1.8 m."""
    max_tilt: Angle = 10.0
    """Maximum angle between its normal and the vertical, if the view has a pose [deg]."""
    max_deviation: Angle = 25.0
    """Maximum angle between the normals of a point and its plane [deg]; 3σ of normals from depth."""
    gap: Positive = 0.3
    """Parts of one plane farther apart than this are two surfaces [m]; shadows of objects are narrower."""
    min_area: NotNegative = 0.05
    """Minimum visible area of a table [m²]; larger than the top of most objects."""
    storey: NotNegative = 0.6
    """A plane this far below a table is the floor [m]; a smaller step is the top of an object."""
    min_points: Count = 200
    """Minimum number of inliers of a table [points]; a tenth of `min_area` at 5 mm."""
    search: Positive = 0.05
    """A known table is searched for within this height of its last place [m]; 5σ of registration and tilt."""
    spacing: Positive = 0.02
    """Spacing of its points kept for later views [m]; fine enough for its outline."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class RegistrationConfig:
    """Refining the reported poses of views against each other."""

    enabled: bool = True
    """Whether poses are refined."""
    translation: Positive = 0.01
    """Expected error of a reported position, per axis [m]; about twice the usual error."""
    rotation: Positive = 0.5
    """Expected error of a reported orientation, per axis, about the camera [deg]."""
    noise: Positive = 0.001
    """Expected distance of a patch to the plane of its match, beyond the spread of their readings [m]."""
    spacing: Positive = 0.01
    """Size of the patches of objects that readings are averaged over [m]; a dozen pixels at 1.5 m."""
    spacing_far: Positive = 0.03
    """Size of the patches of the support surface [m]."""
    sample: Count = 600
    """Patches of a view that are matched with another view [1]."""
    reaches: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.1, 0.05, 0.025)
    """Maximum distance of a match [m], coarse to fine."""
    min_points: Count = 100
    """Minimum number of matches that determine a pose [1]."""
    kept: Count = 12
    """Number of views that later ones are registered to, and that move too [1]; 30° apart on a circle."""
    max_translation: NotNegative = 0.1
    """A longer move is refused [m]."""
    max_rotation: Angle = 5.0
    """A larger turn is refused [deg]."""
    common: Share = 0.25
    """Minimum share of an unregistered view's points around the table that lie where earlier views saw
    something [1]: a third with the right pose, even from the other side; a fifth with a wrong one."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SegmentationConfig:
    """Automatic segmentation by local convexity."""

    stride: Count = 2
    """Pixels between samples of the organised image; 2 keeps 6 mm at 1.5 m."""
    margin: NotNegative = 0.05
    """Points farther than this outside the support surface's outline belong to no object on it [m]."""
    edge_jump: Positive = 0.006
    """A sample farther than this from its neighbour's plane is on another surface [m], at 1 m; times z²."""
    surfel: Positive = 0.015
    """Size of the patches whose edges are judged convex or concave [m]; four times the noise at 1.5 m."""
    crease: NotNegative = 4.0
    """Length that a turn of the normal by 90° adds to a path on the surface [surfels]."""
    step: NotNegative = 0.0035
    """Surfels higher than this over their neighbour's plane are another layer [m]; 2σ after smoothing."""
    reach: Positive = 0.012
    """Points of an unorganised cloud farther apart are not joined [m]; twice the usual spacing."""
    concavity: Angle = 15.0
    """A concave edge separates two surfaces beyond this angle between normals [deg]; LCCP's 10 plus noise."""
    rise: NotNegative = 0.01
    """Height over the tangent plane of another place of a segment from which the pair is concave [m]."""
    min_size: Count = 40
    """Minimum number of samples of a segment [points]."""
    min_width: NotNegative = 0.02
    """A segment narrower than this beside a larger one belongs to it [m]; creases are rounded by as much."""
    alike: Share = 0.4
    """Mean affinity from which parts are merged [1]: 0 a toss-up, 1 certain; 0.4 is a probability of 0.7."""
    merge_gap: NotNegative = 0.25
    """Segments are merged across a nearer object that hides at most this length between them [m]."""
    clearance: NotNegative = 0.008
    """Points nearer to the support surface than this belong to it [m]; 2σ of the sensor at 1.5 m."""
    max_height: Positive = 0.6
    """Points higher above the table belong to no object on it [m]; table-top sizes."""
    overlap: Share = 0.3
    """Share of a segment's points that must lie on an object for the two to be associated [1]."""
    overlap_reach: NotNegative = 0.02
    """Distance within which a point lies on an object [m]; 2σ of registration error of both views."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class MaskConfig:
    """Masks of a learned segmenter."""

    min_pixels: WholeNumber = 200
    """Minimum number of pixels of a mask [px], also after smaller masks are laid over it."""
    max_share: Share = 0.4
    """A mask that covers a larger share of the image is the table or the background [1]."""
    min_score: float = 0.0
    """Masks with a lower score are left out [the segmenter's unit]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class FitConfig:
    """Primitive fitting."""

    shapes: Annotated[tuple[ShapeKind, ...], Field(min_length=1)] = ("box", "cylinder", "sphere")
    """Shapes that are tried; the paper's three."""
    hypotheses: Count = 100
    """Maximum number of RANSAC hypotheses per shape [1]."""
    max_points: Count = 800
    """Points by which a shape is scored [1]; 1.5 cm apart on the largest objects."""
    search_points: Count = 250
    """Points used by the search, or up to twice as many [1]; the best hypotheses are refined on all."""
    min_points: Count = 12
    """Minimum number of points of an object [1]; a box has nine parameters."""
    threshold: Positive = 0.01
    """MSAC truncation of the distance to the surface [m]; 2σ of registration error."""
    polish: Count = 3
    """Best hypotheses of each shape that least squares refines [1]."""
    steps: WholeNumber = 25
    """Maximum number of least-squares steps [1]."""
    max_extent: Positive = 0.5
    """Longest extent of an object on a table [m]."""
    min_extent: Positive = 0.008
    """Shortest extent [m]; below the sensor's resolution."""
    max_radius: Positive = 0.15
    """Largest radius of cylinder and sphere [m]."""
    normal_weight: NotNegative = 0.004
    """Cost of a normal turned by 90° in model choice [m]: half the registration error."""
    correlated: Positive = 4.0
    """Neighbouring points that share one error [1]; depth is smoothed over 2 × 2 pixels."""
    registration: NotNegative = 0.002
    """Standard deviation of registration [m], which no number of points averages out."""
    rim: NotNegative = 0.003
    """Standard deviation of the points' border beside a depth edge [m]: one pixel at 1.5 m."""
    max_residual: Positive = 0.008
    """Mean distance beyond which no shape explains the object [m]: `poor_fit`."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SplitConfig:
    """Model split: one automatic segment may be several objects."""

    cuts: WholeNumber = 5
    """Cuts tried along each direction [1]; a sixth of the points apart."""
    rounds: WholeNumber = 3
    """Iterations of assigning points to the better shape and refitting both [1]."""
    min_points: Count = 20
    """Thinned points a side needs [1]; 1.5 times what a shape needs."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ExplanationConfig:
    """Description length of points explained by shapes, which decides between one object and two."""

    parameter_cost: NotNegative = 4.5
    """Cost of each parameter of a shape [nats]; each is known to a ninetieth of its range."""
    outlier: NotNegative = 4.0
    """Cost of a point that no shape explains [nats]; as likely as one 2.8σ off."""
    irregular: NotNegative = 1.4
    """Cost of a point on an object that no shape fits [nats]."""
    normal_weight: NotNegative = 4.0
    """Cost of a normal turned by 90° [nats]; normals, blurred over edges, are good to 30°."""
    reading: Positive = 0.0002
    """Area whose points share one error [m²]; half of the 2 cm square a registration error shows in."""
    sighted: NotNegative = 2.0
    """Cost of a point parted from others of its segment in a view [nats]; one in eight is not theirs."""
    border: NotNegative = 4.0
    """Cost of a point surrounded by the other object's, on a surface without a crease [nats]."""
    free_cost: NotNegative = 0.5
    """Cost of a voxel inside a shape that was seen free [nats]; four points off at 5 mm spacing."""
    usual: NotNegative = 0.9
    """Mean cost of the points around a point that is still well explained [nats]; 9 in 10 true shapes."""
    spacing: Positive = 0.008
    """Spacing the points are thinned to [m]; a third of the patch that shares one error."""
    reach: Positive = 0.03
    """Objects farther apart are never merged [m]; the width of an occluder's shadow."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class CompletionConfig:
    """Extension of shapes into the unseen space below them."""

    enabled: bool = True
    """Whether unseen sides are extended."""
    max_tilt: Angle = 30.0
    """An unseen side within this angle of facing down may be extended [deg]; only these rest on something."""
    step: Positive = 0.01
    """Step of the extension [m]; a voxel."""
    overlap: NotNegative = 0.004
    """Maximum penetration of the moving side into another shape [m]; the fits' uncertainty."""
    max_free: Share = 0.15
    """The extension ends where more of its rim lies in voxels seen free [1]; half of one side of four."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class PlausibilityConfig:
    """Correction of shapes that overlap or float."""

    rounds: WholeNumber = 3
    """Maximum number of corrections [1]; 0 leaves shapes as they were fitted."""
    touch: NotNegative = 0.001
    """Largest gap or overlap of two shapes in contact [m]; round edges, soft surfaces."""
    sigmas: NotNegative = 3.0
    """Standard deviations of a gap beyond which the fits' uncertainty does not explain it [1]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SupportConfig:
    """Support relations, section III-A."""

    contact_margin: NotNegative = 0.005
    """Gap up to which two shapes are in contact, even if both are certain [m]."""
    margin_sigma: NotNegative = 2.0
    """The same in standard deviations of the gap, if larger [1]; it misses one contact in forty."""
    max_margin: NotNegative = 0.01
    """Shapes farther apart are not in contact, even if they are uncertain [m]."""
    reach: NotNegative = 0.012
    """Gap up to which a contact is assumed where an object would tip without it [m]; 2.5σ of the gap."""
    gentle_tilt: Angle = 25.0
    """Steeper planes, where nothing overlaps, carry only what would tip without them [deg]."""
    max_tilt: Angle = 75.0
    """Steeper separating planes carry nothing [deg]: their normal is too close to the horizontal."""
    patch_depth: NotNegative = 0.003
    """Surfaces this close to the first contact also touch [m]; the noise of one reading at 1.5 m."""
    min_area_ratio: Share = 0.1
    """r_s,min of eq. 1 [1]."""
    overhang: NotNegative = 0.003
    """An object tips if its centre of mass is this far outside the support polygon [m]; 1σ of a fit."""
    stability: Literal["area", "balance"] = "balance"
    """When an object is unstable: by r_s of eq. 1 over its contact points (`area`, the paper's; all that is
    on it may hold it), or also by its centre of mass (`balance`; only what counters its tipping holds it)."""
    draws: Count = 12
    """Scenes drawn by the fits' uncertainty, for probabilities [1]: a share is right to 0.14 near a half."""
    force_share: Share = 0.03
    """Minimum share of an object's weight [1] that a supporter carries in a draw, as in the ground truth."""
    at_rest: Share = 0.05
    """Acceleration below which an object is at rest in a draw [g]: it closes a gap of at most 2 mm."""
    unexplained: Share = 0.1
    """Weight of a draw for an object that does not rest in it [1]: how often something unseen holds one."""
    friction: Lengths = (0.4, 1.0)
    """Sliding friction of each object is drawn from this range [1]: wood on cardboard to rubber on glass."""
    density: Lengths = (300.0, 1200.0)
    """Density of each object is drawn from this range [kg/m³]: half-empty packets to full bottles."""
    touch: Positive = 0.0005
    """Standard deviation of the gap of two shapes in contact [m]; round edges, soft surfaces."""
    max_drop: NotNegative = 0.04
    """Maximum hidden gap between an unsupported object and its supporter [m]; with 0 it stays unsupported."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class FusionConfig:
    """Fusing graphs over views, section III-B."""

    method: FusionMethod = "pc+sg"
    """What is fused: points (`pc`), graphs (`sg`) or both (Table I)."""
    matching: Literal["points", "shapes"] = "points"
    """How a known vertex is recognised: by its points, or as in the paper by its shape, pose and extent."""
    masks: MaskIdentity = "scene"
    """The number of a mask names an object in all views (`scene`), or a segment of one view (`per-view`)."""
    max_distance: NotNegative = 0.05
    """Centres farther apart, plus half the smaller object's size, are two objects [m]."""
    max_angle: Angle = 20.0
    """Axes at a larger angle are two orientations [deg], up to the shape's symmetry."""
    max_ratio: Factor = 1.6
    """Sorted extents that differ by more than this factor [1] are two objects."""
    settled: NotNegative = 0.005
    """A shape that moves, grows or turns by less than this is unchanged [m]; σ of registration error."""
    keep_share: Share = 0.5
    """A support is kept while occurrences / opportunities is at least this [1]; 0 is the union of Table I."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class VoxelConfig:
    """The voxel map for the occlusion test."""

    size: Positive = 0.01
    """Edge of a voxel [m]; the paper's leaf size."""
    max_voxels: Count = 64_000_000
    """Maximum number of voxels [1]: 25 times the defaults; a map of them takes 128 MB."""
    extent: Annotated[
        tuple[Positive, Positive, Positive], AfterValidator(_few_voxels), Field(validate_default=True)
    ] = (1.6, 1.6, 1.0)
    """Size of the map around the view sphere's centre [m]: a table with its margin."""
    below: NotNegative = 0.1
    """How far the map reaches below the sphere's centre [m]."""
    stride: Count = 2
    """Pixels between the rays that are followed; 2 is 6 mm at 1.5 m, below the voxel's size."""
    margin: NotNegative = 0.01
    """Distance before a reading that a ray leaves uncleared [m], so that depth noise carves no surface."""
    hit: Likelihood = 0.7
    """Occupancy that one view with a reading in a voxel implies [1]; the usual sensor model."""
    miss: Likelihood = 0.4
    """Occupancy that one view that looks through a voxel implies [1]; the usual sensor model."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ActiveVisionConfig:
    """Points of interest, view sphere and the choice of the next view, section IV."""

    sphere_points: Count = 40_000
    """Number of points of the view sphere [1]; the paper's."""
    sphere_radius: Positive = 1.5
    """Radius of the view sphere [m]; the paper's."""
    saliency_weight: Share = 0.75
    """λ_s of eq. 2 [1]; the paper's."""
    saliency: Literal["paper", "decreasing"] = "decreasing"
    """Eq. 2 with 2π as printed, or with π so that relations seen often count less."""
    edge_point: Literal["midpoint", "contact"] = "contact"
    """Where a relation's point of interest lies: the middle of the centres, or the contact patch."""
    occlusion: Literal["invert", "ignore"] = "invert"
    """Saliency of a hidden point: negated, as in the paper, or as if the point were visible."""
    propagation: bool = True
    """Whether saliency spreads to neighbouring views, as in the paper, or only the nearest view gets it."""
    spread: Positive = 20.0
    """Angle on the sphere at which saliency has fallen to exp(−½) [deg]."""
    inhibition: NotNegative = 1.0
    """Depth of the negative bump at every visited view [1]; 0 is no inhibition of return."""
    path_cost: Literal["angle", "path", "none"] = "path"
    """h of eq. 3: sin(α/2), the path in sphere diameters (it halves the distance travelled), or nothing."""
    stop: Literal["gain", "unchanged"] = "gain"
    """The loop ends when no view is expected to show more than its path costs (c = s − h of planner `support`
    is at most 0 everywhere), or, as in the paper, after a view that does not change the graph."""
    max_views: Count = 10
    """Maximum number of views, including the first; the paper's."""
    look_directions: Count = 1200
    """Maximum number of directions on the whole sphere that planners try [1]; about 6° apart."""
    effort: NotNegative = 0.05
    """Share of all unseen surface that is worth a path of one sphere diameter, for planner `support` [1]."""
    view_cone: Acute = 30.0
    """Angle from the optical axis within which a point is in the image [deg]; 57° × 43° sensor."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class RobotConfig:
    """The simulated humanoid: holonomic platform, torso lift, head with yaw and pitch."""

    footprint: Positive = 0.35
    """Radius of the platform's disc [m]."""
    camera_height: Lengths = (1.30, 1.90)
    """Lowest and highest camera centre over the floor [m], by the torso lift."""
    pitch: Annotated[tuple[Elevation, Elevation], AfterValidator(_rising)] = (-60.0, 20.0)
    """Head pitch, down to up [deg]."""
    yaw: Annotated[tuple[Azimuth, Azimuth], AfterValidator(_rising)] = (-80.0, 80.0)
    """Head yaw relative to the platform [deg]."""
    camera_forward: NotNegative = 0.1
    """Distance of the camera in front of the platform's centre [m]."""
    cell: Positive = 0.05
    """Edge of a cell of the floor grid [m]."""
    floor: Positive = 3.0
    """Half the side of the square of floor the robot may use, around the table [m]."""
    head_yaws: Count = 9
    """Number of head yaws tried to stand clear of an obstacle, straight ahead first [1]."""
    home: tuple[Azimuth, Elevation] = (180.0, 35.0)
    """Azimuth and elevation on the view sphere of the first view [deg]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ArmConfig:
    """An arm with a camera in its hand."""

    base: tuple[float, float, float] = (-0.5, 0.0, 0.0)
    """Position of a simulated arm from the middle of the table top [m]; 0.2 m beside a built-in table."""
    base_yaw: Azimuth = 0.0
    """Direction of its base's x axis, from the world's x towards y [deg]; 0 points to the table."""
    radius: Lengths = (0.4, 1.0)
    """Smallest and largest view sphere tried [m]; nearer, the camera meets objects on the table; farther, a
    common arm does not reach. Equal values fix the radius."""
    radius_views: Count = 400
    """Views tried on each sphere to choose a radius [1]; about 10° apart."""
    sphere_points: Count = 4000
    """Points of the view sphere [1]; about 3° apart, a tenth of the humanoid's since reachability is slow."""
    rolls: Count = 8
    """Rolls of the camera about its optical axis that are tried, level first [1]; 45° apart, 1 = level."""
    clearance: NotNegative = 0.15
    """Minimum height of the camera over the sphere's centre [m]; lower, the hand meets the table."""
    cell: Positive = 0.08
    """Edge of a cell of a sampled map [m]; finer ones need more samples, by the third power."""
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
    far: Positive = 10.0
    """Surfaces deeper than this are invisible [m]; noise limits readings to the sensor's own range."""
    light: tuple[float, float, float] = (-0.4, 0.3, 0.87)
    """Direction towards the lamp in the world; off the vertical, so that faces of a box differ."""
    ambient: Share = 0.45
    """Share of a surface's colour that shows without the lamp [1]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class NoiseConfig:
    """Carmine 1.09 depth noise and registration error, method notes section 2."""

    axial: tuple[NotNegative, NotNegative, NotNegative] = (0.0012, 0.0019, 0.4)
    """(a, b, z0) of σ(z) = a + b·(z − z0)² [m]."""
    disparity_step: Positive = 0.00285
    """Depth is quantised in equal steps of 1/z [1/m]: 1/8 px of disparity, f = 580 px, baseline 75 mm."""
    grazing: Angle = 80.0
    """Surfaces turned away by more than this give no return [deg]."""
    range: Lengths = (0.35, 3.0)
    """Nearest and farthest reading [m]."""
    edge_jump: NotNegative = 0.03
    """Pixels beside a larger depth step give no return [m]."""
    translation: NotNegative = 0.005
    """σ of the registration error's translation, each view [m]."""
    rotation: Angle = 0.3
    """σ of the registration error's rotation, each view [deg]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class PhysicsConfig:
    """Settling a simulated scene and deriving ground-truth support from physics, method notes section 4."""

    rest_window: Positive = 0.25
    """Time for which an object must stay in place to be at rest [s]."""
    rest_distance: Positive = 0.001
    """Movement within the window that still counts as rest [m]; soft contacts creep up to 3 mm/s."""
    rest_angle: Angle = 1.0
    """Rotation within the window that still counts as rest [deg]."""
    settle_time: NotNegative = 6.0
    """Maximum time to settle [s]; then a scene is used as it is, at rest or not."""
    force_share: NotNegative = 0.03
    """Minimum upward part of a contact force that supports an object, as a share of its weight [1]."""
    removal_time: Positive = 1.0
    """How long the others are observed after an object is removed [s]."""
    moved: NotNegative = 0.01
    """An object displaced by more than this has moved [m]."""
    turned: Angle = 8.0
    """An object turned by more than this has moved [deg]."""
    max_copies: Count = 1000
    """Maximum number of copies that one element of an MJCF file makes [1]; 1,000 settle in 4 s."""
    max_cells: Count = 4_000_000
    """Maximum number of cells of a height field and of pixels of a texture in an MJCF file [1]: 0.2 GB."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class EvaluationConfig:
    """Scores against a ground truth, method notes section 5."""

    min_iou: Share = 0.5
    """Minimum IoU of volumes or masks of the same object [1]."""
    table_tolerance: NotNegative = 0.02
    """Maximum error of the height of the table's top for the table to be found [m]."""
    samples: Count = 10_000
    """Points that measure the overlap of two volumes [1]; σ is at most 0.01, 0.005 for most pairs."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class OracleConfig:
    """The planner that knows the ground truth, method notes section 6."""

    candidates: Count = 32
    """Maximum number of views tried besides the default planner's [1]; about 20° apart, 0.7 s each."""
    stride: Count = 2
    """Pixels between the rays that look for true surface [1]; 6 mm at 1.5 m, below the cell's size."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ReportConfig:
    """The pictures of the report; nothing here changes a result."""

    image_width: Count = 640
    """Width to which camera images are reduced [px]; a report of four views stays below 3 MB."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class RecordingConfig:
    """Choice of the images and frames that become views."""

    max_pixels: Count = 16_000_000
    """Maximum number of pixels of any image [1]; bounds memory, at several times a depth camera's."""
    max_views: Count = 30
    """Maximum number of views [1]; those farthest apart are kept. A table needs 5 to 10."""
    min_distance: Positive = 0.10
    """Distance from which on a view is new, whatever its direction [m]; objects then show other sides."""
    min_angle: Annotated[float, Field(gt=0, le=180)] = 10.0
    """Turn from which on a view is new, wherever its camera is [deg]; objects then show other sides."""
    sharp_window: NotNegative = 0.5
    """Time within which frames are compared by sharpness [s]; they show nearly the same."""
    sharp_share: Share = 0.7
    """Minimum sharpness, as a share of the sharpest within the window [1]; it varies by 10 % at rest."""
    colour_gap: NotNegative = 0.02
    """Maximum time between a depth image and its colour [s]; just over half of 1/30 s."""
    pose_gap: Positive = 0.2
    """Maximum time between two poses that are interpolated [s]; robots send 10 a second."""
    min_readings: Likelihood = 0.1
    """Minimum share of pixels with a depth reading [1]; a camera too close to a surface has fewer."""
    far: Annotated[float, Field(gt=0, le=65)] = 10.0
    """Farther readings are left out [m]; beyond the range of RGB-D cameras."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class ExportConfig:
    """Data that other programs need and the scene model lacks."""

    density: Positive = 600.0
    """Density of objects [kg/m³]; that of the simulated scenes, wood or a filled carton."""
    friction: NotNegative = 0.8
    """Sliding friction of objects [1]; that of the simulated scenes."""
    corners: Annotated[int, Field(ge=8)] = 48
    """Corners of a cylinder's ends in meshes [1]; its radius is then right to 0.2 %."""
    max_objects: Count = 2000
    """Maximum number of objects [1]; MuJoCo takes 2 s for so many, and no more than about 4,000."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class SessionConfig:
    """Limits on the files a session takes, and on what a service keeps."""

    max_bytes: Count = 100_000_000
    """Maximum size of a file [bytes]; larger than any camera's image."""
    max_sessions: Count = 1000
    """Maximum number of sessions of a service [1]; their folders stay until removed by hand."""
    min_free: NotNegative = 1e9
    """With less free disk space, a service accepts nothing new [bytes]; other programs write there too."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class LiftConfig:
    """A lift straight up, and what counts as a disturbance of the other objects."""

    speed: Positive = 0.1
    """Speed of the lift [m/s]; a careful arm's."""
    watch: NotNegative = 2.0
    """How long the others are observed after the lift [s]; long enough for slow tipping."""
    moved: NotNegative = 0.02
    """An object displaced by more than this was disturbed [m]: it slid or fell, rather than settled."""
    turned: Angle = 15.0
    """An object turned by more than this was disturbed [deg]."""


@dataclass(frozen=True, slots=True, config=CHECKED)
class RehearsalConfig:
    """Lifts simulated with the extracted shapes before they are carried out."""

    draws: Count = 32
    """Maximum number of scenes in which a lift is rehearsed [1]: the extracted shapes, and draws from their
    uncertainty. 24 without harm show a risk of 0.02."""
    risk: Share = 0.02
    """Probability of moving another object up to which a lift is safe [1]; with 0, none is."""
    max_objects: Count = 300
    """Maximum number of objects [1]; MuJoCo reserves 0.6 GB a thread for 300, and 4.7 GB for 1,000."""


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
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    oracle: OracleConfig = field(default_factory=OracleConfig)
    session: SessionConfig = field(default_factory=SessionConfig)

    @classmethod
    def paper(cls) -> Config:
        """The settings of the paper; every departure of the defaults is left out.

        Eq. 1 over contact points, without the centre of mass (III-A); vertices matched by shape and the union
        of graphs (III-B, Table I); eqs. 2 and 3 as printed (IV); poses as they are given; shapes as they are
        fitted.
        """
        return cls(
            registration=RegistrationConfig(enabled=False),
            completion=CompletionConfig(enabled=False),
            plausibility=PlausibilityConfig(rounds=0),
            support=SupportConfig(
                stability="area", margin_sigma=0.0, reach=0.005, gentle_tilt=75.0, max_drop=0.0
            ),
            fusion=FusionConfig(matching="shapes", keep_share=0.0),
            active=ActiveVisionConfig(
                saliency="paper", edge_point="midpoint", path_cost="angle", stop="unchanged"
            ),
        )
