"""What a suite's records say: means over scenes with intervals, thresholds, paired differences, failures.

Scenes are what is sampled: the seeds of a scene are averaged first, and the bootstrap draws scenes. An
episode that failed is counted and listed, and is in no mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np

from caryatid.benchmark.bootstrap import Bootstrap, Estimate
from caryatid.benchmark.comparison import Difference, closed_gap, compare
from caryatid.benchmark.records import MEASURES, Record
from caryatid.benchmark.samples import Sample, group, sample, scene_means
from caryatid.benchmark.thresholds import Reach, area_over_path, path_budget, reach
from caryatid.config import StatisticsConfig
from caryatid.geometry.transforms import Array


@dataclass(frozen=True, slots=True)
class Spread:
    """How long something took.

    Attributes:
        count: How often it was done.
        low: 2.5 % took less [s].
        lower: A quarter took less [s].
        median: Half took less [s].
        upper: Three quarters took less [s].
        high: 97.5 % took less [s].
    """

    count: int
    low: float
    lower: float
    median: float
    upper: float
    high: float


@dataclass(frozen=True, slots=True)
class MethodSummary:
    """What one method does under one condition.

    Attributes:
        method: Its name.
        scenes: Scenes its means are over.
        episodes: Episodes its means are over.
        failed: Episodes that failed.
        curves: For each measure its mean after each view.
        reaches: What each threshold takes.
        area: Mean F1 along the path, up to the group's budget [1]; None where nobody moves.
        planning: Time of a choice, or None where none was made.
        perception: Time of a view, or None where there is none.
    """

    method: str
    scenes: int
    episodes: int
    failed: int
    curves: dict[str, tuple[Estimate, ...]]
    reaches: tuple[Reach, ...]
    area: Estimate | None
    planning: Spread | None
    perception: Spread | None


@dataclass(frozen=True, slots=True)
class Group:
    """Methods that can be compared: under one condition, over all scenes or those of one family.

    Attributes:
        condition: Label of noise and segmentation.
        family: Kind of the scenes; empty for all of them.
        families: The kinds of scenes in it.
        scenes: How many scenes there are.
        budget: Path over which F1 is averaged: the median of the methods' mean final paths [m].
        methods: The methods, in the order of the records.
        differences: Each method but the reference minus the reference.
        gaps: Share of the gap between two methods that each other method closes after each view, where it was
            asked for and both are there.
    """

    condition: str
    family: str
    families: tuple[str, ...]
    scenes: int
    budget: float
    methods: tuple[MethodSummary, ...]
    differences: tuple[Difference, ...]
    gaps: dict[str, tuple[Estimate, ...]]

    @property
    def views(self) -> int:
        """The most views a method has."""
        return max((len(m.curves["f1"]) for m in self.methods), default=0)

    @property
    def taken(self) -> bool:
        """Whether its scenes were taken apart; until then all its methods have done the same."""
        return any(lifts.value > 0.0 for method in self.methods for lifts in method.curves.get("lifts", ()))


@dataclass(frozen=True, slots=True)
class Failure:
    """An episode that failed: where, and why.

    Attributes:
        method: Label of the method.
        condition: Label of the condition.
        scene: Name of the scene.
        seed: Of the episode.
        error: What went wrong, in one line.
    """

    method: str
    condition: str
    scene: str
    seed: int
    error: str


@dataclass(frozen=True, slots=True)
class Summary:
    """What the records of a suite say.

    Attributes:
        groups: One for each condition over all its scenes, followed, where they are of more than one family,
            by one for each family.
        methods: Names of the methods, in the order of the records; a method has one colour in all figures.
        reference: The method others are compared with.
        gap: The two methods of which the others close the gap, or None.
        scenes: How many scenes there are.
        episodes: How many episodes there are, the failed ones too.
        seeds: How many seeds there are.
        failures: The episodes that failed.
        config: How it was made.
    """

    groups: tuple[Group, ...]
    methods: tuple[str, ...]
    reference: str
    gap: tuple[str, str] | None
    scenes: int
    episodes: int
    seeds: int
    failures: tuple[Failure, ...]
    config: StatisticsConfig

    @property
    def conditions(self) -> tuple[Group, ...]:
        """The groups over all scenes of a condition, of those in which something was measured."""
        return tuple(group for group in self.groups if not group.family and group.views)


def summarise(
    records: Sequence[Record],
    rng: np.random.Generator,
    *,
    reference: str | None = None,
    gap: tuple[str, str] | None = None,
    config: StatisticsConfig | None = None,
) -> Summary:
    """Say what the records of a suite mean.

    Methods, conditions and families keep the order in which they first appear; no figure depends on an order.

    Args:
        records: Of one suite.
        rng: Draws the bootstrap's seed.
        reference: The method others are compared with; None for the first.
        gap: Two methods, such as random choice and the oracle, of whose gap in F1 is told how much each other
            method closes.
        config: Resamples, confidence, thresholds.

    Raises:
        ValueError: There is no record, or none of the reference, or two are of one method, condition, scene
            and seed.
    """
    config = config or StatisticsConfig()
    methods = tuple(group(records))
    if not methods:
        raise ValueError("there is no episode to summarise")
    reference = reference or methods[0]
    if reference not in methods:
        raise ValueError(f"no episode is of {reference}; the methods are {', '.join(methods)}")
    bootstrap = Bootstrap(int(rng.integers(2**32)), config.resamples, config.confidence)
    groups = []
    for condition in dict.fromkeys(record.member.condition for record in records):
        part = [record for record in records if record.member.condition == condition]
        families = tuple(dict.fromkeys(record.member.family for record in part))
        for family in ("", *(families if len(families) > 1 else ())):
            chosen = [record for record in part if family in ("", record.member.family)]
            groups.append(_group(chosen, condition, family, reference, gap, config, bootstrap))
    return Summary(
        groups=tuple(groups),
        methods=methods,
        reference=reference,
        gap=gap,
        scenes=len({record.member.episode.scene for record in records}),
        episodes=len(records),
        seeds=len({record.member.episode.seed for record in records}),
        failures=tuple(_failure(record) for record in records if record.outcome.error is not None),
        config=config,
    )


def _group(
    records: Sequence[Record],
    condition: str,
    family: str,
    reference: str,
    gap: tuple[str, str] | None,
    config: StatisticsConfig,
    bootstrap: Bootstrap,
) -> Group:
    samples = {method: sample(part) for method, part in group(records).items()}
    budget = path_budget(list(samples.values()))
    return Group(
        condition=condition,
        family=family,
        families=tuple(dict.fromkeys(record.member.family for record in records)),
        scenes=len({record.member.episode.scene for record in records}),
        budget=budget,
        methods=tuple(_method(name, s, budget, config, bootstrap) for name, s in samples.items()),
        differences=tuple(
            compare(name, s, reference, samples[reference], config.thresholds, bootstrap)
            for name, s in samples.items()
            if name != reference and reference in samples
        ),
        gaps={
            name: closed_gap(s, samples[gap[0]], samples[gap[1]], bootstrap)
            for name, s in samples.items()
            if gap is not None and name not in gap and set(gap) <= set(samples)
        },
    )


def _method(
    name: str, part: Sample, budget: float, config: StatisticsConfig, bootstrap: Bootstrap
) -> MethodSummary:
    scenes = len(part.scenes)
    drawn = bootstrap.means(scene_means(part.values, part.keys))
    area = None
    if budget > 0.0 and scenes:
        areas = area_over_path(part.of("f1"), part.of("path"), budget)
        area = bootstrap.estimate(bootstrap.means(scene_means(areas, part.keys)), scenes)
    return MethodSummary(
        method=name,
        scenes=scenes,
        episodes=len(part.keys),
        failed=part.failed,
        curves={
            measure: tuple(bootstrap.estimate(drawn[:, v, m], scenes) for v in range(drawn.shape[1]))
            for m, measure in enumerate(MEASURES)
        },
        reaches=tuple(reach(part, threshold, bootstrap) for threshold in config.thresholds) if scenes else (),
        area=area,
        planning=_spread(part.planning),
        perception=_spread(part.perception),
    )


def _spread(seconds: Array) -> Spread | None:
    if len(seconds) == 0:
        return None
    quantiles = np.quantile(np.sort(seconds), (0.025, 0.25, 0.5, 0.75, 0.975))
    low, lower, median, upper, high = (float(q) for q in quantiles)
    return Spread(len(seconds), low, lower, median, upper, high)


def _failure(record: Record) -> Failure:
    """Name the scene of a folder by the folder alone: pages are shown to others."""
    member, episode = record.member, record.member.episode
    name = PurePath(episode.scene).name
    error = (record.outcome.error or "").replace(episode.scene, name)
    return Failure(member.method, member.condition, name, episode.seed, error)
