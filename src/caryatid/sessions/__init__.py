"""Sessions: a scene model in a folder, updated view by view by a robot's own software."""

from caryatid.sessions.messages import Added, Capture
from caryatid.sessions.session import Session

__all__ = ["Added", "Capture", "Session"]
