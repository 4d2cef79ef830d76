"""What the viewer draws and says after each view, and the loop taken turn by turn."""

from __future__ import annotations

import io
import re
import shutil
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from functools import partial
from socket import create_connection
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import Tab
from conftest import SMALL, run_command
from PIL import Image

from caryatid import InputError, Scene
from caryatid.errors import PlanningError
from caryatid.exploration import explore
from caryatid.geometry import transforms
from caryatid.graph import Support, SupportGraph
from caryatid.io.graph_json import graph_text
from caryatid.sources import open_source
from caryatid.steps import read_run
from caryatid.viewer.drawing import BY_HAND, EARLIER_POINTS, LAYERS
from caryatid.viewer.loop import LoopPage
from caryatid.viewer.page import Page
from caryatid.viewer.panels import describe_object, describe_view
from caryatid.viz.colours import object_colour, rgb

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def opening(scene_file):
    return partial(open_source, str(scene_file), noise="none", segmentation="labels", seed=0)


@pytest.fixture
def loop(opening, settings):
    page = LoopPage(opening, settings, segmentation="labels")
    yield page
    page.close()


@pytest.fixture(scope="module")
def page(opening, settings):
    """The page of two objects, seen once."""
    page = LoopPage(opening, settings, segmentation="labels")
    page.turn()
    page.wait()
    yield page
    page.close()


@pytest.fixture(scope="module")
def step(page):
    return page.steps[0]


@pytest.fixture
def drawn(page):
    """Draw a step and return the nodes of the scene by name."""
    for name in LAYERS:
        page.show_layer(name, True)
    page.wait()

    def draw(step, **look):
        page.drawing.show(step, [step], **look)
        return {node.name: node for nodes in page.drawing.nodes.values() for node in nodes}

    yield draw
    for name, (shown, _) in LAYERS.items():
        page.show_layer(name, shown)
    page.wait()


def with_supports(step, *supports):
    return replace(step, graph=SupportGraph(step.graph.objects, supports))


def test_shapes_and_points_have_their_objects_colours_and_places(step, drawn):
    nodes = drawn(step, chosen="o1")
    assert {name.split("/")[1] for name in nodes} == set(LAYERS) - {"gripper"}
    for item in step.graph.objects:
        body = nodes[f"/shapes/{item.id}"]
        assert tuple(body.color) == rgb(object_colour(item.label))
        np.testing.assert_allclose(body.position, item.centre_world)
    assert nodes["/shapes/o1"].opacity > nodes["/shapes/o2"].opacity
    cloud, points = step.cloud, nodes["/cloud/points"]
    sent = points.points.astype(np.float64) + points.position
    assert np.abs(sent - cloud.points_world).max() < 1e-3
    for label in np.unique(cloud.labels):
        assert (points.colors[cloud.labels == label] == rgb(object_colour(int(label)))).all()
    np.testing.assert_array_equal(drawn(step, true_colours=True)["/cloud/points"].colors, cloud.rgb)


def test_a_shape_moves_as_a_whole_and_is_not_replaced(step, drawn):
    graph, before = step.graph, drawn(step)
    T = transforms.rigid(transforms.rotation_from_vector((0.0, 0.0, 0.3)), (0.1, 0.0, 0.2))
    objects = [replace(o, shape=o.shape.moved(T)) if o.id == "o1" else o for o in graph.objects]
    after = drawn(replace(step, graph=replace(graph, objects=tuple(objects))))
    for name in ("/shapes/o1", "/shapes/o1/edges", "/shapes/o2"):
        assert after[name] is before[name]
    body, edges, shape = after["/shapes/o1"], after["/shapes/o1/edges"], objects[1].shape
    np.testing.assert_allclose(body.position, shape.T_world_object[:3, 3])
    np.testing.assert_allclose(edges.position, 0.0)
    ends_world = transforms.transform(shape.T_world_object, edges.points.astype(float) * edges.scale)
    np.testing.assert_allclose(body.scale, shape.extents)
    np.testing.assert_allclose(ends_world, shape.creases(), atol=1e-3)
    gone = drawn(replace(step, graph=replace(graph, objects=graph.objects[:2], supports=())))
    assert "/shapes/o1" in gone
    assert not [name for name in gone if "o2" in name]


def test_what_is_hidden_is_not_sent_until_it_is_asked_for(loop):
    loop.turn()
    loop.wait()
    sent = {name.split("/")[0] for name, nodes in loop.drawing.nodes.items() if nodes}
    assert sent == {"shapes", "names", "supports", "cameras", "grid"}
    loop.show_layer("cloud", True)
    loop.wait()
    assert loop.drawing.nodes["cloud"]


