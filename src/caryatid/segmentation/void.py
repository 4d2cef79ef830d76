"""Void: the label 255, with which others mark borders of objects, or all that is not labelled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import Cloud, View

VOID = 255
"""The highest number of 8 bits."""
BORDER = 0.02
"""Maximum width of a border of void, as an angle at the camera [rad]; 10 px with f = 525 px."""
MOST = 0.9
"""Share of the points for which something holds, from which it does [1]."""
ENOUGH = 4000
"""Number of points that show where labels lie [1]."""


def is_void(source: View | Cloud, labels: NDArray[np.int32]) -> bool:
    """Return whether the label 255 is void beyond doubt, and no object.

    It is far from the other numbers; it lies between the others and the background, or there is no
    background; and it is a border of them, or all the rest.

    Args:
        source: The view or cloud.
        labels: Its labels, (H, W) or (N,), 0 = background.
    """
    labels = labels.ravel()
    void, others = np.flatnonzero(labels == VOID), np.flatnonzero((labels > 0) & (labels != VOID))
    # Grey levels of two objects may be 127 and 255.
    if not len(void) or not len(others) or 2 * (int(labels[others].max()) + 1) >= VOID:
        return False
    places, background = _places(source), np.flatnonzero(labels == 0)
    some = places[others[:: max(1, len(others) // ENOUGH)]]
    to_background, _ = cKDTree(places[background]).query(some) if len(background) else (np.inf, None)
    to_void, _ = cKDTree(places[void]).query(some)
    if np.mean(to_void < to_background) < MOST:
        return False
    to_others, _ = cKDTree(places[others]).query(places[void[:: max(1, len(void) // ENOUGH)]])
    return bool(len(background) < (1.0 - MOST) * len(void) or np.mean(to_others < BORDER) > MOST)


def _places(source: View | Cloud) -> Array:
    """Directions of pixels or points (N, …), so that distances are angles [rad]; points without a camera."""
    if isinstance(source, View):
        rows, columns = np.indices(source.depth.shape).reshape(2, -1)
        return np.column_stack([columns / source.K[0, 0], rows / source.K[1, 1]])
    if source.viewpoint_world is None:
        return source.points_world
    return transforms.unit(source.points_world - source.viewpoint_world)
