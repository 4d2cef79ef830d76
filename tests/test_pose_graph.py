"""Views are moved jointly to where their pairs and reported poses want them."""

from __future__ import annotations

import numpy as np

from caryatid.sensing.pose_graph import PoseEdges

STILL, MOVING = np.array([0, 0, 1, 2]), np.array([1, 2, 2, 3])


def positive(rng, count):
    A = rng.normal(size=(count, 6, 6))
    return A @ A.swapaxes(1, 2) + np.eye(6)


def ties(rng):
    number = len(STILL)
    return PoseEdges(
        *(STILL, MOVING, 0.1 * rng.normal(size=(number, 6)), np.array([100, 100, 50, 50])),
        *(np.array([80.0, 20.0, 10.0, 50.0]), np.array([0.08, 0.02, 0.01, 0.1])),
        *(rng.normal(size=(number, 6)), positive(rng, number)),
    )


def cost(graph, twists, free, informations):
    change = twists[graph.moving] - twists[graph.still] - graph.apart
    quadratic = np.einsum("ei,eij,ej->", change, graph.information, change) / 2.0
    prior = np.einsum("fi,fij,fj->", twists[free], informations, twists[free]) / 2.0
    return quadratic + prior + float(np.sum(graph.gradient * change))


def test_the_solution_is_the_minimum_and_the_matrix_its_curvature():
    rng = np.random.default_rng(0)
    graph, free, informations = ties(rng), np.array([1, 3]), positive(rng, 2)
    start = 0.1 * rng.normal(size=(4, 6))
    twists, hessian = graph.solve(start, free, informations)
    np.testing.assert_array_equal(twists[[0, 2]], start[[0, 2]])
    least = cost(graph, twists, free, informations)
    for _ in range(20):
        step = rng.normal(size=12)
        other = twists.copy()
        other[free] += step.reshape(2, 6)
        rise = cost(graph, other, free, informations) - least
        np.testing.assert_allclose(rise, step @ hessian @ step / 2.0, rtol=1e-9)


def test_views_that_may_not_move_do_not():
    rng = np.random.default_rng(1)
    start = rng.normal(size=(4, 6))
    twists, hessian = ties(rng).solve(start, np.zeros(0, dtype=np.intp), np.zeros((0, 6, 6)))
    np.testing.assert_array_equal(twists, start)
    assert hessian.shape == (0, 0)


def test_pairs_are_stale_when_they_moved_against_each_other():
    rng = np.random.default_rng(2)
    graph = ties(rng)
    twists = np.zeros((4, 6))
    for still, moving, apart in zip(STILL[[0, 1, 3]], MOVING[[0, 1, 3]], graph.apart[[0, 1, 3]], strict=True):
        twists[moving] = twists[still] + apart
    stale = graph.stale(twists, 1e-6)
    np.testing.assert_array_equal(stale, [False, False, True, False])
    np.testing.assert_array_equal(graph.stale(twists + 0.5, 1e-6), stale)
    assert not PoseEdges.none().stale(twists, 1e-6).any()


def test_partners_are_counted_for_views_and_pairs():
    graph = ties(np.random.default_rng(3))
    np.testing.assert_array_equal(graph.partners(5), [100.0, 90.0, 80.0, 50.0, 0.0])
    shared = graph.shared(np.arange(4))
    np.testing.assert_array_equal(shared, shared.T)
    np.testing.assert_allclose(shared[[0, 0, 1, 2, 0], [1, 2, 2, 3, 3]], [0.8, 0.2, 0.2, 1.0, 0.0])
    # 300 patches asked, 160 found partners 0.21 m off in all, the others count as 1 cm off.
    np.testing.assert_allclose(graph.mean_misfit(0.01), (0.21 + 140 * 0.01) / 300)


def test_pairs_are_taken_out_and_put_together():
    graph = ties(np.random.default_rng(4))
    rest = graph.among(np.array([0, 2, 3]))
    np.testing.assert_array_equal(np.stack([rest.still, rest.moving]), [[0, 2], [2, 3]])
    both = rest.joined(graph.select(graph.moving == 1))
    np.testing.assert_array_equal(both.still, [0, 2, 0])
    np.testing.assert_array_equal(both.information, graph.information[[1, 3, 0]])
    assert len(PoseEdges.none().joined(PoseEdges.none()).found) == 0