def test_arrows_tell_direction_doubt_and_kind(step, drawn):
    def of(*supports):
        nodes = drawn(with_supports(step, *supports))
        return {name.removeprefix("/supports/"): node for name, node in nodes.items() if "/supports" in name}

    certain, (_, below, above) = of(Support("o1", "o2")), step.graph.objects
    assert set(certain) == {"arrow 0"}
    start, end = certain["arrow 0"].points[0].astype(float)
    assert (end - start) @ (above.centre_world - below.centre_world) > 0.0
    np.testing.assert_allclose(np.cross(end - start, above.centre_world - below.centre_world), 0.0, atol=1e-4)
    assert set(of(Support("o0", "o1"), Support("o0", "o2", certain=False))) >= {"arrow 1"}
    doubtful, widths = of(Support("o1", "o2", certain=False)), []
    assert len(doubtful["dashes 0"].points) > 1
    for certain, probability, said in ((False, None, "0.50"), (True, 0.83, "0.83"), (True, None, "")):
        nodes = of(Support("o1", "o2", certain=certain, probability=probability))
        assert (nodes["probability 0"].text if said else "") == said
        assert ("probability 0" in nodes) == bool(said)
        widths.append(nodes["arrow 0"].shaft_radius)
    assert widths == sorted(set(widths))
    assert of(Support("o1", "o2", "lean"))["probability 0"].text == "lean 1.00"


def test_the_sphere_is_painted_and_cameras_show_what_they_saw(step, drawn):
    nodes = drawn(step)
    painted, sphere = nodes["/sphere/reachable"], step.sphere
    assert len(np.unique(painted.colors, axis=0)) > 10
    away = np.linalg.norm(painted.points + painted.position - sphere.centre_world, axis=1)
    np.testing.assert_allclose(away, sphere.radius, rtol=1e-2)
    assert nodes["/cameras/1"].image.shape[2] == 3
    moved = transforms.rigid(np.eye(3), (0.0, 0.0, 0.1)) @ step.decision.T_world_camera
    decision = replace(step.decision, T_world_camera=moved, why="chosen by hand")
    by_hand = replace(step, decision=decision)
    planned = tuple(nodes["/cameras/next"].color)
    assert planned != tuple(drawn(by_hand)["/cameras/next"].color) == BY_HAND


def test_the_panel_says_why_an_object_has_its_shape(page, step, settings):
    text = describe_object(step.graph, "o1", settings.support, reasons=page.find_scene().why("o1"))
    cost = r"Why a box</dt><dd>it costs \d+ nats: points \d+, free space 0, parameters \d+<"
    assert re.search(cost, text)
    assert re.search(r"a cylinder instead</dt><dd>\+\d+ nats", text)


def test_the_panel_describes_an_object(step, settings):
    graph, config = step.graph, settings.support
    text = describe_object(graph, "o1", config)
    for part in ("box", "o0 → o1", "o1 → o2", "Without o1", "o2 moves with probability 1.00:"):
        assert part in text
    assert re.search(
        r"<dd>nothing else moves with probability 0\.9\d</dd>", describe_object(graph, "o2", config)
    )
    assert "Without" not in describe_object(graph, "o0", config)
    doubtful = with_supports(step, Support("o1", "o2", certain=False)).graph
    said = "o1 → o2</dt><dd>bottom-up, probability 0.50, doubtful, 1 of 1 views"
    assert said in describe_object(doubtful, "o1", config)
    assert "not found" in describe_object(graph, "o9", config)
    assert "was removed" in describe_object(graph, "o9", config, taken=True)
    assert "View 1 of 3" in describe_view(step, None, 3)
    assert "next</dt>" in describe_view(step, None, 1)
    ended = describe_view(replace(step, stop="enough"), None, 1)
    assert "finished</dt><dd>enough" in ended
    assert "next</dt>" not in ended
    named = replace(step, name="<img src=x onerror=alert(1)>")
    assert "<img" not in describe_view(named, None, 1)


