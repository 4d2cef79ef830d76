"""The command line end to end: what it writes, what it says, and how it ends."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL, SMALL_SENSOR, run_command, wall_of
from PIL import Image
from synthetic import hausdorff, simulated_views

import caryatid
from caryatid.config import Config
from caryatid.geometry import transforms
from caryatid.io.bop import read_recording, write_recording
from caryatid.io.datasets import SAMPLES
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.steps import read_run, read_steps

ESCAPE = "\x1b"
BOTH = pytest.mark.parametrize("command", ["extract", "explore"])


def explored(source, out, *options):
    """Explore with the small camera; the run as read back."""
    assert run_command("explore", source, "--out", out, *SMALL, *options) == 0
    return read_run(out)


def graph_files(run):
    return {str(p.relative_to(run)): p.read_bytes() for p in sorted(run.rglob("graph.json"))}


# What a run folder holds


def test_the_record_of_a_run_holds_what_the_interfaces_say(kept_run, scene_file):
    record = json.loads((kept_run / "run.json").read_text())
    assert record["source"] == str(scene_file)
    assert record["seed"] == 5
    assert record["settings"]["active"]["max_views"] == 2
    assert record["versions"].keys() >= {"caryatid", "python", "mujoco", "numpy"}
    first, second = record["steps"]
    assert all(seconds >= 0.0 for seconds in first["timings"].values())
    assert {"capture", "fit", "fuse", "plan"} <= first["timings"].keys()
    assert first["angle_travelled"] == first["path_travelled"] == 0.0
    assert 0.0 < second["angle_travelled"] <= np.pi
    assert second["path_travelled"] > 0.1
    assert record["angle_travelled"] == second["angle_travelled"]
    assert record["path_travelled"] == second["path_travelled"]
    assert len(record["scores"]) == 2


def test_every_view_has_its_graph_labels_pose_and_choice(kept_run):
    run = read_run(kept_run)
    assert (kept_run / "graph.json").read_bytes() == (kept_run / "views/01/graph.json").read_bytes()
    for view in run.views:
        with Image.open(view.folder / "labels.png") as image:
            assert image.mode == "I;16"
        labels = view.load_labels()
        assert labels.shape == (SMALL_SENSOR.height, SMALL_SENSOR.width)
        assert set(np.unique(labels)) <= {0, 1, 2, SUPPORT_LABEL}
        assert {o.label for o in view.graph.objects if o.role == "object"} == {1, 2}
        assert view.record["K"][0][0] == SMALL_SENSOR.focal
    choice = run.views[0].record["next"]
    assert choice.keys() >= {"T_world_camera", "saliency", "cost", "score", "why"}
    assert choice["score"] == pytest.approx(choice["saliency"] - choice["cost"], abs=1e-6)
    assert np.allclose(choice["T_world_camera"], run.views[1].record["T_world_camera"], atol=1e-6)
    assert run.views[0].record["candidates"]["reachable"] > 100
    assert "next" not in run.views[1].record
    steps = list(read_steps(run))
    assert [reasons.subject for reasons in steps[-1].reasons] == [("o1",), ("o2",)]
    assert not steps[0].reasons


# Sources


def test_a_recording_is_explored_where_it_was_recorded(tmp_path, recording):
    run = explored(recording, tmp_path / "run", "--no-early-stop", "--no-report")
    poses = [f.T_world_camera for f in read_recording(recording).frames]
    assert sorted(v.name for v in run.views) == [f"recording/{k:06d}" for k in range(3)]
    for view in run.views:
        assert min(np.abs(view.record["T_world_camera"] - T).max() for T in poses) < 1e-9
    assert {s.pair for s in run.graph.supports} == {("o0", "o1"), ("o1", "o2")}
    assert run.record["steps"][-1]["stop"].startswith("no candidate views left")


@pytest.mark.parametrize("segmentation", ["labels", "auto"])
def test_views_before_the_first_that_shows_the_table_are_kept_for_it(tmp_path, capsys, segmentation):
    views, graphs = simulated_views("tower")[1:3], []
    wall, options = wall_of(views[0]), ("--segmentation", segmentation, "--no-report")
    for name, seen in (("without", views), ("before", [wall, wall, *views])):
        write_recording(tmp_path / name, seen)
        capsys.readouterr()
        assert run_command("extract", tmp_path / name, *options, "--out", tmp_path / f"{name}-run") == 0
        graphs.append(read_run(tmp_path / f"{name}-run").graph)
    kept = [line for line in capsys.readouterr().err.splitlines() if "is kept until" in line]
    for number, line in enumerate(kept):
        tried = "fewer than 200 of 21600 points lie on one level plane; the largest plane, 100%"
        assert line.startswith(f"before/{number:06d}: no support surface: {tried} of them, is tilted by 90°")
    run, (without, graph) = read_run(tmp_path / "before-run"), graphs
    assert [v.name for v in run.views] == [f"before/{k:06d}" for k in range(4)]
    assert [v.graph.objects == (v.graph.objects[0],) for v in run.views] == [True, True, False, False]
    assert len(kept) == 2
    assert [s.pair for s in graph.supports] == [s.pair for s in without.supports]
    for one, other in zip(graph.objects, without.objects, strict=True):
        assert one.id == other.id
        assert hausdorff(one.shape, other.shape) < 0.005


@BOTH
def test_a_world_that_is_the_first_cameras_frame_is_levelled(tmp_path, views, refused, command):
    """Its z points forward: the table top leans by 130°, of which the camera's elevation is 40°."""
    T_first_world = transforms.invert(views[0].pose)
    tilted = [view.with_pose(T_first_world @ view.pose) for view in views]
    write_recording(tmp_path / "one", tilted[:1])
    write_recording(tmp_path / "tilted", tilted)
    said = refused(command, tmp_path / "one", names="one/000000", says="of them, is tilted by 130°")
    assert "--level" in said
    options = ("--no-early-stop",) if command == "explore" else ()
    assert run_command(command, tmp_path / "tilted", "--level", "--out", tmp_path / "run", *options) == 0
    run = read_run(tmp_path / "run")
    assert len(run.views) == 3
    assert {s.pair for s in run.graph.supports} == {("o0", "o1"), ("o1", "o2")}


