"""What arrives from the camera: depth and colour images, camera info and masks, matched by their stamps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

from caryatid.errors import InputError

KEPT, KEPT_FOR_MASKS = 10, 60
"""Images that wait for a transform or for the other images, or for masks [1]: 0.3 s and 2 s at 30 Hz."""
NOUNS = {"colour": "colour images", "masks": "masks"}
"""What messages call the images that are matched with depth."""


def seconds_of(stamp: Any) -> float:
    """Time [s] of a builtin_interfaces/Time."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


class Inbox:
    """The newest messages of the camera's topics; one thread may put them in while another reads.

    Args:
        topics: Names of the topics of `depth`, `info` and, unless there is none, `colour` and `masks`.
        info: The newest camera info, which holds until the next one, or None.
    """

    def __init__(self, topics: Mapping[str, str], info: Any = None) -> None:
        self._topics, self._counts = topics, dict.fromkeys(topics, 0)
        kept = KEPT_FOR_MASKS if "masks" in topics else KEPT
        self._known: dict[str, deque[Any]] = {what: deque(maxlen=kept) for what in topics}
        self._known["info"].extend([] if info is None else [info])

    def put(self, what: str, message: Any) -> None:
        """Put in a message of `depth`, `info`, `colour` or `masks`."""
        self._counts[what] += 1
        self._known[what].append(message)

    def views(self, since: float, slop: float) -> Iterator[tuple[Any, Any, dict[str, Any]]]:
        """Depth image, camera info, and `colour` and `masks`, of views not older than a time [s].

        The newest come first. Their stamps differ from that of the depth image by at most `slop` [s].

        Raises:
            InputError: There are none; the error says which topic is the cause.
        """
        known = {what: list(messages) for what, messages in self._known.items()}
        for what, topic in self._topics.items():
            if not known[what]:
                told = ", ".join(f"{self._counts[w]} on {t}" for w, t in self._topics.items() if w != what)
                reason = f"no message arrived, but {told}"
                raise InputError(topic, reason, "check the topic's name, type and publisher")
        depths, info = known.pop("depth"), known.pop("info")[-1]
        topic, newest = self._topics["depth"], depths[-1]
        _check_frames(newest, info, "camera info")
        if (age := since - seconds_of(newest.header.stamp)) > 0.0:
            reason = f"its newest image is {age:.3f} s older than the goal or the arrival of the camera"
            raise InputError(topic, reason, "check the camera, its clock, and use_sim_time")
        if "colour" in known:
            _check_frames(newest, known["colour"][-1], "colour image")
        apart = dict.fromkeys(known, float("inf"))
        for depth in reversed(depths):
            time = seconds_of(depth.header.stamp)
            if time < since:
                break
            gaps = {w: [abs(seconds_of(m.header.stamp) - time) for m in known[w]] for w in known}
            apart = {w: min(apart[w], *gaps[w]) for w in known}
            if all(min(gaps[w]) <= slop for w in known):
                yield depth, info, {w: known[w][gaps[w].index(min(gaps[w]))] for w in known}
        for what, gap in apart.items():
            if gap > slop:
                reason = f"stamps of depth and {NOUNS[what]} differ by {gap:.3f} s or more"
                raise InputError(topic, reason, f"synchronise them, or raise slop, which is {slop:g} s")


def _check_frames(depth: Any, other: Any, name: str) -> None:
    frames = depth.header.frame_id, other.header.frame_id
    if all(frames) and frames[0] != frames[1]:
        reason = f"has frame '{frames[1]}', the depth image has '{frames[0]}'"
        raise InputError(name, reason, "use depth that is registered to colour, and the info of these images")
