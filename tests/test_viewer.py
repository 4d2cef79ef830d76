"""What the viewer draws and says for which moment, as data; and the loop taken turn by turn."""

from __future__ import annotations

import io
import urllib.request
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from conftest import SMALL, run_command

from caryatid import InputError, Scene
from caryatid.exploration import explore
from caryatid.graph import Support, SupportGraph
from caryatid.io.graph_json import graph_text
from caryatid.io.runs import read_run
from caryatid.manipulation.order import TakeStep
from caryatid.sources import open_recording, open_source
from caryatid.support.relations import Effect, predict_removal
from caryatid.viewer import words
from caryatid.viewer.apart import PageApart
from caryatid.viewer.canvas import same
from caryatid.viewer.drawing import BY_HAND, LAYERS, draw_dots, draw_moment
from caryatid.viewer.loop import Loop
from caryatid.viewer.marks import Copies, Frustum, Mesh, Points
from caryatid.viewer.moments import Dots, moment_of_scene
from caryatid.viewer.removal import Picture, lifts_told, pictured
from caryatid.viewer.replay import replayed
from caryatid.viewer.runs import config_of_run, moments_of_run
from caryatid.viewer.steering import candidate_under
from caryatid.viewer.wire import MomentReader, MomentWriter
from caryatid.viz.colours import object_colour, rgb


@pytest.fixture(scope="module")
def opening(scene_file):
    return partial(open_source, str(scene_file), noise="none", segmentation="labels", seed=0)


@pytest.fixture
def loop(opening, settings):
    return Loop(opening, settings, segmentation="labels")


@pytest.fixture(scope="module")
def moment(opening, settings):
    """What is known of the two objects after their first view."""
    return Loop(opening, settings, segmentation="labels").turn()


@pytest.fixture
def run_folder(tmp_path, scene_file):
    assert run_command("explore", scene_file, "--out", tmp_path / "run", "--views", 3, "--no-report",
                       "--quiet", "--noise", "carmine", *SMALL) == 0  # fmt: skip
    return tmp_path / "run"


def test_every_mark_belongs_to_a_layer(moment):
    drawing = draw_moment(moment, [moment.shot])
    assert {name.split("/")[0] for name in drawing} == set(LAYERS)


def test_shapes_have_their_objects_colours_and_stand_where_they_were_fitted(moment):
    drawing = draw_moment(moment, [])
    for item in moment.graph.objects:
        mesh = drawing[f"shapes/{item.id}"]
        assert isinstance(mesh, Mesh)
        assert mesh.colour == rgb(object_colour(item.label))
        assert mesh.object_id == item.id
        np.testing.assert_array_equal(mesh.T_world_mesh, item.shape.T_world_object)
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), item.shape.extents, rtol=1e-2)


def test_the_chosen_object_stands_out(moment):
    plain, chosen = (draw_moment(moment, [], chosen=name)["shapes/o1"] for name in ("", "o1"))
    assert chosen.opacity > plain.opacity


def test_points_have_their_objects_colours(moment):
    dots = moment.dots
    drawn = draw_moment(moment, [])["cloud/points"]
    for label in np.unique(dots.labels):
        assert set(map(tuple, drawn.colours[dots.labels == label])) == {rgb(object_colour(int(label)))}
    np.testing.assert_allclose(drawn.origin_world + drawn.points, dots.points_world, atol=1e-6)
    np.testing.assert_array_equal(draw_dots(dots, 0.004, true_colours=True).colours, dots.rgb)


def test_half_floats_hold_points_to_a_millimetre():
    rng = np.random.default_rng(0)
    points = (rng.uniform(-0.8, 0.8, (1000, 3)) + [5.0, -7.0, 0.9]).astype(np.float32)
    drawn = draw_dots(Dots(points, np.zeros(1000, np.uint16), None), 0.004)
    sent = drawn.points.astype(np.float16).astype(np.float64) + drawn.origin_world
    assert np.abs(sent - points).max() < 1e-3


def test_uncertain_supports_are_dashed_and_kinds_have_signs_of_their_own(moment):
    ids = [o.id for o in moment.graph.objects]

    def drawn(*supports):
        graph = SupportGraph(moment.graph.objects, supports)
        return draw_moment(replace(moment, graph=graph), [])

    certain = drawn(Support(ids[1], ids[2]))
    dashed = drawn(Support(ids[1], ids[2], certain=False))
    assert len(certain["supports/shafts"].scales) == 1
    assert len(dashed["supports/shafts"].scales) > 1
    assert len(dashed["supports/heads"].scales) == 1
    assert "supports/lean" not in certain
    lean = drawn(Support(ids[1], ids[2], "lean"))["supports/lean"]
    weight = drawn(Support(ids[1], ids[2], "top-down"))["supports/top-down"]
    assert isinstance(lean, Copies)
    assert len(lean.vertices) != len(weight.vertices)


