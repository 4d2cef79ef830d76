"""Views as the apps of phones record them: colour has twice the pixels of depth, and the world is y up."""

from __future__ import annotations

import json

import numpy as np
from bag_files import jpeg
from scipy.spatial.transform import Rotation

from caryatid.io.images import png

Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From a world with z up to that of ARKit, whose z points to the viewer: x stays, z becomes y."""


def opengl(T_world_camera):
    """The pose of a camera that looks along −z with y up."""
    T = np.array(T_world_camera)
    T[:3, 1:3] *= -1.0
    return T


def twice(image):
    return image.repeat(2, axis=0).repeat(2, axis=1)


def lens(K):
    """Intrinsics of the colour image, twice as large."""
    large = 2.0 * K
    large[:2, 2] += 0.5
    large[2, 2] = 1.0
    return large


def millimetres(view):
    return png(np.rint(1000.0 * view.depth).astype(np.uint16))


def numbers(T):
    """Translation and quaternion, w last."""
    return [*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat().tolist()]


def write_nerfstudio(folder, views, **changes):
    """Write transforms.json and its images."""
    folder.mkdir()
    frames = []
    for number, view in enumerate(views):
        (folder / f"{number}.jpg").write_bytes(jpeg(twice(view.rgb)))
        (folder / f"{number}.png").write_bytes(millimetres(view))
        paths = {"file_path": f"./{number}.jpg", "depth_file_path": f"{number}.png"}
        frames.append(paths | {"transform_matrix": opengl(view.pose).tolist()})
    K, (h, w) = lens(views[0].K), twice(views[0].depth).shape
    camera = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": w, "h": h}
    (folder / "transforms.json").write_text(json.dumps(camera | {"frames": frames} | changes))


def write_record3d(folder, views, **changes):
    """Write an unzipped .r3d."""
    import lzfse

    (folder / "rgbd").mkdir(parents=True)
    for number, view in enumerate(views):
        metres = np.where(view.depth > 0.0, view.depth, np.nan).astype("<f4")
        (folder / f"rgbd/{number}.jpg").write_bytes(jpeg(twice(view.rgb)))
        (folder / f"rgbd/{number}.depth").write_bytes(lzfse.compress(metres.tobytes()))
    poses = [numbers(opengl(Y_UP @ view.pose)) for view in views]
    (h, w), (dh, dw) = twice(views[0].depth).shape, views[0].depth.shape
    known = {"K": lens(views[0].K).T.ravel().tolist(), "w": w, "h": h, "dw": dw, "dh": dh, "fps": 1.0}
    known |= {"poses": [[*pose[3:], *pose[:3]] for pose in poses]}
    (folder / "metadata").write_text(json.dumps(known | changes))


def write_stray(folder, views, **changes):
    """Write a folder of Stray Scanner, whose poses are those of optical frames."""
    import av

    for name in ("depth", "confidence"):
        (folder / name).mkdir(parents=True)
    (h, w), trust = twice(views[0].depth).shape, np.full(views[0].depth.shape, 2, dtype=np.uint8)
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    trust[:2] = 0
    with av.open(str(folder / "rgb.mp4"), "w") as video:
        stream = video.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.bit_rate = w, h, 10_000_000
        for number, view in enumerate(views):
            frame = av.VideoFrame.from_ndarray(twice(view.rgb), format="rgb24")
            video.mux(stream.encode(frame))
            (folder / f"depth/{number:06d}.png").write_bytes(millimetres(view))
            (folder / f"confidence/{number:06d}.png").write_bytes(png(trust))
            pose = ", ".join(f"{value:.9f}" for value in numbers(Y_UP @ view.pose))
            rows.append(f"{1000.0 + number}, {number:06d}, {pose}")
        video.mux(stream.encode())
    camera = "\n".join(", ".join(map(str, row)) for row in lens(views[0].K))
    tables = {"odometry.csv": "\n".join(rows), "camera_matrix.csv": camera} | changes
    for name, text in tables.items():
        (folder / name).write_text(text)
