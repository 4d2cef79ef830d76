"""The shape fits in NumPy, one step a function: what the compiled ones are compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.fitting import least_squares as refine
from caryatid.fitting.edge_likelihood import likeliest_end
from caryatid.fitting.least_squares import (
    CODES,
    CONVERGED,
    NOISE_FLOOR,
    RIDGE,
    ROBUST_WIDTH,
    ROUGHLY,
    arrays,
    from_arrays,
    linearise,
    refine_reference,
)
from caryatid.fitting.primitives import HOPEFUL, PROMISING
from caryatid.fitting.ransac import BATCH
from caryatid.fitting.uncertainty import estimate
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.signed_distance import levenberg_marquardt
from caryatid.geometry.transforms import Array
from caryatid.sensing.voxel_map import FREE

COLUMNS = {"box": (0, 1, 2, 3, 4, 5, 6, 7, 8), "cylinder": (0, 1, 2, 3, 4, 5, 6, 8), "sphere": range(7)}
"""Where the derivatives of `linearise` stand in the normal equations."""
LEAST_SINE = {"box": 0.5, "cylinder": 0.3, "sphere": 0.1}


def refined(
    shape: Box | Cylinder | Sphere,
    points_world: Array,
    *,
    steps: int,
    min_extent: float,
    shrink: float,
) -> Box | Cylinder | Sphere:
    """Refine one shape by the compiled least squares; arguments as of `refine_reference`."""
    kind, R, centre, half = arrays(shape)
    points = np.ascontiguousarray(points_world)
    levenberg_marquardt(
        kind,
        R,
        centre,
        half,
        points,
        steps,
        min_extent,
        shrink,
        ROBUST_WIDTH,
        NOISE_FLOOR,
        RIDGE,
        CONVERGED,
    )
    return from_arrays(shape.kind, R, centre, half)


@dataclass(frozen=True, eq=False, slots=True)
class Hypotheses:
    """Axes (B, 3, 3), centres (B, 3) [m], half extents (B, 3) [m] of one kind, and which are valid (B,)."""

    R: Array
    centre: Array
    half: Array
    valid: NDArray[np.bool_]

    def shapes(self, kind):
        return [from_arrays(kind, *row) for row in zip(self.R, self.centre, self.half, strict=True)]


def ordered_ends(coordinates, trim):
    """Least and greatest of each column (N, K) once a share of the points at either end is left out."""
    beyond = min(int(trim * len(coordinates)), (len(coordinates) - 1) // 2)
    ordered = np.sort(coordinates, axis=0)
    return ordered[beyond], ordered[-1 - beyond]


def interpolated_ends(coordinates, trim):
    """The same as quantiles, which lie between two points."""
    low, high = np.quantile(coordinates, (trim, 1.0 - trim), axis=0)
    return low, high


# Search


def hypotheses(kind, samples, points, normals, config) -> Hypotheses:
    """Shapes through two oriented points each, by their indices (B, 2)."""
    n1, n2 = normals[samples[:, 0]], normals[samples[:, 1]]
    p1, p2 = points[samples[:, 0]], points[samples[:, 1]]
    if kind == "box":
        across = n2 - np.sum(n1 * n2, axis=1, keepdims=True) * n1
        valid = np.linalg.norm(across, axis=1) > LEAST_SINE[kind]
        y = transforms.unit(np.where(valid[:, None], across, transforms.perpendicular(n1)))
        R = np.stack([np.cross(y, n1), y, n1], axis=-1)
        low, high = ordered_ends(np.einsum("ni,bij->nbj", points, R), config.trim)
        extents = np.maximum(high - low, 1e-4)
        centre = np.einsum("bij,bj->bi", R, (low + high) / 2.0)
        return Hypotheses(R, centre, extents / 2.0, valid & (extents.max(axis=1) <= config.max_extent))
    cross = np.cross(n1, n2)
    valid = np.linalg.norm(cross, axis=1) > LEAST_SINE[kind]
    axis = transforms.unit(np.where(valid[:, None], cross, transforms.perpendicular(n1)))
    gap, turn = p2 - p1, n1 - n2
    gap = gap - np.sum(gap * axis, axis=1, keepdims=True) * axis
    radius = np.sum(gap * -turn, axis=1) / np.maximum(np.sum(turn * turn, axis=1), 1e-12)
    middle = (p1 - radius[:, None] * n1 + p2 - radius[:, None] * n2) / 2.0
    valid &= (radius > 1e-3) & (radius <= config.max_radius)
    R = np.stack([n1, np.cross(axis, n1), axis], axis=-1)
    if kind == "sphere":
        middle = middle + 0.5 * np.sum((p1 + p2 - 2.0 * middle) * axis, axis=1, keepdims=True) * axis
        return Hypotheses(R, middle, np.repeat(radius[:, None], 3, axis=1), valid)
    low, high = ordered_ends(points @ axis.T, config.trim)
    height = np.maximum(high - low, 1e-4)
    along = (low + high) / 2.0 - np.sum(middle * axis, axis=1)
    half = np.stack([radius, radius, height / 2.0], axis=1)
    return Hypotheses(R, middle + along[:, None] * axis, half, valid & (height <= config.max_extent))


def search(kind, points, normals, samples, config) -> tuple[Hypotheses, Array, int]:
    """The best hypotheses, their costs, and how many samples were looked at."""
    ranked: list[tuple[float, float, int]] = []
    every = hypotheses(kind, samples, points, normals, config)
    looked = 0
    while looked < len(samples):
        batch = range(looked, min(looked + BATCH, len(samples)))
        for b in batch:
            if not every.valid[b]:
                continue
            shape = from_arrays(kind, every.R[b], every.centre[b], every.half[b])
            off = np.abs(shape.signed_distance(points)) / config.threshold
            if (off < 1.0).any():
                ranked.append((float(np.minimum(off**2, 1.0).mean()), float((off < 1.0).mean()), b))
        ranked = sorted(ranked, key=lambda r: r[0])[: config.polish]
        looked = batch[-1] + 1
        if ranked:
            hit = min(max(ranked[0][1] ** 2, 1e-9), 1.0 - 1e-9)
            if looked >= config.polish * np.log(1.0 - config.confidence) / np.log(1.0 - hit):
                break
    best = np.array([b for *_, b in ranked], dtype=np.intp)
    found = Hypotheses(every.R[best], every.centre[best], every.half[best], every.valid[best])
    return found, np.array([cost for cost, *_ in ranked]), looked


# Starts of one face


def main_normal(normals):
    """Mean of the normals that agree with the one most agree with, and which they are (N,)."""
    cosine = normals @ normals.T
    agree = cosine > np.cos(np.radians(25.0))
    on_face = agree[int(np.argmax(agree.sum(axis=0)))]
    return transforms.unit(normals[on_face].mean(axis=0)), on_face


def of_one_face(kind, points, normals, config, ends=ordered_ends):
    """A box or a cylinder behind the main normal's face, or None beyond the limits."""
    axis, on_face = main_normal(normals)
    x = _across(points, axis)
    if kind == "box":
        angles = np.radians(np.arange(0.0, 90.0, 3.0))
        y = np.cross(axis, x)
        sides = np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y
        areas = [np.prod(np.subtract(*ends(points @ np.stack([u, np.cross(axis, u)], axis=1), config.trim)))
                 for u in sides]  # fmt: skip
        x = sides[int(np.argmin(areas))]
    R = np.stack([x, np.cross(axis, x), axis], axis=1)
    low, high = (np.array(end) for end in ends(points @ R, config.trim))
    high[2] = np.median((points @ axis)[on_face])
    low[2] = min(low[2], high[2] - config.min_extent)
    T = transforms.rigid(R, R @ ((low + high) / 2.0))
    if kind == "box":
        return Box(T, high - low) if (high - low).max() <= config.max_extent else None
    radius, height = float(np.mean(high[:2] - low[:2]) / 2.0), float(high[2] - low[2])
    if not 1e-3 < radius <= config.max_radius or height > config.max_extent:
        return None
    return Cylinder(T, radius, height)


