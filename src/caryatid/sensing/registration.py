"""Laying views onto each other: point-to-plane matching between views, the reported poses as priors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RegistrationConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each
from caryatid.sensing.correspondences import CHUNK, Search, find_partners, index_patches
from caryatid.sensing.gauss_newton import normal_equations, step_down
from caryatid.sensing.pose_graph import Index, Ties
from caryatid.sensing.surfels import Surfels, even_sample

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
class Descent:
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
class Gathering:
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
    def of(cls, views: Mapping[int, RegisteredView]) -> Gathering:
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
    ) -> Ties:
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
        for_each(find_partners, search.shares, search)
        sums = normal_equations(search.rows, pairs, len(still), outlier)
        sums[:, 2:] *= config.independent
        information = np.empty((len(sums), 6, 6))
        information[:, UPPER[0], UPPER[1]] = sums[:, 8:]
        information[:, UPPER[1], UPPER[0]] = sums[:, 8:]
        apart = twists[moving] - twists[still]
        return Ties(still, moving, apart, asked, sums[:, 0], sums[:, 1], sums[:, 2:8], information)

    def descend(
        self, twists: Array, information: Array, pivot_world: Array, reach: float, config: RegistrationConfig
    ) -> Descent:
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
        stride = max(1, size * len(others) // config.descent)
        tasks, _, asked = self._tasks(others, np.repeat(new, len(others)), stride)
        outlier = config.outlier * reach
        search = self._search(tasks, 1, twists, pivot_world, reach, config)
        twist, ends = search.twists[-1], []
        for _ in range(config.rounds):
            for_each(find_partners, search.shares, search)
            result = step_down(
                *(search.rows, twist, information, min(1.0, stride * config.independent), outlier),
                *(config.steps, config.converged * outlier),
            )
            twist += result[:6]
            ends += [result[6:8], result[8:]]
            if np.abs(result[:6]).max() < config.converged * outlier:
                break
        total = max(int(asked.sum()), 1)
        before, after = (float(far + (total - found) * outlier) / total for found, far in (ends[0], ends[-1]))
        return Descent(twist, before, after)

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
            *(_edge(config), reach, config.min_cosine, config.normal_reach, config.noise),
            np.zeros((len(tasks), CHUNK, 8)),
        )

    def _tasks(
        self, still: Index, moving: Index, stride: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Tasks (R, 5) for `find_partners`, the pair (R,) each is of, and how many patches (E,) they ask."""
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
