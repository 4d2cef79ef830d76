"""Registration: a new view is aligned with the earlier ones, then all views but the first move jointly.

Surfels of one view look for correspondences in another; Gauss–Newton on the robust, symmetric point-to-plane
distance, with the reported poses as priors.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RegistrationConfig
from caryatid.geometry import transforms
from caryatid.geometry.points import solve_positive
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import inner, kernel, on_threads
from caryatid.sensing.surfels import MIN_COSINE, even_sample, surfels_of
from caryatid.sensing.views import Cloud

BUCKETS = 4096
"""Lists in which a view's patches are kept, by a hash of label and cell [1]."""
OUTLIER = 0.3
"""Share of the reach beyond which distances lose their weight [1]."""
INDEPENDENT = 0.1
"""Share of the partners with independent errors [1]: neighbouring patches share theirs."""

EDGE = np.dtype(
    [
        ("still", np.intp),  # The view in which partners were searched for,
        ("moving", np.intp),  # and the one whose patches searched for them.
        ("apart", np.float64, 6),  # Twist of the moving view less that of the still one at that time.
        ("asked", np.float64),  # How many patches searched for a partner,
        ("found", np.float64),  # and how many found one.
        ("misfit", np.float64),  # Sum of their distances [m], none counting more than an outlier.
        ("gradient", np.float64, 6),  # Of half the sum of squares by the moving view's twist.
        ("information", np.float64, (6, 6)),  # Inverse covariance of one view's twist relative to the other.
    ]
)
"""The evidence of a pair of views about their poses: half the sum of the partners' squared distances over
their variance is quadratic in the twist of one view relative to the other, as long as partners keep their
weight.
"""

Outcome = Literal[
    "reference", "fits as reported", "aligned", "too few partners", "beyond the limits", "no better"
]
"""Outcome of a view's alignment when it was new; later views may move it in any case."""

EXACT = ("reference", "fits as reported")
"""Views that stay where they were reported for good."""


