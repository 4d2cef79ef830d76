"""Sessions: a scene model that grows view by view as a robot's own software gives them, kept in a folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime.late import imported_late

if TYPE_CHECKING:
    from caryatid.sessions.captures import Capture
    from caryatid.sessions.session import Added, Session

__all__ = ["Added", "Capture", "Session"]

if not TYPE_CHECKING:
    __getattr__ = imported_late(__name__, {"captures": ["Capture"], "session": ["Added", "Session"]})
