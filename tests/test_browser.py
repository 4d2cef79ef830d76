"""The viewer in a real browser: what a person would see and press."""

from __future__ import annotations

import os
from functools import partial

import numpy as np
import pytest
from chromium import browser, chromium

from caryatid.geometry import transforms
from caryatid.sources import open_source
from caryatid.viewer.controls import Controls
from caryatid.viewer.loop import Loop
from caryatid.viewer.page import Page

pytestmark = pytest.mark.slow

pytest.importorskip("viser")
pytest.importorskip("playwright")


@pytest.fixture
def tab(tmp_path):
    """A fresh Chromium; whatever a test does, its console shows no error and nothing leaves this machine."""
    if chromium() is None:
        if os.environ.get("CI"):
            pytest.fail("there is no Chromium: `make chromium` installs it")
        pytest.skip("there is no Chromium")
    with browser(tmp_path / "user") as opened:
        yield opened
        assert opened.errors == []
        assert opened.hosts == {"127.0.0.1"}


@pytest.fixture
def live(scene_file, settings):
    """The page and the controls of a loop on two objects, its first view taken."""
    opening = partial(open_source, str(scene_file), noise="none", segmentation="labels", seed=0)
    page = Page("caryatid: two", settings.support)
    controls = Controls(page, Loop(opening, settings, segmentation="labels"))
    controls.start()
    controls.wait()
    yield page, controls
    controls.close()
    page.close()


def pixel_of(page, point_world, tab):
    """Where a point of the world is in the window [px]."""
    (client,) = page.server.get_clients().values()
    T_world_camera = np.eye(4)
    w, x, y, z = client.camera.wxyz
    T_world_camera[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    T_world_camera[:3, 3] = client.camera.position
    seen = transforms.transform(transforms.invert(T_world_camera), point_world[None])[0]
    box = tab.page.locator("canvas").first.bounding_box()
    focal = box["height"] / 2.0 / np.tan(client.camera.fov / 2.0)
    u = box["x"] + box["width"] / 2.0 + focal * seen[0] / seen[2]
    v = box["y"] + box["height"] / 2.0 + focal * seen[1] / seen[2]
    return float(u), float(v)


def test_the_page_shows_the_scene_and_the_next_view(live, tab):
    page, _ = live
    tab.open(page.url)
    tab.wait_for_text("View 0")
    first = tab.picture()
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200

    tab.press("next view")
    tab.wait_for_text("View 1")
    tab.wait_for_node("/cameras/1")
    second = tab.picture()
    assert len(page.moments) == 2
    assert (np.abs(second.astype(int) - first).max(axis=-1) > 16).mean() > 0.01

    tab.page.get_by_role("slider").first.press("ArrowLeft")
    tab.wait_for_text("View 0")
    tab.wait_for_node("/cameras/1", there=False)
    back = tab.picture()
    assert (np.abs(back.astype(int) - second).max(axis=-1) > 16).mean() > 0.01


def test_a_click_on_an_object_says_what_falls_without_it(live, tab):
    page, _ = live
    tab.open(page.url)
    crate = page.shown.step.graph["o1"]
    side = crate.centre_world + crate.shape.extents[2] / 4.0 * np.array([0.0, 0.0, -1.0])
    tab.settle()
    tab.page.mouse.click(*pixel_of(page, side, tab))
    tab.wait_for_text("Without o1")
    tab.wait_for_text("falls:")
    assert "o2" in tab.page.locator(".caryatid-cell").last.inner_text()


def test_a_view_is_chosen_by_hand(live, tab):
    page, _ = live
    tab.open(page.url)
    tab.page.get_by_role("checkbox", name="choose the next view by hand").click()
    moment = page.shown.step
    planned = moment.decision.T_world_camera
    facing = np.argmax(moment.candidates.directions @ moment.visited[0])
    eye = moment.candidates.T_world_camera[facing][:3, 3]
    tab.settle()
    tab.page.mouse.click(*pixel_of(page, eye, tab))
    tab.wait_for_text("your view is next")
    tab.press("next view")
    tab.wait_for_text("View 1")
    taken = page.moments[1].step.view.T_world_camera
    assert page.moments[0].by_hand
    assert not np.allclose(taken, planned)
    assert np.linalg.norm(taken[:3, 3] - eye) < 0.2


def test_everything_is_taken_away_in_a_safe_order(live, tab):
    page, _ = live
    tab.open(page.url)
    tab.press("dismantle")
    tab.wait_for_text("a safe order; 2 of 2 taken")
    tab.wait_for_node("/shapes/o1", there=False)
    assert tab.nodes().isdisjoint({"/shapes/o1", "/shapes/o2"})
