"""`caryatid import`: a few good views of a robot's recording become a scene folder."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.options import DEFAULTS, SAID, Command, Settings, Views, defaults_to

Topic = Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="TOPIC"), SAID]


@dataclass(frozen=True, kw_only=True)
class Import(Command):
    """Turn a robot's recording into a scene folder of sharp views from different viewpoints.

    Reads bags of ROS 1 (.bag) and ROS 2 (.mcap, .db3, or a folder with metadata.yaml), and folders of the
    TUM RGB-D benchmark, which need no topics. Depth must be registered to the colour image.

    To try:
      caryatid import pour.bag --out pour
      caryatid import pour.bag --depth /depth/image --info /depth/camera_info --tf map --out pour
      caryatid import rgbd_dataset_freiburg1_desk --out desk
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Bag, or folder with depth.txt."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Scene folder to write, in the BOP format; must be new or empty."""
    depth: Topic = None
    """Depth images: 16UC1 or mono16 [mm], 32FC1 [m], or PNG-compressed. When left out, they are listed."""
    info: Topic = None
    """Camera of the depth images (CameraInfo)."""
    rgb: Topic = None
    """Colour images that depth is registered to; they also tell how sharp a frame is."""
    tf: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FRAME"), SAID] = None
    """World frame, level with z up, such as map or base_link. When left out: one frame without a pose."""
    camera: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.json"), SAID] = None
    """Camera of a TUM RGB-D folder: fx, fy, cx, cy [px]. When left out: as published."""
    level: Annotated[bool, SAID] = False
    """Rotate the world so that the table is level, for poses whose z does not point up; most views must
    show the table."""
    views: Annotated[Views, defaults_to(DEFAULTS.recording.max_views)] = None
    """Maximum number of views."""
    settings: tyro.conf.OmitArgPrefixes[Settings] = field(default_factory=Settings)

    def __call__(self) -> None:
        """Run the command."""
        config = self.settings.settings()
        from caryatid.cli.output import Progress, write_json
        from caryatid.io.datasets import Topics
        from caryatid.io.importing import import_recording, reasons

        if self.views is not None:
            config = replace(config, recording=replace(config.recording, max_views=self.views))
        progress = Progress(self.general.silent)
        topics = Topics(self.depth, self.info, self.rgb, self.tf)
        with progress.working(f"reading {self.source.name}"):
            imported = import_recording(
                self.source, self.out, topics, camera_file=self.camera, level=self.level, config=config
            )
        if self.general.json:
            views = [
                {"view": n, "frame": f.number, "time": f.time, "posed": f.T_world_camera is not None}
                for n, f in enumerate(imported.chosen)
            ]
            document = {"recording": str(self.out), "frames": imported.read, "views": views}
            write_json(document | {"skipped": imported.skipped, "notes": list(imported.notes)})
        for note in imported.notes:
            progress.say(note)
        skipped = f"; skipped: {reasons(imported.skipped)}" if imported.skipped else ""
        progress.say(f"{self.source.name}: {len(imported.chosen)} views of {imported.read} frames{skipped}")
        progress.say(f"recording: {self.out}, try `caryatid extract {self.out} --out run`")
