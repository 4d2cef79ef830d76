"""Settings of perception: from images to labelled points."""

from __future__ import annotations

from dataclasses import dataclass

from caryatid.config.ranges import Angle, Count, NotNegative, Positive, Share, Stage, WholeNumber


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

    tolerance: Positive = 0.01
    """Distance within which a point belongs to the plane [m]; 3σ of the sensor at 1.8 m."""
    max_tilt: Angle = 10.0
    """How far the normal may lean from the vertical where the view has a pose [deg]."""
    max_deviation: Angle = 25.0
    """How far a point's normal may lean from its plane's [deg]; 3σ of normals from depth."""
    gap: NotNegative = 0.3
    """Parts of one plane further apart than this are two surfaces [m]; shadows of objects are narrower."""
    min_area: NotNegative = 0.05
    """Seen area a table has at least [m²]; more than most objects' tops."""
    storey: NotNegative = 0.3
    """A plane that has a table this far above it is the floor [m]."""
    min_points: Count = 200
    """Fewer inliers are no table [points]."""
    search: Positive = 0.05
    """Once known, the table is looked for within this height of itself [m]; 5σ of registration and tilt."""
    spacing: Positive = 0.02
    """Spacing its points are kept at for later views [m]."""


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
    spacing: Positive = 0.01
    """Size of the patches of objects that readings are averaged over [m]; a dozen pixels at 1.5 m."""
    spacing_far: Positive = 0.03
    """Size of the patches of the support surface [m]."""
    sample: Count = 600
    """Patches of a view that look for partners in another [1]."""
    reaches: tuple[Positive, ...] = (0.1, 0.05, 0.025)
    """Partners further away are none [m], coarse to fine."""
    min_points: Count = 100
    """Fewer partners determine no pose [1]."""
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
    surfel: Positive = 0.015
    """Size of the patches whose edges are judged convex or concave [m]; four times the noise at 1.5 m."""
    crease: NotNegative = 4.0
    """What a turn of the normal by 90° adds to a path on the surface [surfels]; surfels end at edges."""
    step: NotNegative = 0.0035
    """Height of one surfel over its neighbour's plane beyond which they are two layers [m]; 2σ evened out."""
    reach: Positive = 0.012
    """Points of an unorganised cloud further apart are not joined [m]; twice the usual thinning."""
    concavity: Angle = 15.0
    """Angle between normals beyond which a concave edge parts two surfaces [deg]; LCCP's 10 and noise."""
    rise: NotNegative = 0.01
    """Height over the tangent plane of another place of a part from which the pair is concave [m]."""
    min_size: Count = 40
    """Samples a part needs to be an object [points]."""
    min_width: NotNegative = 0.02
    """A part narrower than this beside a larger one belongs to it [m]; creases are rounded so far."""
    merge_gap: NotNegative = 0.25
    """Parts are merged across something nearer that hides up to this much between them [m]."""
    clearance: NotNegative = 0.008
    """Points nearer to the support surface than this belong to it [m]; 2σ of the sensor at 1.5 m."""
    max_height: Positive = 0.6
    """Points higher above the table belong to no object on it [m]; table-top sizes."""
    overlap: Share = 0.3
    """Share of a part's points that must lie at an object's points or shape for it to be that object [1]."""
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
