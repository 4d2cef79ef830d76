"""Registration: a new view is laid onto the earlier ones, then all views but the first move jointly.

Surfels of one view look for correspondences in another; Gauss–Newton on the robust, symmetric point-to-plane
distance, with the reported poses as priors.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import RegistrationConfig
from caryatid.geometry import transforms
from caryatid.geometry.points import solve_positive
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each
from caryatid.sensing.pose_graph import Index, PoseEdges
from caryatid.sensing.surfels import MIN_COSINE, Surfels, even_sample, surfels_of
from caryatid.sensing.views import Cloud

COLUMNS = 8
"""Of a patch: x, y, z [m], its unit normal, the variance of its distance from the surface [m²], its label."""
BUCKETS = 4096
"""Lists a view's patches are kept in, by a hash of label and cell [1]; more patches make longer lists."""
CHUNK = 50
"""Patches one task looks for partners of [1]; who does which task changes no result."""
OUTLIER = 0.3
"""Share of the reach beyond which distances lose their weight [1]."""
INDEPENDENT = 0.1
"""Share of the partners that err independently [1]: neighbouring patches err alike."""
ROUNDS = 3
"""Rounds of matching at each reach, and of the joint solution [1]."""
NORMAL_REACH = 0.05
"""How far apart [m] directions at right angles count when partners are looked for, by 1/√2."""


@njit(cache=True)
def index_patches(patches: NDArray[np.float64], edge: float) -> tuple[Array, NDArray[np.int64]]:
    """Sort patches such that those of one label and cell lie together.

    Args:
        patches: (P, 8), see `COLUMNS`.
        edge: Edge of a cell [m].

    Returns:
        The patches in another order, and where the list of each bucket begins (BUCKETS + 1,).
    """
    bucket = np.empty(len(patches), np.int64)
    starts = np.zeros(BUCKETS + 2, np.int64)
    for i in range(len(patches)):
        x, y, z = patches[i, 0], patches[i, 1], patches[i, 2]
        bucket[i] = _bucket(patches[i, 7], np.floor(x / edge), np.floor(y / edge), np.floor(z / edge))
        starts[bucket[i] + 2] += 1
    for b in range(1, len(starts)):
        starts[b] += starts[b - 1]
    ordered = np.empty_like(patches)
    for i in range(len(patches)):
        for c in range(COLUMNS):
            ordered[starts[bucket[i] + 1], c] = patches[i, c]
        starts[bucket[i] + 1] += 1
    return ordered, starts[:-1]


@njit(cache=True, inline="always")
def _bucket(label, x, y, z):  # type: ignore[no-untyped-def]
    """Number of the bucket of a label and a cell, all given as floats."""
    mixed = (np.int64(x) * 73856093) ^ (np.int64(y) * 19349663) ^ (np.int64(z) * 83492791)
    mixed ^= np.int64(label) * 50331653
    return (mixed ^ (mixed >> 15)) & (BUCKETS - 1)


class Search(NamedTuple):
    """Patches that look for partners in other views.

    Attributes:
        patches: Of all views (P, 8), view by view, each as `index_patches` sorts them, in the world as
            reported; see `COLUMNS`.
        starts: Where the list of each bucket of each view begins (V, BUCKETS + 1).
        samples: Patches that may look for a partner (S, 8).
        tasks: (R, 5): first and last sample, step from one to the next, view in which they look for a
            partner, view they are of; at most `CHUNK` of them.
        shares: Into how many shares the tasks go; every so many of them are one.
        twists: Move (V, 6) of each view from where it was reported: 3 × m, 3 × rad, about the pivot.
        pivot_world: (3,) [m].
        edge: Edge of a cell [m], as the patches were sorted.
        reach: How far away a partner may be [m].
        min_cosine: Cosine of the angle between the normals of partners at least.
        normal_reach: How far apart [m] directions at right angles count, by 1/√2.
        noise: Standard deviation of the distance beside what the patches bring [m].
        rows: (R, CHUNK, 8): derivative (6,) of the distance by the twist of the moving view, the other's
            being the opposite; the distance [m]; its inverse variance [1/m²], 0 where there is no partner.
            Written to where a sample looks for one, and zero elsewhere.
    """

    patches: NDArray[np.float64]
    starts: NDArray[np.int64]
    samples: NDArray[np.float64]
    tasks: NDArray[np.int64]
    shares: int
    twists: NDArray[np.float64]
    pivot_world: NDArray[np.float64]
    edge: float
    reach: float
    min_cosine: float
    normal_reach: float
    noise: float
    rows: NDArray[np.float64]