def _across(points, axis):
    """Across the axis, towards the first point well off the middle."""
    offsets = points - points.mean(axis=0)
    offsets = offsets - (offsets @ axis)[:, None] * axis
    reach = np.linalg.norm(offsets, axis=1)
    return transforms.unit(offsets[int(np.argmax(reach > 0.5 * reach.max()))])


# Judgement


def outwards(shape, points):
    """Signed distances (N,), and outward directions (N, 3) in the points' frame."""
    distance, J = linearise(shape, points)
    return distance, -J[:, :3] @ shape.T_world_object[:3, :3].T


def draw_in(shape, points, normals, config):
    """The shape with the sides that no point bears out moved inwards, and which sides are borne out."""
    distance, outward = outwards(shape, points)
    near = np.abs(distance) < config.threshold
    agree = near & (np.sum(normals * outward, axis=1) > 0.5)
    facing = outward[agree] @ shape.T_world_object[:3, :3]
    counts = np.stack([(facing < -0.7).sum(axis=0), (facing > 0.7).sum(axis=0)], axis=1).ravel()
    seen = counts >= max(config.min_points / 3.0, config.side_share * len(points))
    if isinstance(shape, Sphere):
        return shape, tuple(seen)
    T = shape.T_world_object
    local = transforms.transform(transforms.invert(T), points[near] if near.any() else points)
    low, high = -shape.extents / 2.0, shape.extents / 2.0
    for axis in (2,) if isinstance(shape, Cylinder) else (0, 1, 2):
        start, end = np.quantile(local[:, axis], (config.trim, 1.0 - config.trim))
        if not seen[2 * axis]:
            low[axis] = min(max(low[axis], start), high[axis] - config.min_extent)
        if not seen[2 * axis + 1]:
            high[axis] = max(min(high[axis], end), low[axis] + config.min_extent)
    return _between(shape, low, high), tuple(seen)


