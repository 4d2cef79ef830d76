"""Settings of the simulation: sensor, noise, physics and generated scenes."""

from __future__ import annotations

from dataclasses import dataclass

from caryatid.config.ranges import Angle, Count, Counts, Lengths, NotNegative, Positive, Share, Stage


@dataclass(frozen=True, slots=True)
class SensorConfig(Stage):
    """The simulated depth camera: a Carmine 1.09's image."""

    width: Count = 640
    """Image width [px]."""
    height: Count = 480
    """Image height [px]."""
    focal: Positive = 525.0
    """Focal length [px]; the driver's nominal value."""
    far: Positive = 10.0
    """Surfaces deeper than this are not seen at all [m]; noise cuts readings to the sensor's own range."""
    light: tuple[float, float, float] = (-0.4, 0.3, 0.87)
    """Direction towards the lamp in the world; off the vertical, so that faces of a box differ."""
    ambient: Share = 0.45
    """Share of a surface's colour that shows without the lamp [1]."""


@dataclass(frozen=True, slots=True)
class NoiseConfig(Stage):
    """Carmine 1.09 depth noise and registration error, method notes section 2."""

    axial: tuple[NotNegative, NotNegative, NotNegative] = (0.0012, 0.0019, 0.4)
    """(a, b, z0) of σ(z) = a + b·(z − z0)² [m]."""
    disparity_step: Positive = 0.00285
    """Depth is quantised in equal steps of 1/z [1/m]: 1/8 px of disparity, f = 580 px, baseline 75 mm."""
    grazing: Angle = 80.0
    """No return where the surface is turned away by more than this [deg]."""
    range: Lengths = (0.35, 3.0)
    """Nearest and farthest reading [m]."""
    edge_jump: NotNegative = 0.03
    """No return at pixels beside a depth step larger than this [m]."""
    translation: NotNegative = 0.005
    """σ of the registration error's translation, each view [m]."""
    rotation: Angle = 0.3
    """σ of the registration error's rotation, each view [deg]."""


@dataclass(frozen=True, slots=True)
class PhysicsConfig(Stage):
    """Settling a simulated scene and asking physics what holds up what, method notes section 4."""

    rest_window: Positive = 0.25
    """Time over which an object must stay where it is to be at rest [s]."""
    rest_distance: Positive = 0.001
    """Movement within the window that still is rest [m]; soft contacts creep up to 3 mm/s."""
    rest_angle: Angle = 1.0
    """Rotation within the window that still is rest [deg]."""
    settle_time: NotNegative = 6.0
    """After this long a scene is taken as it is, at rest or not [s]."""
    force_window: Positive = 0.2
    """Contact forces are averaged over this long [s]; soft contacts creep, longer ones drift."""
    force_share: NotNegative = 0.03
    """Least upward part of a contact force on an object that supports it, as a share of its weight [1]."""
    removal_time: Positive = 1.0
    """How long the others are watched after an object is taken away [s]."""
    moved: NotNegative = 0.01
    """An object displaced by more than this has moved [m]."""
    turned: Angle = 8.0
    """An object turned by more than this has moved [deg]."""
    lean_angle: Angle = 30.0
    """A force nearer to the horizontal than this leans, a steeper one that points down presses [deg]."""
    disturbed: NotNegative = 0.02
    """`removal` lists what is displaced by more than this [m]: it slid or fell, and did not merely settle."""
    disturbed_turn: Angle = 15.0
    """`removal` lists what is turned by more than this [deg]."""


@dataclass(frozen=True, slots=True)
class GenerationConfig(Stage):
    """Random table-top scenes: sizes of objects, how they are set down, screens and walls."""

    box_edge: Lengths = (0.045, 0.14)
    """Shortest and longest edge of a box [m]; what a hand takes from a table."""
    radius: Lengths = (0.022, 0.045)
    """Radius of cylinders and balls [m]."""
    height: Lengths = (0.05, 0.13)
    """Height of cylinders [m]."""
    mixture: tuple[NotNegative, NotNegative, NotNegative] = (0.6, 0.25, 0.15)
    """Shares of boxes, cylinders and balls [1]."""
    stacked: Share = 0.7
    """Share of a pile's objects that are set down on another one [1]."""
    jitter: NotNegative = 0.3
    """How far off the middle of the one below an object is set down, as a share of its half extent [1]."""
    gap: NotNegative = 0.002
    """Height over what is below from which an object is let go [m]."""
    margin: NotNegative = 0.06
    """Objects are set down at least this far from the table's edge [m]."""
    tries: Count = 10
    """Times an object is set down anew while it falls off, rolls away or upsets others; then the one before
    it is taken up again as well."""
    patience: Count = 40
    """Objects set down, for each that is wanted, before a scene is given up."""
    rest_time: Positive = 2.0
    """An object that has not come to rest after this long is set down anew [s]."""
    lying: Share = 0.3
    """Share of upright objects that are laid on their side, for cylinders [1]."""
    settling: NotNegative = 0.3
    """Time an object is given before rest is asked for [s]."""
    brink: NotNegative = 0.01
    """An object whose middle is nearer to the table's edge than this has as good as fallen [m]."""
    max_height: Positive = 0.36
    """Nothing is set down so that it reaches higher over the table top [m]."""
    upset: NotNegative = 0.04
    """Setting an object down may shift a pile's others, or a heap's screens, by this much [m]."""
    packed_stacked: Share = 0.3
    """Share of a packed scene's objects that are set down on another one [1]."""
    packed_aligned: Share = 0.5
    """Share of a packed scene's objects that are parallel to one another, so that faces touch [1]."""
    packed_gap: NotNegative = 0.0005
    """Gap between objects of a packed scene before they settle [m]; far below what a camera can see."""
    heap_radius: Positive = 0.12
    """Radius of the heap of a dense scene of 16 [m]; it grows with the root of the number beyond that."""
    heap_tilted: Share = 0.3
    """Share of a heap's objects that are dropped in any attitude and not upright [1]."""
    screens: Counts = (2, 4)
    """Least and largest number of screens around the heap."""
    screen_distance: Lengths = (0.2, 0.27)
    """Distance of the screens from the heap's middle [m]."""
    screen_width: Lengths = (0.12, 0.18)
    """Width of a screen [m]."""
    screen_height: Lengths = (0.23, 0.32)
    """Height of a screen [m]; taller than most of the heap."""
    screen_thickness: Positive = 0.05
    """Thickness of a screen [m]; stands firm, hides well."""
    walls: Counts = (1, 2)
    """Least and largest number of walls beside the table."""
