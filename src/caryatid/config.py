"""Every tunable number of caryatid, one frozen dataclass a stage; the paper's values where it gives them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

FusionMethod = Literal["pc", "sg", "pc+sg"]
SegmentationMethod = Literal["labels", "auto"]
NoiseModel = Literal["none", "carmine"]


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """From depth image to oriented points."""

    max_depth: float = 3.0
    """Readings beyond this are dropped [m]; the paper's working range."""
    min_depth: float = 0.35
    """Readings nearer than the sensor's near limit are dropped [m]."""
    normal_window: int = 7
    """Side of the square window normals are estimated over [px]; 7 px is 2 cm at 1.5 m with f = 525 px."""
    edge_jump: float = 0.01
    """A depth step between neighbours beyond this, at 1 m and growing with z², parts two surfaces [m]."""
    max_slope: float = 0.004
    """Change of inverse depth within one surface beyond edge_jump [1/m per px]; a tilt of 80° at 2.7 m."""
    voxel: float = 0.005
    """Spacing the pooled points of an object are thinned to [m]; about the noise of one reading at 1.5 m."""
    neighbours: int = 16
    """Neighbours a normal of an unorganised cloud is estimated from."""


@dataclass(frozen=True, slots=True)
class SurfaceConfig:
    """The support surface (table top)."""

    iterations: int = 400
    """RANSAC hypotheses a plane [1]; 400 find a plane of 20 % of the points with confidence 0.96."""
    sample: int = 4000
    """Points the hypotheses are scored on [1]; spread evenly over the cloud."""
    tolerance: float = 0.01
    """Distance within which a point belongs to the plane [m]; 3σ of the sensor at 1.8 m."""
    max_tilt: float = 10.0
    """How far the normal may lean from the vertical where the view has a pose [deg]."""
    max_deviation: float = 25.0
    """How far a point's normal may lean from its plane's [deg]; 3σ of normals from depth."""
    planes: int = 6
    """Horizontal planes looked at, largest first, before the table is chosen [1]."""
    cell: float = 0.03
    """Grid on a plane its area is measured by [m]; above the points' spacing at 3 m."""
    gap: float = 0.3
    """Parts of one plane further apart than this are two surfaces [m]; shadows of objects are narrower."""
    min_area: float = 0.05
    """Seen area a table has at least [m²]; more than most objects' tops."""
    storey: float = 0.3
    """A plane that has a table this far above it is the floor [m]."""
    storey_share: float = 0.05
    """Points the table above a floor has at least, as a share of the floor's; less is a shelf far behind."""
    min_points: int = 200
    """Fewer inliers are no table [points]."""
    max_points: int = 20_000
    """Points of a view the surface is looked for in [1]; spread evenly, they give its height to 0.1 mm."""
    search: float = 0.05
    """Once known, the table is looked for within this height of itself [m]; 5σ of registration and tilt."""
    spacing: float = 0.02
    """Spacing its points are kept at for later views [m]."""
    thickness: float = 0.04
    """Thickness of the box the table top is modelled by [m]; only its top counts."""


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """Refining the reported pose of a view against what is known."""

    enabled: bool = True
    """Refine at all."""
    iterations: int = 12
    """Rounds of matching at the most [1]."""
    translation: float = 0.01
    """Expected error of a reported pose at the table [m]: 5 mm, and 0.3° over the 1.5 m to the camera."""
    rotation: float = 0.4
    """Expected error of a reported orientation, per axis [deg]."""
    noise: float = 0.02
    """Expected distance of one matched point to its partner's plane [m]; neighbouring points err alike, so it
    stands for about 40 of them with 3 mm each."""
    reach: float = 0.03
    """Partners further away are none [m]; 3σ of the expected error."""
    min_cosine: float = 0.8
    """Cosine of the angle between the normals of partners at least [1]."""
    outlier: float = 0.01
    """Distances beyond this lose their weight [m]."""
    min_points: int = 150
    """Fewer matched points determine no pose [1]."""
    max_translation: float = 0.05
    """A longer move is refused [m]; 5σ."""
    max_rotation: float = 2.0
    """A larger turn is refused [deg]; 5σ."""


