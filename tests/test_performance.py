"""The performance benchmark: what its rows say, what a missing peer does, when the gate fails."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from planning_states import CONFIG, SPHERE, box
from raycast import from_the_side, table_scene
from rich.console import Console

import caryatid as ct
from caryatid.benchmark.provenance import Provenance
from caryatid.geometry import transforms
from caryatid.planning.points_of_interest import points_of_interest
from caryatid.simulation.mjcf import TABLE_HEIGHT
from caryatid.simulation.solids import bounds

sys.path[:0] = [str(Path(__file__).parents[1] / "benchmarks")]

import bench  # noqa: E402
from performance import calm, fitting, growth, hashing, limits, page, peers, planning, rows, telling  # noqa: E402
from performance.effort import FULL, QUICK, Effort  # noqa: E402
from performance.frames import capture, table_of  # noqa: E402
from performance.samples import Setting, draw  # noqa: E402

MACHINE = limits.Machine(bandwidth=1e10, arithmetic=1e11, threads=4)
HALF = rows.Row(
    "turn.auto", "a turn", 50.0, peer="a chain", peer_value=100.0, limit_value=2.0, target=rows.Target(0.5)
)
SLOW = replace(HALF, value=80.0)
ALONE = replace(HALF, peer_value=None, note="a chain cannot be imported: no libusb")
PROVENANCE = Provenance("0", "abc", False, "3", "Linux", "a processor", 4, "numpy 2")


OTHERS = calm.Watch.others


@pytest.fixture(autouse=True)
def machine(monkeypatch):
    monkeypatch.setattr(limits, "machine", lambda: MACHINE)
    monkeypatch.setattr(calm.Watch, "others", lambda self: 0.0)


@pytest.fixture
def view():
    return table_scene(from_the_side(), boxes=[((0.0, 0.0, 0.8), (0.1, 0.2, 0.1))], sigma=0.003)


def without(monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    peers.load.cache_clear()


def test_ratios_are_ours_in_theirs():
    assert HALF.to_peer == 0.5
    assert HALF.to_limit == 25.0
    assert HALF.met is True
    assert SLOW.met is False
    assert ALONE.to_peer is None
    assert ALONE.met is None


@pytest.mark.parametrize("power", [0.0, 0.5, 1.1, 2.0])
def test_the_exponent_is_that_of_the_power_law(power):
    sizes = np.array([5.0, 10.0, 40.0, 100.0])
    assert rows.exponent(sizes, 0.03 * sizes**power) == pytest.approx(power, abs=1e-9)


def test_growth_is_told_with_its_upper_half():
    sizes = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
    curve = growth.Curve("views", "auto", sizes, tuple(0.05 + 0.001 * n**2 for n in sizes), {})
    row = curve.row()
    assert row.value < 1.1 < curve.last_exponent < 2.0
    assert row.met
    assert f"{curve.last_exponent:.2f}" in row.note


@pytest.mark.parametrize("power", [0.0, 1.0])
def test_views_are_put_together_before_growth_is_measured(power):
    found = [(0.1 * view**power, {"fit": 0.05 * view**power}) for view in range(1, FULL.views + 1)]
    curve = growth.binned("labels", found, FULL.views)
    assert curve.sizes[0] >= growth.FIRST
    assert curve.exponent == pytest.approx(power, abs=0.02)
    assert curve.stages["fit"] == pytest.approx([t / 2.0 for t in curve.turns])
    assert curve.row().value == curve.exponent
    short = growth.binned("labels", found[:40], FULL.views).row()
    assert short.met is None
    assert "only 40 views" in short.note


def test_peak_memory_rises_with_what_is_held():
    before = growth.peak_memory()
    held = np.ones(int(before) * 1024**2 // 8 + 25 * 1024**2)
    assert growth.peak_memory() > before + held.nbytes / 1024**2 / 4


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("size", [0.002, 0.01, 0.5])
def test_the_hash_pass_finds_the_voxels_numpy_finds(view, size, threads):
    before = numba.get_num_threads()
    numba.set_num_threads(min(threads, before))
    try:
        found = hashing.hash_voxels(view, size)
    finally:
        numba.set_num_threads(before)
    expected = hashing.hash_voxels_reference(view, size)
    assert len(expected) > 1
    np.testing.assert_array_equal(np.sort(found), expected)


def test_a_view_without_readings_has_no_voxels(view):
    nothing = replace(view, depth=np.zeros_like(view.depth))
    assert len(hashing.hash_voxels(nothing, 0.01)) == 0


def test_a_peer_that_cannot_be_imported_says_why(monkeypatch, view):
    without(monkeypatch, "open3d")
    chain = peers.open3d_chain(view, 3.0)
    assert isinstance(chain, peers.Missing)
    assert "open3d cannot be imported" in chain.reason
    peers.load.cache_clear()


def test_fits_are_told_of_without_the_peers(monkeypatch):
    for module in peers.DISTRIBUTIONS:
        without(monkeypatch, module)
    found = {row.name: row for row in fitting.measure_fits("box", Effort(runs=1, points=()))}
    row = found["fit.box.5k-all-around.pyransac3d"]
    assert row.value > 0.0
    assert row.to_peer is None
    assert row.met is None
    assert "pyransac3d cannot be imported" in row.note
    assert found["fit.box.5k-all-around.open3d.extents"].value < 1.0
    assert found["choose.box.5k-all-around.open3d.volume"].value < 1.0
    peers.load.cache_clear()


def test_a_peer_that_fails_leaves_the_others_and_ours(monkeypatch):
    def fail():
        raise RuntimeError("it fell over in /somewhere/else/peer.cpp")

    monkeypatch.setattr(fitting, "pyransac3d_fit", lambda kind, points: fail)
    monkeypatch.setattr(fitting, "open3d_box", lambda points: lambda: peers.Estimate(extents=np.ones(3)))
    setting = Setting("box", 1000, "all around")
    found = fitting.run(setting, [fitting.PYRANSAC3D, fitting.MINIMAL], [draw(setting, k) for k in range(2)])
    assert found[fitting.PYRANSAC3D].reason == "pyransac3d failed: it fell over in peer.cpp"
    assert len(found[fitting.MINIMAL].errors["volume"]) == len(found["fit"].errors["volume"]) == 2


def test_what_an_import_says_is_told_without_folders():
    error = ImportError("cannot import 'x' from\n'peer' (/home/me/.venv/lib/peer.so): m/s and libusb.so.0")
    assert peers.told(error) == "cannot import 'x' from 'peer' (peer.so): m/s and libusb.so.0"
    assert peers.told(ImportError()) == "ImportError"


def test_pyransac3d_is_spared_many_points():
    counts = {s.count for s in fitting.settings("cylinder", FULL) if fitting.takes_part("pyransac3d", s)}
    assert fitting.USUAL in counts
    assert max(counts) < max(FULL.points)


def test_a_box_of_twice_the_volume_is_off_by_its_volume():
    shape = draw(Setting("box", 1000, "all around"), 0).shape
    found = fitting.errors(peers.Estimate(extents=np.sort(shape.extents) * [1.0, 1.0, 2.0]), shape)
    assert found["volume"] == pytest.approx(100.0)
    assert found["extents"] == pytest.approx(1e3 * shape.extents.max() / 3.0)


def test_a_fit_is_compared_where_both_found_something():
    ours = fitting.Found([0.001, 0.003, 0.002], {"axis": [0.1, 0.2, 0.3], "radius": [0.1, np.nan, 0.1]})
    theirs = fitting.Found([0.4, 0.4, 0.4], {"axis": [2.0, np.nan, 4.0], "radius": [1.0, np.nan, 1.0]})
    setting = Setting("cylinder", fitting.USUAL, "one side")
    time, axis, radius = fitting.compared("fit", ours, fitting.CGAL, theirs, setting)
    assert time.to_peer == pytest.approx(0.005)
    assert time.met
    assert axis.to_peer == pytest.approx(0.2 / 3.0)
    assert axis.met
    assert "CGAL found nothing in 1 of 3" in axis.note
    assert "ours found another shape in 1 of 3" in radius.note


def test_errors_do_not_depend_on_which_way_an_axis_points():
    shape = draw(Setting("cylinder", 1000, "all around"), 0).shape
    exact = fitting.estimate_of(shape)
    assert fitting.errors(exact, shape) == pytest.approx({"axis": 0.0, "radius": 0.0}, abs=1e-5)
    tilt = transforms.rotation_from_vector(np.radians(3.0) * transforms.perpendicular(exact.axis))
    other = peers.Estimate(-tilt @ exact.axis, exact.radius + 0.002)
    assert fitting.errors(other, shape) == pytest.approx({"axis": 3.0, "radius": 2.0})
    assert np.isnan(list(fitting.errors(peers.Estimate(), shape).values())).all()


@pytest.mark.parametrize("side", ["one side", "all around"])
@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
def test_samples_lie_on_their_shape(kind, side):
    sample = draw(Setting(kind, 1000, side), 1)
    assert sample.points.shape == (1000, 3)
    assert np.sqrt(np.mean(sample.shape.signed_distance(sample.points) ** 2)) < 0.0015
    towards = sample.eye - sample.points
    visible = np.mean(np.sum(sample.normals * towards, axis=1) > 0.0)
    assert visible > 0.99 if side == "one side" else visible < 0.01


def test_cgal_lines_are_read():
    told = "Type: cylinder center: (0.1, 0, -2.5e-05) axis: (0, -1e-06, -2) radius:0.0405 #Pts: 5000"
    found = peers.read_cgal(told)
    np.testing.assert_allclose(found.axis, [0.0, -5e-7, -1.0], atol=1e-9)
    assert found.radius == 0.0405
    sphere = peers.read_cgal("Type: sphere center: (0.1, 0.2, 0.3) radius: 0.05 #Pts: 12")
    assert sphere.radius == 0.05
    assert sphere.axis is None


def a_graph():
    """Two on the table hold up a third, all three a fourth; the third holds a fifth: 8 points of interest."""
    objects = tuple(box(k, (0.0, 0.1 * k, 0.8), (0.05, 0.05, 0.1)) for k in range(6))
    pairs = ["o0 o1", "o0 o2", "o1 o3", "o2 o3", "o1 o4", "o2 o4", "o3 o4", "o3 o5"]
    return ct.SupportGraph(objects, tuple(ct.Support(*pair.split()) for pair in pairs))


@pytest.mark.parametrize("count", [3, 5, 6, 8])
def test_a_graph_is_cut_to_so_many_points_of_interest(count):
    graph, visited = a_graph(), SPHERE.directions[:1]
    part = planning.with_points(graph, SPHERE, visited, ct.Config(), count)
    assert len(points_of_interest(part, SPHERE, visited, 1, CONFIG)) == count
    assert {s.pair for s in part.supports} <= {s.pair for s in graph.supports}


def test_a_graph_with_too_few_points_of_interest_is_refused():
    with pytest.raises(ValueError, match="8 points of interest, fewer than 9"):
        planning.with_points(a_graph(), SPHERE, SPHERE.directions[:1], ct.Config(), 9)


@pytest.mark.parametrize("count", [5, 30])
def test_a_table_holds_what_was_asked_for(count):
    scene = table_of(count)
    lowest = [bounds(scene, label)[0][2] for label in scene.object_bodies]
    assert len(lowest) == count
    assert sum(z > TABLE_HEIGHT + 0.03 for z in lowest) == count // 3
    assert min(lowest) > TABLE_HEIGHT - 0.01


def test_views_go_around_the_table():
    poses = np.array([T for T, _ in capture(table_of(5), 5)])
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).min() > 0.5


@pytest.mark.parametrize(
    ("value", "text"), [(0.5, "1/2"), (1 / 200, "1/200"), (2.0, "2 ×"), (1234.5, "1,234 ×"), (None, "–")]
)
def test_ratios_are_told_as_fractions_of_the_peer(value, text):
    assert telling.ratio(value) == text


@pytest.mark.parametrize(("worse", "status"), [(1.0, 0), (1.2, 0), (2.0, 1)])
def test_the_gate_fails_on_a_worse_ratio(tmp_path, monkeypatch, worse, status):
    monkeypatch.setattr(bench, "BASELINE", tmp_path / "baseline.json")
    bench.write_baseline(rows.measures([HALF]), bench.BASELINE)
    now = replace(HALF, value=HALF.value * worse, limit_value=HALF.limit_value * worse)
    monkeypatch.setattr(bench, "MEASUREMENTS", {"turn": lambda effort: ([now], [])})
    assert bench.compare({"turn": [now]}, (), Console(quiet=True)) == status


def test_what_is_worse_is_measured_again_and_the_better_figure_counts(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "BASELINE", tmp_path / "baseline.json")
    other = replace(HALF, name="map")
    bench.write_baseline(rows.measures([HALF, other]), bench.BASELINE)
    monkeypatch.setattr(bench, "MEASUREMENTS", {"turn": lambda effort: ([HALF], [])})
    slow = replace(HALF, value=2.0 * HALF.value)
    assert bench.compare({"turn": [slow], "map": [other]}, (), Console()) == 0
    assert capsys.readouterr().out.count("again") == 1
    slow_too = replace(other, value=2.0 * other.value)
    monkeypatch.setattr(bench, "MEASUREMENTS", {"map": lambda effort: ([slow_too], [])})
    assert bench.compare({"turn": [HALF], "map": [slow_too]}, (), Console()) == 1


def test_the_gate_does_not_pass_where_nothing_was_measured(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "BASELINE", tmp_path / "baseline.json")
    bench.write_baseline(rows.measures([HALF]), bench.BASELINE)
    assert bench.compare({"turn": [replace(ALONE, limit_value=None)]}, (), Console()) == 1
    assert "not measured: turn.auto.to_peer" in capsys.readouterr().out
    assert bench.compare({"turn": [ALONE]}, (), Console()) == 0
    assert "not measured: turn.auto.to_peer" in capsys.readouterr().out


def test_the_baseline_keeps_what_could_not_be_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "BASELINE", tmp_path / "baseline.json")

    def kept():
        return {m.name: m.value for m in bench.read_baseline(bench.BASELINE)}

    other = replace(HALF, name="map")
    bench.update([HALF, other], ())
    bench.update([replace(ALONE, limit_value=5.0)], ("turn",))
    now = {"turn.auto.to_peer": 0.5, "turn.auto.to_limit": 10.0}
    assert kept() == {**now, "map.to_peer": 0.5, "map.to_limit": 25.0}
    bench.update([ALONE], ())
    assert kept() == {"turn.auto.to_peer": 0.5, "turn.auto.to_limit": 25.0}


def test_only_ratios_of_durations_and_exponents_are_kept():
    error = replace(HALF, name="turn.axis", unit="deg")
    found = {m.name for m in rows.measures([HALF, error, rows.Row("growth.views.auto", "", 1.0, "1")])}
    assert found == {"turn.auto.to_peer", "turn.auto.to_limit", "growth.views.auto"}


def render(told, curves=(), disturbed=()):
    return page.render_page(
        page.Run(told, curves, disturbed, MACHINE, PROVENANCE, "open3d 0.19"), "performance"
    )


def test_the_page_names_what_is_missed():
    curve = growth.Curve("views", "auto", (10.0, 100.0), (0.1, 0.2), {"fit": (0.05, 0.1)})
    text = render([SLOW], [curve], ["map"])
    assert "**1 of 1 are missed:** a turn against a chain (1/1.25 where ≤ 1/2 is asked for)." in text
    assert "a processor" in text
    assert "open3d 0.19" in text
    assert "| 100 | 200 | 100 |" in text
    assert "held cores** while this was measured: map." in text
    kept = render([HALF])
    assert "None of those measured is missed" in kept
    assert "held cores" not in kept
    alone = render([ALONE])
    assert "**Not measured:** a turn against a chain (a chain cannot be imported: no libusb)." in alone


def test_what_is_said_of_several_rows_is_said_once():
    told = telling.notes([ALONE, HALF, replace(ALONE, name="map"), replace(HALF, note="fast")])
    assert told == {ALONE.note: "`turn.auto` and 1 more", "fast": "`turn.auto`"}
    assert f"* `turn.auto` and 1 more: {ALONE.note}" in render([ALONE, replace(ALONE, name="turn.labels")])


def test_every_row_has_a_place_on_the_page():
    begin = {name.split(".")[0] for name in bench.MEASUREMENTS} | set(fitting.VARIANTS)
    assert begin <= set(page.TEXTS)


def test_names_of_what_to_measure():
    assert bench.selected(()) == list(bench.MEASUREMENTS)
    assert bench.selected(("map", "fit")) == ["fit.cylinder", "fit.box", "fit.sphere", "map"]
    assert bench.selected(("growth.v*",)) == ["growth.views", "growth.voxels"]
    with pytest.raises(ct.InputError, match="nothing is called 'mop'"):
        bench.selected(("map", "mop"))


def test_a_run_writes_table_json_page_and_baseline(tmp_path, monkeypatch, capsys):
    curve = growth.Curve("views", "auto", (10.0, 100.0), (0.1, 0.2), {"fit": (0.05, 0.1)})
    monkeypatch.setattr(bench, "BASELINE", tmp_path / "baseline.json")
    asked = []

    def measure(effort):
        asked.append(effort)
        return [HALF], []

    monkeypatch.setattr(bench, "MEASUREMENTS", {"turn": measure, "growth": lambda effort: ([], [curve])})
    out, docs = tmp_path / "bench.json", tmp_path / "performance.md"
    arguments = ["--out", str(out), "--docs", str(docs), "--update", "--gate"]
    assert bench.main(arguments) == 0
    told = capsys.readouterr().out
    assert "turn.auto" in told
    assert "targets: 1 met, 0 missed, 0 not measured" in told
    document = json.loads(out.read_text())
    assert document["rows"][0]["to_peer"] == 0.5
    assert document["curves"][0]["turns"] == [0.1, 0.2]
    assert "a chain" in docs.read_text()
    assert (tmp_path / "performance" / "growth.svg").is_file()
    assert bench.main(["--quick"]) == 0
    assert asked == [FULL, QUICK]
    monkeypatch.setattr(bench, "MEASUREMENTS", {"turn": lambda effort: ([SLOW], [])})
    assert bench.main(["--gate"]) == 1
    for partly in (["--only", "turn"], ["--quick"]):
        with pytest.raises(ct.InputError, match="of all rows"):
            bench.main([*partly, "--docs", str(docs)])
    with pytest.raises(ct.InputError, match="no medians to compare"):
        bench.main(["--quick", "--gate"])


def test_what_other_processes_held_is_told(monkeypatch, capsys):
    monkeypatch.setattr(bench, "MEASUREMENTS", {"turn": lambda effort: ([HALF], [])})
    assert bench.main([]) == 0
    assert "other processes" not in capsys.readouterr().out
    monkeypatch.setattr(calm.Watch, "others", lambda self: 1.5)
    assert bench.main([]) == 0
    assert "other processes held 1.5 cores: figures of turn are not right" in capsys.readouterr().out


def test_only_what_others_do_counts_as_theirs(monkeypatch, tmp_path):
    cores = tmp_path / "stat"

    def busy(seconds):
        user = int(seconds * os.sysconf("SC_CLK_TCK"))
        cores.write_text(f"cpu  {user} 0 0 1000 0 0 0 0 0 0\ncpu0 1 2\n")

    monkeypatch.setattr(calm, "CORES", cores)
    busy(100.0)
    watch, own, started = calm.Watch(), time.process_time(), time.perf_counter()
    while time.process_time() < own + 0.2:
        pass
    busy(100.0 + time.process_time() - own)
    assert OTHERS(watch) == pytest.approx(0.0, abs=0.1)
    busy(100.0 + time.process_time() - own + 2.0 * (time.perf_counter() - started))
    assert OTHERS(watch) == pytest.approx(2.0, abs=0.2)


def test_without_the_systems_word_the_machine_is_calm(monkeypatch, tmp_path):
    monkeypatch.setattr(calm, "CORES", tmp_path / "nothing")
    assert OTHERS(calm.Watch()) == 0.0
