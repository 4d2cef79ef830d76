"""The viewer: a page in the browser that shows what is known after each view, and works the loop.

`show` opens one for a `Scene`; `caryatid view` for a run, a scene or a recording. Needs the extra `view`.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from caryatid.scene import Scene
    from caryatid.viewer.page import Page

__all__ = ["Shown", "show"]


@dataclass(frozen=True, slots=True)
class Shown:
    """A page that shows a scene, until it is closed.

    Attributes:
        url: Where it is.
        page: The page.
    """

    url: str
    page: Page

    def update(self, scene: Scene) -> None:
        """Add what a scene knows by now; the page's slider goes back to what it knew before."""
        from caryatid.viewer.drawing import moment_of_scene

        if scene.views:
            self.page.add(moment_of_scene(scene))

    def close(self) -> None:
        """Stop serving the page."""
        self.page.close()

    def _repr_html_(self) -> str:
        source = escape(self.url, quote=True)
        return f'<iframe src="{source}" width="100%" height="620" style="border:0"></iframe>'


def show(scene: Scene, *, host: str = "127.0.0.1", port: int = 0) -> Shown:
    """Open a page that shows what a scene knows.

    Args:
        scene: Of any number of views.
        host: Address to listen at; at 127.0.0.1 only programs on this machine can connect.
        port: Port to listen at, or the next free one; 0 = any that is free.

    Returns:
        A handle with the page's `url`; within a notebook it shows itself.

    Raises:
        InputError: viser is not installed.
    """
    from caryatid.viewer.page import Page

    page = Page("caryatid", scene.config.support, host=host, port=port, small=True)
    shown = Shown(page.url, page)
    shown.update(scene)
    return shown