def test_the_loop_gives_the_views_that_explore_gives_and_says_when_it_would_stop(opening, settings):
    limited = replace(settings, active=replace(settings.active, max_views=2))
    page, source = LoopPage(opening, limited, segmentation="labels"), opening(limited)
    steps = explore(source.camera, source.robot, config=limited, segmentation="labels")
    assert [page.turn() for _ in range(3)][:2] == [None, "maximum of 2 views reached"]
    page.wait()
    assert "cameras/next" not in page.drawing.nodes
    page._show_state("", busy=False)
    page.wait()
    assert page._buttons.options == ("next view", "plan", "clear", "restart")
    page.close()
    assert len(page.steps) == len(page.scores) == 3
    for step, shown, f1 in zip(steps, page.steps, page.scores, strict=False):
        assert graph_text(shown.graph) == graph_text(step.graph)
        np.testing.assert_array_equal(shown.visited, step.visited)
        assert f1 is not None


def test_a_view_may_be_chosen_by_hand_and_another_fusion_and_planner(loop):
    loop.turn()
    step = loop.steps[0]
    candidates = loop._explorer.step.candidates
    index = len(candidates) // 3
    said = loop.choose(index)
    yours, planned = (float(number) for number in re.findall(r"\d\.\d+", said))
    assert yours <= planned == pytest.approx(step.decision.score, abs=0.01)
    loop.turn()
    poses = [step.view.T_world_camera for step in loop.steps]
    np.testing.assert_array_equal(poses[1], candidates.T_world_camera[index])
    assert "sg" in loop.use_fusion("sg")
    assert [step.decision.why == "chosen by hand" for step in loop.steps] == [True, False]
    np.testing.assert_array_equal([step.view.T_world_camera for step in loop.steps], poses)
    before = loop.steps[-1]
    loop.use_planner("farthest")
    assert loop.steps[-1].graph is before.graph
    assert not np.allclose(loop.steps[-1].decision.T_world_camera, before.decision.T_world_camera)
    with pytest.raises(PlanningError):
        loop.choose(10**6)
    with pytest.raises(InputError):
        loop.use_planner("nobody")


def test_the_robot_stands_where_it_took_the_view_and_its_way_leads_there(loop):
    loop.show_layer("robot", True)
    for _ in range(2):
        loop.turn()
    loop.wait()
    base, links, way = loop.drawing.nodes["robot"]
    there = loop.steps[1].robot
    np.testing.assert_allclose(base.position[:2], there.posture.platform_world[:2])
    np.testing.assert_allclose(links.points[-1, -1], there.T_world_camera[:3, 3], atol=1e-3)
    ends = [loop.steps[0].robot.posture.platform_world, there.posture.platform_world]
    np.testing.assert_allclose(
        [way.points[0, 0, :2], way.points[-1, -1, :2]], [e[:2] for e in ends], atol=1e-3
    )


def test_earlier_views_keep_few_points_and_their_cameras_are_not_sent_again(step, settings):
    page = Page("many", settings)
    cloud = step.cloud.select(np.arange(50_000) % len(step.cloud))
    for k in range(3):
        page.add(replace(step, index=k, cloud=replace(cloud)))
        page.wait()
    (first, *_), (frustum, _) = page.steps, page.drawing.nodes["cameras/1"]
    assert EARLIER_POINTS / 2 <= len(first.cloud) <= EARLIER_POINTS < len(page.steps[-1].cloud)
    page.add(replace(step, index=3))
    page.wait()
    assert page.drawing.nodes["cameras/1"][0] is frustum
    page.go_to(0)
    page.wait()
    assert "cameras/2" not in page.drawing.nodes
    page.close()


def test_a_recording_ends_with_its_views(recording, settings):
    page = LoopPage(partial(open_source, str(recording), noise="none", segmentation=None, seed=0), settings)
    assert "no candidate views left" in [page.turn() for _ in range(4)][-1]
    page.wait()
    page.close()
    assert [step.robot for step in page.steps] == [None] * 3
    assert page._chart is None, "there is no ground truth"
    assert page._buttons.options == ("plan", "restart")


@pytest.mark.parametrize("simulated", [True, False])
def test_what_is_taken_is_gone_and_what_moves_leaves_no_points(loop, monkeypatch, simulated):
    loop.turn()
    (step,), shown, numbers = loop.steps, [], []

    def stage(shown_step):
        shown.append(shown_step)
        if shown_step is not None:
            numbers.append((shown_step.index, len(loop.steps) - 1))

    monkeypatch.setattr(loop, "stage", stage)
    if simulated:
        loop._running.set()
        assert loop.clear() == "Finished: no objects are left; no other object moved."
    else:
        loop.plan_order()
        loop.play_order()
    rising = next(
        s for s in shown if s and s.graph["o2"].centre_world[2] > step.graph["o2"].centre_world[2] + 0.01
    )
    assert step.graph["o2"].label not in rising.cloud.labels
    assert step.graph["o1"].label in rising.cloud.labels
    assert {s.pair for s in rising.graph.supports} == {("o0", "o1")}
    assert all(index == newest for index, newest in numbers), "a lift belongs to the newest view"
    last = loop.steps[-1] if simulated else shown[-2]
    assert [o.id for o in last.graph.objects] == ["o0"]
    assert [s.lift.object_id for s in loop.steps if s.lift] == (["o2", "o1"] if simulated else [])