@dataclass(frozen=True, slots=True)
class SegmentationConfig:
    """Automatic parts by local convexity."""

    stride: int = 2
    """Pixels between samples of the organised image; 2 keeps 6 mm at 1.5 m."""
    margin: float = 0.05
    """Points further than this outside the support surface's outline belong to no object on it [m]."""
    edge_jump: float = 0.006
    """A sample further than this from its neighbour's plane is another surface's [m], at 1 m and times z²."""
    max_jump: float = 0.009
    """A depth step between samples beyond this parts two surfaces, however steep [m], at 1 m and times z²."""
    surfel: float = 0.015
    """Size of the patches whose edges are judged convex or concave [m]; four times the noise at 1.5 m."""
    crease: float = 4.0
    """What a turn of the normal by 90° adds to a path on the surface [surfels]; surfels end at edges."""
    step: float = 0.005
    """Height of one surfel over its neighbour's plane beyond which they are two layers [m]."""
    neighbours: int = 10
    """Nearest points a point of an unorganised cloud is joined to [1]."""
    reach: float = 0.012
    """Points of an unorganised cloud further apart are not joined [m]; twice the usual thinning."""
    concavity: float = 15.0
    """Angle between normals beyond which a concave edge parts two surfaces [deg]; LCCP's 10 and noise."""
    min_size: int = 40
    """Samples a part needs to be an object [points]."""
    min_width: float = 0.015
    """A part narrower than this beside a larger one belongs to it [m]; normals are blurred so far."""
    normal_size: float = 0.013
    """Side of the window normals are estimated over, at the objects' median distance [m]."""
    clearance: float = 0.008
    """Points nearer to the support surface than this belong to it [m]; 2σ of the sensor at 1.5 m."""
    max_height: float = 0.6
    """Points higher above the table belong to no object on it [m]; table-top sizes."""
    overlap: float = 0.3
    """Share of a part's points that must lie at an object's points or shape for it to be that object [1]."""
    divide_share: float = 0.1
    """A part is divided among the known objects at which at least this share of its points lies [1]."""
    overlap_reach: float = 0.02
    """Distance within which a point lies at an object [m]; 2σ of registration error of both views."""
    same_share: float = 0.7
    """Share of an object's points that must lie inside another's shape for the two to be one [1]."""


@dataclass(frozen=True, slots=True)
class FitConfig:
    """Primitive fitting."""

    hypotheses: int = 100
    """RANSAC hypotheses a shape at the most [1]; the predecessor's iterations."""
    confidence: float = 0.99
    """RANSAC stops when a better sample is less likely than 1 − confidence."""
    max_points: int = 800
    """Points a fit looks at [1]; more change sizes by less than the noise and cost time in proportion."""
    min_points: int = 12
    """Fewer points are no object [1]; a box has nine parameters."""
    threshold: float = 0.01
    """MSAC truncation of the distance to the surface [m]; 2σ of registration error."""
    polish: int = 3
    """Best hypotheses of each shape that are refined by least squares."""
    steps: int = 25
    """Least-squares steps at the most."""
    max_extent: float = 0.5
    """Longest extent of an object on a table [m]."""
    min_extent: float = 0.008
    """Shortest extent [m]; below the sensor's resolution."""
    max_radius: float = 0.15
    """Largest radius of cylinder and sphere [m]."""
    size_penalty: float = 0.0125
    """Added to the mean residual [m] per square metre of mean squared extent: 1.25e-4·size² (size in dm)."""
    shrink: float = 2e-5
    """Pull on every extent [m]: a face that holds a share s of the points is moved in by shrink / (2·s)."""
    trim: float = 0.005
    """Share of the points beyond each end of an extent that count as noise [1]."""
    side_share: float = 0.02
    """Share of the points that must lie on a side for it to count as seen [1]."""
    normal_weight: float = 0.004
    """What a normal turned by 90° costs in model choice [m]: as much as half the registration error."""
    bare_weight: float = 0.003
    """What seen sides without any point near them cost in model choice [m]; a share of them in proportion."""
    bare_spacing: float = 0.008
    """Spacing of the samples that look for points near a side [m]; 2 to 3 pixels at 1.5 m."""
    max_residual: float = 0.008
    """Mean distance beyond which none of the shapes explains the object [m]: `poor_fit`."""