@njit(cache=True, error_model="numpy")
def find_correspondences(share: int, search: Search) -> None:
    """Look for the patch of another view that is nearest in place and direction, and linearise the distance.

    Distance is along the mean of both normals, and its derivative by a move of either view that about the
    middle between the two patches: a move of both views together changes nothing. Coordinates are about the
    pivot.
    """
    twists, pivot, noise = search.twists, search.pivot_world, search.noise * search.noise
    for task in range(share, len(search.tasks), search.shares):
        stride, still, moving = search.tasks[task, 2], search.tasks[task, 3], search.tasks[task, 4]
        R = _rotation(twists[moving, 3], twists[moving, 4], twists[moving, 5])
        S = _rotation(twists[still, 3], twists[still, 4], twists[still, 5])
        i = 0
        for k in range(search.tasks[task, 0], search.tasks[task, 1], stride):
            row, sample = search.rows[task, i], search.samples[k]
            i += 1
            px, py, pz = _turned(R, sample[0] - pivot[0], sample[1] - pivot[1], sample[2] - pivot[2])
            px, py, pz = px + twists[moving, 0], py + twists[moving, 1], pz + twists[moving, 2]
            nx, ny, nz = _turned(R, sample[3], sample[4], sample[5])
            found = _partner(
                search, still,
                _turned_back(S, px - twists[still, 0], py - twists[still, 1], pz - twists[still, 2]),
                _turned_back(S, nx, ny, nz), sample[7],
            )  # fmt: skip
            if found < 0:
                for a in range(8):
                    row[a] = 0.0
                continue
            other = search.patches[found]
            qx, qy, qz = _turned(S, other[0] - pivot[0], other[1] - pivot[1], other[2] - pivot[2])
            qx, qy, qz = qx + twists[still, 0], qy + twists[still, 1], qz + twists[still, 2]
            mx, my, mz = _turned(S, other[3], other[4], other[5])
            mx, my, mz = mx + nx, my + ny, mz + nz
            length = np.sqrt(mx * mx + my * my + mz * mz)
            mx, my, mz = mx / length, my / length, mz / length
            row[0], row[1], row[2] = mx, my, mz
            row[6] = (px - qx) * mx + (py - qy) * my + (pz - qz) * mz
            qx, qy, qz = 0.5 * (px + qx), 0.5 * (py + qy), 0.5 * (pz + qz)
            row[3], row[4], row[5] = qy * mz - qz * my, qz * mx - qx * mz, qx * my - qy * mx
            row[7] = 1.0 / (sample[6] + other[6] + noise)


@njit(cache=True, error_model="numpy")
def _partner(search, view, point, normal, label):  # type: ignore[no-untyped-def]
    """Number of the patch of a view nearest in place and direction, or −1; point [m] from the pivot."""
    patches, starts, edge, reach = search.patches, search.starts[view], search.edge, search.reach
    min_cosine, normal_reach, pivot = search.min_cosine, search.normal_reach, search.pivot_world
    x, y, z = point[0] + pivot[0], point[1] + pivot[1], point[2] + pivot[2]
    cx, cy, cz = np.floor(x / edge), np.floor(y / edge), np.floor(z / edge)
    fx, fy, fz = x - cx * edge, y - cy * edge, z - cz * edge
    inside = min(min(fx, edge - fx), min(fy, edge - fy), min(fz, edge - fz))
    turned = 2.0 * normal_reach * normal_reach
    widest = reach * reach
    best = widest + turned * (1.0 - min_cosine)
    found = -1
    # Cell by cell in rings around its own; `gap` is how far away along an axis a cell begins.
    for ring in range(int(np.ceil(reach / edge)) + 1):
        border = inside + (ring - 1) * edge
        if ring > 0 and border * border >= min(best, widest):
            break
        for i in range(-ring, ring + 1):
            gap = i * edge - fx if i > 0 else (fx - (i + 1) * edge if i < 0 else 0.0)
            gap_x = gap * gap
            for j in range(-ring, ring + 1):
                gap = j * edge - fy if j > 0 else (fy - (j + 1) * edge if j < 0 else 0.0)
                gap_xy = gap_x + gap * gap
                inner = abs(i) < ring and abs(j) < ring
                for k in range(-ring, ring + 1, 2 * ring if inner else 1):
                    gap = k * edge - fz if k > 0 else (fz - (k + 1) * edge if k < 0 else 0.0)
                    if gap_xy + gap * gap >= min(best, widest):
                        continue
                    bucket = _bucket(label, cx + i, cy + j, cz + k)
                    for n in range(starts[bucket], starts[bucket + 1]):
                        u, v, w = patches[n, 0] - x, patches[n, 1] - y, patches[n, 2] - z
                        apart = u * u + v * v + w * w
                        if apart >= min(best, widest) or patches[n, 7] != label:
                            continue
                        cosine = patches[n, 3] * normal[0] + patches[n, 4] * normal[1]
                        cosine += patches[n, 5] * normal[2]
                        apart += turned * (1.0 - cosine)
                        if cosine > min_cosine and apart < best:
                            best = apart
                            found = n
    return found


