"""The benchmark's figures: complete, the same bytes every time, every method told apart."""

from __future__ import annotations

import io
import itertools
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from benchmark_records import METHODS, make_record, make_suite
from PIL import Image

from caryatid.benchmark.figures import draw_figures, table_views, write_figures
from caryatid.benchmark.plotting import marks, spread
from caryatid.benchmark.records import Outcome, Record
from caryatid.benchmark.sections import tables
from caryatid.benchmark.statistics import summarise
from caryatid.benchmark.words import say_difference, say_estimate, say_number, say_time
from caryatid.config import StatisticsConfig


def summary_of(records):
    return summarise(records, np.random.default_rng(0), config=StatisticsConfig(resamples=50))


@pytest.fixture(scope="module")
def summary():
    return summary_of(make_suite(scenes=6, seeds=1))


@pytest.fixture(scope="module")
def figures(summary):
    return draw_figures(summary)


def test_the_figures_of_a_suite(figures):
    names = [figure.name for figure in figures]
    assert len(set(names)) == len(names)
    assert names[:7] == [
        "f1-over-views", "edge-f1-over-views", "vertex-f1-over-views", "mean-iou-over-views", "f1-over-path",
        "f1-differences", "planning-time",
    ]  # fmt: skip
    assert {"f1-over-views-dense", "f1-over-views-pile", "f1-over-path-dense"} < set(names)


def test_files_are_the_same_bytes_every_time(summary, figures, tmp_path):
    assert draw_figures(summary) == figures
    write_figures(figures, tmp_path / "new")
    for figure in figures:
        assert (tmp_path / f"new/{figure.name}.png").read_bytes() == figure.png
        assert (tmp_path / f"new/{figure.name}.svg").read_text() == figure.svg


def test_svg_and_png_can_be_read_and_say_no_date(figures):
    for figure in figures:
        root = ElementTree.fromstring(figure.svg)
        assert root.tag.endswith("svg")
        assert "dc:date" not in figure.svg
        with Image.open(io.BytesIO(figure.png)) as image:
            assert image.width == 1152
            assert not image.info.keys() & {"Software", "Creation Time"}


def test_every_method_is_named_in_every_figure(figures):
    for figure in figures:
        named = set(METHODS) - ({METHODS[0]} if "differences" in figure.name else set())
        assert named <= set(re.findall(r">([^<>]+)</text>", figure.svg)), figure.name


def test_ids_that_are_referred_to_differ_between_figures(figures):
    for one, other in itertools.combinations(figures, 2):
        used = [set(re.findall(r"url\(#([^)]+)\)|href=\"#([^\"]+)\"", f.svg)) for f in (one, other)]
        assert not used[0] & used[1]


def test_names_are_text_not_markup():
    records = [make_record([0.5, 0.6], scene=s, method=m) for s in "ab" for m in ("<b>&", "$a$_1")]
    for figure in draw_figures(summary_of(records)):
        assert ElementTree.fromstring(figure.svg) is not None
        if figure.name != "f1-differences":
            assert "&lt;b&gt;&amp;" in figure.svg
        assert "$a$_1" in figure.svg


def test_several_conditions_have_figures_each_and_one_of_all():
    records = [r for c in ("none", "carmine × 2") for r in make_suite(scenes=3, seeds=1, condition=c)]
    names = [figure.name for figure in draw_figures(summary_of(records))]
    assert {"f1-over-views-none", "f1-over-views-carmine-2", "f1-by-condition"} < set(names)
    assert not any("dense" in name for name in names)
    assert len(set(names)) == len(names)


def test_of_scenes_taken_apart_harm_is_told_and_no_f1():
    records = []
    for record in make_suite(("one hand", "random"), scenes=4, seeds=1, views=3):
        share = 1.0 if record.member.method == "one hand" else 0.25
        rows = tuple(replace(r, unharmed=round(share), lifts=share) for r in record.outcome.rows)
        records.append(Record(record.member, Outcome(rows)))
    summary = summary_of(records)
    names = [figure.name for figure in draw_figures(summary)]
    assert names[:3] == ["unharmed-over-views", "lifts-over-views", "unharmed-differences"]
    assert not any("f1" in name or "planning" in name for name in names)
    told = tables(summary.conditions[0], summary)
    assert [table.title for table in told] == [
        "Scenes taken apart without harm",
        "Lifts without harm",
        "Scenes taken apart without harm compared with one hand",
    ]
    assert told[1].rows[1][1].startswith("0.250")
    assert told[2].rows[0][1] == "−1.000 [−1.000, −1.000]"
    assert (0, 1) in told[2].strong


def test_what_cannot_be_drawn_is_left_out():
    assert draw_figures(summary_of([make_record(error="no view is left")])) == ()
    names = [figure.name for figure in draw_figures(summary_of([make_record([0.5])]))]
    assert names == [
        "f1-over-views", "edge-f1-over-views", "vertex-f1-over-views", "mean-iou-over-views",
    ]  # fmt: skip


def test_no_two_methods_look_alike():
    looks = [(m.colour, str(m.dash), m.marker) for m in marks([f"m{k}" for k in range(147)]).values()]
    assert len(set(looks)) == 147


def test_labels_keep_apart_and_inside():
    placed = spread(np.array([0.1, 0.5, 0.5, 0.51, 0.99]), 0.1, 0.0, 1.0)
    assert np.all(np.diff(placed) >= 0.1 - 1e-9)
    assert placed[0] == pytest.approx(0.1)
    assert placed[2] == pytest.approx(0.5, abs=0.01)
    assert 0.0 <= placed[0] <= placed[-1] <= 1.0


def test_views_of_a_table():
    assert table_views((1, 2, 3, 5, 10), 4) == (1, 2, 3, 4)
    assert table_views((1, 2, 3, 5, 10), 10) == (1, 2, 3, 5, 10)


def test_figures_in_words():
    from caryatid.benchmark.bootstrap import Estimate

    assert say_estimate(Estimate(0.9123, 0.9, 0.9249)) == "0.912 [0.900, 0.925]"
    assert say_estimate(Estimate(-0.0123, -0.02, 0.001), signed=True) == "−0.012 [−0.020, +0.001]"
    assert [say_number(v, 1) for v in (None, np.nan, np.inf, -0.01, -1.0)] == [
        "–",
        "–",
        "not reached",
        "0.0",
        "−1.0",
    ]
    assert [say_difference(v) for v in (0.0, 0.0001, 0.5)] == ["0.000", "0.000", "+0.500"]
    assert [say_time(t) for t in (0.0, 2e-5, 0.0123, 0.2, 0.9996, 12.34, 123.4)] == [
        "0 µs", "20 µs", "12.3 ms", "200 ms", "1.00 s", "12.3 s", "123 s",
    ]  # fmt: skip
