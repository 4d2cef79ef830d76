"""The result store: what is done is kept, whole, once."""

from __future__ import annotations

import sqlite3
from dataclasses import replace

import pytest

from caryatid.benchmark.records import MEASURES, Episode, Member, Outcome, ViewRow
from caryatid.benchmark.store import ResultStore
from caryatid.errors import InputError


def row(view: int, f1: float = 0.5) -> ViewRow:
    return ViewRow(view, *(f1 + i / 7.0 for i in range(len(MEASURES))))


def member(scene: str = "tower", seed: int = 0) -> Member:
    return Member(Episode(scene, seed=seed, settings=("fit.hypotheses=50",)), "support", "noise", "designed")


def test_what_is_added_comes_back_as_it_was(tmp_path):
    members = [member(seed=s) for s in range(3)]
    outcomes = [
        Outcome((row(1), row(2, 0.25))),
        Outcome((), "tower: fell over"),
        Outcome((row(1, 0.1 + 0.2),)),
    ]
    with ResultStore(tmp_path / "r.sqlite", "code") as store:
        assert store.plan("smoke", members) == [m.episode for m in members]
        for m, outcome in zip(members, outcomes, strict=True):
            store.add(m.episode, outcome)
    with ResultStore(tmp_path / "r.sqlite") as store:
        assert store.suites() == ["smoke"]
        assert [r.member for r in store.records("smoke")] == members
        assert [r.outcome for r in store.records("smoke")] == outcomes


def test_only_what_is_missing_is_asked_for_again(tmp_path):
    members = [member(seed=s) for s in range(3)]
    with ResultStore(tmp_path / "r.sqlite", "code") as store:
        store.plan("a", members)
        store.add(members[1].episode, Outcome((row(1),)))
        assert store.plan("a", members) == [members[0].episode, members[2].episode]
        assert store.plan("b", members[1:]) == [members[2].episode]
        assert len(store.records("b")) == 1
        assert store.planned("a") == 3


def test_an_episode_two_methods_share_is_run_once(tmp_path):
    twice = [member(), replace(member(), method="the same")]
    with ResultStore(tmp_path / "r.sqlite", "code") as store:
        assert store.plan("a", twice) == [twice[0].episode]
        store.add(twice[0].episode, Outcome((row(1),)))
        assert [r.member.method for r in store.records("a")] == ["support", "the same"]


def test_the_first_outcome_of_an_episode_stays(tmp_path):
    with ResultStore(tmp_path / "r.sqlite", "code") as store:
        store.plan("a", [member()])
        store.add(member().episode, Outcome((row(1, 0.25),)))
        store.add(member().episode, Outcome((row(1, 0.75),)))
        assert store.records("a")[0].outcome.rows == (row(1, 0.25),)


def test_an_episode_is_kept_whole_or_not_at_all(tmp_path):
    broken = Outcome((row(1), row(1)))
    with ResultStore(tmp_path / "r.sqlite", "code") as store:
        store.plan("a", [member()])
        with pytest.raises(sqlite3.IntegrityError):
            store.add(member().episode, broken)
        assert store.records("a") == []
        assert store.plan("a", [member()]) == [member().episode]


def test_failures_are_forgotten_only_when_asked_to(tmp_path):
    members = [member(seed=s) for s in range(2)]
    with ResultStore(tmp_path / "r.sqlite", "code") as store:
        store.plan("a", members)
        store.add(members[0].episode, Outcome((), "no luck"))
        store.add(members[1].episode, Outcome((row(1),)))
        assert store.plan("a", members) == []
        store.forget_failures()
        assert store.plan("a", members) == [members[0].episode]


@pytest.mark.parametrize(
    "other",
    [{"scene": "bridge"}, {"seed": 1}, {"views": 6}, {"planner": "random"}, {"fusion": "pc"},
     {"segmentation": "auto"}, {"noise": "none"}, {"settings": ()}, {"content": "abc"}, {"plugin": "abc"}],
)  # fmt: skip
def test_everything_that_decides_an_episode_is_in_its_key(other):
    episode = member().episode
    assert replace(episode, **other).key("code") != episode.key("code")
    assert episode.key("other code") != episode.key("code")


def test_where_a_scene_folder_lies_does_not_matter():
    here, there = (Episode(f"{place}/pile", content="abc") for place in ("here", "there"))
    assert here.key("code") == there.key("code")


def test_results_of_other_code_are_not_mixed(tmp_path):
    with ResultStore(tmp_path / "r.sqlite", "code", {"caryatid": "0.1"}) as store:
        store.plan("a", [member()])
    with pytest.raises(InputError, match=r"made by other code \(0.1 code\).*another --out"):
        ResultStore(tmp_path / "r.sqlite", "newer")
    with ResultStore(tmp_path / "r.sqlite") as store:
        assert store.suites() == ["a"]


def test_another_format_is_refused(tmp_path):
    ResultStore(tmp_path / "r.sqlite", "code").close()
    with sqlite3.connect(tmp_path / "r.sqlite") as database:
        database.execute("UPDATE about SET value = '0' WHERE name = 'format'")
    with pytest.raises(InputError, match="has format 0, this caryatid reads 2; choose another folder"):
        ResultStore(tmp_path / "r.sqlite", "code")


@pytest.mark.parametrize("content", [b"", b"not a database, not at all, by no means", None])
def test_what_is_no_store_is_refused_and_left_as_it_is(tmp_path, content):
    path = tmp_path / "r.sqlite"
    if content is None:
        with sqlite3.connect(path) as database:
            database.execute("CREATE TABLE cakes (name TEXT)")
        content = path.read_bytes()
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"r\.sqlite: is no result store"):
        ResultStore(path)
    assert path.read_bytes() == content


def test_a_missing_store_says_how_to_make_one(tmp_path):
    with pytest.raises(InputError, match="no result store; run a suite first"):
        ResultStore(tmp_path / "r.sqlite")
    assert not list(tmp_path.iterdir())
