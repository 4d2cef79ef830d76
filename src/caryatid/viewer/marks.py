"""What can be drawn into the page's scene, as data: a drawing is a mark for each name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.viz.colours import Colour

Colours = NDArray[np.uint8]
"""Red, green and blue 0…255, (..., 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Points:
    """Many points, each a disc that faces the eye.

    Attributes:
        origin_world: Where the points are counted from (3,) [m]; near them, for they are sent as half floats.
        points: (N, 3) [m] from there.
        colours: (N, 3).
        size: Diameter [m].
    """

    origin_world: Array
    points: NDArray[np.float32]
    colours: Colours
    size: float


@dataclass(frozen=True, eq=False, slots=True)
class Mesh:
    """A body of one colour.

    Attributes:
        T_world_mesh: Where it is (4, 4).
        vertices: (V, 3) [m].
        faces: (F, 3).
        colour: Its colour.
        opacity: 1 = one sees nothing through it.
        object_id: Whose shape it is: a click on it chooses the object; empty for anything else.
        flat: Its faces are, and not parts of something round.
    """

    T_world_mesh: Array
    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    colour: Colour
    opacity: float = 1.0
    object_id: str = ""
    flat: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class Copies:
    """One body in many places.

    Attributes:
        vertices: (V, 3), about 1 in size.
        faces: (F, 3).
        positions_world: (N, 3) [m].
        wxyz: Quaternions (N, 4), w first.
        scales: (N, 3) [m].
        colours: (N, 3).
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    positions_world: Array
    wxyz: Array
    scales: Array
    colours: Colours


@dataclass(frozen=True, eq=False, slots=True)
class Lines:
    """Straight lines.

    Attributes:
        ends_world: (N, 2, 3) [m].
        colours: (N, 3).
        width: [px].
    """

    ends_world: Array
    colours: Colours
    width: float


@dataclass(frozen=True, eq=False, slots=True)
class Frustum:
    """A camera, with the picture it took.

    Attributes:
        T_world_camera: (4, 4), OpenCV camera frame.
        field_of_view: Vertical [rad].
        aspect: Width over height.
        size: How large it is drawn [m].
        colour: Its colour.
        picture: (H, W, 3) or None.
        filled: With faces, so that it is told from those without.
    """

    T_world_camera: Array
    field_of_view: float
    aspect: float
    size: float
    colour: Colour
    picture: Colours | None = None
    filled: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class Label:
    """A short text at a place.

    Attributes:
        position_world: The place (3,) [m].
        text: What it says.
    """

    position_world: Array
    text: str


Mark = Points | Mesh | Copies | Lines | Frustum | Label
Drawing = dict[str, Mark]
"""Marks by name: `layer/…`, so that a layer is shown and hidden as one."""
