"""What arrives from the camera: depth images, colour images and camera info, matched by their stamps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

from caryatid.errors import InputError

KEPT = 10
"""Images of a topic that wait for a transform or for the other image [1]: a third of a second at 30 Hz."""


def seconds_of(stamp: Any) -> float:
    """Time [s] of a builtin_interfaces/Time."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


class Inbox:
    """The newest messages of the camera's topics; one thread may put them in while another reads.

    Args:
        topics: Names of the topics of `depth`, `info` and, unless there is none, `colour`.
        info: The newest camera info, which holds until the next one, or None.
    """

    def __init__(self, topics: Mapping[str, str], info: Any = None) -> None:
        self._topics, self._counts = topics, dict.fromkeys(topics, 0)
        self._known: dict[str, deque[Any]] = {what: deque(maxlen=KEPT) for what in topics}
        self._known["info"].extend([] if info is None else [info])

    def put(self, what: str, message: Any) -> None:
        """Put in a message of `depth`, `info` or `colour`."""
        self._counts[what] += 1
        self._known[what].append(message)

    def views(self, since: float, slop: float) -> Iterator[tuple[Any, Any, Any]]:
        """Depth image, camera info, and colour image or None, of views not older than a time [s].

        The newest come first. Stamps of two images differ by at most `slop` [s].

        Raises:
            InputError: There are none; the error says which topic is the cause.
        """
        depths, infos, colours = (list(self._known.get(what, ())) for what in ("depth", "info", "colour"))
        for what, topic in self._topics.items():
            if not self._known[what]:
                told = ", ".join(f"{self._counts[w]} on {t}" for w, t in self._topics.items() if w != what)
                reason = f"no message arrived, but {told}"
                raise InputError(topic, reason, "check the topic's name, type and publisher")
        topic, newest = self._topics["depth"], depths[-1]
        _check_frames(newest, infos[-1], "camera info")
        if (age := since - seconds_of(newest.header.stamp)) > 0.0:
            reason = f"its newest image is {age:.3f} s older than the goal or the arrival of the camera"
            raise InputError(topic, reason, "check the camera, its clock, and use_sim_time")
        if colours:
            _check_frames(newest, colours[-1], "colour image")
        apart = float("inf")
        for depth in reversed(depths):
            time = seconds_of(depth.header.stamp)
            if time < since:
                break
            gaps = [abs(seconds_of(colour.header.stamp) - time) for colour in colours]
            apart = min([apart, *gaps])
            if not colours or min(gaps) <= slop:
                yield depth, infos[-1], colours[gaps.index(min(gaps))] if colours else None
        if colours and apart > slop:
            reason = f"stamps of depth and colour images differ by {apart:.3f} s or more"
            raise InputError(topic, reason, f"synchronise the images, or raise slop, which is {slop:g} s")


def _check_frames(depth: Any, other: Any, name: str) -> None:
    frames = depth.header.frame_id, other.header.frame_id
    if all(frames) and frames[0] != frames[1]:
        reason = f"has frame '{frames[1]}', the depth image has '{frames[0]}'"
        raise InputError(name, reason, "use depth that is registered to colour, and the info of these images")
