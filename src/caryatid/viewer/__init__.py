"""The viewer: a page in the browser that shows what is known after each view, and works the loop.

`show` opens one for a `Scene`; `caryatid view` for a run, a scene or a recording. Needs the extra `view`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from caryatid.scene import Scene
    from caryatid.viewer.page import Page

__all__ = ["show"]


def show(scene: Scene, *, host: str = "127.0.0.1", port: int = 0) -> Page:
    """Open a page that shows what a scene knows.

    Args:
        scene: Of any number of views.
        host: Address to listen at; at 127.0.0.1 only programs on this machine can connect.
        port: Port to listen at, or the next free one; 0 = any that is free.

    Returns:
        The page with its `url`, `update(scene)` and `close()`; within a notebook it shows itself.

    Raises:
        InputError: viser is not installed.
    """
    from caryatid.viewer.page import Page

    page = Page("caryatid", scene.config.support, host=host, port=port, small=True)
    page.update(scene)
    return page
