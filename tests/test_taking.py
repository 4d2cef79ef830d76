"""`caryatid order`, `caryatid dismantle`, and taking scenes apart in a benchmark."""

from __future__ import annotations

import json
import re

import pytest
from conftest import SMALL, run_command

from caryatid.benchmark.episodes import ORDERS, Episode, run_episode
from caryatid.io.runs import read_run
from caryatid.viz.colours import object_colour

QUICK = ["--set=rehearsal.draws=2", "--set=lift.watch=1.0"]
BRIEF = (
    "sensor.width=160",
    "sensor.height=120",
    "sensor.focal=131.25",
    "rehearsal.draws=2",
    "lift.watch=1.0",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory, scene_file):
    """A run on the crate o1 with the can o2 on it."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    command = ["explore", scene_file, "--views", 2, "--out", folder, "--no-report", "--quiet"]
    assert run_command(*command, *SMALL) == 0
    return folder


def said(capsys) -> dict:
    """The JSON document on stdout, with nothing beside it."""
    out = capsys.readouterr()
    assert out.err == ""
    return json.loads(out.out)


def test_an_order_is_told_as_a_document(run, capsys):
    assert run_command("order", run, "--json", *QUICK) == 0
    document = said(capsys)
    assert document["safe"] is True
    assert document["refusal"] is None
    assert [step["object"] for step in document["steps"]] == ["o2", "o1"]
    for step in document["steps"]:
        assert step.keys() == {"object", "hold", "safe", "risk", "why"}
        assert step["safe"] is True
        assert step["hold"] == []


def test_an_order_is_told_as_a_table(run, capsys):
    assert run_command("order", run, "--goal", "o2", *QUICK) == 0
    out = capsys.readouterr().out
    assert "a safe order" in out
    assert re.search(r"│ 1 │ o2 ", out)
    assert "o1 " not in out.split("┡")[1].split("supports")[0]


def test_orders_that_cannot_be_are_errors(run, tmp_path, capsys):
    assert run_command("order", run, "--goal", "o9", *QUICK) == 1
    assert "o9: is no object of the graph; there are o1, o2" in capsys.readouterr().err
    assert run_command("order", tmp_path, *QUICK) == 1
    assert "run.json" in capsys.readouterr().err
    assert run_command("order", run, "--hands", 3) == 2


def test_a_scene_is_taken_apart(scene_file, tmp_path, capsys):
    command = ["dismantle", scene_file, "--views", 2, "--json", "--out", tmp_path / "run"]
    assert run_command(*command, *SMALL, *QUICK) == 0
    document = said(capsys)
    assert document["success"] is True
    assert document["left"] == []
    assert [(s["object"], s["body"], s["ok"], s["disturbed"]) for s in document["steps"]] == [
        ("o2", "can", True, []),
        ("o1", "crate", True, []),
    ]
    assert read_run(tmp_path / "run").record["dismantling"] == document
    report = (tmp_path / "run/report.html").read_text()
    lifts = re.findall(r'<figure class="lift">.*?</figure>', report, re.S)
    assert len(lifts) == 2
    for name, label in (("o2", 2), ("o1", 1)):
        assert re.search(rf'fill="{object_colour(label)}"/><text [^>]*>{name}<', lifts[0])


def test_without_a_place_nothing_is_written(scene_file, tmp_path, capsys, monkeypatch, leftovers):
    monkeypatch.chdir(tmp_path)
    assert run_command("dismantle", scene_file, "--views", 1, *SMALL, *QUICK, "--quiet") == 0
    assert "all taken, nothing disturbed" in capsys.readouterr().out
    assert not leftovers()


def test_a_recording_cannot_be_taken_apart(recording, capsys, leftovers):
    assert run_command("dismantle", recording, "--views", 1, *QUICK, "--quiet") == 1
    assert "no scene that can be simulated" in capsys.readouterr().err


@pytest.mark.parametrize("order", ORDERS)
def test_an_episode_tells_what_came_of_the_order(order):
    outcome = run_episode(Episode(scene="tower", views=2, order=order, settings=BRIEF))
    assert outcome.error is None
    rows = outcome.rows
    assert rows[0]["lifts"] > 0.0
    assert (rows[0]["unharmed"] == 1.0) == (rows[0]["lifts"] == 1.0)
    assert (rows[1]["unharmed"], rows[1]["lifts"]) == (rows[0]["unharmed"], rows[0]["lifts"])
    if order != "random":
        assert rows[0]["unharmed"] == 1.0


def test_without_an_order_nothing_is_taken():
    (row,) = run_episode(Episode(scene="tower", views=1, settings=BRIEF)).rows
    assert (row["unharmed"], row["lifts"]) == (0.0, 0.0)
