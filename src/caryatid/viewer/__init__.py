"""The viewer: a page in the browser that shows what is known after each view, and works the loop.

`show` opens one for a `Scene`; `caryatid view` for a run, a scene or a recording. Needs the extra `view`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime.late import imported_late

if TYPE_CHECKING:
    from caryatid.viewer.page import Page
    from caryatid.viewer.showing import Shown, show

__all__ = ["Page", "Shown", "show"]

if not TYPE_CHECKING:
    __getattr__ = imported_late(__name__, {"page": ["Page"], "showing": ["Shown", "show"]})


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
