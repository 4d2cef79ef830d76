"""Settings of perception: from images to labelled points."""

from __future__ import annotations

from dataclasses import dataclass

from caryatid.config.ranges import Angle, Cosine, Count, NotNegative, Positive, Share, Stage, WholeNumber


@dataclass(frozen=True, slots=True)
class CloudConfig(Stage):
    """From depth image to oriented points."""

    max_depth: Positive = 3.0
    """Readings beyond this are dropped [m]; the paper's working range."""
    min_depth: NotNegative = 0.35
    """Readings nearer than the sensor's near limit are dropped [m]."""
    normal_window: Count = 7
    """Side of the square window of the local planes at the most [px]; 7 × 7 take the noise to a quarter."""
    normal_size: Positive = 0.02
    """The same on the surface at the median distance [m]: 7 px at 1.5 m with f = 525 px; fewer in coarse
    images, where 7 px would be an object."""
    edge_jump: NotNegative = 0.01
    """A depth step between neighbours beyond this, at 1 m and growing with z², parts two surfaces [m]."""
    max_slope: NotNegative = 0.004
    """Change of inverse depth within one surface beyond edge_jump [1/m per px]; a tilt of 80° at 2.7 m."""
    voxel: Positive = 0.005
    """Spacing the pooled points of an object are thinned to [m]; about the noise of one reading at 1.5 m."""
    depth: Count = 5
    """Points kept in a voxel once more than twice as many views have shown it [1]; their mean errs by less
    than half the noise of one."""
    neighbours: Count = 16
    """Neighbours a normal of an unorganised cloud is estimated from."""


@dataclass(frozen=True, slots=True)
class SurfaceConfig(Stage):
    """The support surface (table top)."""

    iterations: Count = 400
    """RANSAC hypotheses a plane [1]; 400 find a plane of 20 % of the points with confidence 0.96."""
    sample: Count = 4000
    """Points the hypotheses are scored on [1]; spread evenly over the cloud."""
    tolerance: Positive = 0.01
    """Distance within which a point belongs to the plane [m]; 3σ of the sensor at 1.8 m."""
    max_tilt: Angle = 10.0
    """How far the normal may lean from the vertical where the view has a pose [deg]."""
    max_deviation: Angle = 25.0
    """How far a point's normal may lean from its plane's [deg]; 3σ of normals from depth."""
    planes: Count = 6
    """Horizontal planes looked at, largest first, before the table is chosen [1]."""
    cell: Positive = 0.03
    """Grid on a plane its area is measured by [m]; above the points' spacing at 3 m."""
    gap: NotNegative = 0.3
    """Parts of one plane further apart than this are two surfaces [m]; shadows of objects are narrower."""
    min_area: NotNegative = 0.05
    """Seen area a table has at least [m²]; more than most objects' tops."""
    storey: NotNegative = 0.3
    """A plane that has a table this far above it is the floor [m]."""
    storey_share: Share = 0.05
    """Points the table above a floor has at least, as a share of the floor's [1]; less is a shelf behind."""
    min_points: Count = 200
    """Fewer inliers are no table [points]."""
    max_points: Count = 20_000
    """Points of a view the surface is looked for in [1]; spread evenly, they give its height to 0.1 mm."""
    max_points_known: Count = 5000
    """The same once the table is known [1]: as many of a first view's are the table's, the rest is floor."""
    search: Positive = 0.05
    """Once known, the table is looked for within this height of itself [m]; 5σ of registration and tilt."""
    spacing: Positive = 0.02
    """Spacing its points are kept at for later views [m]."""
    thickness: Positive = 0.04
    """Thickness of the box the table top is modelled by [m]; only its top counts."""


