"""Moments from one process to another: an npz of plain arrays each, with a JSON document among them."""

from __future__ import annotations

import io
import json
from dataclasses import asdict
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from caryatid.io.graph_json import graph_from_json, graph_to_json
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.robots import Posture
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.viewer.moments import Dots, Moment, Shot, Standing

LENGTH = 8
"""Bytes that say how long what follows is [1]."""

Arrays = dict[str, NDArray[Any]]


class MomentWriter:
    """Writes moments; arrays that are those of the last moment are not written again.

    Args:
        stream: Takes bytes.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._before: Arrays = {}

    def write(self, moment: Moment) -> None:
        """Write a moment.

        Raises:
            OSError: Nobody reads.
        """
        document, arrays = _taken_apart(moment)
        document["again"] = [name for name, array in arrays.items() if self._before.get(name) is array]
        sent = {name: array for name, array in arrays.items() if name not in document["again"]}
        self._before = arrays
        buffer = io.BytesIO()
        text = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
        np.savez(buffer, allow_pickle=False, document=text, **sent)
        data = buffer.getbuffer()
        self._stream.write(len(data).to_bytes(LENGTH, "little"))
        self._stream.write(data)
        self._stream.flush()


class MomentReader:
    """Reads what a `MomentWriter` writes.

    Args:
        stream: Gives bytes.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._before: Arrays = {}

    def read(self) -> Moment | None:
        """Read the next moment; None where there is none any more."""
        length = self._stream.read(LENGTH)
        data = self._stream.read(int.from_bytes(length, "little"))
        if len(length) < LENGTH or len(data) < int.from_bytes(length, "little"):
            return None
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = dict(archive)
        document = json.loads(arrays.pop("document").tobytes())
        arrays |= {name: self._before[name] for name in document["again"]}
        self._before = arrays
        return _put_together(document, arrays)


def _taken_apart(moment: Moment) -> tuple[dict[str, Any], Arrays]:
    """A moment as a document and arrays, without what is not drawn."""
    document: dict[str, Any] = {
        "index": moment.index,
        "name": moment.name,
        "graph": graph_to_json(moment.graph),
        "score": moment.score,
        "stop": moment.stop,
        "by_hand": moment.by_hand,
        "seconds": moment.seconds,
    }
    arrays: Arrays = {"visited": moment.visited}
    if moment.dots is not None:
        arrays |= {"points": moment.dots.points_world, "labels": moment.dots.labels}
        if moment.dots.rgb is not None:
            arrays["rgb"] = moment.dots.rgb
    if moment.shot is not None:
        document["lens"] = [moment.shot.field_of_view, moment.shot.aspect]
        arrays["shot"] = moment.shot.T_world_camera
        if moment.shot.picture is not None:
            arrays["picture"] = moment.shot.picture
    if moment.sphere is not None:
        document["radius"] = moment.sphere.radius
        arrays |= {"centre": moment.sphere.centre_world, "sphere": moment.sphere.directions}
    if moment.candidates is not None:
        arrays["reachable"] = moment.candidates.directions
    if moment.decision is not None:
        d = moment.decision
        points = [asdict(p) for p in d.points_of_interest]
        for point in points:
            point["position_world"], point["direction"] = (
                point[key].tolist() for key in ("position_world", "direction")
            )
        document["decision"] = [d.index, d.saliency, d.cost, d.score, d.why, points]
        arrays["next"] = d.T_world_camera
        if d.candidate_saliency is not None:
            arrays["saliency"] = d.candidate_saliency
    if moment.robot is not None:
        r = moment.robot
        document["robot"] = [
            r.posture.camera_height, r.posture.head_yaw, r.posture.head_pitch, r.platform, r.arm,
        ]  # fmt: skip
        arrays |= {"platform": r.posture.platform_world, "robot": r.T_world_camera}
    return document, arrays


def _put_together(document: dict[str, Any], arrays: Arrays) -> Moment:
    dots = shot = sphere = candidates = decision = robot = None
    if "points" in arrays:
        dots = Dots(arrays["points"], arrays["labels"], arrays.get("rgb"))
    if "shot" in arrays:
        field_of_view, aspect = document["lens"]
        shot = Shot(arrays["shot"], field_of_view, aspect, arrays.get("picture"))
    if "sphere" in arrays:
        sphere = ViewSphere(arrays["centre"], document["radius"], arrays["sphere"])
    if "reachable" in arrays:
        directions = arrays["reachable"]
        nowhere = np.broadcast_to(np.eye(4), (len(directions), 4, 4))
        candidates = Candidates(nowhere, directions, np.zeros(len(directions)), {})
    if "decision" in document:
        index, saliency, cost, score, why, points = document["decision"]
        for point in points:
            point["position_world"] = np.array(point["position_world"])
            point["direction"] = np.array(point["direction"])
            point["subject"] = tuple(point["subject"])
        interest = tuple(PointOfInterest(**point) for point in points)
        rated = arrays.get("saliency")
        decision = Decision(arrays["next"], index, saliency, cost, score, why, interest, rated)
    if "robot" in document:
        height, yaw, pitch, platform, arm = document["robot"]
        posture = Posture(arrays["platform"], height, yaw, pitch)
        robot = Standing(posture, arrays["robot"], platform, arm)
    return Moment(
        document["index"],
        document["name"],
        graph_from_json(document["graph"], "moment"),
        dots,
        shot,
        sphere,
        arrays["visited"],
        candidates,
        decision,
        robot,
        document["score"],
        document["stop"],
        document["by_hand"],
        document["seconds"],
    )
