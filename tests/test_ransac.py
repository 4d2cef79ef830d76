from __future__ import annotations

import numpy as np
import pytest

from caryatid.ransac import BATCH, ransac

NORMAL = np.array([0.0, 0.6, 0.8])


class PlaneModel:
    """A plane through one oriented point; hypotheses are (normals, offsets)."""

    sample_size = 1

    def __init__(self, refuse=lambda samples: np.zeros(len(samples), dtype=bool)):
        self.drawn = 0
        self._refuse = refuse

    def estimate(self, samples, points, normals):
        self.drawn += len(samples)
        n = normals[samples[:, 0]]
        return n, np.sum(n * points[samples[:, 0]], axis=1), self._refuse(samples)

    def distances(self, hypotheses, points):
        n, offset, refused = hypotheses
        return np.where(refused[:, None], np.inf, np.abs(points @ n.T - offset).T)


def plane_with_clutter(inliers: int, outliers: int, sigma: float = 0.0, seed: int = 0):
    """Points on one plane, the first ones, amid points of random planes."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (inliers + outliers, 3))
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points[:inliers] -= (points[:inliers] @ NORMAL)[:, None] * NORMAL
    points[:inliers] += sigma * rng.normal(size=(inliers, 1)) * NORMAL
    normals[:inliers] = NORMAL
    return points, normals


def search(points, normals, model, seed=0, **options):
    settings = {"threshold": 0.01, "hypotheses": 200, "confidence": 0.99, "keep": 3} | options
    return ransac(points, normals, model, **settings, rng=np.random.default_rng(seed))


def test_the_plane_is_found_amid_clutter():
    points, normals = plane_with_clutter(60, 140)
    best = search(points, normals, PlaneModel())[0]
    assert best.sample[0] < 60
    assert best.inliers >= 0.3
    # The inliers cost nothing and each clutter point at most one.
    assert best.cost <= 0.7


def test_the_cost_is_the_mean_of_truncated_squares():
    points = np.array([[0.0, 0.0, z] for z in (0.0, 0.0, 0.005, 0.5)])
    normals = np.tile((0.0, 0.0, 1.0), (4, 1))
    best = search(points, normals, PlaneModel(), hypotheses=50)[0]
    assert best.cost == pytest.approx((0.0 + 0.0 + 0.25 + 1.0) / 4.0)
    assert best.inliers == 0.75


def test_msac_prefers_the_nearer_of_two_planes_with_as_many_inliers():
    heights = np.array([0.0] * 20 + [0.009] * 10)
    points = np.stack([np.linspace(0, 1, 30), np.zeros(30), heights], axis=1)
    best = search(points, np.tile((0.0, 0.0, 1.0), (30, 1)), PlaneModel())[0]
    assert best.inliers == 1.0
    assert best.sample[0] < 20


def test_the_best_come_first_and_no_more_than_asked_for():
    points, normals = plane_with_clutter(60, 140, sigma=0.004)
    ranked = search(points, normals, PlaneModel(), keep=7, confidence=1.0 - 1e-12)
    assert len(ranked) == 7
    costs = [r.cost for r in ranked]
    assert costs == sorted(costs)
    assert search(points, normals, PlaneModel(), keep=1, confidence=1.0 - 1e-12)[0].cost == costs[0]


def test_it_stops_as_soon_as_it_can_be_confident():
    points, normals = plane_with_clutter(200, 0)
    easy, hard = PlaneModel(), PlaneModel()
    search(points, normals, easy)
    search(*plane_with_clutter(2, 198), hard)
    assert easy.drawn == BATCH
    assert hard.drawn == 200


def test_more_confidence_takes_more_draws():
    drawn = []
    for confidence in (0.5, 0.99, 0.999999):
        model = PlaneModel()
        search(*plane_with_clutter(50, 150), model, confidence=confidence, hypotheses=1000)
        drawn.append(model.drawn)
    assert drawn[0] < drawn[1] < drawn[2] < 1000


def test_never_more_hypotheses_than_allowed():
    model = PlaneModel()
    search(*plane_with_clutter(2, 198), model, hypotheses=30)
    assert model.drawn == 30


def test_fewer_points_than_a_sample_give_nothing():
    assert search(np.zeros((0, 3)), np.zeros((0, 3)), PlaneModel()) == []


def test_hypotheses_that_are_not_valid_are_not_returned():
    points, normals = plane_with_clutter(60, 140)
    assert search(points, normals, PlaneModel(lambda s: np.ones(len(s), dtype=bool))) == []
    only_clutter = search(points, normals, PlaneModel(lambda s: s[:, 0] < 60))
    assert only_clutter
    assert all(r.sample[0] >= 60 for r in only_clutter)


def test_the_same_seed_draws_the_same_samples_and_another_one_others():
    points, normals = plane_with_clutter(60, 140, sigma=0.004)
    first, again, other = (search(points, normals, PlaneModel(), seed=s) for s in (5, 5, 6))
    assert [r.sample.tolist() for r in first] == [r.sample.tolist() for r in again]
    assert [r.sample.tolist() for r in first] != [r.sample.tolist() for r in other]