def test_arrows_point_from_supporter_to_supported(moment):
    crate, can = (moment.graph[i] for i in ("o1", "o2"))
    graph = SupportGraph(moment.graph.objects, (Support("o1", "o2"),))
    heads = draw_moment(replace(moment, graph=graph), [])["supports/heads"]
    tip = heads.positions_world[0] + [0.0, 0.0, heads.scales[0][2]]
    assert np.linalg.norm(tip - can.centre_world) < 0.01
    assert np.linalg.norm(heads.positions_world[0] - crate.centre_world) > 0.05


def test_the_sphere_is_painted_where_the_robot_can_go(moment):
    reachable = draw_moment(moment, [])["sphere/reachable"]
    assert isinstance(reachable, Points)
    assert len(np.unique(reachable.colours, axis=0)) > 10
    np.testing.assert_allclose(np.linalg.norm(reachable.points, axis=1), moment.sphere.radius, rtol=1e-5)
    directions = reachable.points / moment.sphere.radius
    assert (directions @ moment.candidates.directions.T).max(axis=1).min() > 1.0 - 1e-6


def test_cameras_show_what_they_saw_and_a_choice_by_hand_has_another_colour(moment):
    drawing = draw_moment(moment, [moment.shot])
    camera = drawing["cameras/00"]
    assert isinstance(camera, Frustum)
    assert camera.picture.shape[2] == 3
    by_hand = draw_moment(moment.going_to(moment.decision, by_hand=True), [moment.shot])
    assert drawing["cameras/next"].colour != by_hand["cameras/next"].colour == BY_HAND


def test_marks_are_the_same_where_they_look_the_same(moment):
    first, again = draw_moment(moment, [moment.shot]), draw_moment(moment, [moment.shot])
    assert all(same(first[name], again[name]) for name in first)
    larger = draw_moment(moment, [moment.shot], point_size=0.01)
    assert [name for name in first if not same(first[name], larger[name])] == ["cloud/points"]


def test_a_scene_that_has_seen_nothing_can_be_drawn():
    empty = moment_of_scene(Scene())
    assert draw_moment(empty, []) == {}
    assert "nothing seen yet" in words.tell_view(empty, 1)


def test_what_is_said_of_an_object(moment, settings):
    effects = predict_removal(moment.graph, "o1", settings.support)
    said = words.tell_object(moment, "o1", effects)
    for part in ("box", "o0 → o1", "o1 → o2", "Without o1", "<b>o2</b> falls"):
        assert part in said
    assert "nothing falls" in words.tell_object(moment, "o2", ())
    assert "may fall" in words.tell_object(moment, "o1", [Effect("o2", False, "why")])
    assert "not known" in words.tell_object(moment, "o9", ())


def test_names_cannot_put_markup_into_the_page(moment):
    said = words.tell_view(replace(moment, name="<img src=x onerror=alert(1)>"), 1)
    assert "<img" not in said


def test_the_loop_gives_the_views_that_explore_gives(loop, opening, settings):
    source = opening(settings)
    steps = explore(source.camera, source.robot, config=settings, segmentation="labels")
    for step in (next(steps), next(steps)):
        moment = loop.turn()
        assert graph_text(moment.graph) == graph_text(step.graph)
        np.testing.assert_array_equal(moment.decision.T_world_camera, step.decision.T_world_camera)
        assert moment.score is not None


def test_the_loop_says_when_it_would_stop_and_can_go_on(opening, settings):
    limited = replace(settings, active=replace(settings.active, max_views=2))
    loop = Loop(opening, limited, segmentation="labels")
    loop.turn()
    assert loop.pause is None
    loop.turn()
    assert loop.pause == "2 views were asked for"
    assert loop.turn().index == 2


def test_a_view_chosen_by_hand_is_taken(loop):
    loop.turn()
    index = len(loop.moments[0].candidates) // 3
    wanted = loop.moments[0].candidates.T_world_camera[index]
    moment = loop.choose(index)
    assert moment.by_hand
    assert moment.decision.score <= loop.planned.score
    np.testing.assert_array_equal(loop.turn().shot.T_world_camera, wanted)


