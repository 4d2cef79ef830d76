"""The viewer in a real browser: what a person would see and press, one thing after the other in one page."""

from __future__ import annotations

import os
from functools import partial

import numpy as np
import pytest
from chromium import chromium, opened
from scipy.spatial.transform import Rotation

from caryatid.geometry import transforms
from caryatid.sources import open_source
from caryatid.viewer.loop import LoopPage

pytestmark = pytest.mark.slow

pytest.importorskip("viser")
pytest.importorskip("playwright")


@pytest.fixture(scope="module")
def page(scene_file, settings):
    """The page of a loop on two objects, its first view taken."""
    opening = partial(open_source, str(scene_file), noise="none", segmentation="labels", seed=0)
    page = LoopPage(opening, settings, segmentation="labels")
    page.start()
    page.wait()
    yield page
    page.close()


@pytest.fixture(scope="module")
def tab(page):
    """The page in Chromium; whatever a test does, no error is logged and nothing leaves this machine."""
    if chromium() is None:
        if os.environ.get("CI"):
            pytest.fail("there is no Chromium: `make chromium` installs it")
        pytest.skip("there is no Chromium")
    with opened() as tab:
        tab.open(page.url)
        yield tab
        assert tab.errors == []
        assert tab.hosts == {"127.0.0.1"}


def click(page, point_world, tab):
    """Click where a point of the world is in the window."""
    tab.settle()
    (client,) = page.server.get_clients().values()
    rotation = Rotation.from_quat(client.camera.wxyz, scalar_first=True).as_matrix()
    T_world_camera = transforms.rigid(rotation, client.camera.position)
    x, y, z = transforms.transform(transforms.invert(T_world_camera), point_world[None])[0]
    box = tab.page.locator("canvas").first.bounding_box()
    focal = box["height"] / 2.0 / np.tan(client.camera.fov / 2.0)
    middle = box["x"] + box["width"] / 2.0, box["y"] + box["height"] / 2.0
    tab.page.mouse.click(float(middle[0] + focal * x / z), float(middle[1] + focal * y / z))


def test_a_click_on_an_object_says_what_falls_without_it(page, tab):
    crate = page.shown.step.graph["o1"]
    click(page, crate.centre_world - (0.0, 0.0, crate.shape.extents[2] / 4.0), tab)
    tab.wait_for_text("Without o1")
    tab.wait_for_text("falls:")
    assert "o2" in tab.page.locator(".caryatid-cell").last.inner_text()


def test_the_page_shows_the_next_view_and_goes_back(page, tab):
    first, number = tab.picture(), len(page.moments)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200
    tab.press("next view")
    tab.wait_for_text(f"View {number}")
    tab.wait_for_node(f"/cameras/{number}")
    second = tab.picture()
    assert len(page.moments) == number + 1
    assert (np.abs(second.astype(int) - first).max(axis=-1) > 16).mean() > 0.01

    tab.page.get_by_role("slider").first.press("ArrowLeft")
    tab.wait_for_text(f"View {number - 1}")
    tab.wait_for_node(f"/cameras/{number}", there=False)
    assert (np.abs(tab.picture().astype(int) - second).max(axis=-1) > 16).mean() > 0.01
    tab.page.get_by_role("slider").first.press("ArrowRight")
    tab.wait_for_node(f"/cameras/{number}")


def test_a_view_is_chosen_by_hand(page, tab):
    number, step = len(page.moments), page.moments[-1].step
    client = next(iter(page.server.get_clients().values()))
    towards_eye = transforms.unit(client.camera.position - step.sphere.centre_world)
    facing = np.argmax(step.candidates.directions @ towards_eye)
    eye = step.candidates.T_world_camera[facing][:3, 3]
    tab.page.get_by_role("checkbox", name="choose the next view by hand").click()
    click(page, eye, tab)
    tab.wait_for_text("your view is next")
    tab.press("next view")
    tab.wait_for_text(f"View {number}")
    taken = page.moments[number].step.view.T_world_camera
    assert page.moments[number - 1].step.decision.why == "chosen by hand"
    assert not np.allclose(taken, step.decision.T_world_camera)
    assert np.linalg.norm(taken[:3, 3] - eye) < 0.2


def test_everything_is_taken_away_in_a_safe_order(page, tab):
    tab.press("dismantle")
    tab.wait_for_text("a safe order; 2 of 2 taken")
    tab.wait_for_node("/shapes/o1", there=False)
    tab.wait_for_node("/shapes/o2", there=False)
