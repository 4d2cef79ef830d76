"""Chromium, and a viewer's page in it: what a person would see, press and click."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlparse

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.geometry import transforms
from caryatid.viz.report import find_chromium

ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


@contextmanager
def chromium() -> Iterator[Any]:
    """Chromium, as playwright gives it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=find_chromium(), args=ARGUMENTS)
        yield browser
        browser.close()


class Tab:
    """A page in Chromium, cut off from all but this machine; its errors, and the hosts it wanted to ask."""

    def __init__(self, page: Any) -> None:
        self.page, self.errors, self.hosts = page, [], set()
        page.set_default_timeout(60_000)  # Machines may be loaded [ms].
        page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("websocket", lambda socket: self.hosts.add(urlparse(socket.url).hostname))
        page.route("**/*", self._asked)

    def _asked(self, route: Any) -> None:
        address = urlparse(route.request.url)
        if address.scheme not in ("blob", "data"):
            self.hosts.add(address.hostname)
            if address.hostname != "127.0.0.1":
                route.abort()
                return
        route.continue_()

    def open(self, url: str, resolution: float = 0.5) -> None:
        """Go to a viewer's page, at half resolution since it is drawn in software, and wait for its scene."""
        self.page.goto(f"{url}?fixedDpr={resolution}")
        self.page.wait_for_selector("canvas")
        self.wait_for_node("/shapes/o1")
        self.page.locator("#webgl-software-rendering button").click()

    def wait_for_node(self, name: str, there: bool = True) -> None:
        """Wait until the scene has, or has no longer, something of this name."""
        test = f"({name!r} in (window.__viserSceneTree?.getState() ?? {{}})) === {str(there).lower()}"
        self.page.wait_for_function(test)

    def wait_for_text(self, text: str) -> None:
        """Wait until the page says something."""
        self.page.get_by_text(text).first.wait_for()

    def press(self, label: str) -> None:
        """Press a button."""
        self.page.get_by_role("button", name=label, exact=True).click()

    def settle(self) -> None:
        """Let two pictures be drawn."""
        drawn = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
        self.page.evaluate(drawn)

    def pixel(self, page: Any, point_world: Any) -> tuple[float, float]:
        """Where a point of the world is in the window [px]."""
        self.settle()
        (client,) = page.server.get_clients().values()
        rotation = Rotation.from_quat(client.camera.wxyz, scalar_first=True).as_matrix()
        T_world_camera = transforms.rigid(rotation, client.camera.position)
        x, y, z = transforms.transform(transforms.invert(T_world_camera), point_world[None])[0]
        box = self.page.locator("canvas").first.bounding_box()
        focal = box["height"] / 2.0 / np.tan(client.camera.fov / 2.0)
        middle = box["x"] + box["width"] / 2.0, box["y"] + box["height"] / 2.0
        return float(middle[0] + focal * x / z), float(middle[1] + focal * y / z)

    def click(self, page: Any, point_world: Any) -> None:
        """Click where a point of the world is in the window."""
        self.page.mouse.click(*self.pixel(page, point_world))
