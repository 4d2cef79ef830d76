"""Two objects taken for one: a plane that parts the points such that each side is one shape."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caryatid import frames
from caryatid.config import FitConfig, SplitConfig
from caryatid.frames import Array
from caryatid.primitives import candidates

Groups = NDArray[np.intp]


@dataclass(frozen=True, eq=False, slots=True)
class Split:
    """A way to part points.

    Attributes:
        groups: Group of each point (N,), from 0.
        residual: Mean distance [m] of the points to the shapes of their groups.
    """

    groups: Groups
    residual: float


def split(
    points: Array,
    normals: Array,
    residual: float,
    *,
    up: Array,
    config: SplitConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> Groups | None:
    """Part points that no single shape explains, if a cut along a plane explains them much better.

    Cuts are tried across the vertical, where one object lies on another, and across the two horizontal
    directions of the points' faces, where they stand side by side. Unconnected remains are parted too.

    Args:
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        residual: Mean distance [m] of the points to the best single shape.
        up: Unit vector (3,) upwards.
        config: When to try, and what counts as much better.
        fit_config: Settings of the fits.
        rng: Source of the samples.

    Returns:
        Group of each point (N,), from 0, or None where one object is the better explanation.
    """
    if residual < config.min_residual or len(points) < 2 * config.min_points:
        return None
    chosen = np.arange(len(points))
    if len(points) > config.max_points:
        chosen = np.sort(rng.choice(len(points), config.max_points, replace=False))
    some, their_normals = points[chosen], normals[chosen]
    quick = replace(
        fit_config, hypotheses=config.hypotheses, polish=1, steps=config.steps, max_points=config.sample
    )
    best = _best_cut(some, their_normals, up, quick, config, rng)
    if best is None:
        return None
    best = _judged(some, their_normals, best.groups, fit_config, config, rng)
    if best is None or best.residual > config.gain * residual:
        return None
    _, nearest = cKDTree(some).query(points)
    return best.groups[nearest]


def _best_cut(
    points: Array,
    normals: Array,
    up: Array,
    fit_config: FitConfig,
    config: SplitConfig,
    rng: np.random.Generator,
) -> Split | None:
    """Try cuts along each direction, then more of them between the neighbours of the best."""
    found: list[tuple[float, int, int, Split]] = []
    directions = _directions(normals, up)
    shares = np.linspace(0.0, 1.0, config.cuts + 2)

    def try_cut(number: int, share: float, index: int) -> None:
        height = points @ directions[number]
        groups = _connected(points, height > np.quantile(height, share), config)
        judged = _judged(points, normals, groups, fit_config, config, rng)
        if judged is not None:
            found.append((judged.residual, number, index, judged))

    for number in range(len(directions)):
        for index in range(1, len(shares) - 1):
            try_cut(number, float(shares[index]), index)
    if not found:
        return None
    _, number, index, _ = min(found, key=lambda f: f[0])
    for share in np.linspace(shares[index - 1], shares[index + 1], config.cuts + 2)[1:-1]:
        try_cut(number, float(share), index)
    return min(found, key=lambda f: f[0])[3]


def _directions(normals: Array, up: Array) -> list[Array]:
    """Up, and the two horizontal directions most faces look along."""
    level = normals - np.outer(normals @ up, up)
    length = np.linalg.norm(level, axis=1)
    upright = level[length > 0.5] / length[length > 0.5, None]
    if len(upright) == 0:
        return [up]
    x, y = frames.perpendicular(up), np.cross(up, frames.perpendicular(up))
    angle = np.angle(np.mean(((upright @ x) + 1j * (upright @ y)) ** 4)) / 4.0
    main = np.cos(angle) * x + np.sin(angle) * y
    return [up, main, np.cross(up, main)]


def _connected(points: Array, above: NDArray[np.bool_], config: SplitConfig) -> Groups:
    """Connected parts on either side of a cut; crumbs join the largest part of their side."""
    groups = np.full(len(points), -1, dtype=np.intp)
    count = 0
    for side in (above, ~above):
        index = np.flatnonzero(side)
        pairs = cKDTree(points[index]).query_pairs(config.reach, output_type="ndarray")
        graph = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(index), len(index)))
        _, part = connected_components(graph, directed=False)
        sizes = np.bincount(part)
        large = np.flatnonzero(sizes >= config.min_points)
        for number in large if len(large) else [int(np.argmax(sizes))]:
            groups[index[part == number]] = count
            count += 1
        crumbs = index[groups[index] < 0]
        groups[crumbs] = groups[index[part == np.argmax(sizes)][0]] if len(index) else -1
    return groups


def _judged(
    points: Array,
    normals: Array,
    groups: Groups,
    fit_config: FitConfig,
    config: SplitConfig,
    rng: np.random.Generator,
) -> Split | None:
    """Fit each group; None where there is only one, or one is too small or fits no shape."""
    sizes = np.bincount(groups)
    if len(sizes) < 2 or sizes.min() < config.min_points:
        return None
    total = 0.0
    for number, size in enumerate(sizes):
        fits = candidates(points[groups == number], normals[groups == number], config=fit_config, rng=rng)
        if not fits:
            return None
        total += size * fits[0].residual
    return Split(groups, total / len(points))