@dataclass(frozen=True, slots=True)
class RegistrationConfig(Stage):
    """Refining the reported poses of views against each other."""

    enabled: bool = True
    """Refine at all."""
    translation: Positive = 0.01
    """Expected error of a reported position, per axis [m]; the worst that is usual, twice the usual."""
    rotation: Positive = 0.5
    """Expected error of a reported orientation, per axis, about the camera [deg]."""
    noise: Positive = 0.001
    """Expected distance of one patch to its partner's plane beside the spread of their readings [m]."""
    independent: Share = 0.1
    """Share of the partners that err independently [1]: neighbouring patches err alike."""
    spacing: Positive = 0.01
    """Size of the patches of objects that readings are averaged over [m]; a dozen pixels at 1.5 m."""
    spacing_far: Positive = 0.03
    """Size of the patches of the support surface [m]."""
    min_readings: Count = 4
    """Patches of fewer readings are left out [1]: rims, and sides seen at a grazing angle."""
    min_share: Share = 0.33
    """Where few pixels make a patch, this share of what the fullest ones have will do [1]."""
    min_flatness: Share = 0.97
    """Length of the mean of a patch's normals at least [1]; less is an edge."""
    plane_rounds: WholeNumber = 4
    """Rounds of the robust fit of planes to sides [1]."""
    flat: Positive = 0.0015
    """Distance of a patch from its side's plane at which it counts a quarter in it [m]."""
    flat_share: Share = 0.7
    """Share of a side's patches that must lie in its plane for the side to be flat [1]."""
    min_side: NotNegative = 0.006
    """Standard deviation of a flat side's patches along its shorter direction at least [m]; 2 cm wide."""
    min_patches: Count = 6
    """Sides of fewer patches are left out [1]; blurred edges."""
    sample: Count = 600
    """Patches of a view that look for partners in another [1]."""
    descent: Count = 250
    """Patches that look for partners while a new view is laid onto all earlier ones together [1]; its pose is
    then made exact with the whole samples."""
    reaches: tuple[Positive, ...] = (0.1, 0.05, 0.025)
    """Partners further away are none [m], coarse to fine."""
    rounds: Count = 3
    """Rounds of matching at each reach [1]."""
    steps: WholeNumber = 4
    """Gauss-Newton steps between two rounds of matching at the most [1]."""
    converged: NotNegative = 0.1
    """Steps below this share of the distance at which partners lose their weight end a round, and the rounds
    [1]; what is left, the next reach or the joint solution takes."""
    normal_reach: Positive = 0.05
    """How far apart [m] directions at right angles count when partners are looked for, by 1/√2."""
    min_cosine: Cosine = 0.9
    """Cosine of the angle between the normals of partners at least [1]."""
    outlier: Positive = 0.3
    """Share of the reach beyond which distances lose their weight [1]."""
    min_points: Count = 100
    """Fewer partners determine no pose [1]."""
    exact: NotNegative = 0.0003
    """A view that fits better than this as reported is not moved [m]; exact ones leave 0.1 mm, noisy 1 mm."""
    settled: NotNegative = 0.0003
    """Views whose points would move less than this stay where they are [m]."""
    rematch: NotNegative = 0.002
    """Partners are looked for anew between views that moved by more than this against each other [m, rad];
    a quarter of the distance at which they lose their weight."""
    kept: Count = 12
    """Views that later ones are laid onto and that move with them [1]; 30° apart on a full turn."""
    max_translation: NotNegative = 0.1
    """A longer move is refused [m]."""
    max_rotation: Angle = 5.0
    """A larger turn is refused [deg]."""