@njit(cache=True, error_model="numpy")
def _rotation(x, y, z):  # type: ignore[no-untyped-def]
    """Rotation of a rotation vector [rad], row by row (9)."""
    angle = np.sqrt(x * x + y * y + z * z)
    a, b = 1.0, 0.5
    if angle > 1e-6:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / (angle * angle)
    return (
        1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y,
        b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x,
        b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _turned(R, x, y, z):  # type: ignore[no-untyped-def]
    """A vector (3) turned by a rotation (9)."""
    return R[0] * x + R[1] * y + R[2] * z, R[3] * x + R[4] * y + R[5] * z, R[6] * x + R[7] * y + R[8] * z


@njit(cache=True, error_model="numpy")
def _turned_back(R, x, y, z):  # type: ignore[no-untyped-def]
    """A vector (3) turned by the inverse of a rotation (9)."""
    return R[0] * x + R[3] * y + R[6] * z, R[1] * x + R[4] * y + R[7] * z, R[2] * x + R[5] * y + R[8] * z


SUMS = 29
"""Of a group of partners: how many; the sum of their distances [m], none counting more than an outlier; the
gradient (6,); the upper half of the matrix (6, 6), row by row."""


@njit(cache=True, error_model="numpy")
def normal_equations(
    rows: NDArray[np.float64], groups: NDArray[np.int64], count: int, outlier: float
) -> Array:
    """Sum up the robust normal equations of groups of rows.

    Args:
        rows: (R, CHUNK, 8) as of `partners.Search`.
        groups: Group (R,) of each task.
        count: How many groups there are.
        outlier: Distance beyond which partners lose their weight [m].

    Returns:
        Sums (G, SUMS), G = `count`.
    """
    sums, step = np.zeros((count, SUMS)), np.zeros(6)
    for task in range(len(rows)):
        _sum_up(rows[task], step, outlier, sums[groups[task]])
    return sums


@njit(cache=True, error_model="numpy")
def step_down(
    rows: NDArray[np.float64],
    twist: NDArray[np.float64],
    information: NDArray[np.float64],
    independent: float,
    outlier: float,
    steps: int,
    settled: float,
) -> Array:
    """Move a view such that its partners come to lie in each other's planes; the partners stay the same.

    Gauss–Newton on the robust distances and the view's pose as reported.

    Args:
        rows: (R, CHUNK, 8) as of `partners.Search`, found with the view where it is.
        twist: Where it is, from where it was reported (6,).
        information: Inverse covariance (6, 6) of the reported pose's twist.
        independent: Share of the partners that err independently.
        outlier: Distance beyond which partners lose their weight [m].
        steps: Steps at the most.
        settled: A smaller step is the last [m, rad].

    Returns:
        (10,): by how much the twist changes (6,); partners found and the sum of their distances [m], none
        counting more than an outlier, before and after.
    """
    result, step, gradient, hessian = np.zeros(10), np.zeros(6), np.zeros(6), np.zeros((6, 6))
    sums = np.zeros(SUMS)
    largest = np.inf
    for number in range(steps + 1):
        for k in range(SUMS):
            sums[k] = 0.0
        for task in range(len(rows)):
            _sum_up(rows[task], step, outlier, sums)
        if number == 0:
            result[6], result[7] = sums[0], sums[1]
        if number == steps or largest < settled:
            break
        k = 8
        for a in range(6):
            gradient[a] = independent * sums[2 + a]
            for b in range(6):
                gradient[a] += information[a, b] * (twist[b] + step[b])
            for b in range(a, 6):
                hessian[b, a] = information[a, b] + independent * sums[k]
                k += 1
        change = solve_positive(hessian, gradient)
        largest = 0.0
        for a in range(6):
            step[a] -= change[a]
            largest = max(largest, abs(change[a]))
    for a in range(6):
        result[a] = step[a]
    result[8], result[9] = sums[0], sums[1]
    return result


@njit(cache=True, error_model="numpy")
def _sum_up(rows, step, outlier, total):  # type: ignore[no-untyped-def]
    """Add rows (N, 8), after a step (6,) of the moving view, to the total (SUMS,)."""
    for i in range(len(rows)):
        row = rows[i]
        if row[7] == 0.0:
            continue
        distance = row[6]
        for a in range(6):
            distance += row[a] * step[a]
        far = distance / outlier
        weight = row[7] / ((1.0 + far * far) * (1.0 + far * far))
        total[0] += 1.0
        total[1] += min(abs(distance), outlier)
        k = 8
        for a in range(6):
            weighted = weight * row[a]
            total[2 + a] += weighted * distance
            for b in range(a, 6):
                total[k] += weighted * row[b]
                k += 1


UPPER = np.triu_indices(6)
"""Rows and columns of the upper half of a matrix (6, 6), row by row."""


@dataclass(frozen=True, eq=False, slots=True)
class RegisteredView:
    """One view as registration keeps it; patches are rows as `kernels.partners.COLUMNS` says.

    Attributes:
        patches: Its patches (P, 8), in the world as reported, sorted to be found.
        starts: Where in them the list of each bucket begins (BUCKETS + 1,).
        sample: Those (S, 8) that look for partners in other views.
        information: Inverse covariance (6, 6) of the reported pose's error, as a twist about the pivot.
    """

    patches: Array
    starts: NDArray[np.int64]
    sample: Array
    information: Array

    @classmethod
    def of(
        cls, surfels: Surfels, viewpoint_world: Array | None, pivot_world: Array, config: RegistrationConfig
    ) -> RegisteredView:
        """Prepare a view.

        Args:
            surfels: Its patches.
            viewpoint_world: Where the camera was (3,) [m], which errors of orientation turn about, or None.
            pivot_world: What twists turn about (3,) [m].
            config: Expected errors and the size of the sample.
        """
        arm = np.zeros(3) if viewpoint_world is None else viewpoint_world - pivot_world
        at_camera = np.eye(6)
        at_camera[:3, 3:] = -transforms.skew(arm)
        sigma = np.repeat([config.translation, np.radians(config.rotation)], 3)
        information = at_camera.T @ (at_camera / sigma[:, None] ** 2)
        rows = np.column_stack(
            [surfels.points_world, surfels.normals_world, surfels.variance, surfels.labels.astype(np.float64)]
        )
        patches, starts = index_patches(rows, _edge(config))
        return cls(patches, starts, rows[even_sample(surfels, config.sample)], information)


@dataclass(frozen=True, eq=False, slots=True)
class Refinement:
    """Where a view came to lie.

    Attributes:
        twist: Its move (6,) from where it was reported.
        misfit_before: Mean distance [m] over the patches that looked for a partner, those without one being
            outliers, where it started.
        misfit: The same where it came to lie.
    """

    twist: Array
    misfit_before: float
    misfit: float


@dataclass(frozen=True, eq=False, slots=True)
class ViewSet:
    """Several views put together, to look for partners between them.

    Attributes:
        numbers: Their numbers (V,), ascending.
        patches: Those of all views (P, 8), view by view.
        starts: Where in them the list of each bucket of each view begins (V, BUCKETS + 1).
        samples: Those of all views (S, 8) that look for partners.
        first: Where in them those of each view begin (V + 1,).
    """

    numbers: Index
    patches: Array
    starts: NDArray[np.int64]
    samples: Array
    first: NDArray[np.int64]

    @classmethod
    def of(cls, views: Mapping[int, RegisteredView]) -> ViewSet:
        """Put views together.

        Args:
            views: Number → view, ascending.
        """
        before = np.cumsum([0, *(len(v.patches) for v in views.values())])
        return cls(
            np.array(list(views), dtype=np.intp),
            np.concatenate([v.patches for v in views.values()]),
            np.stack([v.starts + n for v, n in zip(views.values(), before[:-1], strict=True)]),
            np.concatenate([v.sample for v in views.values()]),
            np.cumsum([0, *(len(v.sample) for v in views.values())]),
        )

    def sample(self, number: int) -> Array:
        """Patches (S, 8) of a view that look for partners."""
        slot = int(np.searchsorted(self.numbers, number))
        return self.samples[self.first[slot] : self.first[slot + 1]]

    def match(
        self,
        still: Index,
        moving: Index,
        twists: Array,
        pivot_world: Array,
        outlier: float,
        config: RegistrationConfig,
    ) -> PoseEdges:
        """Find the partners of views' whole samples in other views, within the shortest reach.

        Args:
            still: Number (E,) of the view in which each pair's are looked for.
            moving: Number (E,) of the one whose sample looks for them.
            twists: Move of all views from where they were reported, whether here or not (M, 6), M ≥ V.
            pivot_world: What twists turn about (3,) [m].
            outlier: Distance beyond which partners lose their weight [m].
            config: Noise, reach, and how much directions may differ.
        """
        tasks, pairs, asked = self._tasks(still, moving, 1)
        search = self._search(tasks, len(tasks), twists, pivot_world, config.reaches[-1], config)
        for_each(find_correspondences, search.shares, search)
        sums = normal_equations(search.rows, pairs, len(still), outlier)
        sums[:, 2:] *= INDEPENDENT
        information = np.empty((len(sums), 6, 6))
        information[:, UPPER[0], UPPER[1]] = sums[:, 8:]
        information[:, UPPER[1], UPPER[0]] = sums[:, 8:]
        apart = twists[moving] - twists[still]
        return PoseEdges(still, moving, apart, asked, sums[:, 0], sums[:, 1], sums[:, 2:8], information)

    def descend(
        self, twists: Array, information: Array, pivot_world: Array, reach: float, config: RegistrationConfig
    ) -> Refinement:
        """Move the last view such that partners come to lie in each other's planes; the others stay.

        Gauss–Newton on the robust, symmetric point-to-plane distance, maximum a posteriori.

        Args:
            twists: Move of all views from where they were reported, whether here or not (M, 6), M ≥ V.
            information: Inverse covariance (6, 6) of the last one's reported pose.
            pivot_world: What twists turn about (3,) [m].
            reach: How far away a partner may be [m].
            config: Noise, rounds, and how many patches look for partners; the fewer they are, the more of
                them err independently.
        """
        others, new = self.numbers[:-1], self.numbers[-1:]
        size = int(self.first[-1] - self.first[-2])
        # 250 patches will do here; the pose is then made exact with the whole samples.
        stride = max(1, size * len(others) // 250)
        tasks, _, asked = self._tasks(others, np.repeat(new, len(others)), stride)
        outlier = OUTLIER * reach
        # What a step this small leaves, the next reach or the joint solution takes.
        converged = 0.1 * outlier
        search = self._search(tasks, 1, twists, pivot_world, reach, config)
        twist, ends = search.twists[-1], []
        for _ in range(ROUNDS):
            for_each(find_correspondences, search.shares, search)
            result = step_down(
                *(search.rows, twist, information, min(1.0, stride * INDEPENDENT), outlier),
                *(4, converged),
            )
            twist += result[:6]
            ends += [result[6:8], result[8:]]
            if np.abs(result[:6]).max() < converged:
                break
        total = max(int(asked.sum()), 1)
        before, after = (float(far + (total - found) * outlier) / total for found, far in (ends[0], ends[-1]))
        return Refinement(twist, before, after)

    def _search(
        self,
        tasks: NDArray[np.int64],
        shares: int,
        twists: Array,
        pivot_world: Array,
        reach: float,
        config: RegistrationConfig,
    ) -> Search:
        """Tasks (R, 5) in so many shares, and place for what they find; twists of all views (≥ V, 6)."""
        return Search(
            *(self.patches, self.starts, self.samples, tasks, shares, twists[self.numbers], pivot_world),
            *(_edge(config), reach, MIN_COSINE, NORMAL_REACH, config.noise),
            np.zeros((len(tasks), CHUNK, 8)),
        )

    def _tasks(
        self, still: Index, moving: Index, stride: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Tasks (R, 5) of a search, the pair (R,) each is of, and how many patches (E,) they ask."""
        still, moving = np.searchsorted(self.numbers, still), np.searchsorted(self.numbers, moving)
        first, last = self.first[moving], self.first[moving + 1]
        asked = -((first - last) // stride)
        chunks = -(-asked // CHUNK)
        pairs = np.repeat(np.arange(len(still)), chunks)
        number = np.arange(len(pairs)) - np.repeat(np.cumsum(chunks) - chunks, chunks)
        begin = first[pairs] + number * CHUNK * stride
        end = np.minimum(begin + CHUNK * stride, last[pairs])
        step = np.full(len(pairs), stride)
        return np.stack([begin, end, step, still[pairs], moving[pairs]], axis=1), pairs, asked


def twist_transform(twist: Array, pivot_world: Array) -> Array:
    """The rigid transform that turns about a pivot (3,) [m] and moves; leading axes (..., 6) are kept.

    Args:
        twist: Twists (..., 6): 3 × m, 3 × rad.
        pivot_world: What is turned about (3,) [m].

    Returns:
        (..., 4, 4).
    """
    x, y, z = np.moveaxis(twist[..., 3:], -1, 0)
    angle = np.sqrt(x * x + y * y + z * z)[..., None, None]
    K = np.zeros((*twist.shape[:-1], 3, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -z, y, -x
    K -= K.swapaxes(-1, -2)
    # sin(a)/a and (1 - cos(a))/a²; numpy's sinc is sin(πx)/(πx).
    half = np.sinc(angle / (2.0 * np.pi))
    T = np.zeros((*twist.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * half * half * (K @ K)
    T[..., :3, 3] = twist[..., :3] + pivot_world - T[..., :3, :3] @ pivot_world
    T[..., 3, 3] = 1.0
    return T


def _edge(config: RegistrationConfig) -> float:
    """Edge of the cells partners are looked for in [m]: the widest search spans two on either side."""
    return max(config.reaches) / 2.0


Outcome = Literal[
    "reference", "fits as reported", "aligned", "too few partners", "beyond the limits", "no better"
]

EXACT = ("reference", "fits as reported")
"""Views that stay where they were reported, whatever comes later."""


@dataclass(frozen=True, eq=False, slots=True)
class PoseEstimate:
    """Where a view is, better than it was reported.

    Attributes:
        twist: Move from where it was reported (6,): 3 × m, 3 × rad, about the pivot.
        outcome: What became of its alignment when it came; later views may move it whatever that was.
        covariance: Of the twist (6, 6) [m, rad]; zero where the view defines the world or is exact.
        determined: Share (6,) of what is known of each of `directions` that comes from matching, ascending;
            the rest is the report's. Near 0 = what the views share does not show it.
        directions: Independent moves (6, 6), one a column, as twists in standard deviations of the report.
    """

    twist: Array
    outcome: Outcome
    covariance: Array
    determined: Array
    directions: Array


class ViewRegistration:
    """Where the views are; the first one defines the world.

    Args:
        pivot_world: What twists turn about (3,) [m]; best amid the points.
        config: Expected errors and limits.

    Attributes:
        estimates: One for each view.
    """

    def __init__(self, pivot_world: Array, config: RegistrationConfig) -> None:
        self.estimates: list[PoseEstimate] = []
        self._pivot = pivot_world
        self._config = config
        self._views: dict[int, RegisteredView] = {}
        self._twists = np.zeros((0, 6))
        self._edges = PoseEdges.none()

    def copy(self) -> ViewRegistration:
        """Return a registration that knows the same and goes on by itself; the views so far are shared."""
        other = copy.copy(self)
        other.estimates = self.estimates.copy()
        other._views = self._views.copy()
        return other

    def add(self, cloud: Cloud, *, same_labels: bool) -> dict[int, Array]:
        """Take in a view.

        Args:
            cloud: Its labelled points in the world as reported; 65535 = the support surface.
            same_labels: Whether labels mean the same in every view.

        Returns:
            How the new view is to be moved and, on top of what they were moved before, earlier ones: view →
            transform (4, 4) of the world.
        """
        config, new = self._config, len(self.estimates)
        surfels = surfels_of(cloud, config, same_labels=same_labels)
        view = RegisteredView.of(surfels, cloud.viewpoint_world, self._pivot, config)
        self._views[new] = view
        self._twists = np.concatenate([self._twists, np.zeros((1, 6))])
        view_set = ViewSet.of(self._views)
        outcome = self._laid(view_set)
        known: Array = np.zeros((6, 6))
        if outcome not in EXACT:
            known = np.asarray(np.linalg.inv(view.information), dtype=np.float64)
        self.estimates.append(PoseEstimate(np.zeros(6), outcome, known, np.zeros(6), np.eye(6)))
        if outcome == "beyond the limits":
            self._let_go([new])
        elif outcome not in EXACT:
            self._refine(view_set)
        moves = self._moves(view_set)
        if len(self._views) > config.kept:
            self._let_go([self._least_missed()])
        return moves

    def _laid(self, view_set: ViewSet) -> Outcome:
        """Lay the newest view onto those that are kept, from where it was reported and coarse to fine."""
        config, reach = self._config, self._config.reaches[-1]
        outlier = OUTLIER * reach
        *others, new = self._views
        if not others:
            return "reference"
        exact = [v for v in others if self.estimates[v].outcome in EXACT]
        right = self._matched(view_set, exact, [new], reach)
        found = float(right.found.sum())
        # Exact views leave a tenth of the noise, noisy ones all of it.
        if found >= config.min_points and float(right.misfit.sum()) < 0.3 * config.noise * found:
            rest = [v for v in others if v not in exact]
            self._edges = self._edges.joined(right).joined(self._matched(view_set, rest, [new], outlier))
            return "fits as reported"

        reported, information = self._twists, self._views[new].information
        best = fine = view_set.descend(reported, information, self._pivot, reach, config)
        twists = reported.copy()
        for wide in config.reaches[:-1]:
            twists[new] = view_set.descend(twists, information, self._pivot, wide, config).twist
        if np.abs(twists[new] - fine.twist).max() > outlier:
            coarse = view_set.descend(twists, information, self._pivot, reach, config)
            best = coarse if coarse.misfit < fine.misfit else fine
        better = best.misfit < fine.misfit_before
        outcome: Outcome = "aligned" if better else "no better"
        if better:
            twists[new] = best.twist
            self._twists = twists
        edges = self._matched(view_set, others, [new], outlier)
        if edges.found.sum() < config.min_points:
            outcome = "too few partners"
        elif better and self._too_far(best.twist):
            outcome = "beyond the limits"
        if better and outcome != "aligned":
            self._twists = reported
            edges = self._matched(view_set, others, [new], outlier)
        self._edges = self._edges.joined(edges)
        return outcome

    def _matched(
        self,
        view_set: ViewSet,
        still: Sequence[int] | Index,
        moving: Sequence[int] | Index,
        outlier: float,
    ) -> PoseEdges:
        """What pairs of views say of each other where they are, from the whole of their samples."""
        first, second = np.broadcast_arrays(np.asarray(still, np.intp), np.asarray(moving, np.intp))
        return view_set.match(first, second, self._twists, self._pivot, outlier, self._config)

    def _too_far(self, twist: Array) -> bool:
        config = self._config
        turn = np.linalg.norm(twist[3:]) > np.radians(config.max_rotation)
        return bool(turn or np.linalg.norm(twist[:3]) > config.max_translation)

    def _refine(self, view_set: ViewSet) -> None:
        """Move all kept views together that are not exact, unless that lays them worse; note what is known.

        Views that few partners tie to the others stay where they are.
        """
        config, outlier = self._config, OUTLIER * self._config.reaches[-1]
        before = self._twists, self._edges
        for _ in range(ROUNDS):
            free, hessian = self._solve()
            if len(free) == 0:
                return
            # A quarter of the distance at which partners lose their weight.
            stale = self._edges.stale(self._twists, 2.0 * config.noise)
            if not stale.any():
                break
            old = self._edges.select(stale)
            anew = self._matched(view_set, old.still, old.moving, outlier)
            self._edges = self._edges.select(~stale).joined(anew)
        if self._edges.mean_misfit(outlier) > before[1].mean_misfit(outlier) + 0.3 * config.noise:
            self._twists, self._edges = before[0], before[1].among(np.array(list(self._views)))
        covariances, informations = _blocks(np.asarray(np.linalg.inv(hessian), np.float64)), _blocks(hessian)
        reported = np.stack([self._views[v].information for v in free])
        for v, covariance, determined, directions in zip(
            free, covariances, *_determined(reported, informations), strict=True
        ):
            self.estimates[v] = replace(
                self.estimates[v], covariance=covariance, determined=determined, directions=directions
            )

    def _solve(self) -> tuple[list[int], Array]:
        """Move all views to where the pairs of them want them; one that would go too far is let go.

        Returns:
            The views that were free to move, and the inverse covariance of their twists.
        """
        while True:
            enough = self._edges.partners(len(self._twists)) >= self._config.min_points
            free = [v for v in self._views if enough[v] and self.estimates[v].outcome not in EXACT]
            informations = np.array([self._views[v].information for v in free]).reshape(-1, 6, 6)
            twists, hessian = self._edges.solve(self._twists, np.array(free, dtype=np.intp), informations)
            far = [v for v in free if self._too_far(twists[v])]
            if not far:
                self._twists = twists
                return free, hessian
            self._let_go(far)

    def _moves(self, view_set: ViewSet) -> dict[int, Array]:
        """How views are to be moved now: the newest, and those whose points moved since they last were."""
        numbers = view_set.numbers.tolist()
        told = np.stack([self.estimates[v].twist for v in numbers])
        T, T_told = (twist_transform(t, self._pivot) for t in (self._twists[numbers], told))
        moves, settled = {}, 0.3 * self._config.noise
        for v, now, then in zip(numbers, T, T_told, strict=True):
            change = view_set.sample(v)[:, :3] @ (now - then)[:3, :3].T + (now - then)[:3, 3]
            if v == numbers[-1] or np.einsum("ni,ni->n", change, change).max() > settled**2:
                moves[v] = now @ transforms.invert(then)
                self.estimates[v] = replace(self.estimates[v], twist=self._twists[v])
        return moves

    def _let_go(self, views: Sequence[int]) -> None:
        """Let views stay where they are from now on, and lay no others onto them."""
        for v in views:
            del self._views[v]
        self._edges = self._edges.among(np.array(list(self._views)))

    def _least_missed(self) -> int:
        """The kept view whose surfaces another one shows best; the first that nothing ties to any, if any."""
        kept = list(self._views)
        partners = self._edges.partners(len(self._twists))
        loose = [v for v in kept[1:] if partners[v] < self._config.min_points]
        if loose:
            return loose[0]
        shared = self._edges.shared(np.array(kept))
        pair = divmod(int(np.argmax(shared)), len(kept))
        return kept[max((k for k in pair if k > 0), key=lambda k: shared[k].sum())]


def _blocks(matrix: Array) -> Array:
    """Blocks (F, 6, 6) on the diagonal of a matrix (6·F, 6·F)."""
    size = len(matrix) // 6
    return np.asarray(matrix.reshape(size, 6, size, 6)[np.arange(size), :, np.arange(size)], dtype=np.float64)


def _determined(information: Array, hessian: Array) -> tuple[Array, Array]:
    """Share (F, 6) of what is known that is not the report's, ascending, and the directions (F, 6, 6)."""
    half = np.linalg.inv(np.linalg.cholesky(information))
    values, vectors = np.linalg.eigh(half @ hessian @ half.swapaxes(-1, -2))
    return 1.0 - 1.0 / np.maximum(values, 1.0), half.swapaxes(-1, -2) @ vectors
