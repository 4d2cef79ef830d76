"""The report of `caryatid check`: what is wrong, all views together, and each with its largest plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.config import CloudConfig
from caryatid.graph import SupportGraph
from caryatid.segmentation.diagnosis import Diagnosis, find_image_plane
from caryatid.sensing.clouds import oriented_points
from caryatid.sensing.views import Cloud, View
from caryatid.viz.drawings import draw_cloud, draw_image
from caryatid.viz.report import Figure, Report, Section
from caryatid.viz.tables import Table, count_of, sentence

SHOWN = 12
"""Maximum number of views that are drawn [1]."""
TOGETHER = (
    "Each colour is a view. If units, camera and poses are right, the colours lie on the same surfaces, and "
    "the table is level; otherwise, things are there twice, bent or tilted."
)
"""Text above the pictures of all views."""


def make_check_report(
    title: str, found: Diagnosis, views: Sequence[View], table: Table, config: CloudConfig
) -> Report:
    """Make the report of a diagnosis.

    Args:
        title: Its heading.
        found: What was found out.
        views: Some of the views, in their order.
        table: What each view is.
        config: Which readings are drawn.
    """
    rows, points, normals, labels = {row["view"]: row for row in found.views}, [], [], []
    figures = []
    for number, view in enumerate(views, start=1):
        small = view.every(max(1, view.depth.shape[1] // 320))
        own = find_image_plane(small).mask(small)
        tilt = rows[view.name]["tilt"]
        told = f"largest plane: {rows[view.name]['plane']:.0%} of the readings"
        told += "" if tilt is None else f", tilted by {tilt:.1f}°"
        picture = draw_image(small, number * own.astype(np.int32), SupportGraph(), 340, shapes=False)
        figures.append(Figure(view.name.rpartition("/")[2], picture, told, 4))
        if view.T_world_camera is not None:
            p, n, _ = oriented_points(small, config)
            points.append(p)
            normals.append(n)
            labels.append(np.full(len(p), number, dtype=np.int32))
    together = []
    if points:
        cloud = Cloud(np.concatenate(points), np.concatenate(normals), np.concatenate(labels))
        together = [Figure("", draw_cloud(cloud, SupportGraph(), a)) for a in (np.pi + 0.54, 0.54)]
    wrong = [("Wrong", sentence(problem)) for problem in found.problems]
    answer = f"{count_of(len(wrong), 'fault')} in {count_of(len(found.views), 'view')}."
    doubts = [("Not confirmed", sentence(doubt)) for doubt in found.doubts]
    if not wrong:
        answer = "No fault is certain, but not all is confirmed." if doubts else "No fault was found."
    sections = [Section("Answer", answer, facts=wrong + doubts)]
    sections += [Section("World", TOGETHER, together)] if together else []
    sections += [Section("Images", "The largest plane is tinted.", figures)]
    sections.append(Section("Numbers", tables=[table]))
    return Report(title, "", sections, of_run=False)
