"""From records to arrays: the episodes of one method under one condition."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caryatid.benchmark.records import MEASURES, Record, ViewRow
from caryatid.geometry.transforms import Array

Key = tuple[str, int]
"""Scene and seed."""


@dataclass(frozen=True, eq=False, slots=True)
class Sample:
    """Episodes that can be averaged: one method, one condition.

    Attributes:
        keys: Scene and seed of each of the E episodes that did not fail, sorted.
        values: What was measured (E, V, M), M as in `MEASURES`. An episode that ended before its last view
            keeps what it had: its model stays what it is, and the robot where it is. NaN beyond the views it
            was to have.
        failed: Episodes that failed and are in none of the arrays.
        planning: Time of every choice of a view (D,) [s]; the first view of an episode is not chosen.
        perception: Time of every view's perception (P,) [s].
    """

    keys: tuple[Key, ...]
    values: Array
    failed: int
    planning: Array
    perception: Array

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the S scenes, sorted."""
        return tuple(sorted({scene for scene, _ in self.keys}))

    def of(self, measure: str) -> Array:
        """One measure (E, V)."""
        return self.values[:, :, MEASURES.index(measure)]

    def restrict(self, keys: Iterable[Key]) -> Array:
        """What was measured (K, V, M) in these episodes, in the order of the sorted keys."""
        wanted = set(keys)
        return self.values[[key in wanted for key in self.keys]]


def sample(records: Sequence[Record]) -> Sample:
    """Gather the episodes of one method under one condition.

    Args:
        records: In any order.

    Raises:
        ValueError: Two records are of the same scene and seed, or one has neither rows nor an error.
    """
    outcomes: dict[Key, Record] = {}
    for record in records:
        key = (record.member.episode.scene, record.member.episode.seed)
        if key in outcomes:
            raise ValueError(f"two episodes of {record.member.method} in {key[0]} with seed {key[1]}")
        outcomes[key] = record
    done = {key: outcomes[key] for key in sorted(outcomes) if outcomes[key].outcome.error is None}
    if any(not record.outcome.rows for record in done.values()):
        raise ValueError("an episode without rows says no error")
    views = max((_views(record) for record in done.values()), default=0)
    values = np.full((len(done), views, len(MEASURES)), np.nan)
    for e, record in enumerate(done.values()):
        rows = _measured(record.outcome.rows)
        values[e, : len(rows)] = rows
        values[e, len(rows) : _views(record)] = rows[-1]
    rows_all = [row for record in done.values() for row in record.outcome.rows]
    return Sample(
        keys=tuple(done),
        values=values,
        failed=len(outcomes) - len(done),
        planning=np.array([row.planning_seconds for row in rows_all if row.view > 1]),
        perception=np.array([row.perception_seconds for row in rows_all]),
    )


def scene_means(values: Array, keys: Sequence[Key]) -> Array:
    """Average the seeds of each scene.

    Args:
        values: Of each episode (E, ...).
        keys: Scene and seed of each.

    Returns:
        Means (S, ...), the scenes sorted by name.
    """
    names = np.array([scene for scene, _ in keys])
    means = np.empty((len(np.unique(names)), *values.shape[1:]))
    for s, name in enumerate(np.unique(names)):
        means[s] = values[names == name].mean(axis=0)
    return means


def group(records: Iterable[Record]) -> Mapping[str, Sequence[Record]]:
    """Records of each method, the methods in the order they first appear in."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record.member.method, []).append(record)
    return groups


def _views(record: Record) -> int:
    return max(record.member.episode.views, len(record.outcome.rows))


def _measured(rows: Sequence[ViewRow]) -> Array:
    return np.array([[getattr(row, name) for name in MEASURES] for row in rows], dtype=np.float64)