def test_another_planner_chooses_the_next_view_at_once(loop):
    before = loop.turn()
    after = loop.use_planner("farthest")
    assert after.graph is before.graph
    assert not np.allclose(after.decision.T_world_camera, before.decision.T_world_camera)
    np.testing.assert_array_equal(loop.turn().shot.T_world_camera, after.decision.T_world_camera)
    with pytest.raises(InputError):
        loop.use_planner("nobody")


def test_another_fusion_takes_the_same_views(loop):
    loop.turn()
    loop.choose(5)
    loop.turn()
    poses = [m.shot.T_world_camera for m in loop.moments]
    again = list(loop.use_fusion("sg"))
    assert loop.fusion == "sg"
    assert [m.by_hand for m in again] == [True, False]
    np.testing.assert_array_equal([m.shot.T_world_camera for m in again], poses)


def test_a_recording_ends_with_its_views(recording, settings):
    opening = partial(open_source, str(recording), noise="none", segmentation=None, seed=0)
    loop = Loop(opening, settings)
    taken = [loop.turn() for _ in range(4)]
    assert [m is not None for m in taken] == [True, True, True, False]
    assert taken[0].robot is None
    assert "no view is left" in loop.ended


def test_a_ray_points_at_the_view_it_first_meets(moment):
    sphere, candidates = moment.sphere, moment.candidates
    wanted = candidates.directions[7]
    outside = sphere.centre_world + 3.0 * sphere.radius * wanted
    found = candidate_under(outside, -wanted, sphere, candidates, 0.1)
    assert candidates.directions[found] @ wanted > np.cos(0.02)
    inside = candidate_under(sphere.centre_world, wanted, sphere, candidates, 0.1)
    assert candidates.directions[inside] @ wanted > np.cos(0.02)
    assert candidate_under(outside, wanted, sphere, candidates, 0.1) is None
    down = np.array([0.0, 0.0, -1.0])
    assert candidate_under(sphere.centre_world, down, sphere, candidates, 0.1) is None


def test_what_is_taken_is_gone_and_what_moves_leaves_no_points(moment):
    steps = [TakeStep("o2", (), True, 0.0, "why"), TakeStep("o1", (), True, 0.0, "why")]
    pictures = list(lifts_told(steps))
    rising = pictured(moment, pictures[0])
    assert rising.graph["o2"].centre_world[2] > moment.graph["o2"].centre_world[2]
    assert moment.graph["o2"].label not in rising.dots.labels
    assert moment.graph["o1"].label in rising.dots.labels
    assert {s.pair for s in rising.graph.supports} == {("o0", "o1")}
    assert [o.id for o in pictured(moment, pictures[-1]).graph.objects] == ["o0"]
    assert [p.number for p in pictures if p.done] == [0, 1]
    still = pictured(moment, Picture(0, steps[0], {"o1": np.eye(4)}, frozenset()))
    assert moment.graph["o1"].label in still.dots.labels


def test_a_run_folder_has_all_but_clouds_and_they_are_computed_again(run_folder):
    run = read_run(run_folder)
    stored = moments_of_run(run)
    assert len(stored) == len(run.views) > 1
    assert all(m.dots is None and m.score is not None and m.shot is not None for m in stored)
    assert stored[-1].stop is not None
    assert stored[0].decision.points_of_interest
    again = list(replayed(run, stored, config_of_run(run), open_source, open_recording))
    assert [graph_text(m.graph) for m in again] == [graph_text(m.graph) for m in stored]
    assert all(len(m.dots) for m in again)
    np.testing.assert_allclose(stored[0].sphere.centre_world, again[0].sphere.centre_world, atol=1e-6)
    assert stored[0].sphere.radius == pytest.approx(again[0].sphere.radius, abs=1e-6)


def test_a_run_that_comes_out_otherwise_stays_as_it_is_stored(run_folder):
    run = read_run(run_folder)
    stored = moments_of_run(run)
    stored[1] = replace(stored[1], graph=SupportGraph())
    assert len(list(replayed(run, stored, config_of_run(run), open_source, open_recording))) == 1


def test_an_extracted_recording_is_computed_again(recording, tmp_path):
    assert run_command("extract", recording, "--out", tmp_path / "run", "--no-report", "--quiet") == 0
    run = read_run(tmp_path / "run")
    stored = moments_of_run(run)
    again = list(replayed(run, stored, config_of_run(run), open_source, open_recording))
    assert [m.name for m in again] == [m.name for m in stored]
    assert all(len(m.dots) for m in again)


