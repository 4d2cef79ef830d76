"""Frames of stored clouds: that of the sensor, or a world whose z axis points up."""

from __future__ import annotations

import copy
import logging

import numpy as np
from scipy.spatial import cKDTree

from caryatid.config import Config
from caryatid.errors import InputError, NoSurfaceError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import UP, Array
from caryatid.io.point_clouds import StoredCloud
from caryatid.segmentation.observation import find_surfaces, level_transform
from caryatid.sensing.views import Cloud

log = logging.getLogger(__name__)

APART = 0.1
"""Difference of two distances from the sensor, relative to the smaller one, that noise does not make [1]."""
SEVERAL = 0.03
"""Share of points with another one far behind or before them, from which no single sensor saw them [1].

It is below 0.01 in each of 63 real depth images.
"""
ENOUGH = 4000
"""Number of points that are looked at [1]."""


def level_cloud(
    stored: StoredCloud, config: Config, rng: np.random.Generator, *, use_labels: bool = False
) -> Cloud:
    """Return a stored cloud in a world whose z axis points up.

    Programs store points in the frame of the sensor or in a world, with or without the pose of the sensor in
    it. The data decide: from the place of a single sensor, each line of sight meets one surface. A cloud that
    was seen from several places needs normals; if it shows a level surface, its z axis points up.

    Args:
        stored: The cloud.
        config: How normals and planes are found.
        rng: Draws the hypotheses.
        use_labels: Leave out points of labelled objects.

    Raises:
        InputError: It is not in metres.
        NoSurfaceError: It shows no support surface, or was seen from several places and has no normals.
    """
    points = stored.points[stored.kept]
    size = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    if size > config.cloud.max_depth:
        reason = f"half its points are {size:,.0f} m or more from their middle"
        unit = "its unit seems to be millimetres or centimetres"
        raise InputError(stored.name, f"{reason}; {unit}", "save it in metres")
    stated = transforms.invert(stored.T_world_sensor)
    frames = [np.eye(4), *([] if np.array_equal(stated, np.eye(4)) else [stated])]
    shares = [hidden_share(transforms.transform(T, points)) for T in frames]
    tries: list[Array | None] = [frames[k] for k in np.argsort(shares, kind="stable") if shares[k] <= SEVERAL]
    if stored.normals is not None:
        tries = [*tries, None] if tries else [None, frames[0]]
    failure: NoSurfaceError | None = None
    found: Cloud | None = None
    most = -1
    for T in tries:
        drawn = copy.deepcopy(rng)
        cloud = stored.to_cloud(config.cloud, T)
        try:
            if T is None:
                table = find_surfaces(cloud, None, (), UP, config, drawn, None)[0]
                heights = table.height(cloud.points_world)
            else:
                cloud = cloud.moved(level_transform(cloud, config, drawn, use_labels=use_labels))
                heights = cloud.points_world[:, 2]
        except NoSurfaceError as error:
            failure = failure or error
            continue
        # From below or behind, a table hides what stands on it.
        above = (heights > config.surface.search) & (heights < config.segmentation.max_height)
        if (count := int(np.count_nonzero(above))) > most:
            found, most = cloud, count
    remedy = "save normals (nx ny nz) that point to the sensors, or give ct.Cloud(points, normals)"
    if found is not None:
        if stored.normals is None and most < config.surface.min_points:
            log.warning("%s: nothing stands on its table; if its z axis points up, %s", stored.name, remedy)
        return found
    if failure is None:
        reason = "no support surface: its points hide each other, as if they were seen from several places"
        raise NoSurfaceError(f"{stored.name}: {reason}; if they were, {remedy}")
    raise failure


def hidden_share(points: Array) -> float:
    """Share of points (N, 3) that are far behind or before their neighbour, as seen from the origin [1]."""
    distances = np.linalg.norm(points, axis=1)
    rays = points / np.maximum(distances, 1e-9)[:, None]
    some = slice(None, None, max(1, len(points) // ENOUGH))
    _, near = cKDTree(rays).query(rays[some], k=[min(2, len(points))])
    one, other = distances[some], distances[near[:, 0]]
    return float(np.mean(np.abs(one - other) > APART * np.minimum(one, other)))
