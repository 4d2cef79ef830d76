"""The benchmark: suites, scenes, episodes, the result file, statistics and the report."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
from conftest import SMALL, run_command

from caryatid.benchmark.episodes import (
    MEASURES,
    TIMES,
    Episode,
    Outcome,
    content_of,
    family,
    find_scenes,
    run_episode,
    settings_of,
)
from caryatid.benchmark.report import read_results, summarise_store, write_document
from caryatid.benchmark.statistics import bootstrap, summarise
from caryatid.benchmark.store import RESULTS, Member, ResultStore, collect_provenance
from caryatid.benchmark.suites import SUITES, change_suite
from caryatid.errors import InputError
from caryatid.simulation.scenes import is_builtin

QUICK = tuple(flag.removeprefix("--set=") for flag in SMALL)


def without_times(outcome: Outcome) -> Outcome:
    return replace(outcome, rows=tuple(row | dict.fromkeys(TIMES, 0.0) for row in outcome.rows))


def row(view: int, f1: float, path: float = 0.0) -> dict[str, float]:
    figures = {**dict.fromkeys(MEASURES, f1), "path": path, "lifts": 0.0, "unharmed": 0.0}
    return {"view": view, **figures, "forecasts": [[float(f1), True], [0.4, False]]}


def member(scene: str = "tower", method: str = "support", seed: int = 0, kind: str = "designed") -> Member:
    return Member(Episode(scene, planner=method, seed=seed, views=3), method, "labels, Carmine noise", kind)


def fill(path, methods=("support", "random", "oracle"), scenes=2) -> None:
    """A result file of episodes that never ran; the last one failed."""
    rng = np.random.default_rng(1)
    members = [
        member(f"{kind}-5-{scene}", method, seed, kind)
        for method, scene, seed in product(methods, range(scenes), range(2))
        for kind in ["dense" if scene % 2 else "pile"]
    ]
    with ResultStore(path, "code", collect_provenance()) as store:
        store.plan("planners", members)
        for m in members[:-1]:
            rise = 0.6 + 0.1 * methods.index(m.method)
            f1 = np.clip(rise + 0.1 * np.arange(3) + rng.normal(0.0, 0.03, 3), 0.0, 1.0)
            store.add(m.episode, Outcome(tuple(row(v, f1[v - 1], 0.5 * v - 0.5) for v in (1, 2, 3))))
        store.add(members[-1].episode, Outcome((), f"{members[-1].episode.scene}: fell <over>"))


# Suites and scenes


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_is_made_of_valid_episodes_and_can_be_changed(name):
    suite = SUITES[name]
    assert all(is_builtin(scene) for scene in suite.scenes)
    few = replace(suite, scenes=suite.scenes[:1], seeds=1)
    options = {"fusions": ["pc", "sg"], "segmentations": ["auto", "labels"], "noises": ["none", "carmine"]}
    changed = change_suite(few, **options, settings=["noise.translation=0.02"])
    for one in (few, changed):
        members = one.members()
        assert len(members) == len(one.conditions) * len(one.methods)
        assert len({m.episode for m in members}) == len(members)
        assert len({(m.condition, m.method) for m in members}) == len(members)
        configs = [settings_of(e) for e in {m.episode.settings: m.episode for m in members}.values()]
    assert {(m.episode.segmentation, m.episode.noise, m.episode.fusion) for m in changed.members()} == set(
        product(("labels", "auto"), ("none", "carmine"), ("pc", "sg"))
    )
    assert {config.noise.translation for config in configs} == {0.02}


def test_planners_replace_the_methods_and_options_are_not_settings():
    suite = replace(SUITES["smoke"], scenes=("tower",))
    changed = change_suite(suite, planners=["random", "paper", "random"])
    said = [(m.method, m.episode.planner, m.episode.fusion) for m in changed.members()]
    assert said == [("random", "random", "pc+sg"), ("paper", "paper", "pc+sg")]
    with pytest.raises(InputError, match=r"fusion\.method=pc: is set for each episode; use --fusion"):
        change_suite(suite, settings=["fusion.method=pc"])


def test_folders_of_scenes_are_found(tmp_path):
    for name in ("tower", "bridge"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.xml").write_text(name)
        (tmp_path / name / "gt.json").write_text("{}")
    folders = [str(tmp_path / "bridge"), str(tmp_path / "tower")]
    assert find_scenes([str(tmp_path), str(tmp_path / "tower"), "shelf"]) == [*folders, "shelf"]
    assert [family(s) for s in ("tower", "pile-4-1", "a/ycb4_8")] == ["designed", "pile", "ycb"]
    before = content_of(folders[0])
    assert before != content_of(folders[1])
    (tmp_path / "bridge" / "gt.json").unlink()
    assert content_of(folders[0]) != before
    with pytest.raises(InputError, match=r"bridge: has no gt\.json"):
        find_scenes([str(tmp_path)])
    with pytest.raises(InputError, match=r"is neither a built-in scene nor a folder; give .* tower"):
        find_scenes(["castle"])


# Episodes


def test_an_episode_is_scored_view_by_view():
    outcome = run_episode(Episode("tower", settings=QUICK, views=2))
    assert outcome.error is None
    first, second = outcome.rows
    assert (first["view"], second["view"]) == (1, 2)
    assert first["angle"] == first["path"] == first["planning_seconds"] == 0.0
    assert second["angle"] > 0.0
    assert second["path"] > 0.0
    assert 0.5 < second["f1"] <= 1.0


# The result file


def test_what_is_added_comes_back_and_only_what_is_missing_is_asked_for(tmp_path):
    members = [member(seed=s) for s in range(3)]
    twice = [*members, replace(members[0], method="the same")]
    path = tmp_path / RESULTS
    with ResultStore(path, "code") as store:
        assert store.plan("smoke", twice) == [m.episode for m in members]
        store.add(members[0].episode, Outcome((row(1, 0.1 + 0.2),)))
        store.add(members[1].episode, Outcome((), "no luck"))
        with pytest.raises(InputError, match="in use by another process; wait until it finishes"):
            ResultStore(path, "code")
        with ResultStore(path) as reading:
            assert list(reading.suites) == ["smoke"]
    with ResultStore(path, "code") as store:
        assert store.plan("smoke", twice) == [members[2].episode]
        assert store.plan("smoke", twice, retry=True) == [members[1].episode, members[2].episode]
        assert store.plan("other", members[1:]) == [members[2].episode]
        store.add(members[1].episode, Outcome((row(1, 0.5),)))
        store.add(members[1].episode, Outcome((row(1, 0.7),)))
    with ResultStore(path) as store:
        assert store.suites == {"smoke": twice, "other": members[1:]}
        assert store.table("smoke")["f1"].tolist() == [0.1 + 0.2, 0.5, 0.1 + 0.2]


@pytest.mark.parametrize("torn", [0, 1, 200])
def test_a_torn_last_line_is_ignored_and_written_again(tmp_path, torn):
    path = tmp_path / RESULTS
    members = [member(seed=s) for s in range(2)]
    with ResultStore(path, "code") as store:
        store.plan("a", members)
        store.add(members[0].episode, Outcome((row(1, 0.5),)))
        whole = path.stat().st_size
        store.add(members[1].episode, Outcome((row(1, 0.7),)))
    path.write_bytes(path.read_bytes()[: whole + torn])
    with ResultStore(path) as store:
        assert store.table("a")["f1"].tolist() == [0.5]
    with ResultStore(path, "code") as store:
        assert store.plan("a", members) == [members[1].episode]
        store.add(members[1].episode, Outcome((row(1, 0.7),)))
    with ResultStore(path) as store:
        assert store.table("a")["f1"].tolist() == [0.5, 0.7]
    path.write_bytes(b'{"about": {"ver')
    with ResultStore(path, "code") as store:
        assert store.plan("a", members) == [m.episode for m in members]


@pytest.mark.parametrize(
    "other",
    [{"scene": "bridge"}, {"seed": 1}, {"views": 6}, {"planner": "random"}, {"fusion": "pc"},
     {"segmentation": "auto"}, {"noise": "none"}, {"settings": ("a.b=1",)}, {"content": "abc"},
     {"plugin": "abc"}, {"order": "random"}],
)  # fmt: skip
def test_everything_that_decides_an_episode_is_in_its_key(other):
    episode = member().episode
    assert replace(episode, **other).key("code") != episode.key("code")
    assert episode.key("other code") != episode.key("code")
    here, there = (Episode(f"{place}/pile", content="abc") for place in ("here", "there"))
    assert here.key("code") == there.key("code")


def test_results_of_other_code_are_refused_and_kept(tmp_path):
    path = tmp_path / RESULTS
    with pytest.raises(InputError, match="the file is missing; run a suite first"):
        ResultStore(path)
    with ResultStore(path, "code", {"version": "0.1"}):
        pass
    with pytest.raises(InputError, match=r"the code differs \(0.1 code\).*another --out"):
        ResultStore(path, "newer")
    for content in (b"not JSON, not at all", b"no\nlines\n", b'{"cakes": 1}\n'):
        path.write_bytes(content)
        for code in (None, "code"):
            with pytest.raises(InputError, match="not a result file"):
                ResultStore(path, code)
        assert path.read_bytes() == content


# Statistics


def table(curves: dict[str, list[tuple[str, list[float]]]]) -> pd.DataFrame:
    """A row per view: method → (scene, F1 by view); half a metre per view."""
    rows = [
        {"method": method, "condition": "c", "family": "pile", "scene": scene, "seed": 0, "error": None}
        | row(v, f1, 0.5 * v - 0.5)
        for method, episodes in curves.items()
        for scene, values in episodes
        for v, f1 in enumerate(values, start=1)
    ]
    return pd.DataFrame(rows)


def figure(summary: pd.DataFrame, method: str, quantity: str, at: float = 0) -> pd.Series:
    chosen = (summary["method"] == method) & (summary["quantity"] == quantity) & (summary["at"] == at)
    (found,) = summary[chosen].itertuples()
    return found


@pytest.mark.parametrize(
    ("method", "quantity", "at", "expected"),
    [
        ("one", "f1", 2, 0.8),
        ("one", "f1 difference", 3, 0.2),
        ("one", "paired scenes", 0, 2),
        ("one", "gap", 2, 0.5),
        ("one", "share", 0.9, 1.0),
        ("one", "mean path", 0.9, 0.75),
        ("two", "share", 0.9, 1.0 / 3.0),
        ("two", "mean path", 0.9, np.inf),
    ],
)
def test_figures_by_hand(method, quantity, at, expected):
    """Mean curves: one 0.5, 0.8, 1.0; best 0.5, 1.0, 1.0; two, of the scenes it shares, 0.5, 0.6, 0.8."""
    curves = {
        "one": [("a", [0.5, 0.9, 1.0]), ("b", [0.5, 0.7, 1.0])],
        "two": [("a", [0.5, 0.6, 0.7]), ("b", [0.5, 0.6, 0.9]), ("c", [0.0, 0.0, 0.0])],
        "best": [("a", [0.5, 1.0, 1.0]), ("b", [0.5, 1.0, 1.0])],
    }
    summary = summarise(table(curves), reference="two", gap=("two", "best"))
    assert figure(summary, method, quantity, at).value == pytest.approx(expected)
    found = figure(summary, "one", "f1", 2)
    assert (found.low, found.high) == pytest.approx((0.7, 0.9))
    to_one = summarise(table(curves), reference="one")
    assert figure(to_one, "best", "path ratio", 0.9).value == pytest.approx(0.4 / 0.75)


def test_how_good_probabilities_are_by_hand():
    """Two scenes, the other one twice as large; a true support that is missing counts in the Brier score."""
    one = [[0.95, True], [0.92, True], [0.42, False], [0.0, True]]
    two = [[0.95, False], [1.0, True], [0.48, False], [0.95, True]] * 2
    rows = table({"a": [("one", [0.5]), ("two", [0.5])]})
    rows["forecasts"] = [[[p, 1.0, t] for p, t in one], two]  # The first as earlier versions wrote it.
    summary = summarise(rows, reference="a")
    said, true = np.array(one + two).T
    errors = (said - true) ** 2
    assert figure(summary, "a", "pooled brier", 1).value == pytest.approx(np.mean(errors))
    assert figure(summary, "a", "listed brier", 1).value == pytest.approx(np.mean(errors[said > 0.0]))
    gain = 1.0 - np.sum(errors[said > 0.0]) / np.sum((np.where(said < 0.9, 0.5, 1.0) - true)[said > 0.0] ** 2)
    assert figure(summary, "a", "brier gain", 1).value == pytest.approx(gain)
    low, high = (0.42 + 2 * 0.48) / 3, (0.95 + 0.92 + 2 * (0.95 + 1.0 + 0.95)) / 8
    for quantity, expected in (("reliability 1", [0.0, 6 / 8]), ("supports 1", [3, 8])):
        bins = summary[summary["quantity"] == quantity]
        assert bins["at"].tolist() == pytest.approx([low, high])
        assert bins["value"].tolist() == expected
    error = (3 * low + 8 * (high - 6 / 8)) / 11
    assert figure(summary, "a", "calibration error", 1).value == pytest.approx(error)


def test_seeds_of_a_scene_count_as_one_and_failures_not_at_all(tmp_path):
    path = tmp_path / RESULTS
    members = [member("a", seed=0), member("a", seed=1), member("b"), member("b", seed=1)]
    with ResultStore(path, "code") as store:
        store.plan("x", members)
        for m, f1 in zip(members, (0.2, 0.4, 0.9, None), strict=True):
            rows = () if f1 is None else (row(1, f1),)
            store.add(m.episode, Outcome(rows, "fell" if f1 is None else None))
        (result,) = summarise_store(store)
    assert figure(result.summary, "support", "f1", 1).value == pytest.approx(0.6)
    assert figure(result.summary, "support", "failed").value == 1
    assert result.failures == [["support", "labels, Carmine noise", "b", "1", "fell"]]


def test_an_interval_covers_the_mean_as_often_as_it_says():
    values = np.random.default_rng(5).normal(0.5, 0.1, (40, 30))
    scenes = pd.RangeIndex(30, name="scene")
    found = [bootstrap([pd.DataFrame(v, index=scenes)], lambda means: means)[0] for v in values]
    assert 33 <= sum(low < 0.5 < high for _, low, high in found) <= 40


# The report


@pytest.mark.slow
def test_the_command_writes_tables_figures_and_pages_of_finished_episodes(tmp_path, capsys):
    out = tmp_path / "bench"
    fill(out / RESULTS)
    assert run_command("benchmark", "--out", out, "--reference", "support", "--json") == 0
    write_document(*read_results(out / "summary.json.gz"), tmp_path / "page.md", "caryatid benchmark")
    said = json.loads(capsys.readouterr().out)["suites"]["planners"]
    assert (said["planned"], said["done"], said["failed"]) == (12, 12, 1)
    page, document = (out / "index.html").read_text(), (tmp_path / "page.md").read_text()
    for text in (page, document):
        for part in ("planners", "random", "oracle", "Until F1 reaches 0.94", "dense scenes only"):
            assert part in text
    assert "fell &lt;over&gt;" in page
    assert not [link for link in ("http://", "<script", "<link") if link in page]
    shown = {line.split("(")[1].rstrip(")") for line in document.splitlines() if line.startswith("![")}
    assert shown == {f"page/{file.name}" for file in (tmp_path / "page").iterdir()}
    assert page.count('src="data:image/svg+xml;base64,') == len(shown)
    for name in ("f1-over-views", "reliability"):
        assert (out / "planners" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    f1 = said["f1"]["labels, Carmine noise"]["random"]
    assert f"| random | {f1[0]:.3f} [" in document
    with ResultStore(out / RESULTS) as store:
        known = [row["f1"] for outcome in store.outcomes.values() for row in outcome.rows]
    with (out / "planners.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [float(line["f1"]) for line in lines if line["f1"]] == known
    assert lines[-1]["error"].endswith("fell <over>")
    assert run_command("benchmark", "--out", out, "--reference", "nobody") == 1
    assert "unknown method; choose one of support, random, oracle" in capsys.readouterr().err


@pytest.mark.slow
def test_the_terminal_says_of_each_method_whether_it_is_better(tmp_path, capsys):
    fill(tmp_path / RESULTS, ("random", "support", "oracle"), scenes=4)
    assert run_command("benchmark", "--out", tmp_path, "--reference", "support") == 0
    said = capsys.readouterr().err
    for method, verdict in (("random", "worse"), ("oracle", "better")):
        line = rf"^planners, .*: {method} against support: F1 at view 3 .0\.\d.*, {verdict}$"
        assert re.search(line, said, re.M), said
