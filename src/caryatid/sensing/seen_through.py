"""What a view says about a shape it should show."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.sensing.views import View

SPACING = 0.01
"""Spacing of the points on a shape that are looked for in the view [m]."""
BEHIND = 0.02
"""A reading this far behind such a point contradicts it [m]; 2σ of registration and depth together."""
CONTRADICTING = 0.5
"""Share of the points that must be contradicted for the view to speak against the object [1]."""


def seen_through(shape: Shape, view: View) -> bool:
    """Whether a view looks through most of where the shape should be.

    Args:
        shape: In the world frame.
        view: A view with a pose.
    """
    points_world, normals_world = shape.surface(SPACING)
    eye_world = view.pose[:3, 3]
    facing = np.sum((eye_world - points_world) * normals_world, axis=1) > 0.0
    p = transforms.transform(transforms.invert(view.pose), points_world[facing])
    p = p[p[:, 2] > 1e-3]
    u = np.rint(p[:, 0] / p[:, 2] * view.K[0, 0] + view.K[0, 2]).astype(np.intp)
    v = np.rint(p[:, 1] / p[:, 2] * view.K[1, 1] + view.K[1, 2]).astype(np.intp)
    height, width = view.depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = view.depth[v[inside], u[inside]]
    read = depth > 0.0
    if not read.any():
        return False
    return bool((depth[read] > p[inside, 2][read] + BEHIND).mean() > CONTRADICTING)
