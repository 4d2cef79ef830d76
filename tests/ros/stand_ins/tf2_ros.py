"""What the node uses of tf2_ros, which no wheel has: transforms of /tf and /tf_static by time."""

from __future__ import annotations

import threading
import time
from bisect import bisect_left

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from scipy.spatial.transform import Rotation, Slerp
from tf2_msgs.msg import TFMessage

NO_TIME = Duration()


class TransformException(Exception):  # noqa: N818
    """A transform is not known, or not at that time."""


class LookupException(TransformException):
    """A frame is not known."""


class ExtrapolationException(TransformException):
    """A transform is not known at that time."""


class Buffer:
    """Transforms of the last 10 s, by frame."""

    def __init__(self, cache_time=None, node=None) -> None:
        self._news = threading.Condition()
        self._static: dict[str, tuple[str, np.ndarray]] = {}
        self._moving: dict[str, tuple[str, list[tuple[int, np.ndarray]]]] = {}

    def add(self, message: TransformStamped, *, static: bool) -> None:
        """Take a transform."""
        t, q = message.transform.translation, message.transform.rotation
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        T[:3, 3] = t.x, t.y, t.z
        child, parent = message.child_frame_id, message.header.frame_id
        with self._news:
            if static:
                self._static[child] = parent, T
            else:
                stamp = Time.from_msg(message.header.stamp).nanoseconds
                past = self._moving.setdefault(child, (parent, []))[1]
                past.append((stamp, T))
                past.sort(key=lambda entry: entry[0])
                while past[0][0] < past[-1][0] - 10_000_000_000:
                    del past[0]
            self._news.notify_all()

    def lookup_transform(
        self, target_frame: str, source_frame: str, time_: Time, timeout: Duration = NO_TIME
    ) -> TransformStamped:
        """Return target ← source at a time, 0 = the newest that all frames know; wait until it is known."""
        end = time.monotonic() + timeout.nanoseconds * 1e-9
        with self._news:
            while True:
                try:
                    return self._found(target_frame, source_frame, time_.nanoseconds)
                except TransformException:
                    left = end - time.monotonic()
                    if left <= 0.0:
                        raise
                    self._news.wait(left)

    def _found(self, target: str, source: str, stamp: int) -> TransformStamped:
        to, fro = self._chain(target), self._chain(source)
        for frame, chain in ((target, to), (source, fro)):
            if len(chain) == 1 and frame not in self._parents():
                raise LookupException(f'"{frame}" passed to lookupTransform argument does not exist.')
        common = next((frame for frame in fro if frame in to), None)
        if common is None:
            raise LookupException(f"Could not find a connection between '{target}' and '{source}'")
        used = [*to[: to.index(common)], *fro[: fro.index(common)]]
        if stamp == 0:
            stamp = min((self._moving[f][1][-1][0] for f in used if f in self._moving), default=0)
        up, down = np.eye(4), np.eye(4)
        for frame in fro[: fro.index(common)]:
            up = self._at(frame, stamp) @ up
        for frame in to[: to.index(common)]:
            down = self._at(frame, stamp) @ down
        T = np.linalg.inv(down) @ up
        message = TransformStamped()
        message.header.frame_id, message.child_frame_id = target, source
        message.header.stamp = Time(nanoseconds=stamp).to_msg()
        t, q = message.transform.translation, message.transform.rotation
        t.x, t.y, t.z = map(float, T[:3, 3])
        q.x, q.y, q.z, q.w = map(float, Rotation.from_matrix(T[:3, :3]).as_quat())
        return message

    def _parents(self) -> set[str]:
        return {parent for parent, _ in [*self._static.values(), *self._moving.values()]}

    def _chain(self, frame: str) -> list[str]:
        chain = [frame]
        while (link := self._static.get(chain[-1]) or self._moving.get(chain[-1])) is not None:
            chain.append(link[0])
        return chain

    def _at(self, frame: str, stamp: int) -> np.ndarray:
        if frame in self._static:
            return self._static[frame][1]
        past = self._moving[frame][1]
        stamps = [entry[0] for entry in past]
        if stamp > stamps[-1]:
            raise ExtrapolationException("Lookup would require extrapolation into the future.")
        if stamp < stamps[0]:
            raise ExtrapolationException("Lookup would require extrapolation into the past.")
        k = bisect_left(stamps, stamp)
        if stamps[k] == stamp:
            return past[k][1]
        (t0, before), (t1, after) = past[k - 1], past[k]
        share = (stamp - t0) / (t1 - t0)
        T = (1.0 - share) * before + share * after
        turn = Slerp([0.0, 1.0], Rotation.from_matrix([before[:3, :3], after[:3, :3]]))
        T[:3, :3] = turn(share).as_matrix()
        return T


class TransformListener:
    """Fills a buffer from /tf and /tf_static, in the executor of the node, or in a thread of its own."""

    def __init__(self, buffer, node, *, spin_thread=False, qos=None, static_qos=None) -> None:
        kept = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        group = ReentrantCallbackGroup()
        for topic, profile, static in (("/tf", QoSProfile(depth=100), False), ("/tf_static", kept, True)):
            node.create_subscription(
                TFMessage, topic,
                lambda message, static=static: [buffer.add(t, static=static) for t in message.transforms],
                profile, callback_group=group,
            )  # fmt: skip
