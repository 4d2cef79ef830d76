"""Write the package's samples: a recording and a point cloud of the simulated scene `clutter`."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from pypcd4 import Encoding, PointCloud

import caryatid as ct
from caryatid.config import SensorConfig
from caryatid.geometry import transforms
from caryatid.io import read_recording, write_recording
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.simulation import GroundTruth, SimulatedCamera, ground_truth, load_scene, write_truth

SAMPLES = Path(__file__).parents[1] / "src/caryatid/samples"
VIEWS = 8
"""Number of views all around the table, at 40° elevation and 1.2 m from its centre, as a robot could take."""
SENSOR = SensorConfig(width=320, height=240, focal=262.5)
"""Half the resolution of a Carmine."""
THINNED = 0.007
"""Distance between neighbouring points of the cloud [m]."""


def main() -> None:
    """Write both samples, and print their size."""
    shutil.rmtree(SAMPLES, ignore_errors=True)
    scene = load_scene("clutter")
    camera = SimulatedCamera(scene, "carmine", rng=np.random.default_rng(0), sensor=SENSOR)
    centre_world = np.array([0.0, 0.0, 0.75])
    views = []
    for azimuth in np.pi + 2.0 * np.pi * np.arange(VIEWS) / VIEWS:
        out_world = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(np.radians(40.0))])
        eye_world = centre_world + 1.2 * transforms.unit(out_world)
        views.append(camera.capture(transforms.look_at(eye_world, centre_world)))
    folder = SAMPLES / "sample-recording"
    write_recording(folder, views)
    names = {scene.table: "table"} | {body: f"object{label}" for label, body in scene.object_bodies.items()}
    truth = ground_truth(scene)
    edges = (replace(e, supporter=names[e.supporter], supported=names[e.supported]) for e in truth.edges)
    write_truth(GroundTruth(tuple(names[v] for v in truth.vertices), tuple(edges)), folder / "gt.json")

    config = ct.Config()
    model = ct.Scene(replace(config, cloud=replace(config.cloud, voxel=THINNED)))
    for view in read_recording(folder):
        model.update(view)
    cloud = model.cloud.moved(transforms.invert(views[0].pose))  # cloud files are in the sensor's frame
    assert cloud.labels is not None
    labels = np.where(cloud.labels < SUPPORT_LABEL, cloud.labels, 0)
    # Half of the points on objects and a third of those on the table are enough.
    near = np.linalg.norm(model.cloud.points_world[:, :2], axis=1) < 0.5
    kept = near & (np.arange(len(cloud)) % np.where(labels > 0, 2, 3) == 0)
    columns = np.concatenate([cloud.points_world, cloud.normals_world, labels[:, None]], axis=1)[kept]
    fields = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "label")
    types = (np.float32,) * 6 + (np.uint16,)
    stored = PointCloud.from_points(columns, fields, types)
    stored.save(SAMPLES / "sample-cloud.pcd", encoding=Encoding.BINARY_COMPRESSED)
    size = sum(file.stat().st_size for file in SAMPLES.rglob("*") if file.is_file())
    print(f"{SAMPLES.name}: {len(views)} views, {len(columns)} points, {size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
