"""The compiled loops of automatic segmentation beside plain references."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raycast import TABLE, from_the_side, table_scene
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from caryatid.config import CloudConfig, SegmentationConfig, SurfaceConfig
from caryatid.geometry import transforms
from caryatid.segmentation.clusters import OneBody, cluster_by_mean, cluster_by_mean_reference
from caryatid.segmentation.concavity import convex, hollowness
from caryatid.segmentation.plane_fits import Window, tangent_planes, tangent_planes_reference
from caryatid.segmentation.sample_graph import (
    bent_lengths,
    count_borders,
    count_borders_reference,
    nearest_seeds,
    nearest_seeds_reference,
)
from caryatid.segmentation.sample_grid import TOUCHING, colour_patches, grid_edges, spread_labels, wide_parts
from caryatid.segmentation.samples import find_foreground
from caryatid.segmentation.segments import find_support_surface, on_surface
from caryatid.sensing.clouds import oriented_points

UP = np.array([0.0, 0.0, 1.0])
BOXES = [(np.array([0.1 * k, 0.22 * k, TABLE + 0.05]), np.array([0.1, 0.2, 0.1])) for k in (-2, 0, 2)]


@pytest.mark.parametrize("posed", [True, False])
def test_the_foreground_is_what_stands_on_the_surface(posed):
    view = table_scene(from_the_side(33.0), BOXES, sigma=0.001)
    view = view if posed else replace(view, T_world_camera=None)
    points, normals, _ = oriented_points(view, CloudConfig(), 2)
    rng = np.random.default_rng(0)
    surface = find_support_surface(points, normals, UP if posed else None, SurfaceConfig(), rng)
    config, clouds = SegmentationConfig(), CloudConfig(min_depth=0.9, max_depth=1.3)
    found = find_foreground(view, surface, config, clouds)
    T = view.T_world_camera if posed else np.eye(4)
    points = transforms.transform(T, view.points_camera)
    in_range = (view.depth >= 0.9) & (view.depth <= 1.3)
    expected = np.zeros_like(in_range)
    expected[in_range] = on_surface(points[in_range], surface, config)
    assert 0 < expected.sum() < in_range.sum() < in_range.size
    assert (found.pixels != expected).sum() <= 2
    inverse = np.where(in_range, 1.0 / np.where(in_range, view.depth, 1.0), 0.0)
    np.testing.assert_allclose(found.inverse_depth, inverse, rtol=1e-6)
    assert 0.0 < surface.distance_outside(points[found.pixels]).max() < config.margin + 1e-9
    assert surface.distance_outside(points[in_range & (view.labels > 0)]).max() > config.margin


def crease(noise: float):
    """Inverse depth of two planes that meet in column 24, and each pixel's tangent plane before noise."""
    v, u = np.mgrid[:40, :48].astype(float)
    inverse = 0.6 + 0.002 * np.abs(u - 24.0) + 0.001 * v
    planes = np.stack([inverse, 0.002 * np.sign(u - 24.0), np.full_like(u, 0.001)], axis=-1)
    noisy = inverse + noise * np.random.default_rng(0).standard_normal(inverse.shape)
    return np.where((u > 40) & (v > 30), 0.0, noisy).astype(np.float32), planes


NARROW, WIDE = Window(2, 0.01, 0.004), Window(5, 0.004, 0.0)


def test_tangent_planes_agree_with_their_reference():
    image, _ = crease(0.0015)
    image[20, :10] = 0.9
    image[:5, :5] = 0.0
    image[2, 2] = 0.6
    pixels = np.argwhere(image > 0.0)[::3]
    pixels = np.concatenate([pixels, [[2, 2], [20, 4], [39, 0]]])
    ours = tangent_planes(image, pixels, NARROW, WIDE)
    reference = tangent_planes_reference(image, pixels, NARROW, WIDE)
    np.testing.assert_allclose(ours, reference, atol=1e-9)
    assert not ours[-3].any()
    assert ours[:, 0].min() < 0.1 < 0.5 < np.median(ours[:, 0])


def test_tangent_planes_lose_noise_and_keep_creases():
    image, planes = crease(0.0015)
    pixels = np.argwhere((image > 0.0) & (np.abs(np.arange(48) - 24.0) > 3.0))
    truth = planes[tuple(pixels.T)]
    error = np.abs(tangent_planes(image, pixels, NARROW, WIDE) - truth).mean(axis=0)
    assert (error < np.array([0.0005, 0.0002, 0.0002])).all()


def bumpy(shape=(14, 17), seed=0):
    """Samples on a grid with holes and steps, normals all over."""
    rng = np.random.default_rng(seed)
    places = rng.random(shape) < 0.8
    v, u = np.argwhere(places).T
    z = 1.0 + 0.02 * np.round(rng.random(len(v)) * 1.5) + 0.003 * rng.standard_normal(len(v))
    points = np.stack([0.004 * u * z, 0.004 * v * z, z], axis=-1)
    return places, points, transforms.unit(rng.normal(size=(len(v), 3)) * 0.3 + (0.0, 0.0, -1.0))


