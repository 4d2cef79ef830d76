"""What a recording of any kind offers: all its frames at a glance, and those that are wanted as views."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.sensing.views import View

NO_COLOUR = "no colour image of that time"
NO_POSE = "no pose"
BROKEN = "broken"
DARK = "hardly any depth"
BLURRED = "blurred"
ALIKE = "seen from where another view is"
SPARE = "more than are wanted"
"""Why a frame does not become a view."""

SCALES = (0.1, 0.2, 0.5, 1.0)
"""Units depth is written in [mm]: the finest that reaches far enough."""


T = TypeVar("T", bound="Timed")


@dataclass(frozen=True, eq=False, slots=True)
class Shot:
    """A frame that could become a view.

    Attributes:
        number: Which depth image of the recording it is, from 0.
        time: When it was taken [ns].
        sharpness: How sharp it is; only ratios within a recording count.
        T_world_camera: Pose (4, 4), or None where poses are not known.
    """

    number: int
    time: int
    sharpness: float
    T_world_camera: Array | None


@dataclass(frozen=True, eq=False, slots=True)
class Shots:
    """All frames of a recording.

    Attributes:
        usable: Those that could become views, in the order of time.
        read: Depth images there are.
        skipped: How many cannot become views, by reason.
        depth_scale: Millimetres that a unit of written depth is to have.
        notes: What a person should know.
    """

    usable: tuple[Shot, ...]
    read: int
    skipped: Mapping[str, int]
    depth_scale: float
    notes: tuple[str, ...] = ()

    @property
    def times(self) -> Array:
        """When the usable ones were taken, since the first (N,) [s]."""
        return np.array([(shot.time - self.usable[0].time) * 1e-9 for shot in self.usable])


@dataclass(slots=True)
class Sieve:
    """Frames as they are looked through: those that are usable, and the others by reason.

    Attributes:
        usable: Frames that could become views.
        skipped: How many cannot, by reason.
    """

    usable: list[Shot] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)

    def shots(self, read: int, depth_scale: float, notes: Sequence[str]) -> Shots:
        """All that was seen, in the order of time."""
        usable = tuple(sorted(self.usable, key=lambda shot: (shot.time, shot.number)))
        return Shots(usable, read, dict(self.skipped), depth_scale, tuple(notes))


class Timed(Protocol):
    """Something of a time [ns]."""

    @property
    def time(self) -> int:
        """When [ns]."""
        ...


class Timeline(Generic[T]):
    """Things in the order of time, found by it.

    Args:
        items: In any order.
    """

    def __init__(self, items: Iterable[T]) -> None:
        self.items = sorted(items, key=lambda item: item.time)
        self._times = [item.time for item in self.items]

    def at(self, time: int) -> T | None:
        """The thing whose time is nearest, of two as near the earlier one; None where there is nothing."""
        after = bisect_left(self._times, time)
        around = self.items[max(after - 1, 0) : after + 1]
        return min(around, key=lambda item: abs(item.time - time), default=None)


class Footage(Protocol):
    """A recording whose frames are looked through before some are decoded for good.

    Attributes:
        path: Where it is.
    """

    path: Path

    def look_through(self) -> Shots:
        """Find all frames.

        Raises:
            InputError: The recording is damaged, or something in it does not fit.
        """
        ...

    def load(self, shots: Sequence[Shot]) -> Iterator[View]:
        """Decode frames, in the order given."""
        ...


def within(depth: NDArray[np.float32], far: float) -> NDArray[np.float32]:
    """Depth (H, W) [m] without readings farther away than `far` [m]."""
    return np.where(depth <= far, depth, np.float32(0.0))


def finest_scale(reach: float) -> float:
    """Millimetres of the finest unit of depth with which 16 bits reach as far as wanted [m]."""
    return next((scale for scale in SCALES if reach <= scale * 65.535), SCALES[-1])