def misfit(shape, points, normals, config):
    """Mean truncated distance, mean turn of the normals, and share of inliers."""
    distance, outward = outwards(shape, points)
    away = np.abs(distance)
    turned = np.clip(1.0 - np.sum(outward * normals, axis=1), 0.0, 1.0)
    near = (away < config.threshold).mean()
    return float(np.minimum(away, config.threshold).mean()), float(turned.mean()), float(near)


def cost(shape, points, normals, config):
    """What model choice compares, but for the bare share."""
    residual, turned, _ = misfit(shape, points, normals, config)
    return residual + config.normal_weight * turned + config.size_penalty * float(np.mean(shape.extents**2))


def bare_share(shape, seen, points, config):
    """Share of the samples on seen sides that no point is near."""
    samples, outward = shape.surface(config.bare_spacing)
    local = outward @ shape.T_world_object[:3, :3]
    axis = np.argmax(np.abs(local), axis=1)
    side = 2 * axis + (local[np.arange(len(local)), axis] > 0.0)
    on_seen = np.array(seen)[side]
    if not on_seen.any():
        return 1.0
    gap, _ = cKDTree(points).query(samples[on_seen])
    return float((gap > 2.0 * config.bare_spacing).mean())


def candidates(points, normals, config, rng):
    """For each kind the cost but for bare sides, the shape, and the sides seen."""
    count = min(len(points), config.max_points)
    every = max(1, count // config.search_points)
    if every > 1 or count < len(points):
        some = rng.choice(len(points), count, replace=False)
        points, normals = points[some], normals[some]
    origin = points.mean(axis=0)
    points = points - origin
    some, facing = points[::every], normals[::every]
    samples = rng.integers(0, len(some), size=(len(config.shapes), config.hypotheses, 2))
    settings = {"steps": config.steps, "min_extent": config.min_extent, "shrink": config.shrink}

    def judged(start, on, converged):
        shape, seen = draw_in(_refined(start, on, converged=converged, **settings), points, normals, config)
        return cost(shape, points, normals, config), shape, seen

    starts = {}
    for kind, drawn in zip(config.shapes, samples, strict=True):
        starts[kind] = search(kind, some, facing, drawn, config)[0].shapes(kind)
        flat = None if kind == "sphere" else of_one_face(kind, some, facing, config)
        starts[kind] += [flat] * (flat is not None)

    def hopeful(tried, factor):
        """The best shape of each kind that is small enough, where it costs little more than any."""
        best = {kind: min(shapes, key=lambda j: j[0]) for kind, shapes in tried.items() if shapes}
        best = {kind: b for kind, b in best.items() if b[1].extents.max() <= config.max_extent}
        least = min((price for price, *_ in best.values()), default=np.inf)
        return best, [kind for kind, b in best.items() if b[0] <= factor * least]

    tried = {kind: [judged(s, some, ROUGHLY) for s in shapes[:1]] for kind, shapes in starts.items()}
    fit_in, first_hopes = hopeful(tried, HOPEFUL)
    for kind in {*first_hopes, *(tried.keys() - fit_in.keys())}:
        tried[kind] += [judged(s, some, ROUGHLY) for s in starts[kind][1:]]
    rough, promising = hopeful(tried, PROMISING)
    found = {}
    for kind, best in rough.items():
        if kind in promising:
            best = min(best, judged(best[1], points, CONVERGED), key=lambda j: j[0])
        price, shape, seen = best
        if shape.extents.max() <= config.max_extent:
            found[kind] = price, shape.moved(transforms.rigid(np.eye(3), origin)), seen
    return found


def _refined(shape, points, *, converged, **settings):
    """Least squares to a given convergence, which the reference holds as a constant."""
    kept = refine.CONVERGED
    refine.CONVERGED = converged
    try:
        return refine_reference(shape, points, **settings)
    finally:
        refine.CONVERGED = kept


# The last refinement


def polish(shape, seen, points, config):
    """The polished shape and its uncertainty."""
    if len(points) > config.final_points:
        points = points[np.linspace(0, len(points) - 1, config.final_points).astype(np.intp)]
    opened = refine_reference(
        _opened(shape, seen, config), points, steps=config.steps, min_extent=config.min_extent, shrink=0.0
    )
    absolute = np.abs(linearise(opened, points)[0])
    near = absolute < config.threshold
    sigma = max(1.4826 * float(np.median(absolute[near])), NOISE_FLOOR) if near.any() else config.threshold
    closed, hidden = opened, np.full(6, config.max_extent / np.sqrt(12.0))
    if not isinstance(opened, Sphere):
        closed, hidden = _closed(opened, shape, seen, points, sigma, config)
    if closed.extents.max() > config.max_extent or not near.any():
        closed = shape
    information = normal_matrix(opened, points, ROBUST_WIDTH * sigma)
    one = (np.array([value]) for value in (CODES[shape.kind], seen, hidden, information, sigma))
    return closed, estimate(*one, config)[0]


def normal_matrix(shape, points, scale):
    """Weighted sum over the points of the products of their derivatives (9, 9)."""
    distance, J = linearise(shape, points)
    spread = np.zeros((len(points), 9))
    spread[:, list(COLUMNS[shape.kind])] = J
    return spread.T @ (spread / ((1.0 + (distance / scale) ** 2) ** 2)[:, None])


def _opened(shape, seen, config):
    if isinstance(shape, Sphere):
        return shape
    by = np.where(seen, 0.0, config.opening)
    if isinstance(shape, Cylinder):
        grown = 0.0 if any(seen[:4]) else config.opening
        shape = replace(shape, radius=shape.radius + grown)
        by[:4] = 0.0
    return _between(shape, -shape.extents / 2.0 - by[0::2], shape.extents / 2.0 + by[1::2])


def _closed(opened, shape, seen, points, sigma, config):
    T_object_world = transforms.invert(opened.T_world_object)
    local = transforms.transform(T_object_world, points)
    before = transforms.transform(T_object_world, shape.T_world_object[:3, 3])
    ends = np.stack([-opened.extents, opened.extents], axis=1) / 2.0
    hidden = np.full(6, config.max_extent / np.sqrt(12.0))
    margin = config.face_width * sigma
    rim_of = partial(_end, sigma=sigma, config=config)
    closed = opened
    if isinstance(opened, Cylinder):
        reach = np.hypot(local[:, 0], local[:, 1])
        if not any(seen[:4]):
            rim = rim_of(reach[np.abs(np.abs(local[:, 2]) - ends[2, 1]) < margin], growing=True)
            closed = replace(opened, radius=shape.radius if rim is None else rim[0])
            hidden[:4] = hidden[:4] if rim is None else rim[1]
        beside = {2: np.abs(reach - opened.radius) < margin}
    else:
        gap = np.abs(local) - opened.extents / 2.0
        beside = {a: np.abs(np.delete(gap, a, axis=1).max(axis=1)) < margin for a in range(3)}
    for axis, on_face in beside.items():
        for side, sign in enumerate((-1.0, 1.0)):
            if seen[2 * axis + side]:
                continue
            rim = rim_of(sign * local[on_face, axis], growing=False)
            ends[axis, side] = before[axis] + sign * shape.extents[axis] / 2.0
            if rim is not None:
                ends[axis, side], hidden[2 * axis + side] = sign * rim[0], rim[1]
        short = max(config.min_extent - float(ends[axis, 1] - ends[axis, 0]), 0.0)
        ends[axis] += (-short, 0.0) if seen[2 * axis + 1] else (0.0, short)
    return _between(closed, ends[:, 0], ends[:, 1]), hidden


def _end(coordinates, *, sigma, config, growing):
    if len(coordinates) < config.min_points:
        return None
    start = float(np.quantile(coordinates, 1.0 - config.trim))
    span = start - (0.0 if growing else float(np.quantile(coordinates, config.trim)))
    window = max(4.0 * sigma, 0.1 * span)
    end, deviation = likeliest_end(
        np.ascontiguousarray(coordinates), start, sigma, window, growing, config.stray
    )
    return end, float(np.hypot(deviation * np.sqrt(config.correlated), config.rim))


def _between(shape, low, high):
    """The shape between these sides (3,) [m] in its own frame; a cylinder keeps its radius."""
    T = shape.T_world_object
    if isinstance(shape, Cylinder):
        middle = transforms.transform(T, np.array([0.0, 0.0, (low[2] + high[2]) / 2.0]))
        return Cylinder(transforms.rigid(T[:3, :3], middle), shape.radius, float(high[2] - low[2]))
    return Box(transforms.rigid(T[:3, :3], transforms.transform(T, (low + high) / 2.0)), high - low)


# Explanations


def point_costs(shape, points, normals, noise, config):
    """Cost (N,) [nats] of each point as one of a shape's surface."""
    distance, outward = outwards(shape, points)
    turned = 1.0 - np.sum(outward * normals, axis=1)
    return np.minimum(distance**2 / (2.0 * noise**2) + config.normal_weight * turned, config.outlier)


def free_inside(shape, voxels, inset):
    """Cubes of a voxel's size well inside a shape, and how many of them lie in voxels seen free."""
    size = voxels.config.size
    half = shape.extents / 2.0 - inset
    if (half <= 0.0).any():
        return 0, 0
    ticks = [np.arange(-h + size / 2.0, h, size) if h > size / 2.0 else np.zeros(1) for h in half]
    local = np.stack([g.ravel() for g in np.meshgrid(*ticks, indexing="ij")], axis=-1)
    round_in = {"box": 0, "cylinder": 2, "sphere": 3}[shape.kind]
    local = local[np.linalg.norm(local[:, :round_in], axis=1) <= half[0]]
    states = voxels.state_at(transforms.transform(shape.T_world_object, local))
    return len(states), int((states == FREE).sum())