def test_grid_edges_are_those_of_the_reference():
    places, points, normals = bumpy()
    number = {tuple(place): k for k, place in enumerate(np.argwhere(places).tolist())}
    edges, steps = set(), set()
    jump, most, rise, gap = 0.006, 0.02, 0.004, 3
    for (row, col), i in number.items():
        for down, right in [*TOUCHING, (0, 2), (2, 0), (0, 3), (3, 0)]:
            j = number.get((row + down, col + right))
            between = [(row + k * (down > 0), col + k * (right > 0)) for k in range(1, max(down, right))]
            if j is None or any(place in number for place in between):
                continue
            (p, n), (q, m) = (points[i], normals[i]), (points[j], normals[j])
            off = min(abs(n @ q / (n @ p) - 1.0) / q[2], abs(m @ p / (m @ q) - 1.0) / p[2])
            if off <= jump and abs(1.0 / p[2] - 1.0 / q[2]) <= most:
                edges |= {(i, j)} if max(down, right) == 1 else set()
            elif max(n @ (q - p), m @ (p - q)) > rise:
                steps.add((i, j))
    ours = grid_edges(places, points, normals, jump, most, rise, gap)
    assert len(ours[0]) == len(edges) > 100
    assert len(ours[1]) == len(steps) > 100
    assert {tuple(pair) for pair in ours[0].tolist()} == edges
    assert {tuple(pair) for pair in ours[1].tolist()} == steps


def blocks(shape=(9, 12), values=5, size=4, seed=0):
    """A label image of random blocks, some of them one place wide only."""
    labels = np.random.default_rng(seed).integers(0, values, size=shape).astype(np.int32)
    labels = np.repeat(np.repeat(labels, size, axis=0), size, axis=1)
    labels[7, 3:30] = values
    labels[3:30, 40] = values + 1
    labels[:2, :3] = values + 2
    labels[20:22, 10:12] = values + 3
    return labels


def test_wide_parts_hold_a_square_of_three():
    labels = blocks()
    square = np.ones((3, 3), dtype=bool)
    least = ndimage.minimum_filter(labels, footprint=square, mode="nearest")
    core = least == ndimage.maximum_filter(labels, footprint=square, mode="nearest")
    expected = np.isin(np.arange(labels.max() + 1), labels[core])
    assert 2 < expected.sum() < len(expected)
    np.testing.assert_array_equal(wide_parts(labels), expected)


