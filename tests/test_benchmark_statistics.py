"""What records say: means over scenes, intervals, thresholds, areas and paired differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from benchmark_records import make_record, make_suite

from caryatid.benchmark.bootstrap import Bootstrap
from caryatid.benchmark.comparison import closed_gap
from caryatid.benchmark.records import MEASURES
from caryatid.benchmark.samples import sample
from caryatid.benchmark.statistics import summarise
from caryatid.benchmark.thresholds import first_reach
from caryatid.config import StatisticsConfig

QUICK = StatisticsConfig(resamples=200)


def summary_of(records, seed=0, **options):
    return summarise(records, np.random.default_rng(seed), **({"config": QUICK} | options))


def method_of(records, **options):
    return summary_of(records, **options).groups[0].methods[0]


def curve(method, measure="f1"):
    return [estimate.value for estimate in method.curves[measure]]


def test_scenes_weigh_the_same_however_many_seeds_they_have():
    records = [make_record([0.4], scene="a", seed=s) for s in range(3)] + [make_record([0.8], scene="b")]
    method = method_of(records)
    assert curve(method) == pytest.approx([0.6])
    assert (method.scenes, method.episodes) == (2, 4)


def test_interval_covers_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(5)
    covered = 0
    for _ in range(200):
        records = [
            make_record([f1], scene=f"s{k}") for k, f1 in enumerate(rng.uniform(0.5, 0.9, 25).tolist())
        ]
        estimate = summarise(records, rng, config=QUICK).groups[0].methods[0].curves["f1"][0]
        covered += estimate.low <= 0.7 <= estimate.high
    assert 0.88 <= covered / 200 <= 0.98


def test_interval_is_no_wider_for_more_seeds_of_the_same_scene():
    one = [make_record([0.5 + 0.04 * k], scene=f"s{k}") for k in range(8)]
    more = [make_record([0.5 + 0.04 * k], scene=f"s{k}", seed=s) for k in range(8) for s in range(5)]
    assert method_of(one).curves == method_of(more).curves


def test_one_scene_has_no_interval():
    estimate = method_of([make_record([0.5], seed=s) for s in range(4)]).curves["f1"][0]
    assert (estimate.value, estimate.low, estimate.high) == (0.5, None, None)


def test_order_of_records_changes_no_figure():
    records = make_suite(scenes=6)
    shuffled = [records[k] for k in np.random.default_rng(1).permutation(len(records))]
    first, second = summary_of(records), summary_of(shuffled, reference="support")
    for group in first.groups:
        (other,) = [g for g in second.groups if (g.condition, g.family) == (group.condition, group.family)]
        assert other.budget == group.budget
        assert {m.method: m for m in other.methods} == {m.method: m for m in group.methods}
        assert {d.method: d for d in other.differences} == {d.method: d for d in group.differences}


def test_same_generator_gives_the_same_and_another_the_same_means():
    records = make_suite(scenes=6)
    assert summary_of(records) == summary_of(records)
    one, other = (summary_of(records, seed).groups[0].methods[0].curves["f1"][1] for seed in (0, 1))
    assert one.value == other.value
    assert (one.low, one.high) != (other.low, other.high)


def test_a_method_differs_from_itself_by_nothing():
    records = make_suite(["support"], scenes=5)
    twin = [replace(r, member=replace(r.member, method="twin")) for r in records]
    (difference,) = summary_of(records + twin).groups[0].differences
    for measure in MEASURES:
        for estimate in difference.measures[measure]:
            assert (estimate.value, estimate.low, estimate.high) == (0.0, 0.0, 0.0)
    for ratio in difference.path_ratios.values():
        assert ratio is None or ratio.value == 1.0


def test_difference_is_over_what_both_have():
    records = [
        make_record([0.5], scene="a"), make_record([0.1], scene="only ours"),
        make_record([0.9], scene="a", seed=1), make_record([0.6], scene="a", method="other"),
        make_record([0.0], scene="only theirs", method="other"),
    ]  # fmt: skip
    (difference,) = summary_of(records).groups[0].differences
    assert (difference.scenes, difference.episodes) == (1, 1)
    assert difference.measures["f1"][0].value == pytest.approx(0.1)


def test_pairing_removes_what_scenes_share():
    rng = np.random.default_rng(0)
    level = rng.uniform(0.3, 0.8, 20)
    records = [make_record([f1], scene=f"s{k:02d}") for k, f1 in enumerate(level.tolist())]
    records += [
        make_record([f1 + 0.05], scene=f"s{k:02d}", method="b") for k, f1 in enumerate(level.tolist())
    ]
    group = summary_of(records).groups[0]
    (difference,) = group.differences
    estimate = difference.measures["f1"][0]
    assert estimate.excludes_zero
    assert estimate.high - estimate.low < 1e-9
    assert group.methods[0].curves["f1"][0].high > group.methods[1].curves["f1"][0].low


def test_failed_episodes_are_counted_listed_and_averaged_nowhere():
    records = [
        make_record([0.8, 0.9], scene="a"),
        make_record(scene="/somewhere/heap", seed=2, error="/somewhere/heap: nothing is seen", views=2),
    ]
    summary = summary_of(records)
    method = summary.groups[0].methods[0]
    assert curve(method) == [0.8, 0.9]
    assert (method.episodes, method.failed, summary.episodes) == (1, 1, 2)
    (failure,) = summary.failures
    assert (failure.scene, failure.seed, failure.error) == ("heap", 2, "heap: nothing is seen")


def test_a_method_that_always_fails_leaves_the_others_alone():
    good = [make_record([0.8, 0.9], scene=s) for s in "ab"]
    bad = [make_record(scene=s, method="bad", error="no view is left", views=2) for s in "ab"]
    ours, theirs = summary_of(good + bad).groups[0].methods
    assert ours == method_of(good)
    assert (theirs.scenes, theirs.episodes, theirs.failed, theirs.area) == (0, 0, 2, None)
    assert summary_of(good + bad).groups[0].differences[0].scenes == 0


def test_an_episode_that_ends_early_keeps_what_it_has():
    method = method_of([make_record([0.5, 0.7], [0.0, 1.0], views=4)])
    assert curve(method) == [0.5, 0.7, 0.7, 0.7]
    assert curve(method, "path") == [0.0, 1.0, 1.0, 1.0]
    assert method.planning.count == 1


def test_views_and_path_to_a_threshold_by_hand():
    records = [
        make_record([0.5, 0.92, 0.95], [0.0, 1.0, 3.0], scene="a"),
        make_record([0.9, 0.91, 0.97], [0.0, 2.0, 4.0], scene="b"),
        make_record([0.5, 0.6, 0.7], [0.0, 1.0, 2.0], scene="c"),
    ]
    low = method_of(records).reaches[1]
    assert low.threshold == 0.90
    assert low.share.value == pytest.approx(2 / 3)
    assert (low.median_views, low.median_path) == (2.0, 1.0)
    assert low.mean_views == math.inf  # means are 0.633, 0.81, 0.873
    assert low.mean_path.value == math.inf
    high = method_of(records[:2]).reaches[0]
    assert (high.share.value, high.median_views, high.median_path) == (1.0, 3.0, 3.5)
    assert high.mean_views == 3.0
    # mean F1 0.915 at 1.5 m and 0.96 at 3.5 m: 0.94 lies 25/45 of the way
    assert high.mean_path.value == pytest.approx(1.5 + 2.0 * 25 / 45)


def test_median_is_not_reached_when_the_middle_episode_does_not():
    records = [make_record([0.5, f1], scene=f"s{k}") for k, f1 in enumerate((0.99, 0.99, 0.6, 0.6))]
    for reach in method_of(records).reaches:
        assert (reach.share.value, reach.median_views, reach.median_path) == (0.5, math.inf, math.inf)


def test_a_threshold_reached_by_equal_figures_is_reached():
    views, path = first_reach(np.full((1, 3), 0.1 + 0.2 + 0.6), np.zeros((1, 3)), 0.9, straight=True)
    assert (views[0], path[0]) == (1.0, 0.0)


def test_area_by_hand():
    records = [
        make_record([0.4, 0.8, 0.9], [0.0, 1.0, 3.0], scene="a"),
        make_record([0.6, 0.7, 0.7], [0.0, 2.0, 2.0], scene="a", method="b"),
    ]
    group = summary_of(records).groups[0]
    assert group.budget == 2.5
    assert [m.area.value for m in group.methods] == pytest.approx(
        [(0.4 + 1.5 * 0.8) / 2.5, (1.2 + 0.35) / 2.5]
    )


def test_nobody_moves_no_area():
    assert method_of([make_record([0.4, 0.8], [0.0, 0.0])]).area is None


def test_path_ratio_by_hand():
    records = [make_record([0.8, 1.0], [0.0, 1.0], scene=s, method="ours") for s in "ab"]
    records += [make_record([0.8, 1.0], [0.0, 4.0], scene=s, method="random") for s in "ab"]
    (difference,) = summary_of(records, reference="random").groups[0].differences
    ratio = difference.path_ratios[0.90]
    assert (ratio.value, ratio.low, ratio.high) == pytest.approx((0.25, 0.25, 0.25))


def test_closed_gap_by_hand():
    one, low, high = (
        sample([make_record([0.5, f1], scene=s, method=m) for s in "ab"])
        for m, f1 in (("ours", 0.8), ("random", 0.7), ("oracle", 0.9))
    )
    shares = closed_gap(one, low, high, Bootstrap(0, 50, 0.95))
    assert math.isnan(shares[0].value)
    assert (shares[1].value, shares[1].low, shares[1].high) == pytest.approx((0.5, 0.5, 0.5))


def test_gaps_are_told_where_they_are_asked_for():
    records = [
        make_record([f1], scene=s, method=m)
        for s in "ab"
        for m, f1 in (("ours", 0.8), ("random", 0.7), ("oracle", 0.9))
    ]
    gaps = summary_of(records, gap=("random", "oracle")).groups[0].gaps
    assert list(gaps) == ["ours"]
    assert gaps["ours"][0].value == pytest.approx(0.5)
    assert summary_of(records, gap=("random", "nobody")).groups[0].gaps == {}
    assert summary_of(records).groups[0].gaps == {}


def test_families_are_told_apart_where_there_are_several():
    summary = summary_of(make_suite(scenes=6))
    assert [(g.family, g.scenes) for g in summary.groups] == [("", 6), ("pile", 2), ("dense", 4)]
    assert [g.family for g in summary_of([make_record([0.5])]).groups] == [""]


def test_planning_time_leaves_out_the_first_view():
    method = method_of(make_suite(["support"], scenes=4, seeds=1, views=3))
    assert method.planning.count == 8
    assert 0.0 < method.planning.low <= method.planning.median <= method.planning.high
    assert method_of([make_record([0.5])]).planning is None


def test_nothing_to_summarise_and_unknown_reference_are_refused():
    with pytest.raises(ValueError, match="no episode"):
        summary_of([])
    with pytest.raises(ValueError, match="the methods are support"):
        summary_of([make_record([0.5])], reference="nobody")
    with pytest.raises(ValueError, match="two episodes of support"):
        summary_of([make_record([0.5]), make_record([0.6])])
