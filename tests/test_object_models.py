"""Points and shapes of all objects: parts are divided and united as the shapes suggest."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import box, cylinder, sphere, surface_at, surface_points

from caryatid.config import Config
from caryatid.fitting.primitives import FitFailure
from caryatid.geometry import transforms
from caryatid.objects.models import ObjectModels, ObjectPoints
from caryatid.segmentation.observation import Observation
from caryatid.sensing.views import Cloud
from caryatid.sensing.voxel_map import VoxelMap

CRATE, CAN = box((0.0, 0.0, 0.8), (0.16, 0.12, 0.1)), cylinder((0.0, 0.0, 0.91), 0.03, 0.12)


def observation_of(labels, shapes=(CRATE, CAN), eye=(-1.2, -0.6, 1.8), seed=0):
    rng = np.random.default_rng(seed)
    parts = [surface_points(s, rng, eye=eye, spacing=0.005, sigma=0.001) for s in shapes]
    points = np.concatenate([p for p, _ in parts])
    named = np.repeat(np.array(labels, dtype=np.int32), [len(p) for p, _ in parts])
    cloud = Cloud(points, np.concatenate([n for _, n in parts]), named)
    return Observation(None, cloud, np.arange(len(points)), None, np.empty((0, 2), dtype=np.int32))


@pytest.fixture
def models():
    return ObjectModels(Config(), 0)


def test_what_was_taken_for_one_is_divided_and_the_view_relabelled(models):
    observation = observation_of((1, 1))
    models.fit_all(models.add(observation, 0))
    assert [o.label for o in models.objects()] == [1]
    changed = models.divide({1})
    assert len(changed) == 2
    assert sorted(o.shape.kind for o in models.objects()) == ["box", "cylinder"]
    relabelled = models.nearest(observation, changed)
    truth = observation_of((1, 2)).labels
    for k in (1, 2):
        assert (
            np.unique(relabelled.labels[truth == k], return_counts=True)[1].max() > 0.9 * (truth == k).sum()
        )


def test_later_parts_over_both_are_divided_among_the_known(models):
    models.fit_all(models.add(observation_of((1, 2)), 0))
    again = models.associate(observation_of((7, 7), seed=1), models.objects())
    assert set(np.unique(again.labels)) == {1, 2}
    assert (again.labels == observation_of((1, 2), seed=1).labels).mean() > 0.9


def test_two_labels_of_one_object_are_united(models):
    left, right = (-1.2, -0.6, 1.8), (1.2, 0.6, 1.8)
    models.fit_all(models.add(observation_of((1,), (CRATE,), left), 0))
    models.fit_all(models.add(observation_of((1,), (CRATE,), right), 0))
    models.fit_all(models.add(observation_of((2,), (CRATE,), left, seed=3), 0))
    given_up = models.unite({1, 2})
    assert len(given_up) == 1
    assert [o.shape.kind for o in models.objects()] == ["box"]
    np.testing.assert_allclose(np.sort(models.objects()[0].shape.extents), np.sort(CRATE.extents), atol=0.005)


def test_two_united_without_a_shape_that_fits_are_not_looked_up_again(models, monkeypatch):
    models.fit_all(models.add(observation_of((1, 3)), 0))
    models.fit_all(models.add(observation_of((2,), (CRATE,), seed=3), 1))
    counts = {k: len(models.points.of(k)) for k in (1, 2)}
    failure = FitFailure("too few points")
    monkeypatch.setattr("caryatid.objects.models.fit", lambda *_, **__: failure)
    ((old, new),) = models.unite({1, 2, 3}).items()
    assert {old, new} == {1, 2}
    assert len(models.points.of(new)) == sum(counts.values())
    assert [o.label for o in models.objects()] == [3]


@pytest.mark.parametrize(("plated", "kind"), [(True, "solid"), (False, "sphere")])
def test_a_shape_that_another_object_would_fill_is_not_taken(models, plated, kind):
    """The outside of a bowl with a plate on it is no ball: the plate was seen where the ball would be."""
    ball, plate = sphere((0.0, 0.0, 0.83), 0.08), cylinder((0.0, 0.0, 0.84), 0.1, 0.02)
    observation = observation_of((1, 2), (ball, plate))
    points, labels = observation.cloud.points_world, observation.labels
    shown = np.where((labels == 1) & (points[:, 2] > 0.83), 0, labels)
    shown = shown if plated else np.where(shown == 2, 0, shown)
    models.fit_all(models.add(observation.with_labels(shown.astype(np.int32)), 0))
    assert models.objects()[0].shape.kind == "sphere"
    models.form({1, 2}, VoxelMap.around(np.array([0.0, 0.0, 0.75]), Config().voxels), np.empty((0, 3)))
    assert models.objects()[0].shape.kind == kind


@pytest.mark.parametrize(("table", "kind"), [(0.81, "solid"), (0.75, "sphere")])
def test_a_shape_that_the_table_would_fill_is_not_taken(models, table, kind):
    """The upper half of a ball, seen alone, is a dome where it stands on a table, and a ball above one."""
    observation = observation_of((1,), (sphere((0.0, 0.0, 0.83), 0.08),), eye=(-0.9, -0.6, 1.8))
    shown = np.where(observation.cloud.points_world[:, 2] > 0.83, 1, 0).astype(np.int32)
    observation = observation.with_labels(shown)
    models.fit_all(models.add(observation, 0))
    feet = observation.footprint(surface_at(table), Config().explanation.spacing)
    models.form({1}, VoxelMap.around(np.array([0.0, 0.0, 0.75]), Config().voxels), feet)
    assert models.objects()[0].shape.kind == kind


def test_a_pair_is_looked_at_again_when_one_of_them_has_been_divided(models, monkeypatch):
    models.fit_all(models.add(observation_of((1, 1)), 0))
    models.fit_all(models.add(observation_of((2,), (CRATE,), seed=3), 0))

    def all_are_two(known, changed, apart, **settings):
        apart[1, 2] = 10**6

    with monkeypatch.context() as patched:
        patched.setattr("caryatid.objects.models.best_merge", all_are_two)
        assert models.unite({1, 2}) == {}
    assert models.unite({1, 2}) == {}
    models.unite(models.divide({1}))
    assert sorted(o.shape.kind for o in models.objects()) == ["box", "cylinder"]


def cloud(count, label, at=0.0):
    points = np.full((count, 3), at) + np.arange(count)[:, None]
    return Cloud(points, np.tile((0.0, 0.0, 1.0), (count, 1)), np.full(count, label, dtype=np.int32))


def add(points, cloud, view):
    points.add(cloud, cloud.labels, view)


def test_dividing_and_merging_keep_every_point_and_never_give_a_label_again():
    points = ObjectPoints()
    for label, count in ((1, 4), (3, 12)):
        add(points, cloud(count, label), 0)
    before, groups = points.of(3).points_world, np.tile([0, 1, 2], 4)
    assert points.divide(3, groups) == [3, 4, 5]
    for number, name in enumerate((3, 4, 5)):
        np.testing.assert_array_equal(points.of(name).points_world, before[groups == number])
    points.merge(5, 1)
    assert (points.objects, len(points.of(1))) == ([1, 3, 4], 8)
    assert points.divide(1, np.arange(8) % 2) == [1, 6]


def test_many_views_leave_no_more_than_the_newest_points_of_a_place():
    points = ObjectPoints()
    for view in range(9):
        add(points, cloud(20, 1, 0.01 * view), view)
        points.bound({1: 0.5}, 8, 4)
        assert len(points.of(1)) == (20 * (view + 1) if view < 8 else 80)
    left = np.unique(np.round(points.of(1).points_world[:, 0] % 1.0, 9))
    np.testing.assert_array_equal(left, [0.05, 0.06, 0.07, 0.08])
    points.move({8: transforms.rigid(np.eye(3), (0.2, 0.0, 0.0))})
    assert (points.of(1).points_world[:, 0] % 1.0 > 0.2).sum() == 20


def test_colours_stay_only_where_all_have_them():
    plain = cloud(2, 1)
    coloured = Cloud(plain.points_world, plain.normals_world, plain.labels, np.zeros((2, 3), dtype=np.uint8))
    points = ObjectPoints()
    for view, (added, colours) in enumerate(
        [(coloured, True), (coloured, True), (plain, False), (coloured, False)]
    ):
        add(points, added, view)
        assert (points.everything().rgb is not None) == colours
        assert len(points.everything()) == 2 * (view + 1)