@dataclass(frozen=True, slots=True)
class SegmentationConfig(Stage):
    """Automatic parts by local convexity."""

    stride: Count = 2
    """Pixels between samples of the organised image; 2 keeps 6 mm at 1.5 m."""
    margin: NotNegative = 0.05
    """Points further than this outside the support surface's outline belong to no object on it [m]."""
    edge_jump: Positive = 0.006
    """A sample further than this from its neighbour's plane is another surface's [m], at 1 m and times z²."""
    max_jump: Positive = 0.009
    """A depth step between samples beyond this parts two surfaces, however steep [m], at 1 m and times z²."""
    gap: WholeNumber = 3
    """Depth steps are looked for across this many samples without a reading [1]; they leave 2 px a side."""
    min_rise: NotNegative = 0.015
    """Height over a neighbour's plane from which a depth step repels [m]; above staircases on steep faces."""
    surfel: Positive = 0.015
    """Size of the patches whose edges are judged convex or concave [m]; four times the noise at 1.5 m."""
    crease: NotNegative = 4.0
    """What a turn of the normal by 90° adds to a path on the surface [surfels]; surfels end at edges."""
    step: NotNegative = 0.0035
    """Height of one surfel over its neighbour's plane beyond which they are two layers [m]; 2σ evened out."""
    neighbours: Count = 10
    """Nearest points a point of an unorganised cloud is joined to [1]."""
    reach: Positive = 0.012
    """Points of an unorganised cloud further apart are not joined [m]; twice the usual thinning."""
    concavity: Angle = 15.0
    """Angle between normals beyond which a concave edge parts two surfaces [deg]; LCCP's 10 and noise."""
    rise: NotNegative = 0.01
    """Height over the tangent plane of another place of a part from which the pair is concave [m]."""
    concave_share: Share = 0.2
    """Share of concave pairs between two clusters from which they are two bodies [1]."""
    least_surfels: Count = 10
    """Surfels a cluster needs for that to be asked [1]; fewer are bumps and flaws."""
    hollow: Cosine = 0.2
    """Mean cosine between normals and the way inwards that makes a patch the inside of something [1]; a
    bowl's has 0.6, flat faces and their noise 0.05."""
    rim: NotNegative = 0.025
    """Difference in height of the tops of an inside and of what it hangs in [m]; a rim's width and noise."""
    min_size: Count = 40
    """Samples a part needs to be an object [points]."""
    min_width: NotNegative = 0.02
    """A part narrower than this beside a larger one belongs to it [m]; creases are rounded so far."""
    normal_size: Positive = 0.013
    """Side of the window normals are estimated over, at the objects' median distance [m]."""
    plane_radius: Count = 5
    """Radius of the wider window the samples' tangent planes are evened out over [px]."""
    plane_tolerance: Positive = 0.004
    """Readings further from a tangent plane are another surface's [1/m]; 3σ of the sensor at 2 m."""
    rejoin_gap: NotNegative = 0.25
    """Parts are rejoined across what hides this much between them at the most [m]; table-top sizes."""
    rejoin_votes: Count = 5
    """Rows and columns of samples on which they must meet [1]; 3 cm at 1.5 m."""
    rejoin_share: Share = 0.25
    """A part smaller than this share of two that touch may be a splinter of the other [1]."""
    rejoin_concave: Share = 0.1
    """Share of pairs of samples that may be concave where two parts are one [1]; creases are rounded."""
    rejoin_hypotheses: Count = 40
    """RANSAC hypotheses a shape when a joint is judged [1]; samples are evened out and hold few outliers."""
    rejoin_points: Count = 300
    """Points a joint is judged by [1]."""
    rejoin_distance: NotNegative = 0.006
    """Distance within which a sample lies at a shape [m]; 3σ of the evened out samples."""
    rejoin_cosine: Cosine = 0.7
    """Cosine of the angle between the normals of a sample and of the shape it lies at, at least [1]; 45°."""
    rejoin_loss: Share = 0.1
    """Share of a part's samples that its own shape explains and the joint one need not [1]."""
    plain_colour: NotNegative = 0.02
    """Usual distance of the shares of red, green and blue from their mean below which a part is plain [1]."""
    other_colour: NotNegative = 0.08
    """Distance between the mean shares from which two plain colours differ [1]; four times their spread."""
    plain_share: NotNegative = 0.9
    """Share of a part its plain pieces make up where it is cut between them [1]; above 1 nothing is."""
    border_bend: NotNegative = 0.25
    """Width of a border between two colours over its length that is straight [1]; round bodies bend it."""
    rejoin_empty: Share = 0.1
    """Share of a joint shape's visible faces that may lie where the camera saw through [1]; edges fray."""
    clearance: NotNegative = 0.008
    """Points nearer to the support surface than this belong to it [m]; 2σ of the sensor at 1.5 m."""
    max_height: Positive = 0.6
    """Points higher above the table belong to no object on it [m]; table-top sizes."""
    overlap: Share = 0.3
    """Share of a part's points that must lie at an object's points or shape for it to be that object [1]."""
    divide_share: Share = 0.1
    """A part is divided among the known objects at which at least this share of its points lies [1]."""
    overlap_reach: NotNegative = 0.02
    """Distance within which a point lies at an object [m]; 2σ of registration error of both views."""


@dataclass(frozen=True, slots=True)
class MaskConfig(Stage):
    """Masks of a learned segmenter."""

    min_pixels: WholeNumber = 200
    """Masks with fewer pixels, before or after smaller ones are laid over them, are left out [px]."""
    max_share: Share = 0.4
    """A mask of more than this share of the image is the table or what is behind it [1]."""
    min_score: float = 0.0
    """Masks with a lower score are left out [the segmenter's unit]."""
    same: Share = 0.8
    """Two masks with a larger intersection over union are one object seen twice [1]."""
