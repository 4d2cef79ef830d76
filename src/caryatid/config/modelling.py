"""Settings of the scene model: shapes, supports and their fusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from caryatid.config.choices import FusionMethod, ShapeKind
from caryatid.config.ranges import (
    Angle,
    Count,
    Factor,
    NotNegative,
    Positive,
    Share,
    Stage,
    WholeNumber,
)


@dataclass(frozen=True, slots=True)
class FitConfig(Stage):
    """Primitive fitting."""

    shapes: tuple[ShapeKind, ...] = ("box", "cylinder", "sphere")
    """Shapes that are tried; the paper's three."""
    hypotheses: Count = 100
    """RANSAC hypotheses a shape at the most [1]; the predecessor's iterations."""
    max_points: Count = 800
    """Points a shape is judged by [1]; 1.5 cm apart on the largest objects, as far as bare places count."""
    search_points: Count = 250
    """Of these the search looks at so many or nearly twice as many [1]; the best are refined on all."""
    min_points: Count = 12
    """Fewer points are no object [1]; a box has nine parameters."""
    threshold: Positive = 0.01
    """MSAC truncation of the distance to the surface [m]; 2σ of registration error."""
    polish: Count = 3
    """Best hypotheses of each shape that are refined by least squares."""
    steps: WholeNumber = 25
    """Least-squares steps at the most."""
    max_extent: Positive = 0.5
    """Longest extent of an object on a table [m]."""
    min_extent: Positive = 0.008
    """Shortest extent [m]; below the sensor's resolution."""
    max_radius: Positive = 0.15
    """Largest radius of cylinder and sphere [m]."""
    normal_weight: NotNegative = 0.004
    """What a normal turned by 90° costs in model choice [m]: as much as half the registration error."""
    correlated: Positive = 4.0
    """Neighbouring points that share one error [1]: depth is smoothed over 2 × 2 pixels."""
    registration: NotNegative = 0.002
    """Standard deviation of where views are laid [m], which no number of points averages out."""
    rim: NotNegative = 0.003
    """The same of where points end beside a depth edge [m]: one pixel at 1.5 m."""
    max_residual: Positive = 0.008
    """Mean distance beyond which none of the shapes explains the object [m]: `poor_fit`."""


@dataclass(frozen=True, slots=True)
class SplitConfig(Stage):
    """Model split: what automatic segmentation took for one object may be several."""

    cuts: WholeNumber = 5
    """Cuts tried along each direction [1]; a sixth of the points apart."""
    rounds: WholeNumber = 3
    """Times the points go to the shape that explains them better and the shapes are fitted anew [1]."""
    min_points: Count = 20
    """Thinned points a side needs [1]; 1.5 times what a shape needs."""


@dataclass(frozen=True, slots=True)
class ExplanationConfig(Stage):
    """What it costs to explain points by shapes: the least cost decides what is one object and what two."""

    parameter_cost: NotNegative = 4.5
    """Price of each number that an object's shape has [nats]; each is known to a ninetieth of its range."""
    outlier: NotNegative = 4.0
    """Cost of a point no shape explains [nats]; as likely as one 2.8σ off."""
    irregular: NotNegative = 1.4
    """Cost of a point on an object that is none of the shapes [nats]."""
    normal_weight: NotNegative = 4.0
    """Cost of a normal turned by 90° [nats]; blurred over edges, normals are as good as 30°."""
    reading: Positive = 0.0002
    """Surface whose points err alike [m²]; half of the 2 cm square a registration error shows in."""
    border: NotNegative = 4.0
    """Cost of a point with only the other object around it, on a surface without crease [nats]."""
    free_cost: NotNegative = 0.5
    """Cost of a voxel inside a shape that was seen free [nats]; four points off at 5 mm spacing."""
    usual: NotNegative = 0.9
    """Mean cost of the points around a point that is still well explained [nats]; 9 in 10 true shapes."""
    spacing: Positive = 0.008
    """Spacing the points are thinned to [m]; a third of the patch that errs alike."""
    reach: Positive = 0.03
    """Objects further apart are not taken for one [m]; an occluder's shadow."""


@dataclass(frozen=True, slots=True)
class CompletionConfig(Stage):
    """How far shapes reach down where nobody looked."""

    max_tilt: Angle = 30.0
    """An unseen side that faces down within this angle may be extended [deg]; what rests on a face does."""
    step: Positive = 0.01
    """Step of the extension [m]; a voxel."""
    overlap: NotNegative = 0.004
    """How deep the moving side may enter another shape [m]; the fits' uncertainty."""
    max_free: Share = 0.15
    """The extension ends where more of its rim lies in voxels seen free [1]; half of one side of four."""


@dataclass(frozen=True, slots=True)
class PlausibilityConfig(Stage):
    """Shapes that neither overlap nor float."""

    rounds: WholeNumber = 3
    """Corrections at the most [1]; 0 leaves shapes as they were fitted."""
    touch: NotNegative = 0.001
    """How far from zero the gap of two shapes in contact may be [m]; roundness of edges, softness."""
    sigmas: NotNegative = 3.0
    """Standard deviations of a gap beyond which the fits' uncertainty does not explain it [1]."""


@dataclass(frozen=True, slots=True)
class SupportConfig(Stage):
    """Support relations, section III-A."""

    contact_margin: NotNegative = 0.005
    """Gap up to which two shapes are in contact, however sure both are [m]; method notes section 3."""
    margin_sigma: NotNegative = 2.0
    """The same in standard deviations of the gap, where that is more [1]; misses one contact in forty."""
    max_margin: NotNegative = 0.01
    """However unsure they are, shapes further apart are not in contact [m]; method notes section 3."""
    reach: NotNegative = 0.012
    """Gap up to which a contact is believed where an object would tip without it [m]; 2.5σ of the same."""
    gentle_tilt: Angle = 25.0
    """Planes steeper than this, where nothing overlaps, carry only what would tip without them [deg]."""
    max_tilt: Angle = 75.0
    """Separating planes steeper than this carry nothing [deg]: the normal is too near the horizontal."""
    patch_depth: NotNegative = 0.003
    """Surface this near to the first contact counts as touching [m]; the noise of one reading at 1.5 m."""
    min_area_ratio: Share = 0.1
    """r_s,min of eq. 1 [1]."""
    overhang: NotNegative = 0.003
    """A centre of mass this far outside the support polygon tips [m]; 1σ of a fit's position."""
    top_down: Literal["paper", "balance"] = "balance"
    """All that rests on an unstable object holds it (`paper`), or only what weighs against its tipping."""
    max_drop: NotNegative = 0.04
    """How far below an unsupported object its supporter may lie, hidden gap between them [m]."""


@dataclass(frozen=True, slots=True)
class FusionConfig(Stage):
    """Fusing graphs over views, section III-B."""

    method: FusionMethod = "pc+sg"
    """What is fused: points (`pc`), graphs (`sg`) or both (Table I)."""
    max_distance: NotNegative = 0.05
    """Centres further apart are two objects [m], beside half the smaller object's size."""
    max_angle: Angle = 20.0
    """Axes further apart are two orientations [deg], up to the shape's symmetry."""
    max_ratio: Factor = 1.6
    """Sorted extents that differ by more than this factor [1] are two objects."""
    settled: NotNegative = 0.005
    """A shape that moves, grows or turns by less than this has not changed [m]; σ of registration error."""
    keep_share: Share = 0.5
    """A support is kept while occurrences / opportunities is at least this [1]."""
