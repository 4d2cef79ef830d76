"""Pictures of the viewer for its page in the documentation, as a real browser shows it.

python benchmarks/pictures/viewer.py docs/pictures

They are what a real browser shows.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from browser import Tab, browser

from caryatid.config import Config
from caryatid.sources import open_source
from caryatid.viewer.controls import Controls
from caryatid.viewer.loop import Loop
from caryatid.viewer.page import Page

SIZE = (1360, 800)
"""Of the window [px]."""
LARGEST = 300_000
"""A picture may take [bytes]."""


@contextmanager
def worked(scene: str) -> Iterator[tuple[Page, Controls]]:
    """A page with a loop on a scene, its first view taken."""
    config = Config()
    opening = partial(open_source, scene, noise="carmine", segmentation="auto", seed=0)
    page = Page(f"caryatid: {scene}", config.support)
    controls = Controls(page, Loop(opening, config, segmentation="auto"))
    controls.start()
    controls.wait()
    try:
        yield page, controls
    finally:
        controls.close()
        page.close()


def save(tab: Tab, path: Path) -> None:
    """Save what the tab shows, in 255 colours.

    Raises:
        ValueError: The picture is too large.
    """
    tab.page.mouse.move(SIZE[0] / 2, 5)
    tab.page.wait_for_timeout(2500)
    shot = Image.open(io.BytesIO(tab.page.screenshot())).convert("RGB")
    shot.quantize(255, dither=Image.Dither.NONE).save(path, optimize=True)
    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path} takes {path.stat().st_size} bytes, more than {LARGEST}")
    print(f"{path}: {path.stat().st_size // 1000} kB")


def main() -> int:
    """Make the pictures."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures")
    with (
        TemporaryDirectory() as data,
        browser(Path(data), SIZE) as tab,
        worked("clutter") as (page, controls),
    ):
        tab.open(page.url, resolution=1.0)
        for _ in range(2):
            controls.next_view()
            controls.wait()
        tab.wait_for_text("View 2")
        save(tab, folder / "viewer-loop.png")
        page.choose("o9")
        page.wait()
        for layer in ("cloud", "sphere", "interest"):
            page.canvas.show_layer(layer, False)
        page.look_from((-0.7, -0.85, 1.25), (0.03, 0.0, 0.8))
        tab.wait_for_text("Without o9")
        save(tab, folder / "viewer-object.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
