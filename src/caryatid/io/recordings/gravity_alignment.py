"""A world that is not level is turned by the table: what most views take for its normal points up."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from caryatid.config import Config
from caryatid.errors import InputError, PerceptionError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.segmentation.perception import levelled
from caryatid.sensing.views import View

_UP = np.array([0.0, 0.0, 1.0])


def level_rotation(path: Path, views: Iterable[View], config: Config, rng: np.random.Generator) -> Array:
    """Find the smallest turn of the world about its origin (4, 4) that makes the table of views level.

    Each view says where up is as if it had no pose, by the largest plane that faces its camera and has the
    rest of the scene in front of it. Of these directions the one counts that is nearest to all the others.

    Args:
        path: The recording, for errors.
        views: With poses.
        config: How a plane is found, and how far two directions of the same table may be apart.
        rng: Draws the hypotheses.

    Raises:
        InputError: No view shows a plane, or less than half of those that do agree.
    """
    found = [up for view in views if (up := _up_world(view, config, rng)) is not None]
    if not found:
        raise InputError(path, "no view shows a table to level the world by", "leave --level out")
    ups = np.stack(found)
    apart = transforms.angle_between(ups[:, None], ups[None])
    middle = int(np.argmin(apart.sum(axis=1)))
    near = apart[middle] <= np.deg2rad(config.surface.max_tilt)
    if 2 * int(near.sum()) < len(ups):
        reason = f"only {int(near.sum())} of {len(ups)} views agree on where up is"
        raise InputError(path, reason, "leave --level out, and give a world that is level")
    return _turn(transforms.unit(ups[near].mean(axis=0)), _UP)


def _up_world(view: View, config: Config, rng: np.random.Generator) -> Array | None:
    """The table's normal (3,) in the world of a view, or None where there is no table to be seen."""
    try:
        T_level_camera = levelled(replace(view, T_world_camera=None), config, rng).pose
    except PerceptionError:
        return None
    return transforms.rotate(view.pose, transforms.rotate(transforms.invert(T_level_camera), _UP))


def _turn(direction: Array, target: Array) -> Array:
    """Rotation (4, 4) by the smallest angle that takes one unit vector (3,) to another (3,)."""
    angle = float(transforms.angle_between(direction, target))
    axis = np.cross(direction, target)
    if np.linalg.norm(axis) < 1e-9:
        axis = transforms.perpendicular(direction)
    return transforms.rigid(transforms.rotation_from_vector(angle * transforms.unit(axis)), np.zeros(3))