class ViewRegistration:
    """Where the views are; the first one defines the world.

    Args:
        pivot_world: Pivot of twists (3,) [m]; best amid the points.
        config: Expected errors and limits.

    Attributes:
        twists: Move (V, 6) of each view from where it was reported, 3 × m and 3 × rad about the pivot, as
            `add` returned it.
        outcomes: Outcome of each alignment.
    """

    def __init__(self, pivot_world: Array, config: RegistrationConfig) -> None:
        self.twists = np.zeros((0, 6))
        self.outcomes: list[Outcome] = []
        self._pivot = pivot_world
        self._config = config
        # The widest search spans two cells on either side.
        self._edge = max(config.reaches) / 2.0
        self._views: dict[int, _View] = {}
        self._now = np.zeros((0, 6))
        self._edges: NDArray[Any] = np.zeros(0, EDGE)

    @property
    def aligned(self) -> bool:
        """Whether enough of the newest view agrees with the others to trust its pose."""
        return self.outcomes[-1] not in ("too few partners", "beyond the limits")

    def copy(self) -> ViewRegistration:
        """Return an independent copy; the views so far are shared."""
        other = copy.copy(self)
        other.outcomes, other._views = self.outcomes.copy(), self._views.copy()
        return other

    def add(self, cloud: Cloud, *, same_labels: bool) -> dict[int, Array]:
        """Add a view.

        Args:
            cloud: Its labelled points in the world as reported; 65535 = the support surface.
            same_labels: Whether labels mean the same in every view.

        Returns:
            Moves of the new view and, in addition to earlier moves, of earlier ones: view → transform (4, 4)
                of the world.
        """
        new = len(self.outcomes)
        self._views[new] = self._prepared(cloud, same_labels=same_labels)
        self._now, self.twists = (np.concatenate([t, np.zeros((1, 6))]) for t in (self._now, self.twists))
        views = self._views.copy()
        outcome = self._lay()
        self.outcomes.append(outcome)
        if outcome == "beyond the limits":
            self._let_go([new])
        elif outcome not in EXACT:
            self._refine()
        moves = self._moves(views)
        if len(self._views) > self._config.kept:
            self._let_go([self._least_missed()])
        return moves

    def _prepared(self, cloud: Cloud, *, same_labels: bool) -> _View:
        """The stored form of a view; errors of its orientation turn about the camera."""
        config, arm = self._config, np.zeros(3)
        if cloud.viewpoint_world is not None:
            arm = cloud.viewpoint_world - self._pivot
        at_camera = np.eye(6)
        at_camera[:3, 3:] = -transforms.skew(arm)
        sigma = np.repeat([config.translation, np.radians(config.rotation)], 3)
        information = at_camera.T @ (at_camera / sigma[:, None] ** 2)
        patches, side = surfels_of(cloud, config, same_labels=same_labels)
        cells = np.floor(patches[:, :3] / self._edge).astype(np.int64)
        bucket = _bucket.py_func(patches[:, 7].astype(np.int64), *cells.T)
        starts = np.cumsum(np.bincount(bucket + 1, minlength=BUCKETS + 1))
        found, sample = patches[np.argsort(bucket, kind="stable")], patches[even_sample(side, config.sample)]
        return _View(found, starts, sample, information)

    def _lay(self) -> Outcome:
        """Align the newest view with those that are kept, from its reported pose, coarse to fine."""
        config, reach = self._config, self._config.reaches[-1]
        outlier = OUTLIER * reach
        *others, new = self._views
        if not any(len(self._views[v].sample) for v in others):
            return "reference"
        exact = [v for v in others if self.outcomes[v] in EXACT]
        right = self._matched((v, new) for v in exact)
        found = float(right["found"].sum())
        # Exact views leave a tenth of the noise, noisy ones all of it.
        if found >= config.min_points and float(right["misfit"].sum()) < 0.3 * config.noise * found:
            rest = self._matched((v, new) for v in others if v not in exact)
            self._edges = np.concatenate([self._edges, right, rest])
            return "fits as reported"

        reported, twists = self._now, self._now.copy()
        fine, misfit_before, misfit = self._descend(reported, reach)
        best = fine
        for wide in config.reaches[:-1]:
            twists[new] = self._descend(twists, wide)[0]
        if np.abs(twists[new] - fine).max() > outlier:
            coarse, _, coarse_misfit = self._descend(twists, reach)
            if coarse_misfit < misfit:
                best, misfit = coarse, coarse_misfit
        better = misfit < misfit_before
        if better:
            twists[new] = best
            self._now = twists
        edges = self._matched((v, new) for v in others)
        outcome: Outcome = "aligned" if better else "no better"
        if edges["found"].sum() < config.min_points:
            outcome = "too few partners"
        elif better and self._too_far(best):
            outcome = "beyond the limits"
        if better and outcome != "aligned":
            self._now = reported
            edges = self._matched((v, new) for v in others)
        self._edges = np.concatenate([self._edges, edges])
        return outcome

    def _matched(self, pairs: Iterable[tuple[int, int]]) -> NDArray[Any]:
        """Evidence of pairs (still, moving) at their current poses, from all their samples."""
        pairs, reach = list(pairs), self._config.reaches[-1]
        edges, upper = np.zeros(len(pairs), EDGE), np.triu_indices(6)
        found = self._correspondences(pairs, self._now, reach)
        for edge, rows, (still, moving) in zip(edges, found, pairs, strict=True):
            sums = _normal_equations(rows, np.zeros(6), OUTLIER * reach)
            edge["still"], edge["moving"], edge["asked"] = still, moving, len(rows)
            edge["apart"] = self._now[moving] - self._now[still]
            edge["found"], edge["misfit"] = sums[:2]
            sums[2:] *= INDEPENDENT
            edge["gradient"] = sums[2:8]
            edge["information"][upper] = edge["information"].T[upper] = sums[8:]
        return edges

    def _descend(self, twists: Array, reach: float) -> tuple[Array, float, float]:
        """Move the newest view so that partners lie in each other's planes; the others stay.

        Gauss–Newton, maximum a posteriori, starts from `twists` (V, 6). It gives its twist (6,), and the mean
        distance [m] over the patches that searched for a partner, an outlier's without one, before and after.
        """
        *others, new = self._views
        view, pairs = self._views[new], [(v, new) for v in others]
        # 250 patches are enough here; the fewer they are, the more independent their errors.
        stride = max(1, len(view.sample) * len(others) // 250)
        independent, outlier = min(1.0, stride * INDEPENDENT), OUTLIER * reach
        # The next reach or the joint solution covers what so small a step leaves.
        settled = 0.1 * outlier
        twists, misfits = twists.copy(), []
        for _ in range(3):
            rows = np.concatenate(self._correspondences(pairs, twists, reach, stride))
            step, ends = _step_down(rows, twists[new], view.information, independent, outlier, 4, settled)
            twists[new] += step
            misfits += [(far + (len(rows) - found) * outlier) / max(len(rows), 1) for found, far in ends]
            if np.abs(step).max() < settled:
                break
        return twists[new], misfits[0], misfits[-1]

    def _correspondences(
        self, pairs: Sequence[tuple[int, int]], twists: Array, reach: float, stride: int = 1
    ) -> list[Array]:
        """Rows (S, 8) of `_find_correspondences` of each pair (still, moving), for every stride-th patch."""
        T = twist_transform(twists, self._pivot)

        def work(number: int) -> Array:
            still, moving = pairs[number]
            other, sample = self._views[still], np.ascontiguousarray(self._views[moving].sample[::stride])
            return _find_correspondences(
                *(sample, other.patches, other.starts, T[moving], T[still], transforms.invert(T[still])),
                *(self._pivot, self._edge, reach, self._config.noise),
            )

        return on_threads(work, len(pairs))

    def _too_far(self, twist: Array) -> bool:
        turn, move = np.linalg.norm(twist[3:]), np.linalg.norm(twist[:3])
        return bool(turn > np.radians(self._config.max_rotation) or move > self._config.max_translation)

    def _refine(self) -> None:
        """Move all kept views together that are not exact, unless they then fit worse."""
        before, edges_before = self._now, self._edges
        for _ in range(3):
            if not self._solve():
                return
            # A quarter of the distance at which partners lose their weight.
            moved = np.abs(self._change()).max(axis=1, initial=0.0) > 2.0 * self._config.noise
            if not moved.any():
                break
            stale = self._edges[moved]
            again = self._matched(zip(stale["still"].tolist(), stale["moving"].tolist(), strict=True))
            self._edges = np.concatenate([self._edges[~moved], again])
        if self._mean_misfit(self._edges) > self._mean_misfit(edges_before) + 0.3 * self._config.noise:
            self._now, self._edges = before, edges_before
            self._let_go([])

    def _change(self) -> Array:
        """How far (E, 6) pairs moved since partners were searched for."""
        moving, still = (self._now[self._edges[end]] for end in ("moving", "still"))
        return np.asarray(moving - still - self._edges["apart"], dtype=np.float64)

    def _mean_misfit(self, edges: NDArray[Any]) -> float:
        """Mean distance [m] over the patches that searched for a partner; one without is an outlier."""
        asked, found = edges["asked"].sum(), edges["found"].sum()
        missing = (asked - found) * OUTLIER * self._config.reaches[-1]
        return float((edges["misfit"].sum() + missing) / max(asked, 1))

    def _enough(self) -> NDArray[np.bool_]:
        """Which views (V,) have enough partners in all others, or they in them, to determine a pose."""
        number = np.zeros(len(self._now))
        for end in ("still", "moving"):
            np.add.at(number, self._edges[end], self._edges["found"])
        return number >= self._config.min_points

    def _solve(self) -> bool:
        """Move all views as the pairs suggest, if any is free; free those that would move too far."""
        while True:
            enough = self._enough()
            free = [v for v in self._views if enough[v] and self.outcomes[v] not in EXACT]
            now = self._solution(free)
            far = [v for v in free if self._too_far(now[v])]
            if not far:
                self._now = now
                return bool(free)
            self._let_go(far)

    def _solution(self, free: Sequence[int]) -> Array:
        """Twists (V, 6) of all views after the pairs and the reported poses moved the free ones together."""
        information, count, each = self._edges["information"], len(free), np.arange(len(free))
        gradient = self._edges["gradient"] + np.einsum("eij,ej->ei", information, self._change())
        reported = np.array([self._views[v].information for v in free]).reshape(-1, 6, 6)
        moved, views = self._now.copy(), np.array(free, dtype=np.intp)
        column = np.full(len(moved), -1)
        column[views] = each
        i, j = column[self._edges["moving"]], column[self._edges["still"]]
        H = np.zeros((count, count, 6, 6))
        H[each, each] = reported
        g = np.einsum("fij,fj->fi", reported, moved[views])
        for end, sign in ((i, 1.0), (j, -1.0)):
            np.add.at(H, (end[end >= 0], end[end >= 0]), information[end >= 0])
            np.add.at(g, end[end >= 0], sign * gradient[end >= 0])
        both = (i >= 0) & (j >= 0)
        np.subtract.at(H, (i[both], j[both]), information[both])
        np.subtract.at(H, (j[both], i[both]), information[both])
        hessian = H.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count)
        moved[views] -= np.linalg.solve(hessian, g.ravel()).reshape(-1, 6)
        return moved

    def _moves(self, views: dict[int, _View]) -> dict[int, Array]:
        """Moves of views: of the newest, and of those whose points moved since their last move."""
        numbers, moves, twists = list(views), {}, self.twists.copy()
        T, T_told = (twist_transform(t[numbers], self._pivot) for t in (self._now, self.twists))
        for v, now, told in zip(numbers, T, T_told, strict=True):
            moved = transforms.transform(now - told, views[v].sample[:, :3])
            settled = (0.3 * self._config.noise) ** 2
            if v == numbers[-1] or np.einsum("ni,ni->n", moved, moved).max(initial=0.0) > settled:
                moves[v] = now @ transforms.invert(told)
                twists[v] = self._now[v]
        self.twists = twists
        return moves

    def _let_go(self, views: Sequence[int]) -> None:
        """Freeze views, and align no others with them."""
        for v in views:
            del self._views[v]
        kept = [np.isin(self._edges[end], list(self._views)) for end in ("still", "moving")]
        self._edges = self._edges[np.logical_and(*kept)]

    def _least_missed(self) -> int:
        """The kept view whose surfaces another one shows best; or the first that nothing links to another."""
        kept, edges, enough = list(self._views), self._edges, self._enough()
        loose = [v for v in kept[1:] if not enough[v]]
        if loose:
            return loose[0]
        shared = np.zeros((len(kept), len(kept)))
        i, j = np.searchsorted(kept, edges["moving"]), np.searchsorted(kept, edges["still"])
        shared[i, j] = shared[j, i] = edges["found"] / np.maximum(edges["asked"], 1)
        pair = divmod(int(np.argmax(shared)), len(kept))
        return kept[max((k for k in pair if k > 0), key=lambda k: shared[k].sum())]