@BOTH
def test_a_single_frame_without_a_pose_gets_its_world_from_the_table(tmp_path, single, command):
    assert run_command(command, single, "--out", tmp_path / "run") == 0
    run = read_run(tmp_path / "run")
    assert {s.pair for s in run.graph.supports} == {("o0", "o1"), ("o1", "o2")}
    crate, can = run.graph["o1"], run.graph["o2"]
    assert can.centre_world[2] - crate.centre_world[2] == pytest.approx(0.1, abs=0.01)
    assert run.views[0].record["T_world_camera"] is not None
    assert run.views[0].record["T_world_camera"][2][3] > 0.5


def test_a_cloud_is_extracted_by_labels_that_number_parts(tmp_path, points, write_pcd):
    cloud = write_pcd(points[0], points[1] * 10 + (points[1] > 0) * 3)
    assert run_command("extract", cloud, "--label-divisor", 10, "--out", tmp_path / "run") == 0
    run = read_run(tmp_path / "run")
    labels = run.views[0].load_labels()
    assert (run.views[0].folder / "labels.npy").is_file()
    assert labels.shape == points[1].shape
    assert (labels[points[1] > 0] == points[1][points[1] > 0]).all()
    assert (labels == SUPPORT_LABEL).sum() > 1000
    assert {s.pair for s in run.graph.supports} == {("o0", "o1"), ("o1", "o2")}


# evaluate, demo, config, scenes


