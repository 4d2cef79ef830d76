"""Points and shapes of all objects: parts are divided and united as the shapes suggest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import box, cylinder, surface_points

from caryatid.config import Config
from caryatid.objects.models import ObjectModels
from caryatid.segmentation.perception import Percept
from caryatid.sensing.views import Cloud

CRATE, CAN = box((0.0, 0.0, 0.8), (0.16, 0.12, 0.1)), cylinder((0.0, 0.0, 0.91), 0.03, 0.12)


def percept_of(labels, shapes=(CRATE, CAN), eye=(-1.2, -0.6, 1.8), seed=0):
    rng = np.random.default_rng(seed)
    parts = [surface_points(s, rng, eye=eye, spacing=0.005, sigma=0.001) for s in shapes]
    points = np.concatenate([p for p, _ in parts])
    named = np.repeat(np.array(labels, dtype=np.int32), [len(p) for p, _ in parts])
    cloud = Cloud(points, np.concatenate([n for _, n in parts]), named)
    return Percept(None, cloud, np.arange(len(points)), None)


@pytest.fixture
def models():
    return ObjectModels(Config(), 0)


def test_what_was_taken_for_one_is_divided_and_the_view_relabelled(models):
    percept = percept_of((1, 1))
    models.fit_all(models.add(percept, 0))
    assert [o.label for o in models.objects()] == [1]
    changed = models.divide({1})
    assert len(changed) == 2
    assert sorted(o.shape.kind for o in models.objects()) == ["box", "cylinder"]
    relabelled = models.nearest(percept, changed)
    truth = percept_of((1, 2)).labels
    for k in (1, 2):
        assert (
            np.unique(relabelled.labels[truth == k], return_counts=True)[1].max() > 0.9 * (truth == k).sum()
        )


def test_later_parts_over_both_are_divided_among_the_known(models):
    models.fit_all(models.add(percept_of((1, 2)), 0))
    again = models.associate(percept_of((7, 7), seed=1))
    assert set(np.unique(again.labels)) == {1, 2}
    assert (again.labels == percept_of((1, 2), seed=1).labels).mean() > 0.9


def test_two_labels_of_one_object_are_united(models):
    left, right = (-1.2, -0.6, 1.8), (1.2, 0.6, 1.8)
    models.fit_all(models.add(percept_of((1,), (CRATE,), left), 0))
    models.fit_all(models.add(percept_of((1,), (CRATE,), right), 0))
    models.fit_all(models.add(percept_of((2,), (CRATE,), left, seed=3), 0))
    given_up = models.unite({1, 2})
    assert len(given_up) == 1
    assert [o.shape.kind for o in models.objects()] == ["box"]
    np.testing.assert_allclose(np.sort(models.objects()[0].shape.extents), np.sort(CRATE.extents), atol=0.005)


def test_the_newest_view_alone_is_fitted_on_demand(models):
    models.fit_all(models.add(percept_of((1, 2)), 0))
    models.fit_newest(models.add(percept_of((2,), (CAN,)), 0))
    assert [o.label for o in models.objects()] == [2]


def test_an_object_that_could_not_be_divided_is_left_alone_until_it_has_grown(models, monkeypatch):
    tried = []
    monkeypatch.setattr("caryatid.objects.models.split", lambda *a, **k: tried.append(len(a[0].points)))
    models.fit_all(models.add(percept_of((1,), (CRATE,)), 0))
    assert models.divide({1}) == set()
    assert models.divide({1}) == set()
    assert len(tried) == 1
    models.fit_all(models.add(percept_of((1,), (CRATE,), (1.2, 0.6, 1.8)), 0))
    models.divide({1})
    assert len(tried) == 2


def test_a_pair_is_looked_at_again_when_one_of_them_has_been_divided(models, monkeypatch):
    models.fit_all(models.add(percept_of((1, 1)), 0))
    models.fit_all(models.add(percept_of((2,), (CRATE,), seed=3), 0))

    def all_are_two(evidence, alone, changed, apart, **settings):
        apart[1, 2] = 10**6

    with monkeypatch.context() as patched:
        patched.setattr("caryatid.objects.models.united", all_are_two)
        assert models.unite({1, 2}) == {}
    assert models.unite({1, 2}) == {}
    models.unite(models.divide({1}))
    assert sorted(o.shape.kind for o in models.objects()) == ["box", "cylinder"]


def test_labels_of_the_percept_are_required():
    percept = percept_of((1, 2))
    bare = replace(percept, cloud=replace(percept.cloud, labels=None))
    with pytest.raises(ValueError, match="labelled"):
        _ = bare.labels
