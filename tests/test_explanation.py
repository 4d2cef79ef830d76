"""What explanations cost: compiled sums beside their references, and objects explained together as alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import box, cylinder, sphere, surface_points
from test_degenerate_fits import POINTS, UP

from caryatid.config import ExplanationConfig, FitConfig, SplitConfig
from caryatid.geometry import transforms
from caryatid.objects.description_length import (
    Evidence,
    around,
    border_cost,
    explain,
    explained_by,
    gather,
    joined,
    lies_on,
    point_costs,
    price,
)
from caryatid.objects.model_split import split
from caryatid.sensing.views import Cloud

COSTS, FIT = ExplanationConfig(), FitConfig()
EYE = (-1.2, -0.6, 1.0)
SHAPES = [
    box((0.0, 0.0, 0.05), (0.1, 0.14, 0.1), turn_deg=20.0),
    cylinder((0.0, 0.0, 0.05), 0.04, 0.1),
    sphere((0.0, 0.0, 0.05), 0.05),
]

each = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)


def evidence_of(shape, seed=0, sigma=0.002, turned=0.2, voxels=None) -> Evidence:
    rng = np.random.default_rng(seed)
    points, normals = surface_points(shape, rng, eye=EYE, sigma=sigma)
    normals = transforms.unit(normals + turned * rng.normal(size=normals.shape))
    return gather(Cloud(points, normals), 0.003, voxels, COSTS)


def test_a_point_costs_by_its_distance_over_the_noise_and_by_its_turn():
    ball = sphere((0.0, 0.0, 0.0), 0.05)
    points = np.array([[0.05, 0.0, 0.0], [0.053, 0.0, 0.0], [0.05, 0.0, 0.0], [0.2, 0.0, 0.0]])
    normals = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, np.sqrt(0.75), 0.0], [1.0, 0.0, 0.0]])
    cost = point_costs(ball, Evidence(points, normals, np.ones(4), 0.003, None), COSTS)
    np.testing.assert_allclose(cost, (0.0, 0.5, 0.5 * COSTS.normal_weight, COSTS.outlier), atol=1e-9)


def test_points_of_no_shape_are_left_without_one():
    rng = np.random.default_rng(0)
    crumpled = Evidence(
        rng.uniform(-0.1, 0.1, (400, 3)),
        transforms.unit(rng.normal(size=(400, 3))),
        np.ones(400),
        0.003,
        None,
    )
    few = crumpled.select(np.arange(FIT.min_points - 1))
    for evidence, best in zip((crumpled, few), explain([crumpled, few], COSTS, FIT, [rng, rng]), strict=True):
        assert best.shape is None
        assert best.cost == pytest.approx(COSTS.irregular * len(evidence.points) + price(None, COSTS))


def test_objects_explained_together_are_as_explained_alone():
    parts = [evidence_of(shape, seed) for seed, shape in enumerate(SHAPES)]
    together = explain(parts, COSTS, FIT, [np.random.default_rng(k) for k in range(3)])
    backwards = explain(parts[::-1], COSTS, FIT, [np.random.default_rng(k) for k in (2, 1, 0)])[::-1]
    for k, part in enumerate(parts):
        (alone,) = explain([part], COSTS, FIT, [np.random.default_rng(k)])
        for best in (together[k], backwards[k]):
            assert best.cost == alone.cost
            np.testing.assert_array_equal(best.shape.T_world_object, alone.shape.T_world_object)
    assert explain([], COSTS, FIT, []) == []


def test_neighbours_are_the_nearest_points():
    points = np.random.default_rng(0).normal(size=(50, 3))
    gap = np.linalg.norm(points[:, None] - points, axis=2)
    near = around(points, 6)
    assert near.shape == (50, 6)
    np.testing.assert_array_equal(np.sort(near, axis=1), np.sort(np.argsort(gap, axis=1)[:, :6], axis=1))
    assert (np.sort(near, axis=1) == np.arange(50)[:, None]).any(axis=1).all()
    assert around(points[:3], 6).shape == (3, 3)
    assert around(points[:1], 6).tolist() == [[0]]


@pytest.mark.parametrize("seed", range(3))
def test_the_cost_of_a_border_is_that_of_the_reference(seed):
    rng = np.random.default_rng(seed)
    crate, can = box((0.0, 0.0, 0.05), (0.16, 0.12, 0.1)), cylinder((0.0, 0.0, 0.16), 0.04, 0.12)
    both = joined(evidence_of(crate, seed), evidence_of(can, seed))
    both = replace(both, weights=rng.uniform(0.5, 1.5, len(both.points)))
    second = both.points @ rng.normal(size=3) > 0.02
    near = around(both.points, COSTS.neighbours)
    smooth = total = 0.0
    for i, neighbours in enumerate(near):
        for j in neighbours:
            if second[i] != second[j]:
                between = both.points[j] - both.points[i]
                bend = (both.normals[j] - both.normals[i]) @ between / np.linalg.norm(between)
                length = both.weights[i] / COSTS.neighbours
                total += length
                smooth += length * (bend > -np.sin(np.radians(COSTS.crease)))
    assert 0.0 < smooth < total
    cost, share = border_cost(second, both, near, COSTS)
    assert cost == pytest.approx(COSTS.border * smooth)
    assert share == pytest.approx(smooth / total)
    assert border_cost(np.zeros_like(second), both, near, COSTS) == (0.0, 0.0)


def test_points_in_a_layer_on_a_shape_or_inside_it_may_be_of_it():
    crate = SHAPES[0]
    points, normals = surface_points(crate, np.random.default_rng(0), eye=EYE, sigma=0.0005)
    assert lies_on(crate, points + (COSTS.layer - 0.002) * normals, COSTS)
    assert lies_on(crate, points - 0.02 * normals, COSTS)
    assert not lies_on(crate, points + (COSTS.layer + 0.002) * normals, COSTS)
    most = int((COSTS.layer_share + 0.05) * len(points))
    off = np.where(np.arange(len(points))[:, None] < most, 0.0, 0.05) * normals
    assert lies_on(crate, points + off, COSTS)
    off = np.where(np.arange(len(points))[:, None] < most - 0.1 * len(points), 0.0, 0.05) * normals
    assert not lies_on(crate, points + off, COSTS)


@pytest.mark.filterwarnings("error")
def test_points_that_determine_nothing_have_a_finite_cost():
    finite = {
        k: p for k, p in POINTS.items() if len(p) > 0 and np.isfinite(p).all() and np.abs(p).max() < 1e6
    }
    assert len(finite) > 8
    parts = [Evidence(p, UP[: len(p)], np.ones(len(p)), 0.003, None) for p in finite.values()]
    for best in explain(parts, COSTS, FIT, [np.random.default_rng(0)] * len(parts)):
        assert np.isfinite(best.cost)
    for part in parts:
        whole = explained_by(SHAPES[0], part, COSTS)
        groups = split(
            part,
            whole,
            up=np.array([0.0, 0.0, 1.0]),
            config=SplitConfig(),
            costs=COSTS,
            fit_config=FIT,
            rng=np.random.default_rng(0),
        )
        assert groups is None or len(groups) == len(part.points)
