"""Whether a view changed the support graph: the loop ends when one does not."""

from __future__ import annotations

import numpy as np

from caryatid.config import FusionConfig
from caryatid.graph import SceneObject, SupportGraph
from caryatid.objects.sightings import axes_rotation


def changed(before: SupportGraph, after: SupportGraph, config: FusionConfig) -> bool:
    """Whether a vertex came, went or changed its shape beyond the tolerance, or an edge came or went."""
    earlier = {o.id: o for o in before.objects}
    if earlier.keys() != {o.id for o in after.objects}:
        return True
    if {s.pair for s in before.supports} != {s.pair for s in after.supports}:
        return True
    return any(reshaped(earlier[o.id], o, config) for o in after.objects if o.role == "object")


def reshaped(before: SceneObject, after: SceneObject, config: FusionConfig) -> bool:
    """Whether an object's shape moved, turned or grew by more than the tolerance."""
    a, b = before.shape, after.shape
    if a is b:
        return False
    if a.kind != b.kind or np.linalg.norm(before.centre_world - after.centre_world) > config.settled:
        return True
    turn, angle = axes_rotation(b, a)
    lever = float(a.extents.max()) / 2.0
    return bool(
        np.abs(a.extents - np.abs(turn.T @ b.extents)).max() > config.settled
        or angle * lever > config.settled
    )
