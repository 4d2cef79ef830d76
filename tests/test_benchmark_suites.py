"""Suites, their scenes, and running them."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from conftest import SMALL

from caryatid.benchmark.episodes import run_episode, settings_of
from caryatid.benchmark.records import TIMES, Episode, Outcome
from caryatid.benchmark.running import LocalExecutor, run_all
from caryatid.benchmark.scenes import content_of, family, find_scenes
from caryatid.benchmark.store import ResultStore
from caryatid.benchmark.suites import SUITES, find_suite
from caryatid.benchmark.variants import with_conditions, with_fusions, with_planners, with_settings
from caryatid.errors import InputError
from caryatid.simulation.scenes import is_builtin, load_scene, write_scene

QUICK = tuple(flag.removeprefix("--set=") for flag in SMALL)


def without_times(outcome: Outcome) -> Outcome:
    return replace(outcome, rows=tuple(replace(r, **dict.fromkeys(TIMES, 0.0)) for r in outcome.rows))


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_is_made_of_valid_episodes(name):
    suite = find_suite(name)
    members = suite.members()
    assert len(members) == len(suite.scenes) * suite.seeds * len(suite.conditions) * len(suite.methods)
    for m in {replace(m.episode, scene="", seed=0): m for m in members}.values():
        settings_of(m.episode)
    assert all(is_builtin(scene) for scene in suite.scenes)
    for condition in suite.conditions:
        labels = [m.method for m in members if m.condition == condition.label]
        assert len(set(labels)) == len(suite.methods)
        episodes = {m.episode for m in members if m.condition == condition.label}
        assert len(episodes) == len(labels)


def test_the_figure_of_the_paper_has_thirty_scenes_of_each_kind():
    suite = find_suite("fig5")
    assert len(suite.scenes) >= 30
    assert {family(s) for s in suite.scenes} == {"designed", "pile", "dense"}
    assert {m.label for m in suite.methods} == {"PC", "SG", "PC+SG", "random SG", "random PC"}
    assert (suite.seeds, suite.views) == (3, 10)


def test_planners_can_take_the_place_of_the_methods():
    suite = with_planners(find_suite("smoke"), ["random", "paper"])
    assert [(m.label, m.planner, m.fusion) for m in suite.methods] == [
        ("random", "random", "pc+sg"),
        ("paper", "paper", "pc+sg"),
    ]


def test_fusions_take_the_place_of_those_of_the_suite():
    both = with_fusions(find_suite("smoke"), ["pc", "sg"])
    assert [(m.label, m.planner, m.fusion) for m in both.methods] == [
        ("support PC", "support", "pc"),
        ("support SG", "support", "sg"),
        ("random PC", "random", "pc"),
        ("random SG", "random", "sg"),
        ("attention PC", "attention", "pc"),
        ("attention SG", "attention", "sg"),
        ("rear-side-voxel PC", "rear-side-voxel", "pc"),
        ("rear-side-voxel SG", "rear-side-voxel", "sg"),
    ]
    ablation = find_suite("ablation")
    one = with_fusions(ablation, ["sg", "sg"])
    assert [(m.label, m.settings) for m in one.methods] == [(m.label, m.settings) for m in ablation.methods]
    assert {m.fusion for m in one.methods} == {"sg"}


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_can_be_changed(name):
    suite = with_fusions(find_suite(name), ["pc", "sg", "pc+sg"])
    suite = with_conditions(suite, ["auto", "labels"], ["none", "carmine"])
    suite = with_settings(suite, ["noise.translation=0.02"])
    assert [c.label for c in suite.conditions] == [
        "automatic parts, no noise, noise.translation=0.02",
        "automatic parts, Carmine noise, noise.translation=0.02",
        "labels, no noise, noise.translation=0.02",
        "labels, Carmine noise, noise.translation=0.02",
    ]
    labels = [method.label for method in suite.methods]
    assert len(set(labels)) == len(labels)
    few = replace(suite, scenes=suite.scenes[:1], seeds=1).members()
    assert {(m.episode.segmentation, m.episode.noise, m.episode.fusion) for m in few} == set(
        product(("labels", "auto"), ("none", "carmine"), ("pc", "sg", "pc+sg"))
    )
    assert all(settings_of(m.episode).noise.translation == 0.02 for m in few)


def test_settings_that_cannot_be_changed_are_refused():
    suite = find_suite("smoke")
    with pytest.raises(InputError, match=r"fusion\.method=pc: every episode has its own; use --fusion"):
        with_settings(suite, ["fusion.method=pc"])
    with pytest.raises(InputError, match="there is no setting"):
        with_settings(suite, ["fit.hypothesis=3"])


def test_an_unknown_suite_lists_those_there_are():
    with pytest.raises(InputError, match="no suite 'fig6'; choose one of smoke, fig5, planners"):
        find_suite("fig6")


@pytest.mark.parametrize(
    ("scene", "kind"),
    [("tower", "designed"), ("pile-4-1", "pile"), ("dense-10-1", "dense"), ("a/ycb4_8", "ycb")],
)  # fmt: skip
def test_family_is_the_kind_of_scene(scene, kind):
    assert family(scene) == kind


def test_folders_of_scenes_are_found(tmp_path):
    for name in ("tower", "bridge"):
        write_scene(load_scene(name), tmp_path / name)
    folders = [str(tmp_path / "bridge"), str(tmp_path / "tower")]
    assert find_scenes([str(tmp_path), str(tmp_path / "tower"), "shelf"]) == [*folders, "shelf"]
    assert len({content_of(folder) for folder in folders}) == 2
    before = content_of(folders[0])
    (tmp_path / "bridge" / "gt.json").unlink()
    assert content_of(folders[0]) != before
    with pytest.raises(InputError, match=r"bridge: has no gt\.json"):
        find_scenes([str(tmp_path)])


def test_no_scene_says_what_there_is(tmp_path):
    with pytest.raises(InputError, match=r"holds no scene: no scene\.xml"):
        find_scenes([str(tmp_path)])
    with pytest.raises(InputError, match=r"neither a built-in scene nor a folder; give .* tower"):
        find_scenes(["castle"])


def test_an_episode_is_scored_view_by_view():
    outcome = run_episode(Episode("tower", settings=QUICK, views=2))
    assert outcome.error is None
    first, second = outcome.rows
    assert (first.view, second.view) == (1, 2)
    assert first.angle == first.path == first.planning_seconds == 0.0
    assert second.angle > 0.0
    assert second.path > 0.0
    assert second.planning_seconds > 0.0
    assert 0.5 < second.f1 <= 1.0
    expected = 2.0 * second.edge_precision * second.edge_recall / (second.edge_precision + second.edge_recall)
    assert np.isclose(second.edge_f1, expected)


def test_what_fails_is_an_outcome_that_says_why():
    outcome = run_episode(Episode("dense-99-1", settings=QUICK, views=2))
    assert outcome.rows == ()
    assert outcome.error is not None
    assert "dense-99-1: 99 objects cannot be set up" in outcome.error
    assert "\n" not in outcome.error


def test_rows_are_the_same_on_any_number_of_processes(tmp_path):
    suite = replace(find_suite("smoke"), scenes=("tower", "dense-99-1"), seeds=1, views=2)
    suite = with_planners(suite, ["support", "random"])
    members = [
        replace(m, episode=replace(m.episode, settings=QUICK + m.episode.settings)) for m in suite.members()
    ]
    found = []
    for jobs in (1, 2):
        with ResultStore(tmp_path / f"{jobs}.sqlite", "code") as store:
            told: list[Episode] = []
            run_all(
                store,
                store.plan("smoke", members),
                LocalExecutor(jobs),
                lambda episode, _, to=told: to.append(episode),
            )
            assert {e.key("") for e in told} == {m.episode.key("") for m in members}
            found.append([without_times(r.outcome) for r in store.records("smoke")])
    assert found[0] == found[1]
    assert [outcome.error is None for outcome in found[0]] == [True, True, False, False]


def test_running_leaves_the_environment_as_it_was(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = dict(os.environ)
    for _, outcome in LocalExecutor(1).run([Episode("dense-99-1", settings=QUICK, views=2)]):
        assert outcome.error is not None
        assert dict(os.environ) == before


class Interrupting(list):
    """Episodes at whose beginning Ctrl-C is pressed; they count how many were taken."""

    taken = 0

    def __iter__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for episode in super().__iter__():
            yield episode
            self.taken += 1


@pytest.fixture
def interrupting():
    before = signal.getsignal(signal.SIGINT)
    yield Interrupting(Episode("tower", settings=QUICK, views=1, seed=seed) for seed in range(3))
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_waits_until_all_processes_are_started(interrupting):
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt):
        next(LocalExecutor(2).run(interrupting))
    assert interrupting.taken == len(interrupting)


def test_an_interrupt_that_is_ignored_stays_ignored(interrupting):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    assert len(list(LocalExecutor(2).run(interrupting))) == len(interrupting)
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
