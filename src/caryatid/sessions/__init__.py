"""Sessions: a scene model in a folder, updated view by view with what a robot's own software hands in."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime.late import imported_late

if TYPE_CHECKING:
    from caryatid.sessions.captures import Capture
    from caryatid.sessions.session import Added, Session

__all__ = ["Added", "Capture", "Session"]

if not TYPE_CHECKING:
    __getattr__ = imported_late(__name__, {"captures": ["Capture"], "session": ["Added", "Session"]})
