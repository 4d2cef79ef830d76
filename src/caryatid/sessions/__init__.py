"""Sessions: a scene model in a folder, updated view by view with what a robot's own software hands in."""

from caryatid.sessions.captures import Capture
from caryatid.sessions.session import Added, Session

__all__ = ["Added", "Capture", "Session"]