@dataclass(frozen=True, slots=True)
class SplitConfig:
    """Parting what automatic segmentation took for one object."""

    min_residual: float = 0.003
    """Mean distance to the best single shape from which on a cut is tried [m]; noise alone leaves 2 mm."""
    gain: float = 0.6
    """A cut must bring the mean distance below this share of the single shape's [1]."""
    cuts: int = 7
    """Cuts tried along each direction [1]; an eighth of the points apart."""
    sample: int = 250
    """Points of a side a cut is first judged by [1]."""
    min_points: int = 40
    """Points a side needs [1]; three times what a shape needs."""
    reach: float = 0.02
    """Points further apart are not connected [m]; four times their spacing."""


@dataclass(frozen=True, slots=True)
class CompletionConfig:
    """How far shapes reach down where nobody looked."""

    max_tilt: float = 30.0
    """An unseen side that faces down within this angle may be extended [deg]; what rests on a face does."""
    step: float = 0.01
    """Step of the extension [m]; a voxel."""
    spacing: float = 0.015
    """Spacing of the points tested on the moving side [m]."""
    inset: float = 0.01
    """How far inside the walls free space is looked for [m]; a voxel, so that a wall's noise says nothing."""
    overlap: float = 0.004
    """How deep the moving side may enter another shape [m]; the fits' uncertainty."""
    flat: float = 0.02
    """Extent below which a single side's points say nothing of the depth behind it [m]; their noise."""
    least: float = 0.0005
    """Gaps below this are none [m]."""
    max_free: float = 0.15
    """The extension ends where more of its rim lies in voxels seen free [1]; half of one side of four."""


@dataclass(frozen=True, slots=True)
class SupportConfig:
    """Support relations, section III-A."""

    contact_margin: float = 0.005
    """Gap up to which two shapes are in contact [m]; 1σ of the gap between two fits each 3 mm off."""
    reach: float = 0.012
    """Gap up to which a contact is believed where an object would tip without it [m]; 2.5σ of the same."""
    gentle_tilt: float = 25.0
    """Planes steeper than this, where nothing overlaps, carry only what would tip without them [deg]."""
    max_tilt: float = 75.0
    """Separating planes steeper than this carry nothing [deg]: the normal is too near the horizontal."""
    patch_depth: float = 0.003
    """Surface this near to the first contact counts as touching [m]; the noise of one reading at 1.5 m."""
    patch_tilt: float = 1.0
    """The same for faces that a fit turned against each other [deg]; a ball has none."""
    min_area_ratio: float = 0.1
    """r_s,min of eq. 1."""
    overhang: float = 0.003
    """A centre of mass this far outside the support polygon tips [m]; 1σ of a fit's position."""
    lean_angle: float = 75.0
    """Widest angle between a sideways push and the direction straight against an object's tipping [deg]."""
    top_down: Literal["paper", "balance"] = "balance"
    """All that rests on an unstable object holds it (`paper`), or only what weighs against its tipping."""
    max_drop: float = 0.04
    """How far below an unsupported object its supporter may lie, hidden gap between them [m]."""


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """Fusing graphs over views, section III-B."""

    method: FusionMethod = "pc+sg"
    """What is fused: points (`pc`), graphs (`sg`) or both (Table I)."""
    max_distance: float = 0.05
    """Centres further apart are two objects [m], beside half the smaller object's size."""
    max_angle: float = 20.0
    """Axes further apart are two orientations [deg], up to the shape's symmetry."""
    max_ratio: float = 1.6
    """Sorted extents that differ by more than this factor are two objects."""
    settled: float = 0.005
    """A shape that moves, grows or turns by less than this has not changed [m]; σ of registration error."""
    keep_share: float = 0.5
    """A support is kept while occurrences / opportunities is at least this."""