def check_panels(page):
    """Find nothing in one panel that another, or the scene, contradicts."""
    summary, graph, lifts = page._summary.content, page._graph.content, page._lifts.content
    number, count = (int(n) for n in re.search(r"View (\d+) of (\d+)", summary).groups())
    assert (number, count) == (page._slider.value, len(page.steps))
    nodes = {name: [node.name for node in drawn] for name, drawn in page.drawing.nodes.items()}
    shapes = {name.split("/")[2] for name in nodes["shapes"]}
    vertices = set(re.findall(r'/object/(\w+)"', graph))
    assert shapes == vertices
    objects, supports = (int(n) for n in re.search(r"(\d+) objects?, (\d+) support", summary).groups())
    assert (objects, supports) == (len(vertices - {"o0"}), len(re.findall(r'class="edge ', graph)))
    assert {name.split("/")[2] for name in nodes["names"]} == vertices - {"o0"}
    cameras = {name.partition("/")[2] for name in nodes if name.startswith("cameras/")}
    assert cameras - {"next"} == {str(k) for k in range(1, number + 1)}
    assert ("next" in cameras) == ("next</dt>" in summary) != ("finished</dt>" in summary)
    assert page.steps[number - 1].view.name in page._image.content
    assert set(page._goal.options[1:]) == vertices - {"o0"}

    chosen = re.search(r"</i><b>(\w+)", page._about.content) if page._about.visible else None
    bodies = [node for node in page.drawing.nodes["shapes"] if not node.name.endswith("/edges")]
    faint = {node.name.split("/")[2] for node in bodies if node.opacity < 0.5}
    assert faint == (vertices - {chosen[1]} if chosen else set())

    planned = re.search(r"Order</b> after view (\d+)", lifts)
    assert page._play.disabled == ("1. o" not in lifts)
    assert planned is None or int(planned[1]) == number
    order = re.findall(r"\d+\. (\w+)</dt>", lifts if planned else "")
    assert set(order) <= vertices
    assert re.findall(r"lift first</dt><dd>(o\d+):", summary) == order[:1]
    assert ("grasps it" in lifts) == bool(nodes["gripper"])


def test_no_panel_contradicts_another_in_fifty_walks_of_clicks(opening, settings, monkeypatch):
    limited = replace(settings, active=replace(settings.active, max_views=3))
    page, rng = LoopPage(opening, limited, segmentation="labels"), np.random.default_rng(0)
    monkeypatch.setattr(page.server, "get_clients", lambda: {0: "a browser"})
    page.turn()

    def choose_goal():
        page._goal.value = str(rng.choice(page._goal.options))

    def choose_gripper():
        page._gripper.value = str(rng.choice(["none", "franka", "suction"]))

    clicks = [
        lambda: page.queue_work("taking a view", page.turn),
        lambda: page.go_to(int(rng.integers(len(page.steps)))),
        lambda: page.describe(str(rng.choice(["o0", "o1", "o2", ""]))),
        lambda: page.queue_work("planning an order", page.plan_order),
        lambda: page.use_planner(str(rng.choice(["farthest", "support"]))),
        choose_goal,
        choose_gripper,
    ]
    for _ in range(50):
        page.queue_work("starting again", page.restart)
        for click in rng.choice(clicks, 8):
            click()
            page.wait()
            check_panels(page)
    page.close()


# The page


@pytest.fixture
def shown(monkeypatch):
    """The steps that are shown, with their F1."""
    shown, add = [], Page.add
    monkeypatch.setattr(Page, "add", lambda page, *step: (shown.append(step), add(page, *step)))
    return shown


@pytest.fixture
def meanwhile(monkeypatch):
    """Have the command, where it would wait for Ctrl-C, do something else."""
    return lambda work: monkeypatch.setattr("caryatid.cli.run.wait_for_interrupt", work)


