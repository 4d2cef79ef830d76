"""Bags of ROS 1 and ROS 2 written with `rosbags`, and TUM RGB-D folders, from views."""

from __future__ import annotations

import io
import struct

import numpy as np
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from caryatid.geometry import transforms
from caryatid.io.images import png

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
"""Time of the first frame [ns]."""

DEPTH, INFO, RGB = "/camera/depth/image", "/camera/depth/camera_info", "/camera/rgb/image"
WORLD, BASE, LENS = "map", "base", "optical"


class BagFile:
    """A bag in the making, with messages of either ROS.

    Args:
        path: Where; `.bag` makes a bag of ROS 1, anything else a folder of ROS 2.
        storage: `sqlite3` or `mcap`.
    """

    def __init__(self, path, storage="sqlite3"):
        self.one = path.suffix == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.one else Stores.ROS2_JAZZY)
        if self.one:
            transforms = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
            self.writer = Writer1(path)
        else:
            self.writer = Writer2(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
        self.topics = {}

    def __enter__(self):
        self.writer.__enter__()
        return self

    def __exit__(self, *error):
        self.writer.__exit__(*error)

    def type(self, name):
        return self.store.types[name]

    def write(self, topic, message, time):
        kind = message.__msgtype__
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.one else self.store.serialize_cdr
        self.writer.write(self.topics[topic], time, pack(message, kind))

    def header(self, time, frame):
        stamp = self.type("builtin_interfaces/msg/Time")(sec=time // SECOND, nanosec=time % SECOND)
        first = {"seq": 0} if self.one else {}
        return self.type("std_msgs/msg/Header")(**first, stamp=stamp, frame_id=frame)

    def image(self, time, pixels, encoding, frame=LENS, padding=0, big=False):
        """A raw image from an array (H, W[, C])."""
        rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")))
        rows = rows.view(np.uint8).reshape(len(pixels), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
        return self.type("sensor_msgs/msg/Image")(
            header=self.header(time, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(big),
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, time, data, form):
        data = np.frombuffer(data, dtype=np.uint8)
        kind = self.type("sensor_msgs/msg/CompressedImage")
        return kind(header=self.header(time, LENS), format=form, data=data)

    def camera(self, time, K, size, frame=LENS, D=(0.0,) * 5):
        region = self.type("sensor_msgs/msg/RegionOfInterest")
        region = region(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        P = np.column_stack([K, np.zeros(3)])
        names = ("D", "K", "R", "P") if self.one else ("d", "k", "r", "p")
        matrices = (np.asarray(D, dtype=np.float64), K.ravel(), np.eye(3).ravel(), P.ravel())
        return self.type("sensor_msgs/msg/CameraInfo")(
            header=self.header(time, frame),
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=region,
            **dict(zip(names, matrices, strict=True)),
        )

    def transform(self, time, parent, child, T_parent_child):
        x, y, z, w = Rotation.from_matrix(T_parent_child[:3, :3]).as_quat()
        t = self.type("geometry_msgs/msg/Vector3")(*T_parent_child[:3, 3])
        q = self.type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
        pose = self.type("geometry_msgs/msg/Transform")(translation=t, rotation=q)
        stamped = self.type("geometry_msgs/msg/TransformStamped")
        item = stamped(header=self.header(time, parent), child_frame_id=child, transform=pose)
        return self.type("tf2_msgs/msg/TFMessage")(transforms=[item])


T_BASE_LENS = transforms.rigid(transforms.rotation_from_vector((-1.2, 0.9, -0.4)), (0.1, -0.02, 0.3))
"""Where the camera sits on the robot."""


def write_bag(
    path, views, storage="sqlite3", *, without_pose=(), without_colour=(), depth=None, colour=None, **camera
):
    """Write views as a robot would: depth in mm, colour, camera, poses of the base before and after.

    Other depth and colour images are made by functions of bag and time, another camera by fields of `camera`.
    """
    with BagFile(path, storage) as bag:
        if not views:
            return
        bag.write("/tf_static", bag.transform(START, BASE, LENS, T_BASE_LENS), START)
        bag.write("/chatter", bag.type("std_msgs/msg/String")(data="hello"), START)
        for index, view in enumerate(views):
            time = START + index * SECOND
            T_world_base = view.T_world_camera @ transforms.invert(T_BASE_LENS)
            size = view.depth.shape[::-1]
            if index not in without_pose:
                # The base goes straight and turns evenly from 10 ms before the image to 30 ms after it.
                turn = transforms.rotation_from_vector((0.01, -0.02, 0.03))
                back = transforms.rotation_from_vector((-0.01 / 3, 0.02 / 3, -0.01))
                step = np.array([0.003, -0.006, 0.009])
                for late, R, t in ((-10, back, -step / 3), (30, turn, step)):
                    T = transforms.rigid(T_world_base[:3, :3] @ R, T_world_base[:3, 3] + t)
                    when = time + late * SECOND // 1000
                    bag.write("/tf", bag.transform(when, WORLD, BASE, T), when)
            bag.write(INFO, bag.camera(time, **{"K": view.K, "size": size} | camera), time)
            units = np.rint(view.depth * 1000.0).astype(np.uint16)
            bag.write(DEPTH, depth(bag, time) if depth else bag.image(time, units, "16UC1"), time + 1000)
            if index not in without_colour:
                late = time + SECOND // 200
                bag.write(RGB, colour(bag, late) if colour else bag.image(late, view.rgb, "rgb8"), late)


def write_tum(folder, views):
    """Write views as the TUM RGB-D benchmark does."""
    (folder / "depth").mkdir(parents=True)
    (folder / "rgb").mkdir()
    lists = {name: [f"# {name}", "# file: 'made up'"] for name in ("depth", "rgb", "groundtruth")}
    for index, view in enumerate(views):
        time = f"{1305031102 + index}.160407"
        late = f"{1305031102 + index}.175304"
        units = np.rint(view.depth * 5000.0).astype(np.uint16)
        Image.fromarray(units).save(folder / f"depth/{time}.png")
        Image.fromarray(view.rgb).save(folder / f"rgb/{late}.png")
        lists["depth"].append(f"{time} depth/{time}.png")
        lists["rgb"].append(f"{late} rgb/{late}.png")
        q = Rotation.from_matrix(view.T_world_camera[:3, :3]).as_quat()
        numbers = " ".join(f"{v:.9f}" for v in (*view.T_world_camera[:3, 3], *q))
        lists["groundtruth"].append(f"{time} {numbers}")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")


def jpeg(pixels):
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=95)
    return buffer.getvalue()


def compressed_depth(depth, encoding):
    """Data of a message of the compressedDepth transport: 12 bytes, then a PNG."""
    if encoding == "16UC1":
        return struct.pack("<iff", 0, 0.0, 0.0) + png(np.rint(depth * 1000.0).astype(np.uint16))
    scale, most = 100.0 * 101.0, 10.0
    offset = 1.0 - scale / most
    inverse = np.where(depth > 0.0, scale / np.maximum(depth, 1e-6) + offset, 0.0)
    return struct.pack("<iff", 0, scale, offset) + png(np.rint(inverse).astype(np.uint16))
