from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import box, cylinder, sphere, table_object, thing

from caryatid.config import FusionConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.graph import Support, SupportGraph
from caryatid.objects.fusion import changed, reshaped

CONFIG = FusionConfig()
CRATE = thing(1, box((0.0, 0.0, 0.8), (0.1, 0.2, 0.3)))
CAN = thing(2, cylinder((0.0, 0.0, 1.0), 0.03, 0.1))
BEFORE = SupportGraph((table_object(), CRATE, CAN), (Support("o0", "o1"), Support("o1", "o2")))
LITTLE, MUCH = 0.8 * CONFIG.settled, 1.2 * CONFIG.settled


def with_crate(crate):
    return replace(BEFORE, objects=(table_object(), crate, CAN))


def shifted(o, by):
    return replace(o, shape=o.shape.moved(transforms.rigid(np.eye(3), (by, 0.0, 0.0))))


def grown(o, by):
    return replace(o, shape=Box(o.shape.T_world_object, o.shape.extents + (0.0, 0.0, by)))


def turned(o, by):
    """Turned so that the ends of the longest edge move by this much."""
    angle = by / (o.shape.extents.max() / 2.0)
    T = o.shape.T_world_object @ transforms.rigid(
        transforms.rotation_from_vector((angle, 0.0, 0.0)), np.zeros(3)
    )
    return replace(o, shape=replace(o.shape, T_world_object=T))


@pytest.mark.parametrize("change", [shifted, grown, turned])
def test_a_shape_changes_only_beyond_the_tolerance(change):
    assert not changed(BEFORE, with_crate(change(CRATE, LITTLE)), CONFIG)
    assert changed(BEFORE, with_crate(change(CRATE, MUCH)), CONFIG)
    assert not changed(BEFORE, with_crate(change(CRATE, MUCH)), replace(CONFIG, settled=2.0 * MUCH))


def test_the_kind_of_a_shape_is_a_change_and_the_names_of_its_axes_are_none():
    assert changed(BEFORE, with_crate(thing(1, cylinder((0.0, 0.0, 0.8), 0.05, 0.3))), CONFIG)
    x, y, z = np.eye(3)
    T = CRATE.shape.T_world_object @ transforms.rigid(np.stack([y, z, x], axis=1), np.zeros(3))
    renamed = Box(T, CRATE.shape.extents[[1, 2, 0]])
    assert not changed(BEFORE, with_crate(replace(CRATE, shape=renamed)), CONFIG)
    ball = thing(3, sphere((0.0, 0.0, 0.0), 0.05))
    assert not reshaped(ball, turned(ball, 0.05), CONFIG)


@pytest.mark.parametrize(
    "other",
    [
        SupportGraph((table_object(), CRATE), BEFORE.supports[:1]),
        replace(BEFORE, supports=BEFORE.supports[:1]),
        replace(BEFORE, supports=(BEFORE.supports[0], Support("o2", "o1"))),
    ],
    ids=["an object", "an edge", "an edge turned round"],
)
def test_objects_and_edges_that_come_or_go_are_a_change(other):
    assert changed(BEFORE, other, CONFIG)
    assert changed(other, BEFORE, CONFIG)


def test_more_evidence_and_more_of_the_table_are_no_change():
    counted = tuple(replace(s, occurrences=5, opportunities=7, certain=False) for s in BEFORE.supports)
    wider = replace(table_object(), shape=box((0.0, 0.0, 0.73), (0.9, 1.3, 0.04)))
    for same in (BEFORE, replace(BEFORE, supports=counted), replace(BEFORE, objects=(wider, CRATE, CAN))):
        assert not changed(BEFORE, same, CONFIG)
    assert not changed(SupportGraph(), SupportGraph(), CONFIG)
