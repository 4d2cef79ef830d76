"""A headless Chromium for tests of the viewer, cut off from all but this machine."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlparse

import numpy as np
from numpy.typing import NDArray
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
"""What the program is called, in order of preference; the environment's CHROMIUM goes before."""
ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


def chromium() -> str | None:
    """Where Chromium is, or None."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


class Tab:
    """A page in Chromium, and what it did.

    Attributes:
        page: Playwright's.
        errors: What its console called an error, and what nobody caught.
        hosts: What it asked, or wanted to.
    """

    def __init__(self, page: Any) -> None:
        self.page = page
        self.errors: list[str] = []
        self.hosts: set[str | None] = set()
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

    def open(self, url: str) -> None:
        """Go to a viewer's page, at half resolution since it is drawn in software, and wait for its scene."""
        self.page.goto(f"{url}?fixedDpr=0.5")
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

    def picture(self) -> NDArray[np.uint8]:
        """The scene as pixels (H, W, 3): what the canvas shows, without the panels."""
        self.settle()
        box = self.page.locator("canvas").first.bounding_box()
        shot = Image.open(io.BytesIO(self.page.screenshot(clip=box)))
        return np.asarray(shot.convert("RGB"), dtype=np.uint8)


@contextmanager
def opened() -> Iterator[Tab]:
    """A tab in a Chromium that was never used before."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=ARGUMENTS)
        try:
            yield Tab(browser.new_page(viewport={"width": 1280, "height": 720}))
        finally:
            browser.close()
