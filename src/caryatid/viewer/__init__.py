"""The viewer: a page in the browser that shows the scene after each view and controls the loop.

`show` opens one for a `Scene`; `caryatid view` for a run, a scene or a recording. Needs the extra `view`.
"""

from caryatid.viewer.page import show

__all__ = ["show"]
