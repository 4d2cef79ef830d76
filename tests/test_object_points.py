"""The points of each object: added view by view, merged, divided, never lost."""

from __future__ import annotations

import numpy as np

from caryatid.object_points import ObjectPoints, joined
from caryatid.views import SUPPORT_LABEL, Cloud


def cloud(count, label, at=0.0):
    points = np.full((count, 3), at) + np.arange(count)[:, None]
    return Cloud(points, np.tile((0.0, 0.0, 1.0), (count, 1)), np.full(count, label, dtype=np.int32))


def two_views():
    points = ObjectPoints()
    for view, at in enumerate((0.0, 100.0)):
        for label, count in ((1, 4), (3, 6), (SUPPORT_LABEL, 5)):
            points.add(label, cloud(count, label, at), view)
    return points


def test_views_add_up():
    points = two_views()
    assert points.objects == [1, 3]
    assert points.labels_used == 3
    assert len(points.of(3)) == 12
    assert len(points.newest(3)) == 6
    assert points.newest(3).points_world[0, 0] == 100.0
    assert len(points.everything()) == 30
    assert set(points.everything().labels) == {1, 3, SUPPORT_LABEL}
    assert len(points.of(7)) == 0
    assert 3 in points
    assert 7 not in points


def test_merging_keeps_every_point_under_the_new_label():
    points = two_views()
    points.merge(1, 3)
    assert points.objects == [3]
    assert len(points.of(3)) == 20
    assert set(points.of(3).labels) == {3}
    assert len(points.everything()) == 30


def test_dividing_gives_each_group_its_points_and_new_labels_only():
    points = two_views()
    groups = np.tile([0, 1, 2], 4)
    before = points.of(3).points_world
    names = points.divide(3, groups)
    assert names == [3, 4, 5]
    assert points.labels_used == 5
    for number, name in enumerate(names):
        np.testing.assert_array_equal(points.of(name).points_world, before[groups == number])
        assert set(points.of(name).labels) == {name}
    assert len(points.everything()) == 30


def test_a_label_given_up_is_not_given_again():
    points = two_views()
    points.merge(3, 1)
    assert points.divide(1, np.arange(20) % 2) == [1, 4]


def test_colours_stay_only_where_all_have_them():
    plain = cloud(2, 1)
    coloured = Cloud(plain.points_world, plain.normals_world, plain.labels, np.zeros((2, 3), dtype=np.uint8))
    assert joined([coloured, coloured]).rgb is not None
    assert joined([coloured, plain]).rgb is None
    assert len(joined([])) == 0