@dataclass(frozen=True, slots=True)
class VoxelConfig:
    """The voxel map for the occlusion test."""

    size: float = 0.01
    """Edge of a voxel [m]; the paper's leaf size."""
    extent: tuple[float, float, float] = (1.6, 1.6, 1.0)
    """Size of the map around the view sphere's centre [m]: a table with its margin."""
    below: float = 0.1
    """How far the map reaches below the sphere's centre [m]."""
    stride: int = 2
    """Pixels between the rays that are followed; 2 is 6 mm at 1.5 m, below the voxel's size."""
    margin: float = 0.01
    """Length before a reading that a ray does not clear [m]; depth noise within it carves no surface."""
    hit: float = 0.7
    """Occupancy one view with a reading in a voxel speaks for [1]; the usual sensor model."""
    miss: float = 0.4
    """Occupancy one view that looks through a voxel speaks for [1]; the usual sensor model."""


@dataclass(frozen=True, slots=True)
class ActiveVisionConfig:
    """Points of interest, view sphere and the choice of the next view, section IV."""

    sphere_points: int = 40_000
    """Points the view sphere is discretised to; the paper's."""
    sphere_radius: float = 1.5
    """Radius of the view sphere [m]; the paper's."""
    saliency_weight: float = 0.75
    """λ_s of eq. 2; the paper's."""
    saliency: Literal["paper", "decreasing"] = "decreasing"
    """Eq. 2 with 2π as printed, or with π so that relations seen often matter less."""
    edge_point: Literal["midpoint", "contact"] = "contact"
    """Where a relation's point of interest lies: the middle of the centres, or the contact patch."""
    spread: float = 20.0
    """Angle on the sphere at which saliency has fallen to exp(−½) [deg]."""
    occlusion: bool = True
    """Invert the saliency of a candidate from which the point of interest is hidden."""
    inhibition: float = 1.0
    """Depth of the negative bump at every visited view [1]."""
    path_cost: Literal["angle", "path", "none"] = "angle"
    """h of eq. 3: sin(α/2), the path over the floor in sphere diameters, or nothing."""
    max_views: int = 10
    """Views at the most, the first one too; the paper's."""
    clearance: float = 0.05
    """Neighbourhood of a point of interest that its line of sight leaves first [m]; half a common object."""
    look_directions: int = 1200
    """Directions on the whole sphere the planner `support` looks in [1]; about 6° apart."""
    surface_samples: int = 400
    """Points on the fitted shapes the planner `support` tests for being seen [1]."""
    sample_clearance: float = 0.025
    """Length of a surface point's line of sight that does not count [m]; its own surface, 2½ voxels."""
    good_incidence: float = 60.0
    """A surface met at less than this from its normal is seen as well as can be [deg]."""
    space_spacing: float = 0.04
    """Spacing of the points in unseen space the planner `support` tests for being seen [m]."""
    space_weight: float = 1.0
    """Worth of all the space on the table against all the objects' surfaces [1]."""
    relation_weight: float = 0.1
    """Worth of all relations' points of interest against all the objects' surfaces [1]."""
    view_cone: float = 30.0
    """Angle from the optical axis within which a point is in the image [deg]; 57° × 43° sensor."""