class _View(NamedTuple):
    """A view as registration stores it.

    Its patches (P, 8) lie in the world as reported, sorted to be found, with where the list of each bucket
    begins (BUCKETS + 1,). A sample of them (S, 8) searches for partners in other views. The information is
    the inverse covariance (6, 6) of the reported pose's error, as a twist about the pivot.
    """

    patches: Array
    starts: NDArray[np.intp]
    sample: Array
    information: Array


def twist_transform(twist: Array, pivot_world: Array) -> Array:
    """The rigid transforms (..., 4, 4) of twists (..., 6), 3 × m and 3 × rad about a pivot (3,) [m]."""
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


@kernel(inline="always")
def _bucket(label, x, y, z):  # type: ignore[no-untyped-def]
    """Number of the bucket of a label and a cell, all integers."""
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791) ^ (label * 50331653)
    return (mixed ^ (mixed >> 15)) & (BUCKETS - 1)


@kernel
def _find_correspondences(samples, patches, starts, T, T_other, T_back, pivot, edge, reach, noise):  # type: ignore[no-untyped-def]
    """Find the patch of another view that is nearest in place and direction, and linearise the distance.

    Distance is along the mean of both normals, and its derivative by a move of either view that about the
    middle between the two patches: a move of both views together changes nothing. The samples (S, 8) are
    where T puts them, the other view's patches (P, 8) where T_other does, whose inverse is T_back, all
    (4, 4). Rows (S, 8) are the derivative by the samples' twist about the pivot (3,) [m]; the distance [m];
    its inverse variance [1/m²]; zero where there is no partner within reach [m].
    """
    rows = np.zeros((len(samples), 8))
    for i in range(len(samples)):
        row, sample = rows[i], samples[i]
        px, py, pz = _moved(T, sample[0], sample[1], sample[2], 1.0)
        nx, ny, nz = _moved(T, sample[3], sample[4], sample[5], 0.0)
        point, normal = _moved(T_back, px, py, pz, 1.0), _moved(T_back, nx, ny, nz, 0.0)
        found = _partner(patches, starts, edge, reach, point, normal, sample[7])
        if found < 0:
            continue
        other = patches[found]
        qx, qy, qz = _moved(T_other, other[0], other[1], other[2], 1.0)
        mx, my, mz = _moved(T_other, other[3], other[4], other[5], 0.0)
        mx, my, mz = mx + nx, my + ny, mz + nz
        length = np.sqrt(mx * mx + my * my + mz * mz)
        mx, my, mz = mx / length, my / length, mz / length
        row[0], row[1], row[2] = mx, my, mz
        row[6] = (px - qx) * mx + (py - qy) * my + (pz - qz) * mz
        qx, qy, qz = 0.5 * (px + qx) - pivot[0], 0.5 * (py + qy) - pivot[1], 0.5 * (pz + qz) - pivot[2]
        row[3], row[4], row[5] = qy * mz - qz * my, qz * mx - qx * mz, qx * my - qy * mx
        row[7] = 1.0 / (sample[6] + other[6] + noise * noise)
    return rows


