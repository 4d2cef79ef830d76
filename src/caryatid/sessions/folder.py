"""A session's folder: what it was begun with, and its views, which only ever grow or lose the last one.

    DIR/session.json           what the session was begun with
    DIR/views/NNNNNN/          one view: its images, and camera.json
    DIR/state/NNNNNN.npz       what was made of so many views; may go at any time
    DIR/lock                   locked by who writes

A view's folder appears whole, once it is on the disk, by a rename, and goes by one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, get_args

from caryatid.config import Config, SegmentationMethod
from caryatid.config.settings import changed_settings
from caryatid.errors import InputError
from caryatid.io.json_files import field, read_json
from caryatid.io.staging import said_clearly
from caryatid.robots.registry import HUMANOID
from caryatid.sessions.captures import Capture, Entry, read_entry
from caryatid.sessions.durable import publish_durably, remove_durably, settle, write_durably

FORMAT: Final = "caryatid/session"
VERSION: Final = 1
"""What a session's folder says it is."""


class TakenError(InputError):
    """A folder is there already."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """What a session was begun with.

    Attributes:
        config: All settings.
        segmentation: `labels`, `auto`, or None to use labels where the first view has them.
        seed: Seed of every random choice.
        planner: Name of who chooses the next view.
        robot: Name of who takes it.
    """

    config: Config
    segmentation: SegmentationMethod | None
    seed: int
    planner: str
    robot: str = HUMANOID

    def to_json(self) -> dict[str, Any]:
        """What session.json says."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "segmentation": self.segmentation,
            "seed": self.seed,
            "planner": self.planner,
            "robot": self.robot,
            "settings": asdict(self.config),
        }

    @property
    def digest(self) -> str:
        """What tells it from others."""
        return hashlib.sha256(json.dumps(self.to_json()).encode()).hexdigest()


class SessionFolder:
    """The files of one session; who writes holds its lock.

    Args:
        path: The folder.

    Raises:
        InputError: It holds no session, or one of another version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.beginning = _read_beginning(path / "session.json")
        self.views = path / "views"
        self.state = path / "state"
        self.lock = path / "lock"

    def entries(self) -> list[Entry]:
        """What is known of each view without decoding it, in order.

        Raises:
            InputError: A view is missing or broken.
        """
        names = sorted(path.name for path in self.views.glob("[0-9]*"))
        for number, name in enumerate(names):
            if name != f"{number:06d}":
                raise InputError(
                    self.views, f"holds no view {number:06d}", "put it back, or take the later ones out"
                )
        return [read_entry(self.view(number)) for number in range(len(names))]

    def view(self, number: int) -> Path:
        """Folder of one view, 0 the first."""
        return self.views / f"{number:06d}"

    def append(self, number: int, capture: Capture) -> None:
        """Keep a view; when this returns it is on the disk.

        Raises:
            InputError: The disk is full or refuses; nothing has changed.
        """
        publish_durably(self.view(number), capture.files())

    def drop(self, number: int) -> None:
        """Take away the last view.

        Raises:
            InputError: The disk refuses.
        """
        remove_durably(self.view(number))


def chain(digests: Sequence[str]) -> str:
    """Digest of several views in their order."""
    return hashlib.sha256(" ".join(digests).encode()).hexdigest()


def begin(path: Path, beginning: Beginning) -> SessionFolder:
    """Make the folder of a new session.

    Raises:
        TakenError: The place is taken.
        InputError: Nothing can be written there.
    """
    with said_clearly(path):
        path.mkdir(parents=True, exist_ok=True)
        if (path / "session.json").exists():
            raise TakenError(path, "holds a session already", "use that one, or give another folder")
        if any(
            p.name not in ("views", "state", "lock") and not p.name.startswith(".") for p in path.iterdir()
        ):
            raise TakenError(path, "is there already and holds other files", "give a new folder")
        for name in ("views", "state"):
            (path / name).mkdir(exist_ok=True)
    text = json.dumps(beginning.to_json(), indent=1) + "\n"
    write_durably(path / "session.json", text.encode())
    settle(path.resolve().parent)
    return SessionFolder(path)


def _read_beginning(path: Path) -> Beginning:
    if not path.is_file():
        raise InputError(path.parent, "holds no session", "begin one with `caryatid session new`")
    document = read_json(path)
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(path, f"is no '{FORMAT}' of version {VERSION}", "use the caryatid that wrote it")
    segmentation = field(document, "segmentation", (str, type(None)), str(path))
    if segmentation not in (None, *get_args(SegmentationMethod)):
        raise InputError(path, f"'segmentation' is '{segmentation}'", "use labels, auto or null")
    seed = field(document, "seed", int, str(path))
    if seed < 0:
        raise InputError(path, f"'seed' is {seed}", "give 0 or more")
    settings = changed_settings(Config(), field(document, "settings", dict, str(path)), str(path))
    planner, robot = (field(document, key, str, str(path)) for key in ("planner", "robot"))
    return Beginning(settings, segmentation, seed, planner, robot)