def test_colour_patches_are_connected_components():
    rng = np.random.default_rng(2)
    labels = blocks(values=3)
    paints = rng.integers(0, 255, size=(4, 3))
    rgb = paints[blocks(shape=(18, 24), size=2, values=3, seed=3) % 4] + rng.integers(
        0, 4, size=(*labels.shape, 3)
    )
    rgb = np.clip(rgb, 0, 255).astype(np.uint8)
    shares = (rgb + 1.0) / (rgb + 1.0).sum(axis=-1, keepdims=True)
    place, pairs = np.arange(labels.size).reshape(labels.shape), []
    for here, there in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1),), (slice(1, None),)),
    ):
        alike = np.linalg.norm(shares[here] - shares[there], axis=-1) < 0.04
        alike &= (labels[here] == labels[there]) & (labels[here] > 0)
        pairs.append(np.stack([place[here][alike], place[there][alike]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(labels.size, labels.size))
    expected = connected_components(graph, directed=False)[1].reshape(labels.shape)
    patch = colour_patches(labels, rgb, 0.04)
    np.testing.assert_array_equal(patch < 0, labels == 0)
    known, order = np.unique(expected[labels > 0], return_inverse=True)
    assert 10 < len(known) < np.count_nonzero(labels) / 3
    np.testing.assert_array_equal(patch[labels > 0], order)


def spread_reference(labels, foreground, depth, jump, rounds):
    labels = labels.copy()
    height, width = labels.shape
    for _ in range(rounds):
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            here = (slice(max(-down, 0), height - max(down, 0)), slice(max(-right, 0), width - max(right, 0)))
            there = (slice(max(down, 0), height + min(down, 0)), slice(max(right, 0), width + min(right, 0)))
            taken = (labels[here] == 0) & (labels[there] > 0) & foreground[here]
            taken &= np.abs(depth[here] - depth[there]) <= np.float32(jump) * depth[here] * depth[there]
            labels[here][taken] = labels[there][taken]
    return labels


@pytest.mark.parametrize("rounds", [1, 2, 5])
def test_labels_spread_over_the_foreground_up_to_depth_steps(rounds):
    rng = np.random.default_rng(rounds)
    labels = np.where(rng.random((40, 50)) < 0.03, rng.integers(1, 6, size=(40, 50)), 0).astype(np.int32)
    foreground = rng.random((40, 50)) < 0.8
    depth = (1.0 + 0.1 * blocks((10, 13), values=3)[:40, :50] + 0.003 * rng.random((40, 50))).astype(
        np.float32
    )
    spread = spread_labels(labels, foreground, depth, 0.012, rounds)
    np.testing.assert_array_equal(spread, spread_reference(labels, foreground, depth, 0.012, rounds))
    assert np.count_nonzero(labels) < np.count_nonzero(spread) < np.count_nonzero(foreground | (labels > 0))


def random_graph(seed, nodes=60, edges=150):
    """Pairs of nodes, each once, and as many numbers in [−1, 1], some of them alike."""
    rng = np.random.default_rng(seed)
    pairs = np.unique(np.sort(rng.integers(0, nodes, size=(edges, 2)), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return pairs, np.round(rng.uniform(-0.7, 1.0, size=len(pairs)), 1), rng


def test_nearest_seeds_equal_dijkstra():
    pairs, _, rng = random_graph(3, nodes=300, edges=700)
    costs = rng.uniform(0.1, 1.0, size=len(pairs))
    seeds = rng.choice(300, size=12, replace=False)
    owner = nearest_seeds(300, pairs, costs, seeds)
    np.testing.assert_array_equal(owner, nearest_seeds_reference(300, pairs, costs, seeds))
    assert (owner[seeds] == np.arange(12)).all()
    assert (nearest_seeds(4, np.array([[0, 1]]), np.array([1.0]), np.array([0])) == [0, 0, -1, -1]).all()


def test_borders_are_counted_as_by_the_reference():
    pairs, _, rng = random_graph(4, nodes=300, edges=2000)
    owner = rng.integers(-1, 12, size=300)
    found, lengths = count_borders(owner, pairs, 12)
    expected, counts = count_borders_reference(owner, pairs, 12)
    assert counts.max() > 10
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(lengths, counts)
    nothing, _ = count_borders(owner, pairs[:0], 12)
    assert nothing.shape == (0, 2)


def test_edges_are_measured_along_the_surface():
    points = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 2.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    lengths, turns = bent_lengths(points, normals, np.array([[0, 1], [1, 2]]))
    np.testing.assert_allclose(lengths, [5.0, 2.0])
    np.testing.assert_allclose(turns, [0.0, 1.0])


def hollowness_reference(patch):
    inwards = patch[:, :3].mean(axis=0) - patch[:, :3]
    length = np.maximum(np.linalg.norm(inwards, axis=-1), 1e-9)
    return float(np.mean(np.einsum("ij,ij->i", patch[:, 3:], inwards) / length))


def concave_share_reference(first, second, rise, bend):
    between = second[None, :, :3] - first[:, None, :3]
    slack = rise + bend * np.linalg.norm(between, axis=-1)
    over = np.einsum("abi,ai->ab", between, first[:, 3:]) > slack
    under = -np.einsum("abi,bi->ab", between, second[:, 3:]) > slack
    return float((over | under).mean())


def random_patches(rng, count):
    return np.concatenate(
        [
            rng.normal(size=(count, 3)) * (0.1, 0.1, 0.02),
            transforms.unit(rng.normal(size=(count, 3)) + 2.0 * UP),
        ],
        axis=1,
    )


def test_hollow_and_concave_patches_are_those_of_the_references():
    rng = np.random.default_rng(5)
    for _ in range(20):
        first, second = random_patches(rng, 30), random_patches(rng, 21)
        assert abs(hollowness(first) - hollowness_reference(first)) < 1e-12
        share = concave_share_reference(first, second, 0.01, 0.26)
        assert convex(first, second, 0.01, 0.26, share + 1e-6)
        assert not convex(first, second, 0.01, 0.26, share - 1e-6)


def test_clusters_are_those_of_the_reference():
    refused = []
    for seed in range(30):
        pairs, attraction, rng = random_graph(seed, nodes=400, edges=1100)
        lengths = rng.integers(1, 4, size=len(pairs)).astype(float)
        patches = random_patches(rng, 400)
        usual = concave_share_reference(patches[:100], patches[100:], 0.01, 0.26)
        body = OneBody(3, -0.15 if seed % 3 == 0 else 0.2, 0.01, 0.26, usual)

        def allowed(first, second, patches=patches, body=body):
            if min(len(first), len(second)) < body.least:
                return True
            p, q = (patches[m[:: max(1, len(m) // 60)]] for m in (first, second))
            if min(hollowness_reference(p), hollowness_reference(q)) > body.hollow:
                return True
            refused.append(concave_share_reference(p, q, body.rise, body.bend) > body.share)
            return not refused[-1]

        expected = cluster_by_mean_reference(400, pairs, attraction, lengths, allowed)
        assert 3 < len(np.unique(expected)) < 300
        np.testing.assert_array_equal(cluster_by_mean(pairs, attraction, lengths, patches, body), expected)
    assert 300 < sum(refused) < len(refused) - 300
