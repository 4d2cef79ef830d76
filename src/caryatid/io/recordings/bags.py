"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP) opened, their topics listed, their messages read in order."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from caryatid.errors import CaryatidError, InputError
from caryatid.io.recordings.messages import CAMERA, COMPRESSED, IMAGE, TRANSFORMS

SUFFIXES: Final = (".bag", ".mcap", ".db3")
"""How files that are bags end; a folder with a metadata.yaml is one too."""
_METADATA: Final = "metadata.yaml"
_WANTED: Final = {"--depth": (IMAGE, COMPRESSED), "--rgb": (IMAGE, COMPRESSED), "--info": (CAMERA,)}
_CALLED: Final = {"--depth": "images", "--rgb": "images", "--info": "cameras"}


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag."""
    return path.suffix in SUFFIXES if path.is_file() else (path / _METADATA).is_file()


class Bag:
    """An open bag.

    Args:
        path: The bag: `.bag`, `.mcap`, `.db3`, or a folder with a `metadata.yaml`.
        reader: The open reader of `rosbags`.
    """

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self._reader = reader
        self._types: dict[str, str] = {c.topic: c.msgtype for c in reader.connections}

    def topics(self, types: Collection[str]) -> list[str]:
        """Topics with messages of one of these types, by name."""
        return sorted(topic for topic, kind in self._types.items() if kind in types)

    def require(self, option: str, topic: str | None) -> str:
        """Return a topic that is there and of the type an option wants.

        Args:
            option: `--depth`, `--rgb` or `--info`.
            topic: What the user gave.

        Raises:
            InputError: None was given, it is not there, or of another type; says which topics there are.
        """
        fitting = self.topics(_WANTED[option])
        if topic in fitting:
            return topic
        if topic is None:
            reason = f"{option} TOPIC is needed"
        elif topic in self._types:
            reason = f"{option}: '{topic}' holds {self._types[topic]}, not {_CALLED[option]}"
        else:
            reason = f"{option}: there is no topic '{topic}'"
        others = sorted(set(self._types) - set(fitting))
        listed = f"topics with {_CALLED[option]}: {', '.join(fitting) or 'none'}"
        raise InputError(self.path, reason, f"{listed}; other topics: {', '.join(others) or 'none'}")

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of receipt [ns] and message, in the order of receipt.

        Raises:
            InputError: The bag is damaged.
        """
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        with _damage_said(self.path):
            messages = self._reader.messages(connections=connections)
        while True:
            with _damage_said(self.path):
                item = next(messages, None)
                if item is None:
                    return
                connection, received, data = item
                message = self._reader.deserialize(data, connection.msgtype)
            yield connection.topic, int(received), message

    def transform_topics(self) -> list[tuple[str, bool]]:
        """Topics of transforms, and whether those of a topic hold for all times."""
        return [(topic, topic.endswith("tf_static")) for topic in self.topics(TRANSFORMS)]


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag.

    Raises:
        InputError: `rosbags` is not installed, or the bag is missing, empty, damaged or of no known kind.
    """
    if not path.exists():
        raise InputError(path, "there is no such bag", "give a .bag, .mcap or .db3, or a folder of them")
    if not is_bag(path):
        raise InputError(
            path, "is no bag", f"give a file that ends in {', '.join(SUFFIXES)}, or a bag's folder"
        )
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(path, "reading bags needs rosbags", 'pip install "caryatid[ros]"') from None
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(path, "the bag is empty", "record it again")
    with _damage_said(path):
        # Before ROS 2 Iron sqlite3 bags did not say how messages are laid out; those needed here are alike.
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    try:
        bag = Bag(path, reader)
        if not reader.message_count:
            raise InputError(path, "the bag is empty: it holds no message", "record it again")
        yield bag
    finally:
        reader.close()


@contextmanager
def _damage_said(path: Path) -> Iterator[None]:
    """Say of whatever the library stumbles over that the bag is damaged: it meets bytes no program wrote.

    Raises:
        InputError: In place of any other error.
    """
    try:
        yield
    except CaryatidError:
        raise
    except MemoryError as error:
        reason = "is damaged, or more than this machine's memory holds"
        raise InputError(path, reason, _remedy(path)) from error
    except Exception as error:
        words = " ".join(str(error).split()) or type(error).__name__
        told = words if len(words) <= 120 else words[:119] + "…"
        if "not supported" in words or "Profile" in words:
            remedy = "try a newer version, pip install --upgrade rosbags, or convert the bag"
            raise InputError(path, f"is of a kind rosbags does not read ({told})", remedy) from error
        raise InputError(path, f"is damaged or was cut off ({told})", _remedy(path)) from error


def _remedy(path: Path) -> str:
    match path.suffix:
        case ".bag":
            return "try `rosbag reindex`, or record it again"
        case ".mcap":
            return "try `mcap recover`, or record it again"
    return "try `ros2 bag reindex`, or record it again"