@dataclass(frozen=True, slots=True)
class RobotConfig:
    """The simulated humanoid: holonomic platform, torso lift, head with yaw and pitch."""

    footprint: float = 0.35
    """Radius of the platform's disc [m]."""
    camera_height: tuple[float, float] = (1.30, 1.90)
    """Lowest and highest camera centre over the floor [m], by the torso lift."""
    pitch: tuple[float, float] = (-60.0, 20.0)
    """Head pitch, down to up [deg]."""
    yaw: tuple[float, float] = (-80.0, 80.0)
    """Head yaw against the platform [deg]."""
    camera_forward: float = 0.1
    """How far the camera stands before the platform's centre [m]."""
    cell: float = 0.05
    """Edge of a cell of the floor grid [m]."""
    floor: float = 3.0
    """Half the side of the square of floor the robot may use, around the table [m]."""
    head_yaws: int = 9
    """Head yaws tried within the limits, straight ahead first, to stand clear of an obstacle."""
    max_roll: float = 0.5
    """Camera roll beyond this cannot be reached, the head has no third joint [deg]."""
    step: float = 0.02
    """Anything on the floor lower than this is no obstacle to the platform [m]."""
    head_room: float = 0.15
    """What the head needs above the highest camera centre [m]; higher obstacles do not hinder."""
    table_margin: float = 0.1
    """Obstacles met this near to the sphere's centre are the table, not a wall in the line of sight [m]."""
    home: tuple[float, float] = (180.0, 35.0)
    """Azimuth and elevation on the view sphere of the first view [deg]."""


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """The simulated depth camera: a Carmine 1.09's image."""

    width: int = 640
    """Image width [px]."""
    height: int = 480
    """Image height [px]."""
    focal: float = 525.0
    """Focal length [px]; the driver's nominal value."""
    far: float = 10.0
    """Surfaces deeper than this are not seen at all [m]; noise cuts readings to the sensor's own range."""
    light: tuple[float, float, float] = (-0.4, 0.3, 0.87)
    """Direction towards the lamp in the world; off the vertical, so that faces of a box differ."""
    ambient: float = 0.45
    """Share of a surface's colour that shows without the lamp [1]."""


@dataclass(frozen=True, slots=True)
class PhysicsConfig:
    """Settling a simulated scene and asking physics what holds up what, method notes section 4."""

    rest_window: float = 0.25
    """Time over which an object must stay where it is to be at rest [s]."""
    rest_distance: float = 0.001
    """Movement within the window that still is rest [m]; soft contacts creep up to 3 mm/s."""
    rest_angle: float = 1.0
    """Rotation within the window that still is rest [deg]."""
    settle_time: float = 6.0
    """After this long a scene is taken as it is, at rest or not [s]."""
    force_window: float = 0.2
    """Contact forces are averaged over this long [s]; soft contacts creep, longer ones drift."""
    force_share: float = 0.03
    """Least upward part of a contact force on an object that supports it, as a share of its weight [1]."""
    removal_time: float = 1.0
    """How long the others are watched after an object is taken away [s]."""
    moved: float = 0.01
    """An object displaced by more than this has moved [m]."""
    turned: float = 8.0
    """An object turned by more than this has moved [deg]."""
    lean_angle: float = 30.0
    """A force nearer to the horizontal than this leans, a steeper one that points down presses [deg]."""
    disturbed: float = 0.02
    """`removal` lists what is displaced by more than this [m]: it slid or fell, and did not merely settle."""
    disturbed_turn: float = 15.0
    """`removal` lists what is turned by more than this [deg]."""