def test_view_serves_a_run_to_this_machine_until_it_is_stopped(kept_run, meanwhile, shown, capsys):
    served = []

    def ask():
        address = re.search(r"http://\S+", capsys.readouterr().err)[0]  # what programs take for the address
        served.append((address, urllib.request.urlopen(address).read()))

    meanwhile(ask)
    assert run_command("view", kept_run, "--no-browser", "--port", 0) == 0
    ((address, content),) = served
    assert address.startswith("http://127.0.0.1:")
    assert b"<html" in content
    assert len(shown) == len(read_run(kept_run).views) > 1
    assert all(len(step.cloud) and f1 is not None for step, f1 in shown)
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(address)


def test_a_built_in_scene_comes_before_a_run_of_its_name(
    kept_run, tmp_path, monkeypatch, meanwhile, shown, capsys
):
    shutil.copytree(kept_run, tmp_path / "tower")
    monkeypatch.chdir(tmp_path)
    meanwhile(lambda: None)
    for source, views in (("tower", 1), ("./tower", 2)):
        shown.clear()
        assert run_command("view", source, "--no-browser", "--port", 0, *SMALL) == 0
        assert len(shown) == views
        assert ("write ./tower" in capsys.readouterr().err) == (source == "tower")


def test_only_the_viewers_own_page_with_its_token_comes_in(page):
    root, token = page.url.rsplit("/", 1)
    assert len(token) > 16
    assert page.server.get_host() not in root

    def came(address, **headers):
        try:
            socket_headers = {"Upgrade": "websocket"} if headers.pop("socket", False) else {}
            request = urllib.request.Request(address, headers=headers | socket_headers)
            return urllib.request.urlopen(request).status
        except urllib.error.HTTPError as error:
            return error.code

    assert came(page.url, Origin=root) == 200
    strangers = [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Host": "evil.example"},
        {"Host": "[::1"},
    ]
    for socket in (False, True):
        assert all(came(page.url, socket=socket, **headers) == 403 for headers in strangers)
        assert {came(address, socket=socket) for address in (root, f"{root}/x", f"{root}/%C3%A9")} == {403}
    there = urlsplit(root)
    for path, header in (("x", "Host: localhost"), ("/é", "Host: localhost"), ("/", "Origin: null")):
        with create_connection((there.hostname, there.port)) as connection:
            connection.sendall(f"GET {path} HTTP/1.1\r\n{header}\r\n\r\n".encode())
            assert connection.recv(100)[9:13] in (b"400 ", b"403 ")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("nothing-here --port 0", "nothing-here"),
        ("cloud.pcd --port 0", "cloud.pcd"),
        ("{run} --host 192.0.2.1", "192.0.2.1"),
        ("{run} --port 99999", "99999"),
    ],
)
def test_view_says_in_one_line_what_it_cannot_show_or_where_it_cannot_listen(kept_run, words, said, capsys):
    assert run_command("view", "--no-browser", *words.format(run=kept_run).split()) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert said in line


def test_a_scene_shows_itself_in_a_notebook_if_viser_is_there(views, monkeypatch):
    scene = Scene()
    shown = scene.show()
    try:
        for view in views[:2]:
            scene.update(view)
            shown.update(scene)
        shown.wait()
        assert [step.index for step in shown.steps] == [0, 1]
        assert "/shapes/o1" in [node.name for node in shown.drawing.nodes["shapes"]]
        assert f'<iframe src="{shown.url}"' in shown._repr_html_()
    finally:
        shown.close()
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'-m pip install ".*\[view\]"'):
        scene.show()


# In a real browser: what a person would see and press


def picture(tab):
    """The scene as pixels (H, W, 3): what the canvas shows, without the panels."""
    tab.settle()
    box = tab.page.locator("canvas").first.bounding_box()
    shot = Image.open(io.BytesIO(tab.page.screenshot(clip=box)))
    return np.asarray(shot.convert("RGB"), dtype=np.uint8)


def wait_until(true, tab):
    """Wait until something here is true."""
    for _ in range(600):
        if true():
            return
        tab.page.wait_for_timeout(100)
    pytest.fail("waited for a minute")


@pytest.fixture
def seen(opening, settings, browser):
    """A page after one view, in Chromium; no test logs an error, and nothing leaves this machine."""
    page = LoopPage(opening, settings, segmentation="labels")
    page.turn()
    page.wait()
    tab = Tab(browser.new_page(viewport={"width": 1280, "height": 720}))
    tab.open(page.url)
    yield page, tab
    tab.page.close()
    page.close()
    assert tab.errors == []
    assert tab.hosts == {"127.0.0.1"}


