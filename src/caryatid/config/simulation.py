"""Settings of the simulation: sensor, noise, physics and generated scenes."""

from __future__ import annotations

from dataclasses import dataclass

from caryatid.config.ranges import Angle, Count, Lengths, NotNegative, Positive, Share, Stage


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
    force_share: NotNegative = 0.03
    """Least upward part of a contact force on an object that supports it, as a share of its weight [1]."""
    removal_time: Positive = 1.0
    """How long the others are watched after an object is taken away [s]."""
    moved: NotNegative = 0.01
    """An object displaced by more than this has moved [m]."""
    turned: Angle = 8.0
    """An object turned by more than this has moved [deg]."""