@dataclass(frozen=True, slots=True)
class GenerationConfig:
    """Random table-top scenes: sizes of objects, how they are set down, screens and walls."""

    box_edge: tuple[float, float] = (0.045, 0.14)
    """Shortest and longest edge of a box [m]; what a hand takes from a table."""
    radius: tuple[float, float] = (0.022, 0.045)
    """Radius of cylinders and balls [m]."""
    height: tuple[float, float] = (0.05, 0.13)
    """Height of cylinders [m]."""
    mixture: tuple[float, float, float] = (0.6, 0.25, 0.15)
    """Shares of boxes, cylinders and balls [1]."""
    stacked: float = 0.7
    """Share of a pile's objects that are set down on another one [1]."""
    jitter: float = 0.3
    """How far off the middle of the one below an object is set down, as a share of its half extent [1]."""
    gap: float = 0.002
    """Height over what is below from which an object is let go [m]."""
    margin: float = 0.06
    """Objects are set down at least this far from the table's edge [m]."""
    tries: int = 10
    """Times an object is set down anew while it falls off, rolls away or upsets others; then the one before
    it is taken up again as well."""
    patience: int = 40
    """Objects set down, for each that is wanted, before a scene is given up."""
    rest_time: float = 2.0
    """An object that has not come to rest after this long is set down anew [s]."""
    lying: float = 0.3
    """Share of upright objects that are laid on their side, for cylinders [1]."""
    settling: float = 0.3
    """Time an object is given before rest is asked for [s]."""
    brink: float = 0.01
    """An object whose middle is nearer to the table's edge than this has as good as fallen [m]."""
    max_height: float = 0.36
    """Nothing is set down so that it reaches higher over the table top [m]."""
    upset: float = 0.04
    """Setting an object down may shift a pile's others, or a heap's screens, by this much [m]."""
    heap_radius: float = 0.12
    """Radius of the heap of a dense scene of 16 [m]; it grows with the root of the number beyond that."""
    heap_tilted: float = 0.3
    """Share of a heap's objects that are dropped in any attitude and not upright [1]."""
    screens: tuple[int, int] = (2, 4)
    """Least and largest number of screens around the heap."""
    screen_distance: tuple[float, float] = (0.2, 0.27)
    """Distance of the screens from the heap's middle [m]."""
    screen_width: tuple[float, float] = (0.12, 0.18)
    """Width of a screen [m]."""
    screen_height: tuple[float, float] = (0.23, 0.32)
    """Height of a screen [m]; taller than most of the heap."""
    screen_thickness: float = 0.05
    """Thickness of a screen [m]; stands firm, hides well."""
    walls: tuple[int, int] = (1, 2)
    """Least and largest number of walls beside the table."""


@dataclass(frozen=True, slots=True)
class NoiseConfig:
    """Carmine 1.09 depth noise and registration error, method notes section 2."""

    axial: tuple[float, float, float] = (0.0012, 0.0019, 0.4)
    """(a, b, z0) of σ(z) = a + b·(z − z0)² [m]."""
    disparity_step: float = 0.00285
    """Depth is quantised in equal steps of 1/z [1/m]: 1/8 px of disparity, f = 580 px, baseline 75 mm."""
    grazing: float = 80.0
    """No return where the surface is turned away by more than this [deg]."""
    range: tuple[float, float] = (0.35, 3.0)
    """Nearest and farthest reading [m]."""
    edge_jump: float = 0.03
    """No return at pixels beside a depth step larger than this [m]."""
    translation: float = 0.005
    """σ of the registration error's translation, each view [m]."""
    rotation: float = 0.3
    """σ of the registration error's rotation, each view [deg]."""


@dataclass(frozen=True, slots=True)
class ReportConfig:
    """The pictures of the report; nothing here changes a result."""

    image_width: int = 640
    """Width camera images are reduced to [px]; a report of ten views stays below 8 MB."""
    jpeg_quality: int = 82
    """Quality of camera images, 1 … 95."""
    cloud_width: int = 720
    """Width of the pictures of the cloud [px]."""
    cloud_points: int = 200_000
    """Points drawn at the most, evenly picked; 0.1 s."""
    point_size: float = 0.0075
    """Side of a point as drawn [m], the surface's twice that; half more than the spacing leaves no gaps."""
    sphere_width: int = 260
    """Width of the painted view sphere [px]; one cell of 40,000 is 2 px."""
    hidden: float = 0.02
    """A line further than this behind what is seen is drawn as hidden [m]; registration error and noise."""


@dataclass(frozen=True, slots=True)
class EvaluationConfig:
    """Scores against a truth, method notes section 5."""

    min_iou: float = 0.5
    """Volumes or masks that overlap by at least this are the same object [1]."""
    table_tolerance: float = 0.02
    """The table is found when its top is within this of the true height [m]."""
    samples: int = 10_000
    """Points the overlap of two volumes is measured with [1]; σ is at most 0.01, 0.005 for most pairs."""


@dataclass(frozen=True, slots=True)
class Config:
    """All stages."""

    cloud: CloudConfig = field(default_factory=CloudConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    completion: CompletionConfig = field(default_factory=CompletionConfig)
    support: SupportConfig = field(default_factory=SupportConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    voxels: VoxelConfig = field(default_factory=VoxelConfig)
    active: ActiveVisionConfig = field(default_factory=ActiveVisionConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
