"""The viewer in a real browser: what a person would see and press, one thing after the other in one page."""

from __future__ import annotations

import io
import os
import shutil
from functools import partial
from urllib.parse import urlparse

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from caryatid.geometry import transforms
from caryatid.sources import open_source
from caryatid.viewer.loop import LoopPage

pytestmark = pytest.mark.slow

pytest.importorskip("viser")
playwright = pytest.importorskip("playwright.sync_api")

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
"""What the program is called, in order of preference; the environment's CHROMIUM goes before."""
ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


class Tab:
    """A page in Chromium, cut off from all but this machine; its errors, and the hosts it wanted to ask."""

    def __init__(self, page):
        self.page, self.errors, self.hosts = page, [], set()
        page.set_default_timeout(60_000)  # Machines may be loaded [ms].
        page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("websocket", lambda socket: self.hosts.add(urlparse(socket.url).hostname))
        page.route("**/*", self._asked)

    def _asked(self, route):
        address = urlparse(route.request.url)
        if address.scheme not in ("blob", "data"):
            self.hosts.add(address.hostname)
            if address.hostname != "127.0.0.1":
                route.abort()
                return
        route.continue_()

    def open(self, url):
        """Go to a viewer's page, at half resolution since it is drawn in software, and wait for its scene."""
        self.page.goto(f"{url}?fixedDpr=0.5")
        self.page.wait_for_selector("canvas")
        self.wait_for_node("/shapes/o1")
        self.page.locator("#webgl-software-rendering button").click()

    def wait_for_node(self, name, there=True):
        """Wait until the scene has, or has no longer, something of this name."""
        test = f"({name!r} in (window.__viserSceneTree?.getState() ?? {{}})) === {str(there).lower()}"
        self.page.wait_for_function(test)

    def wait_for_text(self, text):
        """Wait until the page says something."""
        self.page.get_by_text(text).first.wait_for()

    def press(self, label):
        """Press a button."""
        self.page.get_by_role("button", name=label, exact=True).click()

    def settle(self):
        """Let two pictures be drawn."""
        drawn = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
        self.page.evaluate(drawn)

    def picture(self):
        """The scene as pixels (H, W, 3): what the canvas shows, without the panels."""
        self.settle()
        box = self.page.locator("canvas").first.bounding_box()
        shot = Image.open(io.BytesIO(self.page.screenshot(clip=box)))
        return np.asarray(shot.convert("RGB"), dtype=np.uint8)


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
    program = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        if os.environ.get("CI"):
            pytest.fail("there is no Chromium: `make chromium` installs it")
        pytest.skip("there is no Chromium")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=program, args=ARGUMENTS)
        tab = Tab(browser.new_page(viewport={"width": 1280, "height": 720}))
        tab.open(page.url)
        yield tab
        browser.close()
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
    crate = page.steps[-1].graph["o1"]
    click(page, crate.centre_world - (0.0, 0.0, crate.shape.extents[2] / 4.0), tab)
    tab.wait_for_text("Without o1")
    tab.wait_for_text("falls:")
    assert "o2" in tab.page.locator(".caryatid-cell").last.inner_text()


def test_the_page_shows_the_next_view_and_goes_back(page, tab):
    first, number = tab.picture(), len(page.steps)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200
    tab.press("next view")
    tab.wait_for_text(f"View {number}")
    tab.wait_for_node(f"/cameras/{number}")
    second = tab.picture()
    assert len(page.steps) == number + 1
    assert (np.abs(second.astype(int) - first).max(axis=-1) > 16).mean() > 0.01

    tab.page.get_by_role("slider").first.press("ArrowLeft")
    tab.wait_for_text(f"View {number - 1}")
    tab.wait_for_node(f"/cameras/{number}", there=False)
    assert (np.abs(tab.picture().astype(int) - second).max(axis=-1) > 16).mean() > 0.01
    tab.page.get_by_role("slider").first.press("ArrowRight")
    tab.wait_for_node(f"/cameras/{number}")


def test_a_view_is_chosen_by_hand(page, tab):
    number, step = len(page.steps), page.steps[-1]
    client = next(iter(page.server.get_clients().values()))
    towards_eye = transforms.unit(client.camera.position - step.sphere.centre_world)
    facing = np.argmax(step.candidates.directions @ towards_eye)
    eye = step.candidates.T_world_camera[facing][:3, 3]
    tab.page.get_by_role("checkbox", name="choose the next view by hand").click()
    click(page, eye, tab)
    tab.wait_for_text("your view is next")
    tab.press("next view")
    tab.wait_for_text(f"View {number}")
    taken = page.steps[number].view.T_world_camera
    assert page.steps[number - 1].decision.why == "chosen by hand"
    assert not np.allclose(taken, step.decision.T_world_camera)
    assert np.linalg.norm(taken[:3, 3] - eye) < 0.2


def test_everything_is_taken_away_in_a_safe_order(page, tab):
    tab.press("dismantle")
    tab.wait_for_text("a safe order; 2 of 2 taken")
    tab.wait_for_node("/shapes/o1", there=False)
    tab.wait_for_node("/shapes/o2", there=False)
