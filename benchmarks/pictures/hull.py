"""A ball as it is seen, and the hull it collides as: how a perfect fit comes to an IoU of two thirds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from scipy.spatial import ConvexHull
from solids import Eye, draw_solids

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Sphere
from caryatid.geometry.transforms import Array
from caryatid.viz.colours import PALETTE

RADIUS = 0.0334
"""Of a tennis ball [m]."""
CORNERS, CORNER_RADIUS = 18, 0.0328
"""Of the hull that stands for the scanned one: how many, and how far from the middle [m]."""
CENTRE = np.array([0.0, 0.0, RADIUS])


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull.

    Attributes:
        planes: Outward normals and offsets (F, 4) of its faces, in its frame.
        T_world_object: Pose (4, 4).
        extents: Of a box around it (3,) [m].
    """

    planes: Array
    T_world_object: Array
    extents: Array

    def signed_distance(self, points_world: Array) -> Array:
        """Distance (N,) [m] from the farthest plane; outside never more than that from the hull."""
        local = transforms.transform(transforms.invert(self.T_world_object), points_world)
        return np.max(local @ self.planes[:, :3].T + self.planes[:, 3], axis=1)


def coarse_hull() -> Hull:
    """The hull of a few points spread evenly over the ball."""
    i = np.arange(CORNERS)
    z = 1.0 - (2.0 * i + 1.0) / CORNERS
    angle = i * np.pi * (3.0 - np.sqrt(5.0))
    level = np.sqrt(1.0 - z**2)
    corners = CORNER_RADIUS * np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=1)
    pose = transforms.rigid(np.eye(3), CENTRE)
    return Hull(ConvexHull(corners).equations, pose, np.full(3, 2.0 * RADIUS))


def overlap(hull: Hull, ball: Sphere) -> float:
    """IoU of the two, by points drawn in the box around the ball."""
    points_world = CENTRE + np.random.default_rng(0).uniform(-RADIUS, RADIUS, (200_000, 3))
    inside, within = hull.signed_distance(points_world) <= 0.0, ball.signed_distance(points_world) <= 0.0
    return float((inside & within).sum() / (inside | within).sum())


def draw_hull(size: tuple[int, int]) -> Any:
    """Draw ball, hull, and both, side by side.

    Args:
        size: Width and height of a panel [px].

    Returns:
        The figure.
    """
    ball, hull = Sphere(transforms.rigid(np.eye(3), CENTRE), RADIUS), coarse_hull()
    colour = matplotlib.colors.to_rgb(PALETTE[0])
    eye = Eye.towards(CENTRE, transforms.unit(np.array([-1.0, 0.4, 0.45])), 1.35 * RADIUS, *size)
    seen, ball_mask = draw_solids([ball], [colour], 0.0, eye)
    true, _ = draw_solids([hull], [matplotlib.colors.to_rgb(PALETTE[1])], 0.0, eye)
    figure, panels = plt.subplots(1, 3, figsize=(3 * size[0] / 100, size[1] / 100 + 0.75), dpi=100)
    figure.subplots_adjust(0.004, 0.01, 0.996, 0.83, wspace=0.015)
    figure.suptitle("The ball is seen, its coarse hull is the truth", fontsize=15, fontweight="bold", y=0.985)
    titles = (
        "what a camera sees",
        "what it is scored against",
        f"perfect fit: IoU {overlap(hull, ball):.2f}",
    )
    for panel, image, title in zip(panels, (seen, true, true), titles, strict=True):
        panel.imshow(image)
        panel.set_title(title, fontsize=11)
        panel.axis("off")
    panels[2].contour(ball_mask == 0, levels=[0.5], colors=PALETTE[0], linewidths=3.0)
    return figure
