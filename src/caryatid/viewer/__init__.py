"""The viewer: a page in the browser that shows what is known after each view, and works the loop.

`show` opens one for a `Scene`; `caryatid view` for a run, a scene or a recording. Needs the extra `view`.
"""

from caryatid.viewer.page import show

__all__ = ["show"]
