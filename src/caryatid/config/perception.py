"""Settings of perception: from images to labelled points."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """From depth image to oriented points."""

    max_depth: float = 3.0
    """Readings beyond this are dropped [m]; the paper's working range."""
    min_depth: float = 0.35
    """Readings nearer than the sensor's near limit are dropped [m]."""
    normal_window: int = 7
    """Side of the square window of the local planes at the most [px]; 7 × 7 take the noise to a quarter."""
    normal_size: float = 0.02
    """The same on the surface at the median distance [m]: 7 px at 1.5 m with f = 525 px; fewer in coarse
    images, where 7 px would be an object."""
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
    """Refining the reported poses of views against each other."""

    enabled: bool = True
    """Refine at all."""
    translation: float = 0.01
    """Expected error of a reported position, per axis [m]; the worst that is usual, twice the usual."""
    rotation: float = 0.5
    """Expected error of a reported orientation, per axis, about the camera [deg]."""
    noise: float = 0.001
    """Expected distance of one patch to its partner's plane beside the spread of their readings [m]."""
    independent: float = 0.1
    """Share of the partners that err independently [1]: neighbouring patches err alike."""
    spacing: float = 0.01
    """Size of the patches of objects that readings are averaged over [m]; a dozen pixels at 1.5 m."""
    spacing_far: float = 0.03
    """Size of the patches of the support surface [m]."""
    min_readings: int = 4
    """Patches of fewer readings are left out [1]: rims, and sides seen at a grazing angle."""
    min_share: float = 0.33
    """Where few pixels make a patch, this share of what the fullest ones have will do [1]."""
    min_flatness: float = 0.97
    """Length of the mean of a patch's normals at least [1]; less is an edge."""
    plane_rounds: int = 4
    """Rounds of the robust fit of planes to sides [1]."""
    flat: float = 0.0015
    """Distance of a patch from its side's plane at which it counts a quarter in it [m]."""
    flat_share: float = 0.7
    """Share of a side's patches that must lie in its plane for the side to be flat [1]."""
    min_side: float = 0.006
    """Standard deviation of a flat side's patches along its shorter direction at least [m]; 2 cm wide."""
    min_patches: int = 6
    """Sides of fewer patches are left out [1]; blurred edges."""
    sample: int = 600
    """Patches of a view that look for partners in another [1]."""
    reaches: tuple[float, ...] = (0.1, 0.05, 0.025)
    """Partners further away are none [m], coarse to fine."""
    rounds: int = 3
    """Rounds of matching at each reach [1]."""
    steps: int = 4
    """Gauss-Newton steps between two rounds of matching at the most [1]."""
    converged: float = 2e-5
    """Steps below this end the rounds [m, rad]."""
    normal_reach: float = 0.05
    """How far apart [m] directions at right angles count when partners are looked for, by 1/√2."""
    min_cosine: float = 0.9
    """Cosine of the angle between the normals of partners at least [1]."""
    outlier: float = 0.3
    """Share of the reach beyond which distances lose their weight [1]."""
    min_points: int = 100
    """Fewer partners determine no pose [1]."""
    exact: float = 0.0003
    """A view that fits better than this as reported is not moved [m]; exact ones leave 0.1 mm, noisy 1 mm."""
    settled: float = 0.0003
    """Views whose points would move less than this stay where they are [m]."""
    max_translation: float = 0.1
    """A longer move is refused [m]."""
    max_rotation: float = 5.0
    """A larger turn is refused [deg]."""


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
    gap: int = 3
    """Depth steps are looked for across this many samples without a reading [1]; they leave 2 px a side."""
    min_rise: float = 0.015
    """Height over a neighbour's plane from which a depth step repels [m]; above staircases on steep faces."""
    surfel: float = 0.015
    """Size of the patches whose edges are judged convex or concave [m]; four times the noise at 1.5 m."""
    crease: float = 4.0
    """What a turn of the normal by 90° adds to a path on the surface [surfels]; surfels end at edges."""
    step: float = 0.0035
    """Height of one surfel over its neighbour's plane beyond which they are two layers [m]; 2σ evened out."""
    neighbours: int = 10
    """Nearest points a point of an unorganised cloud is joined to [1]."""
    reach: float = 0.012
    """Points of an unorganised cloud further apart are not joined [m]; twice the usual thinning."""
    concavity: float = 15.0
    """Angle between normals beyond which a concave edge parts two surfaces [deg]; LCCP's 10 and noise."""
    rise: float = 0.01
    """Height over the tangent plane of another place of a part from which the pair is concave [m]."""
    concave_share: float = 0.2
    """Share of concave pairs between two clusters from which they are two bodies [1]."""
    least_surfels: int = 10
    """Surfels a cluster needs for that to be asked [1]; fewer are bumps and flaws."""
    hollow: float = 0.2
    """Mean cosine between normals and the way inwards that makes a patch the inside of something [1]; a
    bowl's has 0.6, flat faces and their noise 0.05."""
    rim: float = 0.025
    """Difference in height of the tops of an inside and of what it hangs in [m]; a rim's width and noise."""
    min_size: int = 40
    """Samples a part needs to be an object [points]."""
    min_width: float = 0.02
    """A part narrower than this beside a larger one belongs to it [m]; creases are rounded so far."""
    normal_size: float = 0.013
    """Side of the window normals are estimated over, at the objects' median distance [m]."""
    plane_radius: int = 5
    """Radius of the wider window the samples' tangent planes are evened out over [px]."""
    plane_tolerance: float = 0.004
    """Readings further from a tangent plane are another surface's [1/m]; 3σ of the sensor at 2 m."""
    rejoin_gap: float = 0.25
    """Parts are rejoined across what hides this much between them at the most [m]; table-top sizes."""
    rejoin_votes: int = 5
    """Rows and columns of samples on which they must meet [1]; 3 cm at 1.5 m."""
    rejoin_share: float = 0.25
    """A part smaller than this share of two that touch may be a splinter of the other [1]."""
    rejoin_concave: float = 0.1
    """Share of pairs of samples that may be concave where two parts are one [1]; creases are rounded."""
    rejoin_hypotheses: int = 40
    """RANSAC hypotheses a shape when a joint is judged [1]; samples are evened out and hold few outliers."""
    rejoin_points: int = 300
    """Points a joint is judged by [1]."""
    rejoin_distance: float = 0.006
    """Distance within which a sample lies at a shape [m]; 3σ of the evened out samples."""
    rejoin_cosine: float = 0.7
    """Cosine of the angle between the normals of a sample and of the shape it lies at, at least [1]; 45°."""
    rejoin_loss: float = 0.1
    """Share of a part's samples that its own shape explains and the joint one need not [1]."""
    plain_colour: float = 0.02
    """Usual distance of the shares of red, green and blue from their mean below which a part is plain [1]."""
    other_colour: float = 0.08
    """Distance between the mean shares from which two plain colours differ [1]; four times their spread."""
    plain_share: float = 0.9
    """Share of a part its plain pieces make up where it is cut between them [1]; above 1 nothing is."""
    border_bend: float = 0.25
    """Width of a border between two colours over its length that is straight [1]; round bodies bend it."""
    rejoin_empty: float = 0.1
    """Share of a joint shape's visible faces that may lie where the camera saw through [1]; edges fray."""
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


@dataclass(frozen=True, slots=True)
class MaskConfig:
    """Masks of a learned segmenter."""

    min_pixels: int = 200
    """Masks with fewer pixels, before or after smaller ones are laid over them, are left out [px]."""
    max_share: float = 0.4
    """A mask of more than this share of the image is the table or what is behind it [1]."""
    min_score: float = 0.0
    """Masks with a lower score are left out [the segmenter's unit]."""
    same: float = 0.8
    """Two masks with a larger intersection over union are one object seen twice [1]."""