@inner
def _partner(patches, starts, edge, reach, point, normal, label):  # type: ignore[no-untyped-def]
    """Number of the patch nearest in place and direction, or −1."""
    x, y, z = point
    cx, cy, cz = np.floor(x / edge), np.floor(y / edge), np.floor(z / edge)
    fx, fy, fz = x - cx * edge, y - cy * edge, z - cz * edge
    inside = min(min(fx, edge - fx), min(fy, edge - fy), min(fz, edge - fz))
    # A right angle between directions counts as √2 · 5 cm.
    turned = 2.0 * 0.05 * 0.05
    widest = reach * reach
    best = widest + turned * (1.0 - MIN_COSINE)
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
                    bucket = _bucket(np.int64(label), np.int64(cx) + i, np.int64(cy) + j, np.int64(cz) + k)
                    for n in range(starts[bucket], starts[bucket + 1]):
                        u, v, w = patches[n, 0] - x, patches[n, 1] - y, patches[n, 2] - z
                        apart = u * u + v * v + w * w
                        if apart >= min(best, widest) or patches[n, 7] != label:
                            continue
                        cosine = patches[n, 3] * normal[0] + patches[n, 4] * normal[1]
                        cosine += patches[n, 5] * normal[2]
                        apart += turned * (1.0 - cosine)
                        if cosine > MIN_COSINE and apart < best:
                            best = apart
                            found = n
    return found