def _waiting(monkeypatch, meanwhile):
    """Have the command, where it would wait for Ctrl-C, do something else."""
    monkeypatch.setattr("caryatid.cli.viewing.wait_for_interrupt", meanwhile)


def test_view_serves_a_page_to_this_machine_until_it_is_stopped(run_folder, monkeypatch, capsys):
    pages = []

    def meanwhile():
        address = capsys.readouterr().err.split(" at ")[-1].split(";")[0]
        pages.append((address, urllib.request.urlopen(address).read()))

    _waiting(monkeypatch, meanwhile)
    assert run_command("view", run_folder, "--no-browser", "--port", 0) == 0
    ((address, page),) = pages
    assert address.startswith("http://127.0.0.1:")
    assert b"<canvas" in page or b"<html" in page
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(address)


@pytest.mark.parametrize("source", ["nothing-here", "cloud.pcd"])
def test_view_says_in_one_line_what_cannot_be_shown(source, monkeypatch, capsys):
    _waiting(monkeypatch, lambda: None)
    assert run_command("view", source, "--no-browser", "--port", 0) == 1
    assert capsys.readouterr().err.startswith("error: ")


def test_explore_shows_its_views_while_it_works(scene_file, tmp_path, monkeypatch, capsys):
    pages = []
    monkeypatch.setattr("webbrowser.open", pages.append)
    _waiting(monkeypatch, lambda: pages.append(urllib.request.urlopen(pages[0]).status))
    out = tmp_path / "run"
    assert (
        run_command("explore", scene_file, "--out", out, "--views", 2, "--view", "--no-report", *SMALL) == 0
    )
    assert pages[1] == 200
    assert (out / "run.json").is_file()
    assert pages[0] in capsys.readouterr().err


def test_an_exploration_that_is_interrupted_is_kept_and_its_page_closed(scene_file, tmp_path, monkeypatch):
    from caryatid.cli.watching import Watcher

    shown, waited = [], []
    monkeypatch.setattr("webbrowser.open", lambda url: None)
    _waiting(monkeypatch, lambda: waited.append(True))
    show = Watcher.show

    def interrupted(self, step, source, score):
        show(self, step, source, score)
        shown.append(step.index)
        if step.index == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(Watcher, "show", interrupted)
    out = tmp_path / "run"
    options = ("--no-early-stop", "--view", "--no-report", "--quiet", *SMALL)
    assert run_command("explore", scene_file, "--out", out, *options) == 130
    assert shown == [0, 1]
    assert not waited
    assert len(read_run(out).views) == 1


def test_moments_come_through_a_pipe_as_they_were(loop):
    stream = io.BytesIO()
    writer = MomentWriter(stream)
    sent = [loop.turn(), loop.turn()]
    for moment in sent:
        writer.write(moment)
    stream.seek(0)
    reader = MomentReader(stream)
    for moment in sent:
        read = reader.read()
        before, after = (draw_moment(m, [m.shot]) for m in (moment, read))
        assert before.keys() == after.keys()
        # Shapes are rounded to a nanometre, as in graph.json.
        loose = {name for name in before if name.split("/")[0] in ("shapes", "names", "supports")}
        assert all(same(before[name], after[name]) for name in before.keys() - loose)
        assert words.tell_view(read, 1) == words.tell_view(moment, 1)
        assert graph_text(read.graph) == graph_text(moment.graph)
    assert reader.read() is None


def test_a_page_apart_shows_what_is_added_and_ends_with_its_maker(moment, settings):
    page = PageApart("apart", settings.support)
    page.add(moment)
    assert urllib.request.urlopen(page.url).status == 200
    page.close()
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(page.url)


def test_without_viser_the_extra_to_install_is_named(monkeypatch):
    from caryatid.viewer.page import Page

    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(InputError, match=r"caryatid\[view\]"):
        Page("nothing")


def test_a_scene_shows_itself_in_a_notebook(views):
    from caryatid.viewer import show

    scene = Scene()
    scene.update(views[0])
    shown = show(scene)
    try:
        shown.page.wait()
        assert "shapes/o1" in shown.page.canvas.drawn
        assert f'<iframe src="{shown.url}"' in shown._repr_html_()
        scene.update(views[1])
        shown.update(scene)
        assert [m.index for m in shown.page.moments] == [0, 1]
    finally:
        shown.close()
