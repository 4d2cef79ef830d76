"""Shapes drawn as lines over an image or a cloud: what is hidden stays faint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject
from caryatid.viz.colours import object_colour
from caryatid.viz.svg import element, path, tooltip

NEAR = 0.05
"""Lines nearer to the camera than this are left out [m]."""
FLAT = 0.4
"""Lines that bend by less than this are written by their ends [px]."""


@dataclass(frozen=True, eq=False, slots=True)
class Projection:
    """How a picture sees the world.

    Attributes:
        T_world_camera: Pose (4, 4) of the eye, OpenCV camera frame.
        K: (3, 3) [px]; for a parallel projection the focal lengths are the scale [px/m].
        depth: Distance (H, W) [m] along the eye's z of what the picture shows, 0 = nothing there.
        parallel: Parallel instead of central projection.
    """

    T_world_camera: Array
    K: Array
    depth: NDArray[np.float32]
    parallel: bool = False

    def project(self, points_world: Array) -> tuple[Array, Array]:
        """Return pixels (N, 2) and distances (N,) [m] of points (N, 3)."""
        points_camera = transforms.transform(transforms.invert(self.T_world_camera), points_world)
        z = points_camera[:, 2]
        on_plane = points_camera[:, :2] / (1.0 if self.parallel else np.maximum(z, NEAR)[:, None])
        return on_plane @ self.K[:2, :2].T + self.K[:2, 2], z

    def hidden(self, pixels: Array, z: Array, margin: float) -> NDArray[np.bool_]:
        """Say of pixels (N, 2) at distances z (N,) whether the picture shows something nearer by `margin`."""
        height, width = self.depth.shape
        u, v = np.rint(np.clip(pixels, -1.0, (width, height))).astype(int).T
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        shown = np.where(inside, self.depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], 0.0)
        return (shown > 0.0) & (z > shown + margin)


def draw_shapes(objects: Sequence[SceneObject], projection: Projection, margin: float) -> str:
    """Draw fitted shapes as lines in their objects' colours; hidden ones (by `margin` [m]) thin and faint."""
    groups = []
    for item in sorted(objects, key=lambda o: o.role != "support_surface"):
        visible, hidden = _runs(item.shape, projection, margin)
        kind = "wire surface" if item.role == "support_surface" else "wire"
        groups.append(
            element(
                "g",
                tooltip(f"{item.id}, {item.shape.kind}"),
                element("path", d=hidden, class_="hidden") if hidden else "",
                element("path", d=visible, class_="casing") if visible else "",
                element("path", d=visible) if visible else "",
                class_=kind,
                stroke=object_colour(item.label),
            )
        )
    return "".join(groups)


def _runs(shape: Shape, projection: Projection, margin: float) -> tuple[str, str]:
    """Path data of what can be seen of a shape's lines, and of what is hidden."""
    from scipy.ndimage import median_filter

    data: dict[bool, list[str]] = {False: [], True: []}
    for line in shape.lines(projection.T_world_camera[:3, 3]):
        pixels, z = projection.project(line)
        hidden = median_filter(projection.hidden(pixels, z, margin), size=5, mode="nearest")
        cuts = np.flatnonzero(np.diff(hidden)) + 1
        for start, stop in zip([0, *cuts], [*cuts, len(line)], strict=True):
            run = slice(start, min(stop + 1, len(line)))
            if stop > start and (z[run] > NEAR).all() and len(pixels[run]) > 1:
                data[bool(hidden[start])].append(path(_thinned(pixels[run])))
    return "".join(data[False]), "".join(data[True])


def _thinned(pixels: Array) -> Array:
    """Return the ends alone where a line (N, 2) is as good as straight."""
    along = transforms.unit(np.append(pixels[-1] - pixels[0], 0.0))[:2]
    offset = pixels - pixels[0]
    bend = np.abs(offset[:, 0] * along[1] - offset[:, 1] * along[0])
    closed = np.allclose(pixels[0], pixels[-1], atol=FLAT)
    return pixels if closed or bend.max() > FLAT else pixels[[0, -1]]