@pytest.mark.slow
def test_the_first_sight_is_the_objects_with_their_names_and_what_moves_without_one(seen):
    page, tab = seen
    tab.settle()
    box = tab.page.locator("canvas").first.bounding_box()
    found = page.steps[-1].graph.objects[1:]
    shot = np.asarray(Image.open(io.BytesIO(tab.page.screenshot())).convert("RGB"))
    for item in found:
        u, v = map(round, tab.pixel(page, item.centre_world))
        plate = (shot[v - 6 : v + 6, u - 8 : u + 8] > 200).all(axis=-1)
        assert plate.mean() > 0.1, item.id  # the rest is letters and blur
    corners = [tab.pixel(page, corner) for item in found for corner in item.shape.outline()]
    low, high = np.min(corners, axis=0) - (box["x"], box["y"]), np.max(corners, axis=0) - (box["x"], box["y"])
    room = box["width"], box["height"]
    assert (low > 0.0).all()
    assert (high < room).all()
    assert ((high - low) / room).max() > 0.4

    crate = page.steps[-1].graph["o1"]
    tab.click(page, crate.centre_world - (0.0, 0.0, crate.shape.extents[2] / 4.0))
    tab.wait_for_text("Without o1")
    tab.wait_for_text("moves with probability")
    assert "o2" in tab.page.locator(".caryatid-cell").last.inner_text()
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    for theme in ("light", "dark"):
        tab.page.emulate_media(color_scheme=theme)
        tab.page.reload()
        tab.page.wait_for_selector(f'[data-mantine-color-scheme="{theme}"]')
        tab.wait_for_text("Without o1")
        faults = axe.run(tab.page, context={"include": [[".caryatid-cell"]]}).response["violations"]
        assert [(v["id"], v["nodes"]) for v in faults if v["impact"] in ("serious", "critical")] == []


@pytest.mark.slow
def test_a_person_goes_on_and_back_chooses_a_view_by_hand_and_clears(seen):
    page, tab = seen
    first = picture(tab)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200
    tab.press("next view")
    tab.wait_for_text("View 2 of 2")
    tab.wait_for_node("/cameras/2")
    second = picture(tab)
    assert len(page.steps) == 2
    assert (np.abs(second.astype(int) - first).max(axis=-1) > 16).mean() > 0.01

    slider = tab.page.get_by_role("slider").first  # above the layers, whatever other pages this process made
    slider.press("ArrowLeft")
    tab.wait_for_text("View 1 of 2")
    tab.wait_for_node("/cameras/2", there=False)
    assert (np.abs(picture(tab).astype(int) - second).max(axis=-1) > 16).mean() > 0.01
    slider.press("ArrowRight")
    tab.wait_for_node("/cameras/2")

    step = page.steps[-1]
    tab.page.get_by_text("options", exact=True).click()
    tab.page.get_by_role("checkbox", name="choose by hand").click()
    client = next(iter(page.server.get_clients().values()))
    centre, radius = step.sphere.centre_world, step.sphere.radius
    wait_until(lambda: np.linalg.norm(client.camera.position - centre) > 2.0 * radius, tab)
    towards_eye = transforms.unit(client.camera.position - centre)
    facing = np.argmax(step.candidates.directions @ towards_eye)
    eye = centre + radius * step.candidates.directions[facing]

    def taken_next():
        tab.click(page, eye)
        tab.page.wait_for_timeout(500)
        return tab.page.get_by_text("next view chosen by hand").first.is_visible()

    wait_until(taken_next, tab)  # A click before the page listens is lost.
    tab.press("next view")
    tab.wait_for_node("/cameras/3")
    taken = page.steps[2].view.T_world_camera
    assert page.steps[1].decision.why == "chosen by hand"
    assert not np.allclose(taken, step.decision.T_world_camera)
    assert np.linalg.norm(taken[:3, 3] - eye) < 0.2

    tab.page.locator('a[href$="/object/o2"]').click()
    tab.wait_for_text("Why a cylinder")
    tab.page.keyboard.press("Escape")
    tab.page.get_by_text("Why a cylinder").wait_for(state="hidden")
    tab.page.get_by_text("order", exact=True).click()
    tab.press("plan")
    tab.wait_for_text("Safe order (nothing else moves")
    page.describe("o2")
    tab.press("clear")
    tab.wait_for_text("Finished: no objects are left; no other object moved.")
    tab.wait_for_node("/shapes/o1", there=False)
    tab.wait_for_node("/shapes/o2", there=False)
    tab.wait_for_text("was removed")