def test_scenes_and_samples_are_listed_and_a_name_spelt_wrong_is_guessed(tmp_path, capsys):
    assert run_command("scenes", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert {"tower", "pile-SIZE-SEED"} <= set(listed["scenes"])
    assert set(listed["samples"]) == {path.stem for path in SAMPLES.iterdir()}
    assert run_command("extract", "sample-cloud", "--out", tmp_path / "run", "--no-report", "--json") == 0
    assert len(json.loads(capsys.readouterr().out)["graph"]["supports"]) == 10
    assert run_command("explore", "towr", "--out", tmp_path / "other") == 1
    assert "did you mean tower?" in capsys.readouterr().err


def test_a_run_is_scored_against_the_ground_truth_of_its_source_or_of_a_place(
    tmp_path, kept_run, scene_file, capsys, monkeypatch
):
    def scored(*arguments):
        capsys.readouterr()
        assert run_command("evaluate", *arguments, "--json") == 0
        return capsys.readouterr().out

    assert scored(kept_run) == scored(kept_run, scene_file.parent) == scored(kept_run, scene_file)
    monkeypatch.chdir(tmp_path)
    shutil.copytree(scene_file.parent, "sub/two")
    words = ("--views", 1, "--quiet", "--no-report", *SMALL)
    assert run_command("explore", "sub/two", "--out", "sub/run", *words) == 0
    Path("sub").rename("moved")
    assert scored("moved/run") == scored("moved/run", scene_file)
    assert run_command("extract", "sample-recording", "--out", tmp_path / "run", "--no-report") == 0
    assert scored(tmp_path / "run") == scored(tmp_path / "run", "sample-recording")
    strange = json.loads(scored(tmp_path / "run", "tower"))
    (warning,) = strange["warnings"]
    assert "matches one of tower" in warning
    assert strange["views"][-1]["brier"] is strange["views"][-1]["average_precision"] is None
    views = json.loads(scored(kept_run))["views"]
    assert [v["view"] for v in views] == [0, 1]
    keys = {"view", "precision", "recall", "f1", "edge_precision", "edge_recall", "mean_iou", "brier"}
    assert all(v.keys() >= keys for v in views)
    told = json.loads((kept_run / "run.json").read_text())["scores"]
    assert [v["f1"] for v in views] == [s["f1"] for s in told]
    assert views[1]["f1"] == 1.0

    assert run_command("evaluate", kept_run, scene_file.parent) == 0
    table = capsys.readouterr().out
    assert "F1" in table
    assert f"{views[1]['mean_iou']:.3f}" in table
    assert all(len(line) <= 80 for line in table.splitlines())
    assert ESCAPE not in table


@pytest.mark.slow
def test_the_demo_says_view_by_view_what_it_found(tmp_path, capsys):
    file = tmp_path / "settings.toml"
    file.write_text("[active]\nmax_views = 2\n")
    words = ["demo", "--scene", "tower", *SMALL, "--config", file, "--out", tmp_path / "run"]
    assert run_command(*words) == 0
    said = capsys.readouterr()
    conditions, *lines = said.err.splitlines()
    assert said.out.startswith("Safe order (nothing else moves: 98%): ")
    assert conditions == "tower (masks: simulator, noise: carmine)"
    assert re.fullmatch(r"view 1: \d objects, \d supports.*, F1 \d\.\d{3} \(\d+\.\d s\)", lines[0])
    assert lines[1].startswith("  found: o1 (")
    assert " supported by " in lines[1]
    assert lines[2].startswith("         o2 (")
    assert any(line.startswith("  next view: ") for line in lines)
    assert any(line.startswith("view 2: ") for line in lines)
    assert "  done: maximum of 2 views reached" in lines
    assert str(tmp_path / "run") in lines[-1]
    assert ESCAPE not in said.err
    assert (tmp_path / "run/report.html").is_file()
    assert run_command(*words, "--views", 1, "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert len(read_run(tmp_path / "run").views) == 1


def test_config_writes_settings_that_read_back_as_they_are(tmp_path, capsys):
    assert run_command("config", "--set=fit.hypotheses=77", "--set=robot.pitch=[-50.5, 10]") == 0
    text = capsys.readouterr().out
    assert tomllib.loads(text)["fit"]["hypotheses"] == 77
    assert tomllib.loads(text).keys() == asdict(Config()).keys()
    assert "# Displacement above which an object was disturbed [m]" in text
    (tmp_path / "settings.toml").write_text(text)
    assert run_command("config", "--config", tmp_path / "settings.toml") == 0
    assert capsys.readouterr().out == text
    words = ["--config", tmp_path / "settings.toml", "--fusion", "sg", "--set", "fit.hypotheses=78"]
    assert run_command("config", "--json", *words) == 0
    settings = json.loads(capsys.readouterr().out)
    assert (settings["fusion"]["method"], settings["fit"]["hypotheses"]) == ("sg", 78)


def test_with_a_goal_it_says_what_moves_without_it(tmp_path, scene_file, capsys):
    words = ("explore", scene_file, "--goal", "o1", "--noise", "none", "--out", tmp_path / "run", *SMALL)
    assert run_command(*words) == 0
    last = [line for line in capsys.readouterr().err.splitlines() if line.startswith("  without o1: ")][-1]
    assert re.fullmatch(r"  without o1: o2 moves \(1\.00\), nothing else moves \(0\.9\d\)", last)
    report = re.sub("<[^>]+>", "", (tmp_path / "run/report.html").read_text())
    assert last.partition(": ")[2] + "." in report
    assert run_command(*words, "--json", "--no-report") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["stop"] == "whether each object moves without o1 is known with probability 0.95"
    (effect,) = document["removal"]["moving"]
    assert effect["object"] == "o2"
    assert effect["probability"] > 0.99
    assert 0.9 < document["removal"]["rest"] < 1.0


def test_without_early_stop_it_looks_until_the_views_are_used_up(tmp_path, recording):
    stops, goes_on = (
        explored(
            recording,
            tmp_path / name,
            "--no-report",
            "--set=active.stop=unchanged",
            "--set=fusion.settled=0.1",
            *options,
        )
        for name, options in (("stops", ()), ("goes-on", ("--no-early-stop",)))
    )
    assert len(stops.views) == 2
    assert stops.record["steps"][-1]["stop"] == "the last view did not change the graph"
    assert len(goes_on.views) == 3


def test_the_same_seed_gives_the_same_graphs_byte_for_byte(tmp_path, scene_file):
    options = ["--views", 2, "--no-report", "--noise", "carmine", "--planner", "random", "--seed"]
    first, again, other = (
        graph_files(explored(scene_file, tmp_path / name, *options, seed).folder)
        for name, seed in (("first", 3), ("again", 3), ("other", 4))
    )
    assert len(first) == 3
    assert first == again
    assert first != other


# What it says


def test_a_run_says_why_its_objects_are_what_they_are(kept_run, capsys):
    first, second = [o.id for o in read_run(kept_run).graph.objects if o.role == "object"][:2]
    assert run_command("why", kept_run, first, second, "--json") == 0
    two, one = json.loads(capsys.readouterr().out)["options"]
    assert one["what"].startswith("one: a ")
    assert two["total"] == pytest.approx(two["points"] + two["free"] + two["parameters"] + two["border"])
    assert run_command("why", kept_run, first) == 0
    assert f"{first}: costs in nats" in capsys.readouterr().out
    assert run_command("why", kept_run) == 1
    assert "give one, or two" in capsys.readouterr().err


def test_doctor_says_what_is_installed_and_which_package_of_an_extra_is_missing(monkeypatch, capsys):
    def version(package):
        if package == "viser":
            raise PackageNotFoundError(package)
        return "1.2.3"

    monkeypatch.setattr("caryatid.cli.results.version", version)
    assert run_command("doctor", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["caryatid"] == caryatid.__version__
    assert "viser is missing" in found["extra view"]
    assert found["extra usd"] == "usd-core 1.2.3"
    assert not {"extra dev", "extra docs", "extra all"} & found.keys()
