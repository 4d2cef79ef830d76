"""The loop for Rerun and Foxglove, view by view: sent to Rerun's viewer, or recorded as .rrd or .mcap."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from caryatid.errors import InputError, needs_extra
from caryatid.exploration import Step
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.staging import write_file
from caryatid.sensing.views import Cloud, View
from caryatid.viz.colours import NOTHING_COLOUR, label_colours, object_colour, rgb
from caryatid.viz.pictures import THEME
from caryatid.viz.scene_3d import LETTER, make_arrow, support_arrow
from caryatid.viz.tables import happenings

STREAMS = (".rrd", ".mcap")
"""Suffixes of recordings, for Rerun and Foxglove."""

CHANNELS = ("red", "green", "blue", "alpha")


class Body(NamedTuple):
    """A mesh (`trimesh.Trimesh`) in its own frame, its pose (4, 4), colour and opacity 0…255, and a text."""

    mesh: Any
    T_world_body: Array
    colour: tuple[int, int, int, int]
    text: str


Shown = View | Body | Cloud | NDArray[Any] | float | list[str]
"""A camera, a body, points, an image (colours uint8, depths [m] float32, labels int32), F1, or texts."""


def show_step(step: Step, before: Step | None, f1: float | None) -> Iterator[tuple[str, Shown]]:
    """List what is shown of a step, by name; the step before tells what is new."""
    view, graph = step.view, step.graph
    if view is not None:
        if view.T_world_camera is not None:
            yield "camera", view
        if view.rgb is not None:
            yield "camera/colour", view.rgb
        yield "camera/depth", view.depth
        yield "camera/segments", step.labels
    if step.decision is not None and step.stop is None:
        ahead = make_arrow(np.zeros(3), np.array([0.0, 0.0, 0.15]), 0.005)
        yield "next", Body(ahead, step.decision.T_world_camera, (*rgb(THEME["line"]), 255), "next")
    yield "cloud", step.cloud
    for item in graph.objects:
        colour = (*rgb(object_colour(item.label)), 140 if item.role == "object" else 255)
        yield f"objects/{item.id}", Body(item.shape.mesh(), item.shape.T_world_object, colour, item.title)
    for support in graph.supports:
        if (arrow := support_arrow(support, graph)) is not None:
            T = transforms.rigid(np.eye(3), arrow.bounds.mean(axis=0))
            arrow.apply_transform(transforms.invert(T))
            text = f"{'' if support.kind == 'bottom-up' else f'{support.kind} '}{support.belief:.2f}"
            colour = (*rgb(THEME["doubt" if support.doubtful else "line"]), 255)
            yield f"supports/{support.supporter}/{support.supported}", Body(arrow, T, colour, text)
    if f1 is not None:
        yield "f1", float(f1)
    told = happenings(before, step)
    if before is not None and before.index == step.index:  # Only why it is the last is new.
        told = told[-1:]
    yield "log", [f"{what}: {text}" for what, text in told]


class Stream:
    """Shows steps in Rerun's viewer, or records them as they come; closes at the end of a `with` block.

    Each view is a point of Rerun's timeline `view`, and a second of a .mcap file, counted from 1.

    Args:
        target: A file .rrd or .mcap, which is replaced; or `rerun`: the viewer, started if none runs here.

    Raises:
        InputError: It is neither, an extra is missing, or the file or viewer cannot be opened.
    """

    def __init__(self, target: str | Path) -> None:
        self._before: Step | None = None
        path = Path(target)
        if path.suffix not in STREAMS and str(path) != "rerun":
            raise InputError(path, "is not a stream", f"give a file {' or '.join(STREAMS)}, or rerun")
        self._writer = _Foxglove(path) if path.suffix == ".mcap" else _Rerun(path)

    def add(self, step: Step, f1: float | None = None) -> None:
        """Show a step in place of the one before, with its F1 if the ground truth is known."""
        self._writer.write(step, dict(show_step(step, self._before, f1)))
        self._before = step

    def close(self) -> None:
        """Finish the recording."""
        self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _Rerun:
    """Writes entities of Rerun: `world/NAME`, and `f1` and `log`."""

    def __init__(self, target: Path) -> None:
        with needs_extra("rerun", target):
            import rerun
            import rerun.blueprint as rrb
        self._rr, self._recording = rerun, rerun.RecordingStream("caryatid", recording_id=uuid4())
        self.close = self._recording.disconnect
        self._recording.set_log_time_enabled(False)
        self._recording.set_log_tick_enabled(False)
        if str(target) == "rerun":
            try:
                self._recording.spawn()
                self._recording.flush(timeout_sec=10.0)
            except RuntimeError as error:
                remedy = "start `rerun` on this machine, which needs a display, or give a file .rrd"
                raise InputError(target, "the viewer does not answer", remedy) from error
        else:
            write_file(target, b"")  # Says why it cannot be written.
            self._recording.save(target)
        self._recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._names, self._classes = set[str](), {0: (0, "nothing", rgb(NOTHING_COLOUR))}
        covering, unseen = ("world/cloud", "world/camera/depth"), rrb.EntityBehavior(visible=False)
        image = rrb.Spatial2DView(origin="world/camera", contents=["$origin/colour", "$origin/segments"])
        beside = rrb.Vertical(image, rrb.TextLogView(), rrb.TimeSeriesView())
        scene = rrb.Spatial3DView(origin="world", overrides=dict.fromkeys(covering, unseen))
        self._recording.send_blueprint(rrb.Horizontal(scene, beside, column_shares=[2, 1]))

    def write(self, step: Step, items: dict[str, Shown]) -> None:
        rr, log = self._rr, self._recording.log
        self._recording.set_time("view", sequence=step.index + 1)
        for name in self._names - items.keys():
            log(f"world/{name}", rr.Clear(recursive=True))
        self._names = set(items)
        known = {o.label: (o.label, o.title, rgb(object_colour(o.label))) for o in step.graph.objects}
        self._classes |= known  # All so far: Rerun takes them only from what is static.
        log("world", rr.AnnotationContext([*self._classes.values()]), static=True)
        for name, item in items.items():
            place = f"world/{name}"
            match item:
                case View(K=K, depth=depth):
                    pinhole = rr.Pinhole(image_from_camera=K, width=depth.shape[1], height=depth.shape[0])
                    log(place, self._pose(item.pose), pinhole)
                case Body(mesh, T, colour, text):
                    corners = {"vertex_positions": mesh.vertices, "triangle_indices": mesh.faces}
                    log(place, self._pose(T), rr.Mesh3D(albedo_factor=colour, **corners))
                    white = {"colors": [(255, 255, 255)], "radii": [0.0]}
                    log(f"{place}/name", rr.Points3D([(0.0, 0.0, 0.0)], labels=[text], **white))
                case Cloud(points_world=points, labels=labels):
                    log(place, rr.Points3D(points, class_ids=labels, radii=[0.0015]))
                case float():
                    log(name, rr.Scalars(item))
                case list():
                    for text in item:
                        log(name, rr.TextLog(text))
                case np.ndarray(dtype=np.uint8):
                    log(place, rr.Image(item))
                case np.ndarray(dtype=np.float32):
                    log(place, rr.DepthImage(item, meter=1.0))
                case _:
                    log(place, rr.SegmentationImage(item.astype(np.uint16)))

    def _pose(self, T: Array) -> Any:
        return self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


class _Foxglove:
    """Writes topics of Foxglove; each message of `/scene` is whole, so that a player can jump to any view."""

    def __init__(self, target: Path) -> None:
        with needs_extra("foxglove", target):
            import foxglove
            from foxglove import channels, messages
        self._channels, self._kinds, self._of = dict[str, Any](), channels, messages
        self._context, self._any = foxglove.Context(), partial(foxglove.Channel, message_encoding="json")
        write_file(target, b"")
        self.close = foxglove.open_mcap(target, allow_overwrite=True, context=self._context).close

    def write(self, step: Step, items: dict[str, Shown]) -> None:
        of, seconds, entities = self._of, step.index + 1, []
        now = {"timestamp": of.Timestamp(seconds)}
        world, camera = now | {"frame_id": "world"}, now | {"frame_id": "camera"}

        def send(topic: str, message: Any) -> None:
            if topic not in self._channels:
                kind = getattr(self._kinds, f"{type(message).__name__}Channel", None)
                self._channels[topic] = (kind or self._any)(f"/{topic}", context=self._context)
            self._channels[topic].log(message, log_time=10**9 * seconds)

        for name, item in items.items():
            match item:
                case View(K=K, depth=depth):
                    place, turn = self._place(item.pose)
                    frames = {"parent_frame_id": "world", "child_frame_id": "camera"}
                    send("tf", of.FrameTransform(**now, **frames, translation=place, rotation=turn))
                    size = {"width": depth.shape[1], "height": depth.shape[0]}
                    matrices = {"K": [*K.ravel()], "P": [*(K @ np.eye(3, 4)).ravel()]}
                    send(name, of.CameraCalibration(**camera, **size, **matrices))
                case Body(mesh, T, colour, text):
                    place, turn = self._place(T)
                    pose = of.Pose(position=place, orientation=turn)
                    r, g, b, opacity = (channel / 255.0 for channel in colour)
                    points = [of.Point3(x=x, y=y, z=z) for x, y, z in mesh.vertices]
                    faces = {"points": points, "indices": [*mesh.faces.ravel()]}
                    paint = of.Color(r=r, g=g, b=b, a=opacity)
                    body = of.TriangleListPrimitive(pose=pose, color=paint, **faces)
                    look = {"billboard": True, "font_size": LETTER, "color": of.Color(r=1, g=1, b=1, a=1)}
                    plate = of.TextPrimitive(pose=pose, text=text, **look)
                    entities.append(of.SceneEntity(**world, id=name, triangles=[body], texts=[plate]))
                case Cloud(points_world=points_world, labels=np.ndarray() as labels):
                    colours = np.insert(label_colours(labels), 3, 255, axis=1)
                    data = np.hstack([np.ascontiguousarray(points_world, "<f4").view(np.uint8), colours])
                    kinds = of.PackedElementFieldNumericType
                    axes = {axis: (4 * i, kinds.Float32) for i, axis in enumerate("xyz")}
                    parts = axes | {c: (12 + i, kinds.Uint8) for i, c in enumerate(CHANNELS)}
                    fields = [
                        of.PackedElementField(name=n, offset=at, type=k) for n, (at, k) in parts.items()
                    ]
                    packed = {"point_stride": data.shape[1], "fields": fields, "data": data.tobytes()}
                    send(name, of.PointCloud(**world, **packed))
                case float():
                    send(name, {name: item})
                case list():
                    for text in item:
                        send(name, of.Log(**now, level=of.LogLevel.Info, message=text))
                case np.ndarray():
                    image = label_colours(item) if item.dtype == np.int32 else item
                    size = {"height": len(image), "width": image.shape[1], "step": image.nbytes // len(image)}
                    encoding = "32FC1" if image.dtype == np.float32 else "rgb8"
                    send(name, of.RawImage(**camera, **size, encoding=encoding, data=image.tobytes()))
        before = of.SceneEntityDeletion(**now, type=of.SceneEntityDeletionType.All)
        send("scene", of.SceneUpdate(deletions=[before], entities=entities))

    def _place(self, T: Array) -> tuple[Any, Any]:
        """A pose (4, 4) as Foxglove writes it: position and quaternion."""
        turn = Rotation.from_matrix(T[:3, :3]).as_quat()
        parts = zip("xyz", T[:3, 3], strict=True), zip("xyzw", turn, strict=True)
        return self._of.Vector3(**dict(parts[0])), self._of.Quaternion(**dict(parts[1]))
