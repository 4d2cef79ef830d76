"""Sessions: a scene model in a folder, updated view by view by a robot's own software."""

from caryatid.sessions.captures import Capture
from caryatid.sessions.session import Added, Session

__all__ = ["Added", "Capture", "Session"]