@kernel(inline="always")
def _moved(T, x, y, z, last):  # type: ignore[no-untyped-def]
    """A point (last 1) or a direction (last 0) moved by a rigid transform (4, 4)."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3] * last,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3] * last,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3] * last,
    )


@kernel
def _normal_equations(rows, step, outlier):  # type: ignore[no-untyped-def]
    """Sum up the robust normal equations of rows (N, 8) after a step (6,) of the moving view.

    They are (29,): how many partners there are; the sum of their distances [m], none counting more than an
    outlier [m], beyond which they lose their weight; the gradient (6,); the upper half of the matrix (6, 6).
    """
    sums = np.zeros(29)
    for i in range(len(rows)):
        row = rows[i]
        if row[7] == 0.0:
            continue
        distance = row[6]
        for a in range(6):
            distance += row[a] * step[a]
        far = distance / outlier
        weight = row[7] / ((1.0 + far * far) * (1.0 + far * far))
        sums[0] += 1.0
        sums[1] += min(abs(distance), outlier)
        k = 8
        for a in range(6):
            weighted = weight * row[a]
            sums[2 + a] += weighted * distance
            for b in range(a, 6):
                sums[k] += weighted * row[b]
                k += 1
    return sums


@kernel
def _step_down(rows, twist, information, independent, outlier, steps, settled):  # type: ignore[no-untyped-def]
    """Move a view by Gauss–Newton on the robust distances and its pose as reported; partners stay the same.

    Rows (N, 8) are those of the view where it is. A share of the partners has independent errors; a step
    smaller than settled [m, rad] is the last. It gives the change of the twist (6,), and the number of
    partners and the sum of their distances [m] before and after (2, 2).
    """
    step, gradient, hessian, ends = np.zeros(6), np.zeros(6), np.zeros((6, 6)), np.zeros((2, 2))
    largest = np.inf
    for number in range(steps + 1):
        sums = _normal_equations(rows, step, outlier)
        ends[min(number, 1), 0], ends[min(number, 1), 1] = sums[0], sums[1]
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
    return step, ends
