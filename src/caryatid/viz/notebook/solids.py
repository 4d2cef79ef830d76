"""One shape as a little drawing: its edges or its outline, seen from above and aside."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.viz import svg
from caryatid.viz.wireframes import Projection

SIDE = 150.0
"""Width and height of the drawing [px]."""
MARGIN = 8.0
"""Free border [px]."""
TOWARDS_EYE = transforms.unit(np.array([-1.0, -0.6, 0.7]))
"""Where it is looked at from."""
DISTANCE = 10.0
"""Distance of the eye [m]; any beyond the shape does, for it is a parallel projection."""
NUDGE = 1e-3
"""Step towards the eye that tells the near side from the far one, in shares of the shape's reach."""


def draw_solid(shape: Shape, colour: str) -> str:
    """Draw one shape as SVG, as it stands in the world, filling the picture.

    Args:
        shape: What to draw.
        colour: Of its surface, `#rrggbb`.
    """
    centre_world = shape.T_world_object[:3, 3]
    eye_world = centre_world + DISTANCE * TOWARDS_EYE
    outline = shape.outline()
    reach = float(np.linalg.norm(outline - centre_world, axis=1).max())
    scale = (SIDE / 2.0 - MARGIN) / max(reach, 1e-9)
    K = np.array([[scale, 0.0, SIDE / 2.0], [0.0, scale, SIDE / 2.0], [0.0, 0.0, 1.0]])
    view = Projection(
        transforms.look_at(eye_world, centre_world), K, np.zeros((1, 1), np.float32), parallel=True
    )
    data: dict[bool, list[str]] = {True: [], False: []}
    for line in shape.lines(eye_world):
        pixels, _ = view.project(line)
        # From a point on the near side of a convex solid a step towards the eye leads out of it.
        near = shape.signed_distance(line + NUDGE * reach * TOWARDS_EYE) > 0.0
        cuts = np.flatnonzero(np.diff(near)) + 1
        for start, stop in zip([0, *cuts], [*cuts, len(line)], strict=True):
            data[bool(near[start])].append(svg.path(pixels[start : stop + 1]))
    surface = svg.path(_rim(view.project(outline)[0]), closed=True)
    return svg.picture(
        SIDE,
        SIDE,
        svg.element("path", d=surface, class_="solid", fill=colour),
        svg.element("path", d="".join(data[False]), class_="far") if data[False] else "",
        svg.element("path", d="".join(data[True]), class_="near"),
        name=f"a {shape.kind}",
    )


def _rim(pixels: Array) -> Array:
    """The convex hull (M, 2) of pixels (N, 2)."""
    from shapely import MultiPoint

    return np.asarray(MultiPoint(pixels).convex_hull.exterior.coords)[:-1]
